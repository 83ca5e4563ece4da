"""Points of a plane sweep are on the surface that the photographs show, in its colours."""

from dataclasses import replace

import numpy as np
import pytest
from support.datasets import dataset_of, look_at, write_points
from support.small_fits import config_of

from drgs.cameras.fisheye import Fisheye
from drgs.config.changes import with_changes
from drgs.core.errors import UserError
from drgs.datasets.types import View
from drgs.initialization.defaults import resolve_defaults
from drgs.initialization.plane_sweep import swept_points
from drgs.initialization.start import start_of

WIDTH, HEIGHT, FOCAL = 110, 80, 90.0
RNG = np.random.default_rng(1)
WAVES = RNG.uniform(-9, 9, (24, 2)), RNG.uniform(0, 6, 24), RNG.normal(0, 0.09, (24, 3))


def texture(x, y):
    """Colours (..., 3) of the ground: a sum of waves, of a few pixels and more."""
    (kx, ky), phases, amplitudes = WAVES[0].T, *WAVES[1:]
    waves = np.sin(x[..., None] * kx + y[..., None] * ky + phases)
    return 0.5 + waves @ amplitudes


def height(x):
    """Height of the ground, scene units: a step of 0.3 at x = 0."""
    return np.where(x > 0, 0.3, 0.0)


def photograph(center, lens=None):
    """A view of the ground; rays meet the upper level, or else the lower one."""
    pose = look_at(center, (0.1, 0.05, 0.1))
    pose[:3, 1:3] *= -1
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    a, b = (u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL
    if lens is None:
        rays = np.stack([a, b, np.ones_like(a)], axis=-1)
    else:  # equidistant
        theta = np.hypot(a, b)
        rays = np.stack([a, b, theta / np.tan(theta)], axis=-1)
    rays = rays @ pose[:3, :3].T
    upper, lower = (
        np.asarray(center) + rays * ((level - center[2]) / rays[..., 2])[..., None]
        for level in (0.3, 0.0)
    )
    hit = np.where((upper[..., 0] > 0)[..., None], upper, lower)
    image = texture(hit[..., 0], hit[..., 1]).astype(np.float32)
    size = FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT
    return View(f"{center}", pose, *size, lens=lens, image=image)


def photographs(lens=None, count=14):
    angles = np.linspace(0, 2, count)
    rng = np.random.default_rng(0)
    return [
        photograph((2.0 * np.sin(a), -2.0 * np.cos(a) + 0.3, 2 + 0.4 * rng.uniform()), lens)
        for a in angles
    ]


@pytest.mark.parametrize("lens", [None, Fisheye.from_coefficients()], ids=["pinhole", "fisheye"])
def test_points_are_on_the_surface_in_its_colours(lens):
    """A pixel is 0.03 scene units wide there, and cameras 1 apart see depths to about as much."""
    points, colors = swept_points(photographs(lens))
    assert len(points) > 0.2 * 14 * WIDTH * HEIGHT
    x, y, z = points.T
    off = np.abs(z - height(x))
    is_inner = np.abs(x) > 0.15  # beside the step
    assert np.quantile(off[is_inner], 0.9) < 0.03 and np.median(off) < 0.01
    error = np.abs(colors - texture(x, y)).mean(axis=1)
    assert np.median(error) < 0.02 and np.quantile(error, 0.9) < 0.06


def test_masked_pixels_are_no_points_and_bytes_are_the_same():
    views = photographs(count=8)
    mask = np.ones((HEIGHT, WIDTH), np.float32)
    mask[:, : WIDTH // 2] = 0
    whole, half = (swept_points([replace(view, mask=m) for view in views]) for m in (None, mask))
    assert 0.2 * len(whole[0]) < len(half[0]) < 0.8 * len(whole[0])
    assert [a.tobytes() for a in whole] == [a.tobytes() for a in swept_points(views)]


def test_photographs_that_do_not_overlap_give_no_points():
    """One camera; cameras in one place; images of noise."""
    views = photographs(count=6)
    assert len(swept_points(views[:1])[0]) == 0
    same = [replace(view, camera_to_world=views[0].camera_to_world) for view in views]
    assert len(swept_points(same)[0]) == 0
    rng = np.random.default_rng(2)
    noise = [replace(v, image=rng.random((HEIGHT, WIDTH, 3), np.float32)) for v in views]
    assert len(swept_points(noise)[0]) < 0.002 * 6 * WIDTH * HEIGHT


def test_a_fit_without_points_starts_there_or_at_random_ones(tmp_path):
    views = photographs()
    config = with_changes(config_of(), {"init.num_points": 500, "seed": 3})

    def start(dataset, **init):
        given = with_changes(config, {f"init.{name}": value for name, value in init.items()})
        return start_of(resolve_defaults(given, dataset), dataset)

    dataset = dataset_of(views)
    found = start(dataset)
    assert "500 of " in found.description and "points of a plane sweep" in found.description
    assert np.median(np.abs(found.means[:, 2] - height(found.means[:, 0]))) < 0.02
    assert "random points" in start(dataset, start="random").description
    write_points(tmp_path / "cloud.ply", np.zeros((9, 3)) + np.arange(9)[:, None], np.zeros((9, 3)))
    with_points = replace(dataset, point_cloud=tmp_path / "cloud.ply")
    assert "plane sweep" in start(with_points, start="sweep").description
    few = dataset_of(views[:2])
    with pytest.raises(UserError, match=r"init.start: a plane sweep needs photographs that over"):
        start(few, start="sweep")
