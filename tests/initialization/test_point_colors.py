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

from drgs.cameras.viewpoints import CameraMotion
from drgs.initialization import start
from drgs.initialization.start import colors_from_images

COUNT, RADIUS = 1000, 0.8
BALL = images_of(sphere(RADIUS), 16)
POINTS = RADIUS * directions_to(COUNT)  # evenly on it but for its poles
SPACING = np.full(COUNT, RADIUS * np.sqrt(4 * np.pi / COUNT))
NOTHING = np.zeros((64, 64), np.float32)
MASKED = [replace(view, image=0 * view.image, mask=NOTHING) for view in BALL]
MOVING = [replace(view, motion=CameraMotion(np.eye(4), "global")) for view in BALL]
BLACK = replace(BALL[0], image=0 * BALL[0].image, alpha=np.ones_like(BALL[0].alpha))


def colors_of(views, background=WHITE):
    return colors_from_images(POINTS, SPACING, views, background)


@pytest.mark.parametrize(
    ("views", "max_mean"),
    [(BALL, 0.006), ([*MASKED[:3], *BALL], 0.006), ([BLACK, *BALL[1:], *BALL[1:]], 0.02)],
    ids=["all", "some masked", "an outlier"],
)
def test_points_have_the_colours_of_the_surface(views, max_mean):
    colors = colors_of(views)
    assert colors.shape == (COUNT, 3) and colors.dtype == np.float32
    # A pixel is 0.045 wide, over which a colour changes by up to 0.027; some are seen obliquely.
    errors = np.abs(colors - colors_at(POINTS))
    assert errors.mean() < max_mean and (views is not BALL or errors.max() < 0.1)


def test_colours_do_not_depend_on_the_background():
    black = (0.0, 0.0, 0.0)
    actual = colors_of(images_of(sphere(RADIUS), 16, background=black), black)
    np.testing.assert_allclose(actual, colors_of(BALL), atol=1e-5)


def test_a_point_does_not_get_the_colour_of_an_occluder():
    """A wall in front of a ball, of another colour, with points on both."""

    def paint(points):
        return np.where(points[:, :1] > 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])

    wall = box((1.0, -0.6, -0.6), (1.1, 0.6, 0.6))
    views = images_of(together(sphere(0.5), wall), 12, paint=paint)
    side = np.linspace(-0.58, 0.58, 40)
    on_wall = np.stack(np.meshgrid([1.0, 1.1], side, side), axis=-1).reshape(-1, 3)
    both = np.concatenate([0.5 * directions_to(COUNT), on_wall])
    spacing = np.full(len(both), 0.5 * np.sqrt(4 * np.pi / COUNT))
    colors = colors_from_images(both, spacing, views, WHITE)
    assert (colors[:COUNT, 1] > colors[:COUNT, 0]).mean() > 0.99
    assert (colors[COUNT:, 0] > colors[COUNT:, 1]).mean() > 0.99


def test_unseen_point_gets_the_colour_of_the_nearest_seen_one():
    aside = 30 * POINTS[::50] + [0, 0, 0.1]
    both, wide = np.concatenate([POINTS, aside]), np.append(SPACING, SPACING[::50])
    colors = colors_from_images(both, wide, BALL, WHITE)
    for point, color in zip(aside, colors[COUNT:], strict=True):
        nearest = np.argmin(((POINTS - point) ** 2).sum(axis=1))
        np.testing.assert_array_equal(color, colors[nearest])


@pytest.mark.parametrize("views", [[], MASKED, MOVING], ids=["none", "masked", "moving"])
def test_points_that_no_image_shows_have_no_colours(views):
    assert colors_of(views) is None
    assert colors_from_images(100 + POINTS, SPACING, BALL, WHITE) is None


def test_few_views_are_used_for_very_many_points(monkeypatch):
    monkeypatch.setattr(start, "MAX_COLOR_BYTES", 12 * COUNT * 9)
    # Colours of every other view are those of all: the others are not looked at.
    expected = colors_of(BALL[::2])
    np.testing.assert_array_equal(colors_of(BALL), expected)
    assert np.abs(expected - colors_at(POINTS)).mean() < 0.02
