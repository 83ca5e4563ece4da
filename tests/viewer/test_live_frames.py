"""Frames for viewer clients: contents and approximations."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.small_capture import RADIUS, blobs, decibels, pose_around

from drgs.config.approximations import Approximations
from drgs.config.schema import ModelConfig
from drgs.core.errors import UserError
from drgs.integrator.scene import make_scene, render_views
from drgs.viewer.frames import (
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


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


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


def test_smaller_images_are_downscaled_ones(scene):
    small = scene.frame(REQUEST.smaller(2)).pixels
    assert small.shape == (16, 24, 3)
    means = pixels(scene).reshape(16, 2, 24, 2, 3).mean(axis=(1, 3))
    assert np.abs(small - means).mean() < 6  # of 255: a pixel's centre, or the mean of four


def test_depths_are_colored_from_near_to_far(scene):
    frame = scene.frame(replace(REQUEST, content="depth"))
    near, far = (float(word) for word in frame.note.split() if word[0].isdigit())
    assert RADIUS - 1.1 < near < far < RADIUS + 1.1  # the blobs are within a unit of the focus
    opacity = pixels(scene, content="opacity")
    empty = opacity.max(axis=2) == 0
    assert 0.3 < empty.mean() < 1
    assert (frame.pixels[empty] == round(255 * BACKDROP_GRAY)).all()
    red, _, blue = frame.pixels[opacity.min(axis=2) > 200].astype(int).T
    assert (red > blue).any() and (blue > red).any()


def test_empty_view_has_no_depth(scene):
    away = ViewerCamera(pose_around(0.4, 0.3) @ np.diag([-1.0, 1, -1, 1]), 40.0, RADIUS)
    frame = scene.frame(replace(REQUEST, camera=away, content="depth"))
    assert frame.note == "nothing is seen" and np.ptp(frame.pixels) == 0


def test_normals_point_to_the_camera(scene):
    opaque = pixels(scene, content="opacity").min(axis=2) > 250
    normals = pixels(scene, content="normals")[opaque] / 255 * 2 - 1
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1, abs=0.05)  # eight bits, alpha
    # A sum of unit vectors that point to the camera, seen at most 30 degrees from the axis.
    assert (normals @ EYE.camera_to_world[:3, 2]).max() < 0.5


def test_the_error_is_the_difference_from_the_most_accurate_image(scene):
    shown, accurate = reference_image(), reference_image(**BEST)
    frame = scene.frame(replace(REQUEST, content="error"))
    expected = np.round(255 * np.clip(0.5 + 5 * (shown - accurate), 0, 1))
    assert np.abs(frame.pixels - expected).max() <= 1  # halves are rounded in single precision
    assert f"{decibels(shown, accurate):.1f} dB" in frame.note
    values = replace(scene.approximations, **BEST)
    frame = scene.frame(replace(REQUEST, content="error", approximations=values))
    assert (frame.pixels == 128).all() and "the same as" in frame.note


def test_error_of_orthographic_views_comes_from_the_order_only():
    """``ewa`` is exact there: with the most accurate order there is none."""
    scene = LiveScene(blobs(), ModelConfig(**MOST_ACCURATE), WHITE)
    assert (pixels(scene, lens="orthographic", content="error") == 128).all()
    assert (pixels(scene, content="error") != 128).any()


NUMBERS = {"opencv": {"k1": 0.1}, "fisheye": {"k1": 0.1}, "thin lens": {"aperture": 0.03}}


@pytest.mark.slow
@pytest.mark.parametrize("lens", VIEWER_LENSES)
@pytest.mark.parametrize(
    ("projection", "order"), [("ewa", "center"), ("unscented", "pixel"), ("exact", "pixel")]
)
def test_every_content_is_rendered_through_every_lens(scene, lens, projection, order):
    """But for the projection ``exact``, which only pinholes and thin lenses have."""
    approximations = Approximations(projection=projection, order=order)
    for content in FRAME_CONTENTS:
        numbers = NUMBERS.get(lens, {})
        request = FrameRequest(EYE, 12, 8, lens, numbers, content, approximations)
        if projection == "exact" and lens in ("opencv", "fisheye", "orthographic"):
            with pytest.raises(UserError, match="exact"):
                scene.frame(request)
        else:
            assert scene.frame(request).pixels.shape == (8, 12, 3)
