"""Light between splats and surfaces by probes and mirrored cameras, against that by rays."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from support.kernels import kernel_hashes
from support.lit_scenes import FAR_AWAY, camera, scene_of
from support.reference_lenses import gaussians_at

import drgs  # noqa: F401  (registers the plugins)
from drgs.core.errors import PluginError
from drgs.integrator.light.mirrors import FlatMirror, Mirrors
from drgs.light.probe import Probes
from drgs.reference import splatting
from drgs.results import metrics

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
    return gaussians_at(means, size, 0.99, 0.5 + 0.4 * np.sin(2 * means))


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
    splats = gaussians_at(rng.uniform(-1, 1, (30, 3)) * [1, 1, 0.3] + [0, 0, 1.5], 0.4, 0.3, 0.0)
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
        unseen: render(splats, light="probe", probes="ball", probe_fallback=unseen, **settings)
        for unseen in ("none", "rays")
    }
    np.testing.assert_array_equal(found["rays"], render(splats, light="rays", **settings))
    nothing = render(splats, light="none", nested="splatpath", **settings)
    np.testing.assert_array_equal(found["none"], nothing)


def test_probes_see_smoothed_gaussians():
    """A filter of 0.2 makes Gaussians of 0.1 as large as those of 0.224, and fainter."""
    means = around(60).means
    wide = gaussians_at(means, np.hypot(0.1, 0.2), 0.9 * (0.1 / np.hypot(0.1, 0.2)) ** 3, 0.8)
    settings = {"light": "probe", "probes": "ball", "spp": 4, **mirror_ball()}
    smoothing = mi.Float(np.full(len(means), 0.2, np.float32))
    smoothed = render(gaussians_at(means, 0.1, 0.9, 0.8), smoothing=smoothing, **settings)
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
    with pytest.raises(RuntimeError, match="probe_fallback must be one of none, rays, got 'guess'"):
        scene(probes="ball", probe_fallback="guess")
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


SKY = {"type": "constant", "id": "sky"}


# ----------------------------------------------------------------------------------------------
# Flat mirrors
# ----------------------------------------------------------------------------------------------


EYE, TARGET = [0.3, 1.0, -2.6], [0, -0.7, 0]


def at(x, y, z):
    return mi.ScalarTransform4f().translate([x, y, z])


def floor(**changes):
    to_world = mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale([-3, 3, 5])
    return {"type": "rectangle", "to_world": to_world, "bsdf": MIRROR, **changes}


def wall():
    """Return a wall of another metal: Mitsuba would merge equal ones."""
    to_world = at(0, 0, 1.2) @ mi.ScalarTransform4f().rotate([1, 0, 0], 180).scale(2)
    bsdf = {"type": "conductor", "material": "Al"}
    return {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "twosided", "b": bsdf}}


def cloud(y=0.9, x=0.0, count=60):
    rng = np.random.default_rng(7)
    means = rng.uniform(-0.4, 0.4, (count, 3)) + np.array([x, y, 0])
    return gaussians_at(means, 0.12, 0.95, rng.random((count, 3)))


def scene(light="probe", splats=None, probes="floor", **others):
    settings = {"probes": probes} if light == "probe" else {"light_samples": 0}
    objects = {"floor": floor(), "sensor": camera(EYE, TARGET), **others}
    splats = cloud() if splats is None else splats
    return scene_of(splats, light=light, spp=16, max_depth=4, **settings, **objects)


def rendered(*arguments, **others):
    return np.array(mi.render(scene(*arguments, **others), seed=3), np.float64)


def images_by_light(probes="floor", **others):
    """Images without light, with probes, and with rays."""
    own = rendered(None, **others), rendered(probes=probes, **others)
    return *own, rendered("rays", **others)


@pytest.mark.slow
def test_mirror_matches_the_mirrored_camera(monkeypatch):
    """40 dB of the float64 reference, of which much is the noise of 64 paths: rays have 43."""
    monkeypatch.syspath_prepend(REPOSITORY / "scenes")
    import flat_mirror

    splats = flat_mirror.cloud(100)
    expected = flat_mirror.mirrored_camera(splats, 24)
    found = {name: flat_mirror.render(splats, 24, way) for name, way in flat_mirror.LIGHTS.items()}
    for name in ("probe", "rays, all splats"):
        assert metrics.psnr(found[name], expected) > 40, name
        assert found[name].mean() == pytest.approx(expected.mean(), rel=0.01), name
    assert metrics.psnr(found["none"], expected) < 20


def sensor(to_world=None, film=None, **others) -> dict:
    """Another one at the camera's place."""
    own = camera(EYE, TARGET)
    own |= {"to_world": own["to_world"] @ (to_world or mi.ScalarTransform4f())}
    return (
        {k: v for k, v in own.items() if k != "fov"} | others | {"film": own["film"] | (film or {})}
    )


def batch():
    one, other = camera(EYE, TARGET), camera([-1, 1.2, -2.4], TARGET)
    return sensor(type="batch", one=one, other=other, film={"width": 48})


def pane():
    to_world = mi.ScalarTransform4f().look_at([0.2, 0.6, -1.6], TARGET, [0, 1, 0]).scale(3)
    return {"type": "rectangle", "to_world": to_world, "bsdf": {"type": "thindielectric"}}


LENS = {"aperture_radius": 0.05, "focus_distance": 3.4}
BENT = {"lens": "fisheye", "fx": 33.0, "fy": 33.0, "cx": 12.0, "cy": 12.0, "k1": 0.1}
CROP = {"crop_offset_x": 3, "crop_offset_y": 7, "crop_width": 17, "crop_height": 12}

