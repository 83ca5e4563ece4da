"""Error budgets of images with something behind the splats, against float64 rays over it."""

from dataclasses import replace
from functools import cache, partial

import drjit as dr
import drjit.llvm.ad as llvm
import mitsuba as mi
import numpy as np
import pytest
from support.studies import reference_rays as rays

import drgs  # noqa: F401  (registers the plugins)
from drgs.bench.scenes import device_camera
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator import error_budget
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.reference import splatting as reference

BUDGET, WIDTH, HEIGHT, FOV, DISTANCE = 0.02, 48, 32, 40, 4.0
EXACT = {"projection": "exact", "order": "pixel", "sh_direction": "pixel"}
UNCUT = {"alpha_cut": 1e-6, "transmittance_stop": 0.0}


def gaussians_of(count, scale, logit, color, seed=0):
    rng = np.random.default_rng(seed)
    values = {
        "means": rng.normal(0, 0.35, (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "log_scales": np.log(scale) + rng.normal(0, 0.1, (count, 3)),
        "logit_opacities": np.full(count, logit),
        "sh0": color + rng.normal(0, 0.1, (count, 1, 3)),
        "shN": np.zeros((count, 0, 3)),
    }
    return Gaussians(**{k: v.astype(np.float32) for k, v in values.items()})


HAZE = gaussians_of(400, 0.3, -4.25, -1.7)
"""Dark splats, hardly any of which is above the usual cut of alpha; together, they hide much."""

WHOLE = (0, 0, WIDTH, HEIGHT)
FOCAL = WIDTH / 2 / np.tan(np.radians(FOV / 2))
ALONG_Y = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # world to camera
CAMERA = reference.Camera(
    ALONG_Y, np.array([0, -DISTANCE, 0]), FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, 0.01
)


def sensor(**others):
    film = {"type": "hdrfilm", "width": WIDTH, "height": HEIGHT, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f().look_at([0, -DISTANCE, 0], [0, 0, 0], [0, 0, 1])
    film |= {"pixel_format": "rgb", "component_format": "float32"}
    return {"type": "perspective", "fov": FOV, "film": film, "to_world": to_world, **others}


def load(objects, gaussians=HAZE, **settings):
    tensors = {k: mi.TensorXf(getattr(gaussians, k)) for k in PARAMETER_NAMES}
    settings = {k: v for k, v in ({"error": BUDGET} | settings).items() if v is not None}
    integrator = {"type": "splats", **tensors, **settings}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor(), **objects})


def encode(linear):
    linear = np.maximum(linear, 0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def decode(display):
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


@cache
def layers():
    """Colours of the splats and their transmittance, both (H, W, 3), float64."""
    splats = reference.Gaussians(*(getattr(HAZE, name) for name in PARAMETER_NAMES))
    model = rays.ImageModel(**EXACT, **UNCUT)
    black, white = (rays.render(splats, CAMERA, 3 * (v,), model).image for v in (0.0, 1.0))
    return black, white - black


def over_radiance(radiance):
    """Display space: linear radiance before light, as ``docs/mitsuba.md`` has it."""
    color, rest = layers()
    return encode((1 - rest) * decode(color / (1 - rest)) + rest * radiance)


def over_color(display):
    color, rest = layers()
    return color + rest * display


def wall(**others):
    to_world = mi.ScalarTransform4f().translate([0, 3, 0]).rotate([1, 0, 0], 90).scale(9)
    return {"wall": {"type": "rectangle", "to_world": to_world, **others}}


LIGHT = {"type": "area", "radiance": 1.0}
CHROME = {"type": "conductor", "specular_reflectance": 1.0}
SKY, BITMAP = {"sky": {"type": "constant", "radiance": 1.0}}, np.ones((4, 4, 3), np.float32)
DISPLAY = {"srgb_primitives": False}

BEHIND = {
    "nothing": ({}, {}, lambda: over_color(0.0)),
    "a colour": ({}, {"background": [1.0, 1.0, 1.0]}, lambda: over_color(1.0)),
    "an environment": (SKY, {}, lambda: over_radiance(1.0)),
    "a bright environment": (
        {"sky": {"type": "constant", "radiance": 5.0}}, {}, lambda: over_radiance(5.0),
    ),
    "an environment in display space": (SKY, DISPLAY, lambda: over_color(1.0)),
    "a lamp": (partial(wall, emitter=LIGHT), {}, lambda: over_radiance(1.0)),
    "a lamp in display space": (partial(wall, emitter=LIGHT), DISPLAY, lambda: over_color(1.0)),
    "a mirror": (lambda: wall(bsdf=CHROME) | SKY, {}, lambda: over_radiance(1.0)),
    "a texture": (
        {}, {"background": lambda: {"type": "bitmap", "bitmap": mi.Bitmap(BITMAP), "raw": True}},
        lambda: over_color(1.0),
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BEHIND)
def test_budgets_hold_over_what_stands_behind(name):
    """Over nothing, cut-offs are chosen that are too coarse for all that is bright."""
    objects, settings, expected = BEHIND[name]
    objects = objects() if callable(objects) else objects
    settings = {k: v() if callable(v) else v for k, v in settings.items()}
    scene = load(objects, **settings)
    image = np.array(mi.render(scene, spp=1), np.float64)  # all rays see the same light
    image = image if settings.get("srgb_primitives") is False else encode(image)
    report = scene.integrator().budget_report
    error = np.sqrt(np.mean((image - expected()) ** 2))
    assert error <= BUDGET
    # All is measured: to the error of the most accurate image, and of the reference's cut-offs.
    assert report.errors == pytest.approx([error], rel=0.03, abs=3e-4)
    assert (report.chosen.changes["alpha_cut"] == 1 / 64) == (name == "nothing")


def test_splats_of_another_object_behind_count():
    """A bright one, moved behind the haze: against the integrator's most accurate image."""
    ball = gaussians_of(1, 0.8, 9.0, 1.7)
    other = {k: mi.TensorXf(getattr(ball, k)) for k in PARAMETER_NAMES}
    other |= {"type": "splats", "to_world": mi.ScalarTransform4f().translate([0, 3, 0])}
    scene = load({}, behind=other)
    image = np.array(mi.render(scene, spp=1))
    cuts = {"alpha_cut": 1e-5, "transmittance_stop": 1e-7, "error": None}
    exact = np.array(mi.render(load({}, behind=other, **EXACT, **cuts, order_window=64), spp=1))
    error = np.sqrt(np.mean((encode(image) - encode(exact)) ** 2))
    assert 0.003 < error <= BUDGET
    assert scene.integrator().budget_report.errors == pytest.approx([error], rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("light", ["rays", "probe"])
def test_light_between_splats_and_a_mirror_is_measured(light):
    """The mirror shows the haze again: its image depends on the cut-offs, too."""
    scene = load(wall(bsdf=CHROME, id="wall") | SKY, light=light, probes="wall", light_samples=0)
    image = encode(np.array(mi.render(scene, spp=4), np.float64))
    exact = load(
        wall(bsdf=CHROME, id="wall") | SKY, light=light, probes="wall", light_samples=0, error=None,
        **EXACT, order_window=32, alpha_cut=1e-5, transmittance_stop=1e-7,
    )  # fmt: skip
    error = np.sqrt(np.mean((image - encode(np.array(mi.render(exact, spp=4)))) ** 2))
    assert error <= BUDGET
    assert scene.integrator().budget_report.errors == pytest.approx([error], rel=0.2)


def test_nothing_cheaper_than_the_choice_is_within_the_budget():
    """All is measured with one sensor, so that no allowance is made for other views."""
    errors = {}
    for cut, stop in ((1 / 64, 1e-2), (1 / 255, 1e-4), (1 / 2048, 1e-6)):
        cuts = {"alpha_cut": cut, "transmittance_stop": stop, "error": None}
        image = np.array(mi.render(load({}, **cuts, **DISPLAY, background=1.0), spp=1))
        errors[cut] = np.sqrt(np.mean((image - over_color(1.0)) ** 2))
    coarse, default, fine = errors.values()
    assert coarse > default > 1.5 * fine
    scene = load({}, error=1.02 * default, **DISPLAY, background=1.0)
    mi.render(scene, spp=1)
    assert scene.integrator().budget_report.chosen.changes["alpha_cut"] == pytest.approx(1 / 255)


def test_a_choice_is_stale_once_what_it_was_measured_on_changes():
    scene = load(SKY)
    integrator, params = scene.integrator(), mi.traverse(scene)
    mi.render(scene, spp=1)
    chosen = integrator.budget_report.chosen
    same = mi.load_dict(sensor())
    for view in (0, same):
        mi.render(scene, sensor=view, spp=1)
        assert integrator.budget_report.stale == ""
    mi.render(scene, sensor=mi.load_dict(sensor(fov=50)), spp=1)
    assert integrator.budget_report.stale == "the sensor"
    for name, value in (("sky.radiance.value", 0.5), ("integrator.sh0", params["integrator.sh0"])):
        integrator.error = BUDGET  # measures again
        mi.render(scene, spp=1)
        assert integrator.budget_report.stale == ""
        params[name] = value + 0.25
        params.update()
        for _ in range(2):
            mi.render(scene, spp=1)
            report = integrator.budget_report
            assert report.stale == name
            assert report.line().endswith(f"; measured before a change of {name}")
            assert report.record()["stale"] == name
    assert report.chosen.changes == chosen.changes


def test_an_optimisation_keeps_the_choice(monkeypatch):
    scene = load({}, background=1.0)
    params = mi.traverse(scene)
    searches = []
    meet = error_budget.meet_error_budget
    monkeypatch.setattr(
        error_budget, "meet_error_budget", lambda *args: (searches.append(1), meet(*args))[1]
    )
    optimizer = mi.ad.Adam(lr=0.01)
    optimizer["integrator.sh0"] = params["integrator.sh0"]
    for _ in range(3):
        params.update(optimizer)
        loss = dr.mean(dr.square(mi.render(scene, params, spp=1)))
        dr.backward(loss)
        optimizer.step()
    assert len(searches) == 1
    assert scene.integrator().budget_report.stale == "integrator.sh0"


@pytest.mark.parametrize(("count", "window"), [(200, 32), (300, 4)])
def test_rays_measure_the_error_of_the_most_accurate_image_among_giants(count, window):
    """Without a low-pass; an order within a window never becomes exact there."""
    giants = gaussians_of(count, 0.8, -2, 0.0)
    rng = np.random.default_rng(1)
    spread = giants.log_scales + rng.normal(0, 0.6, (count, 3)).astype(np.float32)
    giants = replace(giants, log_scales=spread, sh0=rng.normal(0, 1, (count, 1, 3)))
    splats = reference.Gaussians(*(getattr(giants, name) for name in PARAMETER_NAMES))
    model = rays.ImageModel(**EXACT, **UNCUT, low_pass=0.0)
    truth = [rays.render(splats, CAMERA, 3 * (v,), model).image for v in (0.0, 1.0)]
    values = Approximations(
        **EXACT, order_window=window, alpha_cut=1e-5, transmittance_stop=1e-7, low_pass=0.0
    )
    on_device, camera = giants.to(llvm.TensorXf), device_camera(CAMERA, llvm.Float)
    errors = []
    for value, exact in zip((0.0, 1.0), truth, strict=True):
        renderer = error_budget.renderer_of(on_device, values, 0, 3 * (value,))
        errors.append(np.mean((renderer.image(camera) - exact) ** 2))
    residual = partial(error_budget.ray_residual, on_device, 0, {}, camera, WHOLE)
    assert max(errors) > 1e-4**2
    assert residual(values) == pytest.approx(max(errors), rel=0.02)
    assert error_budget.ray_residual(HAZE.to(llvm.TensorXf), 0, {}, camera, WHOLE, values) == 0


def test_an_inaccurate_most_accurate_image_is_reported():
    giants = gaussians_of(800, 0.8, -2, 0.0)
    rng = np.random.default_rng(1)
    giants = replace(giants, sh0=rng.normal(0, 1, (800, 1, 3)).astype(np.float32))
    scene = load({}, giants, **DISPLAY)
    mi.render(scene, spp=1)
    report = scene.integrator().budget_report
    assert 0 < report.uncertainty <= min(report.errors)
    line = replace(report, budget=2 * report.uncertainty).line()
    assert f"the most accurate image is itself within {report.uncertainty:.2g} only" in line


SENSORS = {
    "perspective": {},
    "cropped": {
        "crop": {"crop_offset_x": 5, "crop_offset_y": 3, "crop_width": 40, "crop_height": 24}
    },
    "thinlens": {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 4.0},
    "fisheye": {"type": "calibrated", "lens": "fisheye", "fx": 40.0, "fy": 40.0},
    "moving": {"type": "calibrated", "fx": 60.0, "fy": 60.0, "shutter": "global"},
}
"""Kinds of sensors; ``moving`` has a second pose."""


@pytest.mark.parametrize("kind", SENSORS)
@pytest.mark.parametrize("behind", ["environment", "texture"])
def test_measured_images_are_the_integrators_own(kind, behind):
    """Whole and in windows; tolerance: rounding."""
    pixels = np.linspace(0, 1, 8 * 16 * 3).reshape(8, 16, 3).astype(np.float32)
    objects, settings, others = {}, {}, dict(SENSORS[kind])
    if behind == "environment":
        objects = {"sky": {"type": "envmap", "bitmap": mi.Bitmap(pixels)}}
    else:
        settings["background"] = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}
    if kind == "moving":
        close = mi.ScalarTransform4f().look_at([0.5, -DISTANCE, 0], [0, 0, 0], [0, 0, 1])
        others |= {"to_world_close": close, "shutter_samples": 3}
    film = sensor()["film"] | others.pop("crop", {})
    view = sensor(**others, film=film)
    if view["type"] == "calibrated":
        del view["fov"]
        view |= {"cx": WIDTH / 2, "cy": HEIGHT / 2}
    scene = load(objects, error=None, **settings)
    view, state = mi.load_dict(view), scene.integrator().state
    expected = encode(np.array(mi.render(scene, sensor=view, spp=1), np.float64))
    camera = camera_from_sensor(read_sensor(view, state.near))
    copy = replace(state, cache=replace(state.cache, kept={}))
    renderer = error_budget.SceneRenderer(copy, scene, [(camera, view)])
    x, y, width, height = window = 7, 5, 20, 12
    draw = partial(renderer.draw, approximations=Approximations(), samples=3)
    np.testing.assert_allclose(draw(camera, None), expected, atol=2e-6)
    part = expected[y : y + height, x : x + width]
    np.testing.assert_allclose(draw(camera, window), part, atol=2e-6)
