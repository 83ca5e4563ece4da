"""Which effects are composed in, what asked for them, and that the others leave no trace."""

import json
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from conftest import TESTS
from support import small_fits as fits
from support.viewer_rendering import VIEWER_RENDERING
from support.views import VIEWS, Scene, tensors

import drgs  # noqa: F401  (registers the plugins)
from drgs.cameras.fisheye import Fisheye
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cameras.viewpoints import CameraMotion
from drgs.config.changes import with_changes
from drgs.config.schema import FitConfig
from drgs.effects.base import integrator_settings, training_effects
from drgs.fit.summary import summary_of_fit
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.integrator.summary import format_effects, summary_of_sensors, summary_of_views

MODULES = """
    accuracy.exact accuracy.lens_rays accuracy.peaks accuracy.pixel_order accuracy.ray_colors
    accuracy.unscented cameras.distortion cameras.fisheye cameras.motion cameras.orthographic
    cameras.radial_tangential cameras.thin_prism_fisheye effects.defocus effects.occlusion
    effects.rolling_shutter effects.smoothing gaussians.rotation gaussians.similarity
    integrator.parts integrator.light.splat_transport integrator.light.shadows
    integrator.light.surfaces light light.grid light.probe light.walk
"""
"""Modules used only by effects of images; a fit asks every effect whether it takes part."""


def config_of(**changes):
    """The default of everything but of filters; ``__`` is written for the dot."""
    values = {key.replace("__", "."): value for key, value in changes.items()}
    return with_changes(FitConfig(data={"path": "."}, model=VIEWER_RENDERING), values)


def test_the_plan_of_a_plain_fit():
    config = config_of(data__background="white")
    plan = format_effects(summary_of_fit(config, fits.plain_dataset()))
    assert plan == (
        "simulated:\n"
        "  view dependence: spherical harmonics up to degree 3 (model.sh_degree: 3)\n"
        "  background: white (data.background)\n"
        "  not simulated: lens distortion, motion, antialiasing, depth, exposure and white "
        "balance, masks, camera refinement"
    )
    default = FitConfig(data={"path": ".", "background": "white"})
    by_default = format_effects(summary_of_fit(default, fits.plain_dataset()))
    assert "antialiasing: opacities compensated for the low-pass filter" in by_default


def rich_dataset():
    """Two bent lenses, a moving camera, masks in two views, depth in all, transparency."""
    dataset = fits.true_dataset()
    first, second, third, *others = dataset.train
    mask = np.ones((first.height, first.width), np.float32)
    first = replace(first, lens=RadialTangential.from_coefficients(k1=0.1, k2=0.01), mask=mask)
    second = replace(second, lens=Fisheye.from_coefficients(k1=0.1), mask=mask)
    third = replace(third, motion=CameraMotion(first.camera_to_world, "rolling"))
    return replace(dataset, train=(first, second, third, *others))


EVERYTHING = {
    "data__random_background": True,
    "colors__lr": 1e-3,
    "cameras__optimise": True,
    "model__smoothing": True,
    "model__antialiased": True,
}


def test_plan_of_a_fit_lists_the_setting_of_each_effect():
    config = config_of(**EVERYTHING, model__sh_degree=0, cameras__focal_lr=1e-4)
    assert format_effects(summary_of_fit(config, rich_dataset())) == (
        "simulated:\n"
        "  background: a random colour at each iteration (data.random_background)\n"
        "  lens distortion: fisheye (k1) and opencv (k1, k2) "
        "(2 of the dataset's cameras)\n"
        "  motion: rolling shutter (1 of the dataset's cameras)\n"
        "  antialiasing: opacities compensated for the low-pass filter, 3D smoothing filter "
        "(model.antialiased, model.smoothing)\n"
        "  depth: supervision (the dataset's depth, in 6 views)\n"
        "  exposure and white balance: a colour transform for each training photograph "
        "(colors.lr)\n"
        "  masks: pixels left out (the dataset's masks, in 2 views)\n"
        "  camera refinement: poses, focal lengths (cameras.optimise)\n"
        "  not simulated: view dependence"
    )


SETTINGS = [
    ({"loss__depth_weight": 0.0}, "depth", (None, "the dataset's depth, in 6 views")),
    ({"data__background": "black"}, "background", ("black", "data.background")),
    (
        {"cameras__optimise": True, "cameras__principal_lr": 1e-4},
        "camera refinement",
        ("poses, principal point", "cameras.optimise"),
    ),
    (
        {"cameras__optimise": True, "cameras__rotation_lr": 0.0, "cameras__translation_lr": 0.0},
        "camera refinement",
        ("nothing: all rates are 0", "cameras.optimise"),
    ),
    ({"model__smoothing": True}, "antialiasing", ("3D smoothing filter", "model.smoothing")),
]