KINDS = {
    "a disk": lambda: {"floor": floor(type="disk")},
    "under a sky": lambda: {"sky": {"type": "constant", "radiance": 0.5}},
    "cut by the mirror": lambda: {"splats": cloud(0.1)},
    "behind": lambda: {
        "splats": cloud(-0.9),
        "floor": floor(bsdf={"type": "twosided", "bsdf": MIRROR}),
        "sensor": camera([0.3, -1.0, -2.6], [0, 0.7, 0]),
    },
    "through a pane": lambda: {"pane": pane()},
    "a ball among the splats": lambda: {
        "ball": {"type": "sphere", "center": [0.1, 0.9, 0], "radius": 0.3}
    },
    "thinlens": lambda: {"sensor": sensor(type="thinlens", fov=40, **LENS)},
    "orthographic": lambda: {
        "sensor": sensor(mi.ScalarTransform4f().scale(1.2), type="orthographic")
    },
    "fisheye": lambda: {"sensor": sensor(type="calibrated", **BENT)},
    "crop": lambda: {"sensor": sensor(film=CROP, fov=40)},
    "batch": lambda: {"sensor": batch()},
    "far away": lambda: {
        "splats": cloud(0.9, x=100),
        "floor": floor(to_world=at(100, 0, 0) @ floor()["to_world"]),
        "sensor": camera([100.3, 1.0, -2.6], [100, -0.7, 0]),
    },
}


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_flat_mirror_matches_traced_rays(kind):
    """46 dB, between texels; without light there are less than 24."""
    none, probe, rays = images_by_light(**KINDS[kind]())
    assert metrics.psnr(probe, rays) > 46
    assert metrics.psnr(none, rays) < 24


@pytest.mark.slow
def test_rough_and_nested_mirrors_use_the_mirrored_camera():
    """Both are approximate; from the middles of the objects, there are 25 and 29 dB."""
    rough = {"floor": floor(bsdf={"type": "roughconductor", "alpha": 0.1})}
    for probes, objects, least in (("floor", rough, 29), ("floor, wall", {"wall": wall()}, 34)):
        none, probe, rays = images_by_light(probes, **objects)
        assert metrics.psnr(probe, rays) > least
        assert metrics.psnr(none, rays) < 24


CACHED = {
    "probe": (
        Probes,
        lambda: scene_of(around(20), light="probe", probes="ball", spp=1, **mirror_ball()),
        ("integrator.sh0", "ball.to_world"),
    ),
    "mirror": (
        Mirrors,
        lambda: scene(ball={"type": "sphere", "radius": 0.3, "to_world": at(0.1, 0.9, 0)}),
        ("integrator.sh0", "ball.to_world", "sensor.to_world", "floor.to_world"),
    ),
}
"""The class that renders the cached image, a scene, and the parameters on which it depends."""


@pytest.mark.slow
@pytest.mark.parametrize("name", CACHED)
def test_probes_and_mirrors_are_cached_until_the_scene_changes(name, monkeypatch):
    kind, load, keys = CACHED[name]
    counts, render = [], kind.render
    monkeypatch.setattr(kind, "render", lambda *values: counts.append(1) or render(*values))
    found = load()
    mi.render(found)
    mi.render(found, seed=1)
    assert len(counts) == 1
    for number, key in enumerate(keys, 2):
        params = mi.traverse(found)
        if key.endswith("to_world"):
            params[key] = params[key] @ mi.Transform4f().translate([0.1, 0, 0.1])
        else:
            params[key] = params[key] + 0.3
        params.update()
        kept = np.array(mi.render(found, seed=2))
        assert len(counts) == number, key
        found.integrator().state.cache.kept.clear()
        np.testing.assert_array_equal(mi.render(found, seed=2), kept, err_msg=key)
        counts.pop()


def test_camera_motion_needs_no_new_kernels():
    found, kernels = scene(), []
    for _ in range(3):
        params = mi.traverse(found)
        step = mi.Transform4f().translate(mi.Point3f(dr.opaque(mi.Float, 0.05), 0, 0))
        params["sensor.to_world"] = step @ params["sensor.to_world"]
        params.update()
        kernels.append(kernel_hashes(lambda: dr.eval(mi.render(found))))
    assert kernels[2] == kernels[1]


def test_flat_shapes_are_recognised_by_their_vertices():
    def plane(shape):
        return FlatMirror.from_shape(mi.load_dict(shape | {"bsdf": MIRROR}))

    turned = at(1, 2, 3) @ mi.ScalarTransform4f().rotate([0, 1, 0], 30).scale([2, -3, 1])
    normal = np.array([0.5, 0, np.sqrt(0.75)])
    for kind in ("rectangle", "disk"):
        found = plane({"type": kind, "to_world": turned})
        sign = np.sign(found.offset)
        np.testing.assert_allclose(sign * np.array(found.normal), normal, atol=1e-6)
        assert abs(found.offset) == pytest.approx(normal @ [1, 2, 3], abs=1e-5)
        assert (found.has_delta, found.is_specular) == (True, True)
    for kind in ("cube", "sphere", "cylinder"):
        assert plane({"type": kind, "to_world": at(0, 0, 1)}) is None
    lamp = {"type": "rectangle", "emitter": {"type": "area"}}
    assert plane(lamp) is None


@pytest.mark.parametrize(
    ("bsdf", "has_delta", "is_specular"),
    [("plastic", True, False), ("dielectric", True, False), ("roughconductor", False, True)],
)
def test_scattered_reflections_do_not_read_the_mirrored_image(bsdf, has_delta, is_specular):
    found = FlatMirror.from_shape(mi.load_dict(floor(bsdf={"type": bsdf})))
    assert (found.has_delta, found.is_specular) == (has_delta, is_specular)
    assert FlatMirror.from_shape(mi.load_dict(floor(bsdf={"type": "diffuse"}))) is None
