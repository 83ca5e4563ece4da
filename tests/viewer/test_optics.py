"""Lenses to look through: where things come to the image, and how sharp they are."""

import math

import mitsuba as mi
import numpy as np
import pytest
from support.small_capture import RADIUS, blobs, pose_around
from support.viewer_rendering import VIEWER_RENDERING

from drgs.cameras.fisheye import Fisheye
from drgs.cameras.radial_tangential import RadialTangential
from drgs.config.schema import ModelConfig
from drgs.datasets.types import Viewpoint
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, render_views
from drgs.viewer.frames import FrameRequest, LiveScene, ViewerCamera

WIDTH, HEIGHT, FOV = 60, 40, 50.0
BACKGROUND = (0.25, 0.5, 0.75)
EYE = ViewerCamera(pose_around(0.4, 0.3), FOV, RADIUS)
FOCAL = HEIGHT / 2 / math.tan(math.radians(FOV) / 2)


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def seen(gaussians, lens="pinhole", **numbers):
    scene = LiveScene(gaussians, ModelConfig(**VIEWER_RENDERING), BACKGROUND)
    return scene.image(FrameRequest(EYE, WIDTH, HEIGHT, lens, numbers))[0]


def viewpoint(focal=FOCAL, lens=None):
    size = WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT
    return Viewpoint("", EYE.camera_to_world, focal, focal, *size, lens=lens)


@pytest.mark.parametrize(
    ("lens", "numbers", "view"),
    [
        ("pinhole", {}, viewpoint()),
        (
            "opencv",
            {"k1": -0.3, "p1": 0.02},
            viewpoint(lens=RadialTangential.from_coefficients(k1=-0.3, p1=0.02)),
        ),
        # The angle of the whole height on the film, so many px a radian.
        (
            "fisheye",
            {"k1": 0.1},
            viewpoint(HEIGHT / math.radians(FOV), Fisheye.from_coefficients(k1=0.1)),
        ),
    ],
    ids=["pinhole", "opencv", "fisheye"],
)
def test_image_matches_the_same_camera_in_a_dataset(lens, numbers, view):
    scene = make_scene(blobs(), ModelConfig(**VIEWER_RENDERING), BACKGROUND)
    (expected,) = render_views(scene, [view])
    rendered = np.clip(seen(blobs(), lens, **numbers), 0, 1)
    assert np.ptp(expected) > 0.3
    # The focal length goes through an angle in degrees, in single precision: 1e-6 of it.
    assert np.abs(rendered - expected).max() < 1e-4


def speck(x, y, z):
    """One opaque Gaussian, much smaller than a pixel, at camera coordinates in scene units."""
    means = EYE.camera_to_world @ [x, y, z, 1]
    return Gaussians(
        means=np.float32([means[:3]]),
        quats=np.float32([[1, 0, 0, 0]]),
        log_scales=np.full((1, 3), -7, np.float32),
        logit_opacities=np.full(1, 3, np.float32),
        sh0=np.full((1, 1, 3), 1.5, np.float32),
        shN=np.zeros((1, 0, 3), np.float32),
    )


def place(rendered):
    """Return the middle (px) of pixels that differ from the background, and their largest
    difference."""
    difference = np.abs(rendered[:, :, :3] - BACKGROUND).sum(axis=2)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return (
        (difference * x).sum() / difference.sum(),
        (difference * y).sum() / difference.sum(),
        difference.max(),
    )


@pytest.mark.parametrize("depth", [RADIUS, 1.5 * RADIUS])
def test_orthographic_view_matches_the_pinhole_at_the_focus_distance(depth):
    x, y, _ = place(seen(speck(0.8, -0.5, depth), "orthographic"))
    # The middle of a speck that is cut off at a small alpha is within a tenth of a pixel.
    assert x == pytest.approx(WIDTH / 2 + FOCAL * 0.8 / RADIUS, abs=0.1)
    assert y == pytest.approx(HEIGHT / 2 - FOCAL * 0.5 / RADIUS, abs=0.1)


def test_a_closed_aperture_is_a_pinhole(capfd):
    """Mitsuba's warning appears at most once an image."""
    dot = speck(0.8, -0.5, 2 * RADIUS)
    assert np.array_equal(seen(dot, "thin lens", aperture=0.0), seen(dot))
    assert "aperture" not in "".join(capfd.readouterr())


def test_thin_lens_is_sharp_at_its_focus_only():
    for focus, depth in ((1.0, RADIUS), (1.5, 1.5 * RADIUS)):
        dot = speck(0.8, -0.5, depth)
        sharp = seen(dot)
        focused = seen(dot, "thin lens", aperture=0.1, focus=focus)
        assert np.abs(focused - sharp).max() < 1e-4  # roundings of the field of view
        blurred = seen(dot, "thin lens", aperture=0.1, focus=focus / 2)
        assert place(blurred)[2] < 0.5 * place(sharp)[2]
        assert np.abs(np.subtract(place(blurred)[:2], place(sharp)[:2])).max() < 0.1