@pytest.mark.parametrize(("changes", "name", "expected"), SETTINGS)
def test_the_plan_follows_the_configuration(changes, name, expected):
    (effect,) = [e for e in summary_of_fit(config_of(**changes), rich_dataset()) if e.name == name]
    assert (effect.what, effect.why) == expected


def test_plan_of_a_fit_lists_ignored_data():
    """Not what is ignored and not there."""
    ignored = replace(fits.plain_dataset(), ignored=("distortion", "motion", "masks", "depth"))
    assert format_effects(summary_of_fit(config_of(), ignored)).splitlines()[-1] == (
        "  not simulated: lens distortion (ignored), motion (ignored), antialiasing, "
        "depth (ignored), exposure and white balance, masks (ignored), camera refinement"
    )
    plain = config_of(
        loss__depth_weight=0.0, data__ignore_distortion=True, data__ignore_motion=True
    )
    assert "ignored" not in format_effects(summary_of_fit(plain, fits.plain_dataset()))
    assert "depth (ignored)" in format_effects(summary_of_fit(plain, rich_dataset()))


def rich_scene(**settings):
    """The integrator of a scene whose Gaussians have a smoothing filter."""
    gaussians = tensors(Scene().gaussians) | {"smoothing": mi.Float(np.full(40, 0.01, np.float32))}
    return mi.load_dict({"type": "splats", **gaussians, **settings})


def test_plan_of_views_covers_all_views():
    views = rich_dataset().train
    assert format_effects(summary_of_views(rich_scene().state, views[1:])) == (
        "simulated:\n"
        "  view dependence: spherical harmonics up to degree 1 (the Gaussians' coefficients)\n"
        "  background: a constant colour (the integrator's background)\n"
        "  lens distortion: fisheye (k1) (1 of 5 cameras)\n"
        "  motion: rolling shutter (1 of 5 cameras)\n"
        "  antialiasing: 3D smoothing filter (the Gaussians' filter)"
    )
    state = rich_scene(ignore="distortion, motion, defocus, smoothing").state
    for others, ignored in ((views, " (ignored)"), (fits.plain_dataset().train, "")):
        assert format_effects(summary_of_views(state, others)).splitlines()[-1] == (
            f"  not simulated: lens distortion{ignored}, motion{ignored}, antialiasing, "
            "smoothing filter (ignored)"
        )


def test_plan_of_sensors_covers_all_sensors():
    """A pinhole; one that is bent and moves; a thin lens; an orthographic one."""
    close = {"to_world_close": VIEWS[0].sensor()["to_world"]}
    thin = {"fov": 40.0, "aperture_radius": 0.1, "focus_distance": 2.0}
    views = [
        VIEWS[1],
        VIEWS[1].with_sensor("calibrated", lens="opencv", k1=0.1, **close),
        VIEWS[1].with_sensor("thinlens", **thin),
        VIEWS[1].with_sensor("orthographic"),
    ]
    sensors = [mi.load_dict(view.sensor()) for view in views]
    cameras = [camera_from_sensor(read_sensor(sensor, 0.01)) for sensor in sensors]

    def lines(integrator, **surfaces):
        plan = summary_of_sensors(integrator.state, cameras, None, **surfaces)
        return format_effects(plan).splitlines()[3:]

    assert lines(rich_scene()) == [
        "  lens: Orthographic and RadialTangential (k1) (2 of 4 sensors)",
        "  depth of field: a thin lens (1 of 4 sensors)",
        "  motion: blurred (1 of 4 sensors)",
        "  antialiasing: 3D smoothing filter (the Gaussians' filter)",
        "  not simulated: surfaces",
    ]
    assert lines(rich_scene(ignore="distortion, motion, defocus"), num_surfaces=2) == [
        "  lens: Orthographic (1 of 4 sensors)",
        "  antialiasing: 3D smoothing filter (the Gaussians' filter)",
        "  surfaces: a nested integrator's image, between the splats (2 of the scene's shapes)",
        "  not simulated: lens (ignored), depth of field (ignored), motion (ignored), "
        "light between splats and surfaces",
    ]


def test_plain_fit_has_no_effects():
    assert training_effects(config_of(), fits.plain_dataset()) == []
    assert integrator_settings([]) == {}
    trainer = fits.make_trainer(fits.plain_dataset())
    assert trainer.effects == [] and trainer.integrator.state.aovs == {}
    assert all(view.uploads == {} and view.target is view.photograph for view in trainer.views)
    assert {type(view.sensor).__name__ for view in trainer.views} == {"ProjectiveCamera"}


