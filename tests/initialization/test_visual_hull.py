"""Points on visual hulls: of bodies whose surface is known, and of masks that say little."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from support import lenses as reference
from support.analytic_shapes import box, images_of, opaque_at, sphere, together

from drgs.cameras.viewpoints import CameraMotion
from drgs.initialization.start_box import Box
from drgs.initialization.visual_hull import are_masks, hull_points, silhouettes_of

START_BOX = Box(np.zeros(3), 1.3)
BALL = images_of(sphere(0.8), 16)


def carved(views, count=1500, seed=0, within=START_BOX):
    return hull_points(silhouettes_of(views), within, count, seed)


def distances(points):
    return np.linalg.norm(points, axis=1)


def test_points_of_a_ball_are_all_over_its_surface():
    points = carved(BALL)
    assert 0.7 * 1500 < len(points) <= 1500
    assert np.all([opaque_at(view, points) for view in BALL])
    # A shell of area 4 pi r^2 has a cube of this edge for each point.
    cell = np.sqrt(4 * np.pi * 0.8**2 / len(points))
    # A pixel that is partly covered, at distance 4: 0.04. A hull of 16 views bulges by about that.
    assert np.abs(distances(points) - 0.8).max() < cell + 0.04
    # No direction is farther than two cells from the next point.
    directions = points / distances(points)[:, None]
    wanted = np.random.default_rng(1).normal(size=(300, 3))
    wanted /= distances(wanted)[:, None]
    assert (0.8 * np.arccos((wanted @ directions.T).max(axis=1).clip(-1, 1))).max() < 2 * cell


def test_small_object_in_a_large_box_has_as_many_points():
    views = images_of(sphere(0.05, (0.3, 0.2, -0.1)), 12, size=200, samples=1)
    points = carved(views, 500)
    assert len(points) > 300
    assert distances(points - [0.3, 0.2, -0.1]).max() < 0.08


@pytest.mark.slow
def test_thin_pole_is_kept():
    """Its width is a fifth of a pixel and a fifteenth of a cube; beside it is a body."""
    pole = box((-0.004, 0.596, -1), (0.004, 0.604, 1))
    views = images_of(together(pole, sphere(0.4)), 10, samples=7)
    points = carved(views, 600)
    near = points[distances(points[:, :2] - [0, 0.6]) < 0.12]
    assert np.diff(np.sort([-1, *near[:, 2], 1])).max() < 0.25


@pytest.mark.slow
@pytest.mark.parametrize(("is_noise", "limit"), [(False, 20e6), (True, 60e6)])
def test_carving_uses_little_memory(is_noise, limit):
    """The limit is a chunk of cubes, and some numbers of each cube."""
    rng, views = np.random.default_rng(2), BALL
    if is_noise:
        views = [replace(v, alpha=np.float32(rng.uniform(0, 1, v.alpha.shape))) for v in BALL]
    silhouettes = silhouettes_of(views)
    tracemalloc.start()
    hull_points(silhouettes, START_BOX, 3000, 0)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < limit


@pytest.mark.slow
def test_masked_pixels_and_moving_cameras_do_not_carve_the_hull():
    hole = np.zeros((64, 64), bool)
    hole[20:40, 20:40] = True
    wrong = [replace(v, alpha=np.where(hole, 0, v.alpha)) for v in BALL[:2]]
    assert distances(carved([*wrong, *BALL[2:]], 300)).min() < 0.55
    masked = [replace(v, mask=np.where(hole, 0, 1).astype(np.float32)) for v in wrong]
    moving = [replace(v, motion=CameraMotion(np.eye(4), "global")) for v in wrong]
    for ignored in (masked, moving):
        points = carved([*ignored, *BALL[2:]], 300)
        assert np.abs(distances(points) - 0.8).max() < 0.3


def test_distorted_images_are_carved_without_undistortion():
    lens = reference.OpenCV(k1=-0.3, k2=0.05, p1=0.01)
    body = sphere(0.5, (0.6, 0, 0))
    views = images_of(body, 12, size=24, samples=1, lens=lens, focal=1.0)
    points = carved(views, 400)
    assert len(points) > 250
    assert np.abs(distances(points - [0.6, 0, 0]) - 0.5).max() < 0.3
    assert np.all([opaque_at(view, points, lens) for view in views])


def test_hull_ends_where_masks_contradict_or_few_images_show_it():
    points = carved(BALL, 300, within=Box(np.zeros(3), 2.5))
    assert distances(points).max() < 1.1
    elsewhere = images_of(sphere(0.1, (0, 0, 1.1)), 12)
    assert len(carved([*BALL[::2], *elsewhere])) == 0
    assert len(carved([replace(view, alpha=0 * view.alpha) for view in BALL])) == 0


OPAQUE = tuple(replace(view, alpha=np.ones_like(view.alpha)) for view in BALL)
PLAIN = tuple(replace(view, alpha=None) for view in BALL)


@pytest.mark.parametrize(
    ("views", "expected"),
    [
        (BALL, True),
        ((*BALL, *BALL[1:], OPAQUE[0]), True),
        ((*BALL[3:], *OPAQUE[:3]), False),
        ((*BALL[3:], *PLAIN[:3]), False),
        (PLAIN, False),
        (BALL[:2], False),
    ],
)
def test_alpha_is_a_mask_if_nearly_all_images_have_transparency(views, expected):
    assert are_masks(silhouettes_of(views), views) == expected
