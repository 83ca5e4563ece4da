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


@pytest.mark.parametrize(
    ("name", "numbers", "focal", "lens"),
    [
        ("pinhole", {}, FOCAL, None),
        ("opencv", {"k1": -0.3, "p1": 0.02}, FOCAL, RadialTangential),
        # The angle of the whole height on the film, so many px a radian.
        ("fisheye", {"k1": 0.1}, HEIGHT / math.radians(FOV), Fisheye),
    ],
)
def test_image_matches_the_same_camera_in_a_dataset(name, numbers, focal, lens):
    lens = lens and lens.from_coefficients(**numbers)
    size = WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT
    view = Viewpoint("", EYE.camera_to_world, focal, focal, *size, lens=lens)
    scene = make_scene(blobs(), ModelConfig(**VIEWER_RENDERING), BACKGROUND)
    (expected,) = render_views(scene, [view])
    assert np.ptp(expected) > 0.3
    # The focal length goes through an angle in degrees, in single precision: 1e-6 of it.
    rendered = np.clip(seen(blobs(), name, **numbers), 0, 1)
    assert np.abs(rendered - expected).max() < 1e-4


def speck(depth):
    """One opaque Gaussian, much smaller than a pixel, at (0.8, -0.5, depth), camera axes."""
    means = EYE.camera_to_world @ [0.8, -0.5, depth, 1]
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
    middle = [(difference * axis).sum() / difference.sum() for axis in (x, y)]
    return np.array(middle), difference.max()


@pytest.mark.parametrize("depth", [RADIUS, 1.5 * RADIUS])
def test_orthographic_view_matches_the_pinhole_at_the_focus_distance(depth):
    middle, _ = place(seen(speck(depth), "orthographic"))
    expected = np.array([WIDTH, HEIGHT]) / 2 + FOCAL / RADIUS * np.array([0.8, -0.5])
    # The middle of a speck that is cut off at a small alpha is within a tenth of a pixel.
    assert middle == pytest.approx(expected, abs=0.1)


def test_a_closed_aperture_is_a_pinhole(capfd):
    """Mitsuba's warning appears at most once an image."""
    dot = speck(2 * RADIUS)
    assert np.array_equal(seen(dot, "thin lens", aperture=0.0), seen(dot))
    assert "aperture" not in "".join(capfd.readouterr())


@pytest.mark.parametrize("focus", [1.0, 1.5])
def test_thin_lens_is_sharp_at_its_focus_only(focus):
    dot = speck(focus * RADIUS)
    sharp = seen(dot)
    focused = seen(dot, "thin lens", aperture=0.1, focus=focus)
    assert np.abs(focused - sharp).max() < 1e-4  # roundings of the field of view
    blurred = seen(dot, "thin lens", aperture=0.1, focus=focus / 2)
    (middle, peak), (expected, sharp_peak) = place(blurred), place(sharp)
    assert peak < 0.5 * sharp_peak
    assert np.abs(middle - expected).max() < 0.1