@pytest.mark.parametrize(
    ("changes", "names"),
    [
        ({}, ["depth", "masks"]),
        ({"colors__lr": 0.1}, ["depth", "colors", "masks"]),
        ({"colors__vignetting_lr": 0.1}, ["depth", "photometry", "masks"]),
        (EVERYTHING, ["depth", "colors", "background", "masks", "smoothing", "cameras"]),
    ],
)
def test_effects_of_a_fit_are_ordered(changes, names):
    """Depth is taken off the image first, masks come after what changes colours."""
    effects = training_effects(config_of(**changes), rich_dataset())
    assert [effect.name for effect in effects] == names
    assert integrator_settings(effects) == {"aovs": "depth:depth, alpha:alpha"}


@pytest.mark.slow
def test_all_effects_work_in_one_fit():
    """And it learns, and goes on from a checkpoint to the same bytes."""
    dataset = rich_dataset()
    # No camera is bent or moves: the photographs show none of it.
    dataset = fits.with_views(dataset, lambda v: replace(v, lens=None, motion=None))
    changes = {**EVERYTHING, "model__antialiased": False}
    trainer = fits.make_trainer(dataset, **changes)
    losses = [trainer.step().loss for _ in range(36)]
    assert np.mean(losses[-6:]) < 0.8 * np.mean(losses[:6])
    fits.assert_resumes_to_the_same_bytes(lambda: fits.make_trainer(dataset, **changes), 3, 4)


IMPORTS = """
import json, sys
sys.path.insert(0, {tests!r})
import drgs, mitsuba as mi, numpy as np
mi.set_variant("llvm_ad_rgb")
from support import small_capture as capture
from support.trainers import make_trainer

def show(objects=(), kind="perspective", sensor=(), **settings):
    film = {{"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {{"type": "box"}}}}
    sensor = {{"type": kind, "film": film, **dict(sensor)}}
    integrator = {{"type": "splats", "filename": {ply!r}, **settings}}
    scene = {{"type": "scene", "integrator": integrator, "sensor": sensor, **dict(objects)}}
    mi.render(mi.load_dict(scene), spp=1)

aperture = {{"aperture_radius": 0.1, "focus_distance": 2.0}}
rolling = {{"shutter": "rolling", "to_world_close": mi.ScalarTransform4f().translate([0.1, 0, 0])}}
sky = {{"sky": {{"type": "constant"}}}}
lit = {{**sky, "ball": {{"type": "sphere"}}}}
capture.blobs().save({ply!r})
found, known = [], set()
for step in {steps!r}:
    eval(step)
    now = set(sys.modules) & set({modules!r})
    found.append(sorted(now - known))
    known |= now
print(json.dumps(found))
"""

STEPS = {
    "make_trainer().step()": "cameras.motion effects.smoothing",
    "show(kind='calibrated')": "",
    "show(light='none')": "",
    "show(light='rays')": "",  # without surfaces
    "show(sky)": "",
    "show(projection='exact')": "accuracy.exact accuracy.peaks",
    "show(projection='unscented')": "accuracy.unscented",
    "show(order='pixel')": "accuracy.pixel_order",
    "show(sh_direction='pixel')": "accuracy.ray_colors",
    "show(kind='calibrated', sensor={'lens': 'opencv', 'k1': 0.1})": (
        "cameras.distortion cameras.radial_tangential"
    ),
    "show(kind='calibrated', sensor={'lens': 'opencv', 'k1': 0.1}, projection='exact')": (
        "accuracy.lens_rays"
    ),
    "show(kind='calibrated', sensor=rolling)": "effects.rolling_shutter",
    "show(kind='thinlens', sensor=aperture)": "effects.defocus",
    "show(kind='orthographic')": "cameras.orthographic",
    "show(lit, light='none')": "effects.occlusion integrator.light.surfaces",
    "show(lit, nested={'type': 'path'})": "",
    "show(lit, nested={'type': 'splatpath'})": "",
    "show(lit, light='rays')": (
        "integrator.light.splat_transport light light.grid light.probe light.walk"
    ),
    "show(lit, shadows='ball')": "integrator.light.shadows",
    "show(to_world=mi.ScalarTransform4f().scale(2))": (
        "gaussians.rotation gaussians.similarity integrator.parts"
    ),
}
"""Expressions, and the modules that each imports besides those of the expressions before."""


@pytest.mark.slow
def test_each_effect_imports_its_own_modules(run_python, tmp_path):
    modules, steps = [f"drgs.{name}" for name in MODULES.split()], [*STEPS]
    ply = str(tmp_path / "blobs.ply")
    result = run_python(IMPORTS.format(tests=TESTS, modules=modules, ply=ply, steps=steps))
    assert result.returncode == 0, result.stderr
    found = dict(zip(steps, json.loads(result.stdout), strict=True))
    assert found == {k: [f"drgs.{name}" for name in v.split()] for k, v in STEPS.items()}
