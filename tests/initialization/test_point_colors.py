"""Colours of points, from images of bodies whose colours are known."""

from dataclasses import replace

import numpy as np
import pytest
from support.analytic_shapes import (
    WHITE,
    box,
    colors_at,
    directions_to,
    images_of,
    sphere,
    together,
)

from drgs.datasets.types import CameraMotion
from drgs.initialization import point_colors
from drgs.initialization.point_colors import colors_from_images

COUNT = 1000


@pytest.fixture(scope="module")
def ball():
    return images_of(sphere(0.8), 16)


def on_the_ball(radius=0.8):
    """Points evenly on it but for its poles, and how far they are apart."""
    points = radius * directions_to(COUNT)
    return points, np.full(COUNT, radius * np.sqrt(4 * np.pi / COUNT))


def test_points_have_the_colours_of_the_surface(ball):
    points, spacing = on_the_ball()
    colors = colors_from_images(points, spacing, ball, WHITE)
    assert colors.shape == (COUNT, 3) and colors.dtype == np.float32
    # A pixel is 0.045 wide, over which a colour changes by up to 0.027; some are seen obliquely.
    errors = np.abs(colors - colors_at(points))
    assert errors.max() < 0.1 and errors.mean() < 0.006


def test_colours_do_not_depend_on_the_background(ball):
    points, spacing = on_the_ball()
    black = images_of(sphere(0.8), 16, background=(0.0, 0.0, 0.0))
    expected = colors_from_images(points, spacing, ball, WHITE)
    actual = colors_from_images(points, spacing, black, (0.0, 0.0, 0.0))
    np.testing.assert_allclose(actual, expected, atol=1e-5)


def test_a_point_does_not_get_the_colour_of_an_occluder():
    """A wall in front of a ball, of another colour, with points on both."""

    def paint(points):
        return np.where(points[:, :1] > 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])

    wall = box((1.0, -0.6, -0.6), (1.1, 0.6, 0.6))
    views = images_of(together(sphere(0.5), wall), 12, paint=paint)
    points, spacing = on_the_ball(0.5)
    y, z = np.meshgrid(np.linspace(-0.58, 0.58, 40), np.linspace(-0.58, 0.58, 40))
    on_wall = np.concatenate(
        [np.column_stack([np.full(1600, x), y.ravel(), z.ravel()]) for x in (1.0, 1.1)]
    )
    both = np.concatenate([points, on_wall])
    colors = colors_from_images(both, np.full(len(both), spacing[0]), views, WHITE)
    assert (colors[:COUNT, 1] > colors[:COUNT, 0]).mean() > 0.99
    assert (colors[COUNT:, 0] > colors[COUNT:, 1]).mean() > 0.99


def test_outlier_image_does_not_affect_colours(ball):
    points, spacing = on_the_ball()
    wrong = replace(ball[0], image=np.zeros_like(ball[0].image), alpha=np.ones_like(ball[0].alpha))
    colors = colors_from_images(points, spacing, [wrong, *ball[1:], *ball[1:]], WHITE)
    assert np.abs(colors - colors_at(points)).mean() < 0.02


def test_masked_pixels_are_not_used(ball):
    points, spacing = on_the_ball()
    nothing = np.zeros((64, 64), np.float32)
    masked = [replace(view, image=0 * view.image, mask=nothing) for view in ball]
    expected = colors_from_images(points, spacing, ball, WHITE)
    actual = colors_from_images(points, spacing, [*masked[:3], *ball], WHITE)
    np.testing.assert_array_equal(actual, expected)
    assert colors_from_images(points, spacing, masked, WHITE) is None


def test_unseen_point_gets_the_colour_of_the_nearest_seen_one(ball):
    points, spacing = on_the_ball()
    aside = 30 * points[::50] + [0, 0, 0.1]
    both, wide = np.concatenate([points, aside]), np.append(spacing, spacing[::50])
    colors = colors_from_images(both, wide, ball, WHITE)
    seen = colors[:COUNT]
    for point, color in zip(aside, colors[COUNT:], strict=True):
        nearest = np.argmin(((points - point) ** 2).sum(axis=1))
        np.testing.assert_array_equal(color, seen[nearest])


def test_points_that_no_image_shows_have_no_colours(ball):
    points, spacing = on_the_ball()
    assert colors_from_images(100 + points, spacing, ball, WHITE) is None
    assert colors_from_images(points, spacing, [], WHITE) is None
    moving = [replace(view, motion=CameraMotion(np.eye(4), "global")) for view in ball]
    assert colors_from_images(points, spacing, moving, WHITE) is None


def test_few_views_are_used_for_very_many_points(ball, monkeypatch):
    monkeypatch.setattr(point_colors, "MAX_BYTES", 12 * COUNT * 9)
    looked_at = []
    seen = point_colors._find_shown_points
    monkeypatch.setattr(
        point_colors,
        "_find_shown_points",
        lambda view, *rest: looked_at.append(view.name) or seen(view, *rest),
    )
    points, spacing = on_the_ball()
    colors = colors_from_images(points, spacing, ball, WHITE)
    assert looked_at == [f"v{number}" for number in range(0, 16, 2)]
    assert np.abs(colors - colors_at(points)).mean() < 0.02


def test_colour_is_the_interquartile_mean():
    rng = np.random.default_rng(0)
    samples = rng.random((11, 6, 3)).astype(np.float32)
    counts = (0, 1, 2, 4, 7, 11)
    for point, count in enumerate(counts):
        samples[rng.permutation(11)[count:], point] = np.inf
    actual = point_colors._middle_mean(samples)
    assert np.isnan(actual[0]).all()
    for point, count in enumerate(counts[1:], 1):
        for channel in range(3):
            values = sorted(v for v in samples[:, point, channel].tolist() if v != np.inf)
            kept = values[count // 4 : count - count // 4]
            assert actual[point, channel] == pytest.approx(sum(kept) / len(kept), rel=1e-6)
