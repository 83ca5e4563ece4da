"""The property ``ignore`` of the ``splats`` integrator, and its messages."""

import mitsuba as mi
import numpy as np
import pytest
from support.splats_checks import assert_images_agree, fresh_image, fresh_integrator
from support.views import VIEWS, Scene, image_of, pose, tensors

import drgs  # noqa: F401  (registers the plugin)

CLOSE = pose([0.3, -1.0, 0.5], 48, (0.5, -0.6, 1.0))


def sensor_like(view, kind="calibrated", **changes) -> dict:
    """The view with a pinhole, by another sensor."""
    sensor = view.sensor()
    kept = {key: sensor[key] for key in ("to_world", "film", "sampler", "near_clip")}
    if kind == "calibrated":
        camera = view.camera
        kept |= {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    return kept | {"type": kind, **changes}


BENT = {"lens": "opencv", "k1": -0.25, "p1": 0.01}

BLURRED = {"aperture_radius": 0.1, "focus_distance": 2.0, "fov": VIEWS[1].fov}


def moving(**changes):
    return {"to_world_close": mi.ScalarTransform4f(np.array(CLOSE)), **changes}


IGNORED = {
    "distortion": ("distortion", lambda: sensor_like(VIEWS[1], **BENT)),
    "fisheye": ("distortion", lambda: sensor_like(VIEWS[1], lens="fisheye", k1=0.02)),
    "defocus": ("defocus", lambda: sensor_like(VIEWS[1], "thinlens", **BLURRED)),
    "motion blur": ("motion", lambda: sensor_like(VIEWS[1], **moving(shutter_samples=2))),
    "rolling shutter": ("motion", lambda: sensor_like(VIEWS[1], **moving(shutter="rolling"))),
    "both": ("motion, distortion", lambda: sensor_like(VIEWS[1], **BENT, **moving())),
}


@pytest.mark.parametrize("case", IGNORED)
def test_ignored_effects_leave_a_static_pinhole(case):
    """And what is not asked to be ignored is seen."""
    ignored, sensor = IGNORED[case]
    scene = Scene()

    def image(**settings):
        integrator = scene.settings | tensors(scene.gaussians) | settings
        return image_of(
            mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor()})
        )

    expected = fresh_image(scene)
    assert_images_agree(image(ignore=ignored), expected)
    assert np.abs(image() - expected).max() > 0.05
    others = [word for word in ("distortion", "defocus", "motion") if word not in ignored]
    assert np.array_equal(image(ignore=", ".join([*others, "smoothing"])), image())


def test_orthographic_lens_does_not_count_as_distortion():
    """No pinhole could take its place."""
    scene, sensor = Scene(), mi.load_dict(sensor_like(VIEWS[1], "orthographic"))
    plain, ignoring = fresh_integrator(scene), fresh_integrator(scene, ignore="distortion")
    images = [image_of(scene.load(), sensor=sensor, integrator=i) for i in (plain, ignoring)]
    np.testing.assert_array_equal(*images)


def plan_of(sensor, **settings) -> str:
    scene = Scene(degree=settings.pop("degree", 1))
    emitter = {"sky": {"type": "constant"}} if settings.pop("sky", False) else {}
    integrator = fresh_integrator(scene, **settings)
    loaded = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **emitter})
    return loaded.integrator().summary(loaded, loaded.sensors()[0])


def test_plan_lists_the_setting_of_each_effect():
    sensor = sensor_like(VIEWS[1], **BENT, **moving(shutter="rolling"))
    smoothing = mi.Float(np.full(40, 0.01, np.float32))
    settings = {"sky": True, "degree": 0, "antialiased": True, "smoothing": smoothing}
    assert plan_of(sensor, **settings) == (
        "simulated:\n"
        "  background: an environment (the scene's emitter)\n"
        "  lens: RadialTangential (k1, p1, p2) (the sensor)\n"
        "  motion: rolling shutter (the sensor)\n"
        "  antialiasing: opacities compensated for the low-pass filter, 3D smoothing filter "
        "(antialiased, the Gaussians' filter)\n"
        "  not simulated: view dependence, depth of field, surfaces"
    )
    ignored = plan_of(sensor, **settings, ignore="distortion, motion, smoothing")
    absent = "view dependence, lens (ignored), depth of field, motion (ignored)"
    assert f"  not simulated: {absent}, smoothing filter (ignored), surfaces" in ignored
    assert "3D smoothing" not in ignored
    rendered = {"type": "bitmap", "bitmap": mi.Bitmap(np.ones((2, 2, 3), np.float32))}
    blurred = plan_of(sensor_like(VIEWS[1], **moving()), background=rendered)
    assert "  background: an image (the integrator's background)\n" in blurred
    assert "  motion: blurred (the sensor)\n" in blurred
