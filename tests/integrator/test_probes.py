"""Light between splats and surfaces by probes, against that by rays."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.lit_scenes import FAR_AWAY, camera, gaussians, scene_of

import drgs  # noqa: F401  (registers the plugins)
from drgs.core.errors import PluginError, UnsupportedError
from drgs.light.probe import Probes
from drgs.reference import splatting

MIRROR = {"type": "conductor", "material": "none"}


def mirror_ball(**others):
    return {
        "ball": {"type": "sphere", "id": "ball", "radius": 0.5, "bsdf": MIRROR},
        "sensor": camera([0, 0, 4], [0, 0, 0], fov=15),
        **others,
    }


def around(count=3000, seed=0, distance=2.5, size=0.1):
    """Colourful splats around the origin, none before the camera."""
    rng = np.random.default_rng(seed)
    towards = rng.normal(size=(count, 3))
    towards *= distance / np.linalg.norm(towards, axis=1, keepdims=True)
    kept = (towards[:, 2] < 0.9 * distance) | (distance < 0.5)
    means = towards[kept]
    return gaussians(means, size, 0.99, 0.5 + 0.4 * np.sin(2 * means))


def render(splats, seed=0, **settings):
    return np.array(mi.render(scene_of(splats, **settings), seed=seed))


def test_mirror_ball_matches_traced_rays():
    """30 dB, of which the noise of drawn splats is no part."""
    splats = around()
    rays = render(splats, spp=16, light_samples=0, **mirror_ball())
    probe = render(splats, light="probe", probes="ball", spp=16, **mirror_ball())
    none = render(splats, light="none", spp=16, **mirror_ball())
    errors = [((rendered - rays) ** 2).mean() for rendered in (probe, none)]
    assert errors[0] < 1e-3 < 0.02 < errors[1]


@pytest.mark.slow
def test_lamp_with_a_probe_is_dimmed_by_fog():
    """Fog before the lamp dims it by its alpha; up to 0.01, as rays with four times that."""
    rng = np.random.default_rng(1)
    splats = gaussians(rng.uniform(-1, 1, (30, 3)) * [1, 1, 0.3] + [0, 0, 1.5], 0.4, 0.3, 0.0)
    wall = {
        "wall": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(2)},
        "lamp": {"type": "point", "id": "lamp", "position": [0.5, 0.3, 3], "intensity": 10.0},
        # Beside the fog: its own splats would be before the wall.
        "sensor": camera([6, 0, 2], [0, 0, 0], size=12, fov=10),
    }
    settings = {"max_depth": 2, **wall}
    bright = render(FAR_AWAY, spp=256, **settings)
    rays = render(splats, spp=4096, **settings) / bright
    probe = render(splats, light="probe", probes="lamp", spp=256, **settings) / bright
    assert rays.min() < 0.4
    np.testing.assert_allclose(probe.mean(2), rays.mean(2), atol=0.03)


def test_objects_without_a_probe_see_no_splats():
    # Inside the ball, where no ray comes.
    other = {"other": {"type": "sphere", "radius": 0.1, "id": "other"}}
    none = render(around(), light="none", nested="splatpath", spp=4, **mirror_ball(**other))
    probe = render(around(), light="probe", probes="other", spp=4, **mirror_ball(**other))
    np.testing.assert_array_equal(probe, none)


def test_rays_unknown_to_a_probe_are_empty_or_traced():
    """Splats in the ball hide all others from the probe, and none from its rays."""
    parts = [vars(around()), vars(around(count=400, distance=0.3, size=0.08))]
    splats = splatting.Gaussians(**{k: np.concatenate([p[k] for p in parts]) for k in parts[0]})
    settings = {"spp": 4, **mirror_ball()}
    found = {
        unseen: render(splats, light="probe", probes="ball", unseen=unseen, **settings)
        for unseen in ("none", "rays")
    }
    np.testing.assert_array_equal(found["rays"], render(splats, light="rays", **settings))
    nothing = render(splats, light="none", nested="splatpath", **settings)
    np.testing.assert_array_equal(found["none"], nothing)


def test_probes_are_cached_until_the_scene_changes(monkeypatch):
    counts, render = [], Probes.render
    monkeypatch.setattr(Probes, "render", lambda *values: counts.append(1) or render(*values))
    scene = scene_of(around(20), light="probe", probes="ball", spp=1, **mirror_ball())
    changes = {
        "integrator.sh0": lambda sh0: sh0 + 0.1,
        "ball.to_world": lambda to_world: mi.Transform4f().translate([0, 0.1, 0]),
    }
    mi.render(scene)
    mi.render(scene, seed=1)
    assert len(counts) == 1
    for number, (name, changed) in enumerate(changes.items(), 2):
        params = mi.traverse(scene)
        params[name] = changed(params[name])
        params.update()
        mi.render(scene)
        mi.render(scene)
        assert len(counts) == number, name


def test_probes_see_smoothed_gaussians():
    """A filter of 0.2 makes Gaussians of 0.1 as large as those of 0.224, and fainter."""
    means = around(60).means
    wide = gaussians(means, np.hypot(0.1, 0.2), 0.9 * (0.1 / np.hypot(0.1, 0.2)) ** 3, 0.8)
    settings = {"light": "probe", "probes": "ball", "spp": 4, **mirror_ball()}
    smoothing = mi.Float(np.full(len(means), 0.2, np.float32))
    smoothed = render(gaussians(means, 0.1, 0.9, 0.8), smoothing=smoothing, **settings)
    np.testing.assert_allclose(smoothed, render(wide, **settings), atol=1e-3)


@pytest.mark.slow
def test_objects_too_close_to_splats_give_one_warning():
    """A splat is nearer to the middle than 1.25 radii; changes repeat no warning."""
    lines = []

    class Lines(mi.Appender):
        def append(self, level, text):
            lines.append(text)

        def log_progress(self, *others):
            pass

    logger, appender = mi.logger(), Lines()
    logger.add_appender(appender)
    try:
        for distance, count in ((0.6, 1), (1.5, 1)):
            found = scene_of(
                around(distance=distance), light="probe", probes="ball", **mirror_ball()
            )
            for seed in range(2):
                params = mi.traverse(found)
                params["integrator.sh0"] = params["integrator.sh0"] + 0.1
                params.update()
                mi.render(found, spp=1, seed=seed)
            assert sum("'ball' has splats so close" in line for line in lines) == count
    finally:
        logger.remove_appender(appender)


def test_invalid_probe_settings_are_refused():
    def scene(**settings):
        return scene_of(around(4), light="probe", **settings, **mirror_ball(sky=SKY))

    with pytest.raises(RuntimeError, match="probes must be ids of shapes and emitters, got none"):
        scene()
    with pytest.raises(RuntimeError, match="unseen must be one of none, rays, got 'guess'"):
        scene(probes="ball", unseen="guess")
    for name, message in (("bowl", "got 'bowl'; there are sky, ball"), ("sky", "infinitely far")):
        found = scene(probes=f"ball, {name}")
        with pytest.raises(PluginError, match=message):
            found.integrator().render(found)
    twins = {name: {"type": "rectangle", "id": name, "bsdf": MIRROR} for name in ("a", "b")}
    found = scene_of(around(4), light="probe", probes="a", **twins, **mirror_ball())
    with pytest.raises(
        PluginError, match=r"got 'a'; there are .*load the scene with optimize=False"
    ):
        found.integrator().render(found)
    found = scene(probes="ball")
    params = mi.traverse(found)
    dr.enable_grad(params["integrator.means"])
    params.update()
    with pytest.raises(UnsupportedError, match="light 'probe'"):
        dr.backward(dr.mean(mi.render(found, params).array))


SKY = {"type": "constant", "id": "sky"}
