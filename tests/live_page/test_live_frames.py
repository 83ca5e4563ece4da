"""Frames for viewer clients: contents, approximations and lenses."""

import math
from dataclasses import replace

import numpy as np
import pytest
from support.small_capture import RADIUS, blobs, decibels, pose_around
from support.viewer_rendering import VIEWER_RENDERING

from drgs.cameras.fisheye import Fisheye
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cameras.viewpoints import Viewpoint
from drgs.config.approximations import Approximations
from drgs.config.schema import ModelConfig
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, render_views
from drgs.live_page.frames import (
    BACKDROP_GRAY,
    FRAME_CONTENTS,
    MOST_ACCURATE,
    VIEWER_LENSES,
    FrameRequest,
    LiveScene,
    ViewerCamera,
)

WHITE = (1.0, 1.0, 1.0)
EYE = ViewerCamera(pose_around(0.4, 0.3), 40.0, RADIUS)
REQUEST = FrameRequest(EYE, 48, 32)
BEST = {"projection": "exact", **MOST_ACCURATE}


@pytest.fixture
def scene():
    return LiveScene(blobs(), ModelConfig(), WHITE)


def pixels(scene, **changes):
    return scene.frame(replace(REQUEST, **changes)).pixels


def reference_image(**approximations):
    scene = make_scene(blobs(), ModelConfig(**approximations), WHITE)
    (rendered,) = render_views(scene, [EYE.viewpoint(48, 32)])
    return rendered


@pytest.mark.parametrize("others", [{"projection": "exact"}, {"order": "pixel"}, {"low_pass": 0.0}])
def test_approximations_can_be_changed_and_restored(scene, others):
    first = pixels(scene)
    assert first.dtype == np.uint8
    assert np.array_equal(first, np.round(255 * reference_image()))
    switched = pixels(scene, approximations=replace(scene.approximations, **others))
    assert np.array_equal(switched, np.round(255 * reference_image(**others)))
    assert not np.array_equal(switched, first)
    assert np.array_equal(pixels(scene), first)


def test_depths_and_normals_are_colored(scene):
    """Depths from near to far; normals point to the camera."""
    frame = scene.frame(replace(REQUEST, content="depth"))
    near, far = (float(word) for word in frame.note.split() if word[0].isdigit())
    assert RADIUS - 1.1 < near < far < RADIUS + 1.1  # the blobs are within a unit of the focus
    opacity = pixels(scene, content="opacity")
    empty = opacity.max(axis=2) == 0
    assert 0.3 < empty.mean() < 1
    assert (frame.pixels[empty] == round(255 * BACKDROP_GRAY)).all()
    red, _, blue = frame.pixels[opacity.min(axis=2) > 200].astype(int).T
    assert (red > blue).any() and (blue > red).any()
    normals = pixels(scene, content="normals")[opacity.min(axis=2) > 250] / 255 * 2 - 1
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1, abs=0.05)  # eight bits, alpha
    # A sum of unit vectors that point to the camera, seen at most 30 degrees from the axis.
    assert (normals @ EYE.camera_to_world[:3, 2]).max() < 0.5
    away = ViewerCamera(pose_around(0.4, 0.3) @ np.diag([-1.0, 1, -1, 1]), 40.0, RADIUS)
    frame = scene.frame(replace(REQUEST, camera=away, content="depth"))
    assert frame.note == "nothing is seen" and np.ptp(frame.pixels) == 0


def test_the_error_is_the_difference_from_the_most_accurate_image(scene):
    shown, accurate = reference_image(), reference_image(**BEST)
    frame = scene.frame(replace(REQUEST, content="error"))
    expected = np.round(255 * np.clip(0.5 + 5 * (shown - accurate), 0, 1))
    assert np.abs(frame.pixels - expected).max() <= 1  # halves are rounded in single precision
    assert f"{decibels(shown, accurate):.1f} dB" in frame.note
    values = replace(scene.approximations, **BEST)
    frame = scene.frame(replace(REQUEST, content="error", approximations=values))
    assert (frame.pixels == 128).all() and "the same as" in frame.note


