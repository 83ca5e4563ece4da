"""Frames for viewer clients: contents and approximations."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.small_capture import RADIUS, blobs, pose_around

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


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture
def scene():
    return LiveScene(blobs(), ModelConfig(), WHITE)


def reference_image(**approximations):
    scene = make_scene(blobs(), ModelConfig(**approximations), WHITE)
    (rendered,) = render_views(scene, [EYE.viewpoint(48, 32)])
    return rendered


def test_colors_match_the_rendering_in_eight_bits(scene):
    frame = scene.frame(REQUEST)
    assert frame.pixels.dtype == np.uint8 and frame.seconds > 0
    assert np.array_equal(frame.pixels, np.round(255 * reference_image()))


@pytest.mark.parametrize("others", [{"projection": "exact"}, {"order": "pixel"}, {"low_pass": 0.0}])
def test_approximations_can_be_changed_and_restored(scene, others):
    first = scene.frame(REQUEST).pixels
    values = {**vars(scene.approximations), **others}
    switched = scene.frame(replace(REQUEST, approximations=Approximations(**values))).pixels
    assert np.array_equal(switched, np.round(255 * reference_image(**others)))
    assert not np.array_equal(switched, first)
    assert np.array_equal(scene.frame(REQUEST).pixels, first)


def test_smaller_images_are_downscaled_ones(scene):
    small = scene.frame(REQUEST.smaller(2)).pixels
    assert small.shape == (16, 24, 3)
    means = scene.frame(REQUEST).pixels.reshape(16, 2, 24, 2, 3).mean(axis=(1, 3))
    assert np.abs(small - means).mean() < 6  # of 255: a pixel's centre, or the mean of four


def test_depths_are_colored_from_near_to_far(scene):
    frame = scene.frame(replace(REQUEST, content="depth"))
    near, far = (float(word) for word in frame.note.split() if word[0].isdigit())
    assert RADIUS - 1.1 < near < far < RADIUS + 1.1  # the blobs are within a unit of the focus
    opacity = scene.frame(replace(REQUEST, content="opacity")).pixels
    empty = opacity.max(axis=2) == 0
    assert 0.3 < empty.mean() < 1
    assert (frame.pixels[empty] == round(255 * BACKDROP_GRAY)).all()
    red, _, blue = frame.pixels[opacity.min(axis=2) > 200].astype(int).T
    assert (red > blue).any() and (blue > red).any()


def test_normals_point_to_the_camera(scene):
    pixels = scene.frame(replace(REQUEST, content="normals")).pixels
    opaque = scene.frame(replace(REQUEST, content="opacity")).pixels.min(axis=2) > 250
    normals = pixels[opaque] / 255 * 2 - 1
    assert np.linalg.norm(normals, axis=1) == pytest.approx(1, abs=0.05)  # eight bits, alpha
    # A sum of unit vectors that point to the camera, seen at most 30 degrees from the axis.
    assert (normals @ EYE.camera_to_world[:3, 2]).max() < 0.5


def test_the_error_is_the_difference_from_the_most_accurate_image(scene):
    best = {"projection": "exact", **MOST_ACCURATE}
    shown, accurate = reference_image(), reference_image(**best)
    frame = scene.frame(replace(REQUEST, content="error"))
    expected = np.round(255 * np.clip(0.5 + 5 * (shown - accurate), 0, 1))
    assert np.abs(frame.pixels - expected).max() <= 1  # halves are rounded in single precision
    psnr = -10 * np.log10(np.mean((shown - accurate) ** 2))
    assert f"{psnr:.1f} dB" in frame.note
    values = Approximations(**{**vars(scene.approximations), **best})
    frame = scene.frame(replace(REQUEST, content="error", approximations=values))
    assert (frame.pixels == 128).all() and "the same as" in frame.note


def test_unsupported_combination_is_refused_in_one_line(scene):
    values = Approximations(**{**vars(scene.approximations), "projection": "exact"})
    with pytest.raises(UserError, match="exact"):
        scene.frame(replace(REQUEST, lens="fisheye", approximations=values))


NUMBERS = {"opencv": {"k1": 0.1}, "fisheye": {"k1": 0.1}, "thin lens": {"aperture": 0.03}}


@pytest.mark.slow
@pytest.mark.parametrize("lens", VIEWER_LENSES)
def test_every_content_is_rendered_through_every_lens(scene, lens):
    """But for the projection ``exact``, which only pinholes and thin lenses have."""
    numbers, refused = NUMBERS.get(lens, {}), set()
    for projection, order in (("ewa", "center"), ("unscented", "pixel"), ("exact", "pixel")):
        approximations = replace(scene.approximations, projection=projection, order=order)
        for content in FRAME_CONTENTS:
            request = FrameRequest(EYE, 12, 8, lens, numbers, content, approximations)
            try:
                assert scene.frame(request).pixels.shape == (8, 12, 3)
            except UserError:
                refused.add(projection)
    assert refused == ({"exact"} if lens in ("opencv", "fisheye", "orthographic") else set())


def test_error_of_orthographic_views_comes_from_the_order_only():
    """``ewa`` is exact there: with the most accurate order there is none."""
    scene = LiveScene(blobs(), ModelConfig(**MOST_ACCURATE), WHITE)
    parallel = replace(REQUEST, lens="orthographic", content="error")
    assert (scene.frame(parallel).pixels == 128).all()
    assert (scene.frame(replace(parallel, lens="pinhole")).pixels != 128).any()


def test_empty_view_has_no_depth(scene):
    away = ViewerCamera(pose_around(0.4, 0.3) @ np.diag([-1.0, 1, -1, 1]), 40.0, RADIUS)
    frame = scene.frame(replace(REQUEST, camera=away, content="depth"))
    assert frame.note == "nothing is seen" and np.ptp(frame.pixels) == 0
