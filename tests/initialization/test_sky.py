"""A dome behind everything where photographs show sky, and none where they do not."""

from dataclasses import replace

import numpy as np
import pytest
from support.datasets import dataset_of, look_at, write_points
from support.small_fits import config_of

from drgs.config.changes import with_changes
from drgs.datasets.types import View
from drgs.initialization.defaults import resolve_defaults
from drgs.initialization.sky import NUM_GAUSSIANS, OPACITY, find_sky
from drgs.initialization.start import gaussians_at, start_of

WIDTH, HEIGHT, FOCAL = 96, 72, 70.0


def sky_color(rays):
    """Colours (..., 3) of directions, which change slowly."""
    x, y, z = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True), -1, 0)
    return np.stack([0.4 + 0.3 * x, 0.5 + 0.3 * y, 0.6 + 0.3 * z], axis=-1)


def photograph(center, target, distance=None):
    """Ground below the horizon, of a colour that changes with the place; above it, sky.

    distance: of a wall in place of the sky, whose colours change with the place.
    """
    pose = look_at(center, target)
    pose[:3, 1:3] *= -1
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    rays = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1)
    rays = rays @ pose[:3, :3].T
    is_ground = rays[..., 2] < 0
    place = center + rays * (-center[2] / np.where(is_ground, rays[..., 2], -1))[..., None]
    ground = 0.5 + 0.4 * np.sin(3 * place)
    if distance is None:
        above = sky_color(rays)
    else:
        t = distance / np.hypot(rays[..., 0], rays[..., 1])
        above = 0.5 + 0.45 * np.sin(6 * (center + rays * t[..., None]))
    image = np.where(is_ground[..., None], ground, above).astype(np.float32)
    return View(f"{center}", pose, FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, image=image)


def photographs(distance=None):
    angles = np.linspace(0, 5, 24)
    centers = [np.array([3 * np.cos(a), 3 * np.sin(a), 1 + 0.5 * np.sin(5 * a)]) for a in angles]
    return [photograph(center, (0, 0, 1.4), distance) for center in centers]


@pytest.fixture
def ground():
    xy = np.random.default_rng(0).uniform(-12, 12, (6000, 2))
    return np.column_stack([xy, np.zeros(len(xy))])


def test_dome_is_far_and_has_the_colours_of_the_sky(ground):
    sky = find_sky(photographs(), ground)
    middle = np.mean([view.center for view in photographs()], axis=0)
    away = sky.means - middle
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), np.linalg.norm(away[0]))
    assert np.linalg.norm(away[0]) > 20 * 3  # cameras are 3 from the middle
    elevation = np.degrees(np.arcsin(away[:, 2] / np.linalg.norm(away[0])))
    shown = (elevation > 12) & (elevation < 25)  # above the cells with points, in several images
    error = np.abs(sky.colors - sky_color(away))
    assert np.median(error[shown]) < 0.02 and error[shown].max() < 0.1
    assert error[elevation > 25].max() < 0.35  # of the nearest ones, where no photograph looks


def test_no_dome_where_there_are_points_or_photographs_disagree(ground):
    views = photographs()
    wall = np.random.default_rng(1).uniform(0, 2 * np.pi, 20_000)
    heights = np.random.default_rng(2).uniform(0, 9, len(wall))
    wall = np.column_stack([9 * np.cos(wall), 9 * np.sin(wall), heights])
    assert find_sky(views, np.concatenate([ground, wall])) is None
    assert find_sky(photographs(distance=6.0), ground) is None
    mask = np.zeros((HEIGHT, WIDTH), np.float32)
    assert find_sky([replace(view, mask=mask) for view in views], ground) is None
    cut_out = [replace(view, alpha=np.ones((HEIGHT, WIDTH), np.float32)) for view in views]
    assert find_sky(cut_out, ground) is None


def test_a_fit_from_points_starts_with_the_dome_unless_told(ground, tmp_path):
    cloud = tmp_path / "cloud.ply"
    write_points(cloud, ground, np.full((len(ground), 3), 99))
    dataset = replace(dataset_of(photographs()), point_cloud=cloud)
    config = config_of()
    for settings, extra in (({}, NUM_GAUSSIANS), ({"init.sky": False}, 0)):
        given = resolve_defaults(with_changes(config, settings), dataset)
        start = start_of(given, dataset)
        gaussians = gaussians_at(start, given)
        assert gaussians.num_gaussians == len(ground) + extra
        assert ("of directions are sky" in start.description) == bool(extra)
        opacities = 1 / (1 + np.exp(-gaussians.logit_opacities[len(ground) :]))
        np.testing.assert_allclose(opacities, OPACITY, rtol=1e-5)
