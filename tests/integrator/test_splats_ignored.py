"""The property ``ignore`` of the ``splats`` integrator, and its messages."""

import mitsuba as mi
import numpy as np
import pytest
from support.splats_checks import assert_images_agree, fresh_image
from support.views import VIEWS, Scene, image_of, pose

import drgs  # noqa: F401  (registers the plugin)

CLOSE = pose([0.3, -1.0, 0.5], 48, (0.5, -0.6, 1.0))


def pinhole(**changes) -> dict:
    """The view with a pinhole, by the ``calibrated`` sensor."""
    camera = VIEWS[1].camera
    intrinsics = {"fx": camera.fx, "fy": camera.fy, "cx": camera.cx, "cy": camera.cy}
    return VIEWS[1].with_sensor("calibrated", **intrinsics | changes).sensor()


BENT = {"lens": "opencv", "k1": -0.25, "p1": 0.01}

BLURRED = {"aperture_radius": 0.1, "focus_distance": 2.0, "fov": VIEWS[1].fov}


def moving(**changes):
    return {"to_world_close": mi.ScalarTransform4f(np.array(CLOSE)), **changes}


IGNORED = {
    "distortion": ("distortion", lambda: pinhole(**BENT)),
    "fisheye": ("distortion", lambda: pinhole(lens="fisheye", k1=0.02)),
    "defocus": ("defocus", lambda: VIEWS[1].with_sensor("thinlens", **BLURRED).sensor()),
    "motion blur": ("motion", lambda: pinhole(**moving(shutter_samples=2))),
    "rolling shutter": ("motion", lambda: pinhole(**moving(shutter="rolling"))),
    "both": ("motion, distortion", lambda: pinhole(**BENT, **moving())),
}


@pytest.mark.parametrize("case", IGNORED)
def test_ignored_effects_leave_a_static_pinhole(case):
    """And what is not asked to be ignored is seen."""
    ignored, sensor = IGNORED[case]
    scene = Scene()

    def image(**settings):
        return image_of(scene.load_with(sensor(), **settings))

    expected = fresh_image(scene)
    assert_images_agree(image(ignore=ignored), expected)
    assert np.abs(image() - expected).max() > 0.05
    others = [word for word in ("distortion", "defocus", "motion") if word not in ignored]
    assert np.array_equal(image(ignore=", ".join([*others, "smoothing"])), image())


def test_orthographic_lens_does_not_count_as_distortion():
    """No pinhole could take its place."""
    sensor = VIEWS[1].with_sensor("orthographic").sensor()
    ignoring = image_of(Scene().load_with(sensor, ignore="distortion"))
    np.testing.assert_array_equal(ignoring, image_of(Scene().load_with(sensor)))


def plan_of(sensor, **settings) -> str:
    emitter = {"sky": {"type": "constant"}} if settings.pop("sky", False) else {}
    loaded = Scene(degree=settings.pop("degree", 1)).load_with(sensor, emitter, **settings)
    return loaded.integrator().summary(loaded, loaded.sensors()[0])


def test_plan_lists_the_setting_of_each_effect():
    sensor = pinhole(**BENT, **moving(shutter="rolling"))
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
    rendered = {"type": "bitmap", "bitmap": mi.Bitmap(np.ones((2, 2, 3), np.float32))}
    blurred = plan_of(pinhole(**moving()), background=rendered)
    assert "  background: an image (the integrator's background)\n" in blurred
    assert "  motion: blurred (the sensor)\n" in blurred
