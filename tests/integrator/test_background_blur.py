"""Environments behind splats, out of focus and in motion."""

import mitsuba as mi
import numpy as np
import pytest
from support.backgrounds import (
    CLOSE,
    EMITTERS,
    IMAGE,
    VIEW,
    Camera,
    calibrated,
    integrator_of,
    load,
)
from support.views import Scene, image_of, tensors

import drgs  # noqa: F401  (registers the plugins)
from drgs.reference import effects
from drgs.reference import splatting as reference

# ----------------------------------------------------------------------------------------------
# Through an aperture
# ----------------------------------------------------------------------------------------------


SHARP = {"ignore": "defocus"}


APERTURE = {"aperture_radius": 0.25, "focus_distance": 1.25}


def thin_lens(**changes) -> Camera:
    return Camera(changes={"type": "thinlens", "fov": 55.0, **APERTURE, **changes})


def hidden_splats() -> dict:
    gaussians = tensors(Scene().gaussians)
    return {"type": "splats", **gaussians, "logit_opacities": mi.Float(np.full(40, -20.0))}


def test_defocused_environment_is_the_mean_of_pinholes_in_the_aperture():
    """The pinholes' principal points agree on the plane in focus."""
    sensor = thin_lens().dictionary()
    image = image_of(load(sensor, hidden_splats(), sky=EMITTERS["envmap"]()))
    height, width = image.shape[:2]
    focal = width / 2 / np.tan(np.radians(55) / 2)
    plain = reference.Camera(
        np.eye(3), np.zeros(3), focal, focal, width / 2, height / 2, width, height
    )
    lens = effects.ThinLens(APERTURE["aperture_radius"], APERTURE["focus_distance"])
    images = []
    for camera in effects.lens_cameras(plain, lens, 16):
        pinhole = calibrated(fx=focal, fy=focal, cx=camera.cx, cy=camera.cy).dictionary()
        images.append(image_of(load(pinhole, hidden_splats(), sky=EMITTERS["envmap"]())))
    np.testing.assert_allclose(image, np.mean(images, axis=0), atol=IMAGE)
    assert np.abs(image - images[0]).max() > 0.3


# ----------------------------------------------------------------------------------------------
# Movement, and what is ignored
# ----------------------------------------------------------------------------------------------


def pose_at(time) -> np.ndarray:
    """Mitsuba's 4 x 4 between the two poses of a camera that moves, by the reference."""
    flip = np.diag([-1.0, -1.0, 1.0])
    ends = [(flip @ np.array(m)[:3, :3].T, np.array(m)[:3, 3]) for m in (VIEW.to_world, CLOSE)]
    rotation, center = effects.interpolate_pose(*ends, time)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = (flip @ rotation).T, center
    return pose


def moving(**changes) -> Camera:
    return calibrated(to_world_close=lambda: mi.ScalarTransform4f(CLOSE), **changes)


@pytest.mark.parametrize("times", [{}, {"shutter_open": 2.0, "shutter_close": 2.5}])
def test_motion_blurs_environment_and_splats_alike(times):
    """The mean of images from where the camera was, whatever the clock says."""
    gaussians = Scene().gaussians
    count = 3
    sensor = moving(shutter_samples=count, **times).dictionary()
    image = image_of(load(sensor, integrator_of(gaussians), sky=EMITTERS["envmap"]()))
    still = []
    for k in range(count):
        pose = mi.ScalarTransform4f(pose_at((k + 0.5) / count))
        alone = calibrated().dictionary(to_world=pose)
        still.append(image_of(load(alone, integrator_of(gaussians), sky=EMITTERS["envmap"]())))
    # Poses are interpolated in single precision on one side.
    np.testing.assert_allclose(image, np.mean(still, axis=0), atol=10 * IMAGE)
    assert np.abs(still[0] - still[-1]).max() > 0.2


@pytest.mark.parametrize(
    ("camera", "ignored"),
    [
        (calibrated(lens="opencv", k1=-0.25, k2=0.0625), "distortion"),
        (moving(shutter_samples=3), "motion"),
        (moving(shutter="rolling"), "motion"),
    ],
    ids=["distortion", "blur", "rolling shutter"],
)
def test_ignored_effects_do_not_apply_to_the_background(camera, ignored):
    gaussians = Scene().gaussians
    image, expected = (
        image_of(
            load(c.dictionary(), integrator_of(gaussians, ignore=ignored), sky=EMITTERS["envmap"]())
        )
        for c in (camera, calibrated())
    )
    np.testing.assert_allclose(image, expected, atol=IMAGE)