NUMBERS = {"opencv": {"k1": 0.1}, "fisheye": {"k1": 0.1}, "thin lens": {"aperture": 0.03}}


@pytest.mark.slow
@pytest.mark.parametrize("lens", VIEWER_LENSES)
@pytest.mark.parametrize(
    ("projection", "order"), [("ewa", "center"), ("unscented", "pixel"), ("exact", "pixel")]
)
def test_every_content_is_rendered_through_every_lens(scene, lens, projection, order):
    approximations = Approximations(projection=projection, order=order)
    for content in FRAME_CONTENTS:
        request = FrameRequest(EYE, 12, 8, lens, NUMBERS.get(lens, {}), content, approximations)
        assert scene.frame(request).pixels.shape == (8, 12, 3)


WIDTH, HEIGHT, FOV = 60, 40, 50.0
SKY_BLUE = (0.25, 0.5, 0.75)
WIDE = ViewerCamera(pose_around(0.4, 0.3), FOV, RADIUS)
FOCAL = HEIGHT / 2 / math.tan(math.radians(FOV) / 2)


def seen(gaussians, lens="pinhole", **numbers):
    scene = LiveScene(gaussians, ModelConfig(**VIEWER_RENDERING), SKY_BLUE)
    return scene.image(FrameRequest(WIDE, WIDTH, HEIGHT, lens, numbers))[0]


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
    view = Viewpoint("", WIDE.camera_to_world, focal, focal, *size, lens=lens)
    scene = make_scene(blobs(), ModelConfig(**VIEWER_RENDERING), SKY_BLUE)
    (expected,) = render_views(scene, [view])
    assert np.ptp(expected) > 0.3
    # The focal length goes through an angle in degrees, in single precision: 1e-6 of it.
    rendered = np.clip(seen(blobs(), name, **numbers), 0, 1)
    assert np.abs(rendered - expected).max() < 1e-4


def speck(depth):
    """One opaque Gaussian, much smaller than a pixel, at (0.8, -0.5, depth), camera axes."""
    values = {
        "means": (WIDE.camera_to_world @ [0.8, -0.5, depth, 1])[None, :3],
        "quats": [[1, 0, 0, 0]],
        "log_scales": np.full((1, 3), -7),
        "logit_opacities": [3],
        "sh0": np.full((1, 1, 3), 1.5),
        "shN": np.zeros((1, 0, 3)),
    }
    return Gaussians(**{name: np.float32(value) for name, value in values.items()})


def place(rendered):
    """Return the middle (px) of pixels other than the background, and the largest difference."""
    difference = np.abs(rendered[:, :, :3] - SKY_BLUE).sum(axis=2)
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    middle = [(difference * axis).sum() / difference.sum() for axis in (x, y)]
    return np.array(middle), difference.max()


@pytest.mark.parametrize("depth", [RADIUS, 1.5 * RADIUS])
def test_orthographic_view_matches_the_pinhole_at_the_focus_distance(depth):
    middle, _ = place(seen(speck(depth), "orthographic"))
    expected = np.array([WIDTH, HEIGHT]) / 2 + FOCAL / RADIUS * np.array([0.8, -0.5])
    # The middle of a speck that is cut off at a small alpha is within a tenth of a pixel.
    assert middle == pytest.approx(expected, abs=0.1)


@pytest.mark.parametrize("focus", [1.0, 1.5])
def test_thin_lens_is_sharp_at_its_focus_only(focus, capfd):
    dot = speck(focus * RADIUS)
    sharp = seen(dot)
    assert np.array_equal(seen(dot, "thin lens", aperture=0.0), sharp)  # a pinhole
    assert "aperture" not in "".join(capfd.readouterr())  # Mitsuba warns at most once an image
    focused = seen(dot, "thin lens", aperture=0.1, focus=focus)
    assert np.abs(focused - sharp).max() < 1e-4  # roundings of the field of view
    blurred = seen(dot, "thin lens", aperture=0.1, focus=focus / 2)
    (middle, peak), (expected, sharp_peak) = place(blurred), place(sharp)
    assert peak < 0.5 * sharp_peak
    assert np.abs(middle - expected).max() < 0.1
