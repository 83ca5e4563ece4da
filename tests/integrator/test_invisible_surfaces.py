"""Surfaces that let all light pass change no image, wherever they are."""

from functools import cache

import mitsuba as mi
import numpy as np
import pytest
from support.lit_scenes import camera, scene_of
from support.reference_lenses import gaussians_at
from support.views import image_of

import drgs  # noqa: F401  (registers the plugins)

ROUNDING = 4e-4
"""Mitsuba moves rays that go on from a surface by 1e-4: so much is the shift of what they see."""

PANES = {
    "null": {"type": "null"},
    "mask": {"type": "mask", "opacity": 0.0, "bsdf": {"type": "diffuse"}},
    "thindielectric": {"type": "thindielectric", "int_ior": 1.0, "ext_ior": 1.0},
}


@cache
def cloud():
    """Soft splats of many colours, between a camera at z = 4 and a wall at z = -2."""
    rng = np.random.default_rng(5)
    means = rng.uniform(-0.8, 0.8, (30, 3))
    return gaussians_at(means, 0.3, 0.4, rng.uniform(0, 1, (30, 3)))


def plane(z, bsdf) -> dict:
    """A square across the axis along which the camera looks; 16 wide."""
    return {"type": "rectangle", "z": z, "bsdf": bsdf}


SKY = {"sky": {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.5, 0.9]}}}
LAMP = {"lamp": {"type": "point", "position": [0.5, 1.0, 5.0], "intensity": 30.0}}
DIRECTIONAL = {"lamp": {"type": "directional", "direction": [0.2, -0.3, -1.0]}}
MIRROR = {"wall": plane(-2, {"type": "conductor", "material": "none"})}
MATT = {"wall": plane(-2, {"type": "diffuse"})}
RAYS = {"light": "rays", "light_samples": 0}
PROBE = {"light": "probe", "probes": "wall"}

# Without noise: a mirror under a sky, or a matt wall under a lamp that is a point.
SCENES = {
    "no wall": (SKY, {"light": "none", "nested": "path"}),
    "no wall, no sky": ({}, {"light": "none", "nested": "prb"}),
    "mirror, path": (SKY | MIRROR, {"light": "none", "nested": "path"}),
    "mirror, rays": (SKY | MIRROR, RAYS),
    "mirror, rays, no sky": (MIRROR, RAYS),
    "mirror, probe": (SKY | MIRROR, PROBE),
    "matt wall, point lamp, no light": (MATT | LAMP, {"light": "none"}),
    "matt wall, point lamp, default": (MATT | LAMP, {"light": "none", "nested": None}),
    "matt wall, point lamp, rays": (MATT | LAMP, RAYS | {"max_depth": 2}),
    "matt wall, directional lamp, rays": (MATT | DIRECTIONAL, RAYS | {"max_depth": 2}),
}


def placed(node) -> dict:
    """For ``mi.load_dict``, once there is a variant."""
    if "z" not in node:
        return node
    to_world = mi.ScalarTransform4f().translate([0, 0, node["z"]]).scale(8)
    return {k: v for k, v in node.items() if k != "z"} | {"to_world": to_world}


def rendered(objects, settings) -> np.ndarray:
    sensor = camera([0, 0, 4], [0, 0, 0], size=12)
    objects = {name: placed(node) for name, node in objects.items()}
    scene = scene_of(cloud(), **({"spp": 4, "max_depth": 4} | settings), sensor=sensor, **objects)
    return image_of(scene, seed=1)


@cache
def without_panes(name) -> np.ndarray:
    return rendered(*SCENES[name])


@pytest.mark.slow
@pytest.mark.parametrize("z", [2.0, 0.05, -1.5], ids=["before", "amid", "behind"])
@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("pane", PANES)
def test_invisible_surfaces_leave_the_image_unchanged(pane, name, z):
    objects, settings = SCENES[name]
    found = rendered(objects | {"pane": plane(z, PANES[pane])}, settings)
    expected = without_panes(name)
    np.testing.assert_allclose(found, expected, rtol=0, atol=ROUNDING)
    assert expected.std() > 0.05


WINDOW = {"pane": {"type": "rectangle", "bsdf": {"type": "thindielectric"}}}


def sensor_of(kind, origin) -> dict:
    sensor = camera(origin, [0, 0, 0], size=12)
    if kind == "thinlens":
        sensor |= {"type": "thinlens", "aperture_radius": 1e-4, "focus_distance": 4.0}
    return sensor


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["batch", "thinlens", "aov"])
def test_every_sensor_sees_windows(kind):
    """Images equal a pinhole's alone: two sensors side by side, one without a window; and
    ``aov``."""
    to_world = mi.ScalarTransform4f().translate([0, 0, -1.2]).scale(0.4)
    window = {"pane": WINDOW["pane"] | {"to_world": to_world}}
    mirror = {"wall": placed(MIRROR["wall"])}
    settings = {"light": "none", "nested": "path", "spp": 256, "max_depth": 4}
    origins = ([0, 0, 4], [0, 0, -4])
    scene = scene_of(
        cloud(), **settings, sensor=sensor_of("", origins[0]), **SKY, **mirror, **window
    )
    alone = [image_of(scene, sensor=mi.load_dict(sensor_of("", o)), seed=1) for o in origins]
    if kind == "batch":
        views = {f"view_{k}": sensor_of("", o) for k, o in enumerate(origins)}
        film = sensor_of("", origins[0])["film"] | {"width": 24}
        sampler = {"type": "independent", "sample_count": 1}
        batch = mi.load_dict({"type": "batch", "film": film, "sampler": sampler, **views})
        found, expected = image_of(scene, sensor=batch, seed=1), np.concatenate(alone, axis=1)
    elif kind == "thinlens":
        sensor = mi.load_dict(sensor_of("thinlens", origins[0]))
        found, expected = image_of(scene, sensor=sensor, seed=1), alone[0]
    else:
        outer = mi.load_dict({"type": "aov", "aovs": "d:depth", "img": scene.integrator()})
        found, expected = image_of(scene, integrator=outer, seed=1)[..., :3], alone[0]
    # Five standard errors of 256 paths that pass the window or are reflected by it.
    np.testing.assert_allclose(found, expected, rtol=0, atol=5 * 0.3 / 16 * 0.9)
    assert np.abs(found - expected).mean() < 0.01 and expected.std() > 0.05
