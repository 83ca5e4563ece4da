"""Points on visual hulls: of bodies whose surface is known, and of masks that say little."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
from support.analytic_shapes import box, images_of, opaque_at, sphere, together

from drgs.datasets.types import CameraMotion
from drgs.initialization.start_box import Box
from drgs.initialization.visual_hull import are_masks, hull_points, silhouettes_of
from drgs.reference import effects as reference

START_BOX = Box(np.zeros(3), 1.3)


def carved(views, count=1500, seed=0, within=START_BOX):
    return hull_points(silhouettes_of(views), within, count, seed)


@pytest.fixture(scope="module")
def ball():
    return images_of(sphere(0.8), 16)


@pytest.fixture(scope="module")
def brick():
    return images_of(box((-0.5, -0.25, -0.75), (0.5, 0.25, 0.75)), 16)


def test_points_of_a_ball_are_on_its_surface(ball):
    points = carved(ball)
    assert 0.7 * 1500 < len(points) <= 1500
    # A shell of area 4 pi r^2 has a cube of this edge for each point.
    cell = np.sqrt(4 * np.pi * 0.8**2 / len(points))
    # A pixel that is partly covered, at distance 4: 0.04. A hull of 16 views bulges by about that.
    off = np.linalg.norm(points, axis=1) - 0.8
    assert off.max() < cell + 0.04
    assert off.min() > -cell - 0.04
    # All over it: no direction is farther than two cells from the next point.
    directions = points / np.linalg.norm(points, axis=1, keepdims=True)
    wanted = np.random.default_rng(1).normal(size=(300, 3))
    wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
    assert (0.8 * np.arccos((wanted @ directions.T).max(axis=1).clip(-1, 1))).max() < 2 * cell


def test_points_of_a_brick_are_on_its_faces(brick):
    points = carved(brick)
    assert 0.7 * 1500 < len(points) <= 1500
    cell = np.sqrt(5.5 / len(points))
    beyond = np.abs(points) - np.array([0.5, 0.25, 0.75])
    assert beyond.max() < cell + 0.04
    assert beyond.max(axis=1).min() > -cell - 0.04


@pytest.mark.parametrize("views", ["ball", "brick"])
def test_every_image_is_opaque_at_hull_points(views, request):
    """Points are projected by the reference, pixel by pixel."""
    views = request.getfixturevalue(views)
    points = carved(views)
    assert np.all([opaque_at(view, points) for view in views])


@pytest.mark.slow
def test_the_number_of_points_is_never_exceeded_and_nearly_reached(ball):
    for count in (50, 400, 3000):
        assert 0.6 * count <= len(carved(ball, count)) <= count


def test_small_object_in_a_large_box_has_as_many_points():
    views = images_of(sphere(0.05, (0.3, 0.2, -0.1)), 12, size=200, samples=1)
    points = carved(views, 500)
    assert len(points) > 300
    assert np.linalg.norm(points - [0.3, 0.2, -0.1], axis=1).max() < 0.08


@pytest.mark.slow
def test_thin_pole_is_kept():
    """Its width is a fifth of a pixel and a fifteenth of a cube; beside it is a body."""
    pole = box((-0.004, 0.596, -1), (0.004, 0.604, 1))
    views = images_of(together(pole, sphere(0.4)), 10, samples=7)
    points = carved(views, 600)
    near = points[np.linalg.norm(points[:, :2] - [0, 0.6], axis=1) < 0.12]
    assert np.diff(np.sort([-1, *near[:, 2], 1])).max() < 0.25


@pytest.mark.slow
def test_the_same_seed_gives_the_same_points(ball):
    first = carved(ball, 300)
    np.testing.assert_array_equal(carved(ball, 300), first)
    assert not np.array_equal(carved(ball, 300, seed=1), first)


@pytest.mark.slow
def test_carving_uses_little_memory(ball):
    """The limit is a chunk of cubes, and some numbers of each cube."""
    silhouettes = silhouettes_of(ball)
    tracemalloc.start()
    hull_points(silhouettes, START_BOX, 3000, 0)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 20e6


@pytest.mark.slow
def test_noisy_silhouettes_use_little_memory(ball):
    rng = np.random.default_rng(2)
    noisy = [replace(v, alpha=rng.uniform(0, 1, v.alpha.shape).astype(np.float32)) for v in ball]
    tracemalloc.start()
    hull_points(silhouettes_of(noisy), START_BOX, 3000, 0)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 60e6


def test_silhouettes_of_large_images_are_downscaled(ball):
    large = [replace(v, alpha=np.kron(v.alpha, np.ones((20, 20), np.float32))) for v in ball[:2]]
    for silhouette, view in zip(silhouettes_of(large), ball, strict=False):
        assert silhouette.scale == 3 and silhouette.solid.shape == (427, 427)
        wide = np.pad(np.kron(view.alpha, np.ones((20, 20))), ((0, 1), (0, 1)))
        largest = wide.reshape(427, 3, 427, 3).max(axis=(1, 3))
        opaque = largest > 4 / 255
        np.testing.assert_array_equal(silhouette.solid, largest >= 0.5)
        for rows, columns in ((427, 427), (200, 210), (1, 1), (250, 1)):
            assert silhouette.table[rows, columns] == opaque[:rows, :columns].sum()


def test_masked_pixels_do_not_carve_the_hull(ball):
    hole = np.zeros((64, 64), bool)
    hole[20:40, 20:40] = True
    wrong = [replace(v, alpha=np.where(hole, 0, v.alpha)) for v in ball[:2]]
    assert np.linalg.norm(carved([*wrong, *ball[2:]], 300), axis=1).min() < 0.55
    masked = [replace(v, mask=np.where(hole, 0, 1).astype(np.float32)) for v in wrong]
    points = carved([*masked, *ball[2:]], 300)
    assert np.abs(np.linalg.norm(points, axis=1) - 0.8).max() < 0.3


def test_moving_camera_is_left_out(ball):
    moving = replace(ball[0], motion=CameraMotion(np.eye(4), "global"), alpha=0 * ball[0].alpha)
    assert len(silhouettes_of([moving, *ball[1:]])) == 15
    assert len(carved([moving, *ball[1:]], 300)) > 200


def test_distorted_images_are_carved_without_undistortion():
    lens = reference.OpenCV(k1=-0.3, k2=0.05, p1=0.01)
    body = sphere(0.5, (0.6, 0, 0))
    views = images_of(body, 12, size=24, samples=1, lens=lens, focal=1.0)
    points = carved(views, 400)
    assert len(points) > 250
    off = np.linalg.norm(points - [0.6, 0, 0], axis=1) - 0.5
    assert np.abs(off).max() < 0.3
    assert np.all([opaque_at(view, points, lens) for view in views])


def test_contradictory_masks_have_no_hull(ball):
    elsewhere = images_of(sphere(0.1, (0, 0, 1.1)), 12)
    assert len(carved([*ball[::2], *elsewhere])) == 0
    assert len(carved([replace(view, alpha=0 * view.alpha) for view in ball])) == 0


def test_regions_that_few_images_show_are_not_part_of_the_hull(ball):
    points = carved(ball, 300, within=Box(np.zeros(3), 2.5))
    assert np.linalg.norm(points, axis=1).max() < 1.1


def test_alpha_is_a_mask_if_nearly_all_images_have_transparency(ball):
    opaque = [replace(view, alpha=np.ones_like(view.alpha)) for view in ball]
    plain = [replace(view, alpha=None) for view in ball]
    for views, expected in (
        (ball, True),
        ([*ball, *ball[1:], opaque[0]], True),
        ([*ball[3:], *opaque[:3]], False),
        ([*ball[3:], *plain[:3]], False),
        (opaque, False),
        (plain, False),
        (ball[:2], False),
    ):
        assert are_masks(silhouettes_of(views), views) == expected
