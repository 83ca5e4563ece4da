"""Analytic shapes, and images of them with alpha: rays through every pixel, in float64."""

import numpy as np

from drgs.datasets.types import Dataset, View
from support.datasets import look_at
from support.lens_scenes import PINHOLE, kernel_lens
from support.small_capture import reference_camera

WHITE = (1.0, 1.0, 1.0)
DISTANCE = 4.0


def sphere(radius, center=(0, 0, 0)):
    """Distances along rays at which a ball is met; inf: it is not."""

    def hit(origin, directions):
        offset = origin - np.asarray(center, float)
        along = directions @ offset
        squared = along**2 - offset @ offset + radius**2
        return np.where(squared > 0, -along - np.sqrt(np.maximum(squared, 0)), np.inf)

    return hit


def box(low, high):
    """The same of a box along the axes."""

    def hit(origin, directions):
        with np.errstate(divide="ignore"):
            a, b = ((np.asarray(c, float) - origin) / directions for c in (low, high))
        first, last = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        return np.where((first < last) & (first > 0), first, np.inf)

    return hit


def together(*shapes):
    """Whichever is met first."""
    return lambda origin, directions: np.min([b(origin, directions) for b in shapes], axis=0)


def colors_at(points):
    """(N, 3) in 0.1..0.9: changes smoothly with the place."""
    return 0.5 + 0.4 * np.sin(1.5 * points)


def directions_to(count):
    """(count, 3): evenly over the sphere (a golden-angle spiral), the poles left out."""
    height = 0.95 * (1 - 2 * (np.arange(count) + 0.5) / count)
    azimuth = np.arange(count) * np.pi * (3 - np.sqrt(5))
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)


def image_of(
    shape, name, center, size=64, samples=2, lens=None, background=WHITE, focal=1.4, paint=colors_at
):
    """A view towards the origin; lens: of the reference, as well; samples: of a pixel, squared."""
    pose = look_at(center, (0, 0, 0)) * [1, -1, -1, 1]
    focal, middle = focal * size, size / 2
    fine = (np.arange(size * samples) + 0.5) / samples
    slopes = np.stack(np.meshgrid(fine, fine), axis=-1).reshape(-1, 2) / focal - middle / focal
    if lens is not None:
        slopes = lens.undistort(slopes)
    rays = np.column_stack([slopes, np.ones(len(slopes))])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    rays = rays @ pose[:3, :3].T
    distance = shape(np.asarray(center, float), rays)
    met = np.isfinite(distance)
    colors = np.zeros((len(rays), 3))
    colors[met] = paint(np.asarray(center) + distance[met, None] * rays[met])

    def averaged(values):
        return values.reshape(size, samples, size, samples, -1).mean(axis=(1, 3))

    alpha = averaged(met.astype(float))
    image = averaged(colors) + (1 - alpha) * np.array(background)
    host = lens and kernel_lens(lens)
    planes = {"image": image.astype(np.float32), "alpha": alpha[..., 0].astype(np.float32)}
    return View(name, pose, focal, focal, middle, middle, size, size, host, **planes)


def images_of(shape, count=20, **options):
    """Views from all around."""
    return tuple(
        image_of(shape, f"v{number}", DISTANCE * direction, **options)
        for number, direction in enumerate(directions_to(count))
    )


def dataset_of_images(views, half_extent=1.3, background=WHITE, **fields):
    """All of them to train on."""
    return Dataset(tuple(views), (), "test", background, half_extent, "", **fields)


def opaque_at(view, points, lens=PINHOLE):
    """(N,) bool: whether the image shows something at the places of points (N, 3), world.

    Projection by the reference. True where the image does not show them.
    """
    camera = reference_camera(view)
    position = (points - view.center) @ view.camera_to_world[:3, :3]
    column, row = np.floor(lens.film_points(camera, position)).astype(int).T
    inside = lens.is_seen(camera, position)
    inside &= (column >= 0) & (row >= 0) & (column < view.width) & (row < view.height)
    alpha = np.asarray(view.alpha)
    return ~inside | (alpha[np.where(inside, row, 0), np.where(inside, column, 0)] > 4 / 255)
