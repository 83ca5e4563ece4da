"""Scenes of any size, anywhere: what is fitted is the same in other units, and far from the origin.

Positions, depths and points are scaled and moved as a whole, so that the photographs stay as they
are. Rounding differs, and over the iterations of Adam it grows to some thousandths of a colour.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support import small_capture as capture
from support.small_fits import true_dataset

import drgs
from drgs.core.origin import MAX_SCENE_SIZES, WORLD
from drgs.datasets import Dataset, load_dataset

CASES = {
    "budget": {},
    "mcmc": {"densify": {"strategy": "mcmc", "mcmc": {"gaussians": 200}}},
    "refined cameras": {"cameras": {"optimise": True}},
    "smoothing": {"model": {"smoothing": True}},
    "depth": {"loss": {"depth_weight": 0.5}},
    "visual hull": {"init": {"start": "masks", "num_points": 100}},
}
"""Sections of a configuration: strategies, starts and effects that have lengths of their own."""

MIN_EQUAL_PSNR_DB = 40.0
"""Measured: 45 to 71 dB for images that differ by rounding alone, 10 to 20 dB if a length of the
program is not in proportion to the scene."""


def scaled(unit: float) -> Dataset:
    """The dataset in a unit of length that is 1 / unit as long."""

    def moved(view):
        pose = view.camera_to_world.copy()
        pose[:3, 3] *= unit
        return replace(view, camera_to_world=pose, depth=np.float32(unit) * view.depth)

    dataset = true_dataset()
    train, test = (tuple(map(moved, views)) for views in (dataset.train, dataset.test))
    return replace(dataset, train=train, test=test)


def images_and_result(case: str, dataset: Dataset):
    config = {
        "data": {"path": "."},
        "iterations": 60,
        "init": {"num_points": 150},
        "densify": {"budget": {"gaussians": 250}},
        **CASES[case],
    }
    result = drgs.train(config, dataset)
    result.trainer.sync_scene()
    return np.stack(list(result.trainer.images(dataset.test))), result.gaussians


@cache
def fit_at_unit_scale(case: str):
    return images_and_result(case, true_dataset())


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1e-6, 1e6])
@pytest.mark.parametrize("case", CASES)
def test_fit_is_invariant_to_units(case, unit):
    expected, gaussians = fit_at_unit_scale(case)
    images, found = images_and_result(case, scaled(unit))
    assert found.num_gaussians == gaussians.num_gaussians
    assert capture.decibels(images, expected) > MIN_EQUAL_PSNR_DB
    np.testing.assert_allclose(
        np.median(found.scales), unit * np.median(gaussians.scales), rtol=0.02
    )


def write_and_load(folder, dataset: Dataset) -> Dataset:
    """Half transparent photographs in the NeRF-synthetic layout; then the true ones."""
    capture.write_dataset(folder, dataset)
    loaded = replace(load_dataset(folder), start_half_extent=None)  # which is about the origin
    for name in ("train", "test"):
        pairs = zip(getattr(loaded, name), getattr(dataset, name), strict=True)
        views = tuple(replace(view, image=true.image, alpha=true.alpha) for view, true in pairs)
        loaded = replace(loaded, **{name: views})
    return loaded


@pytest.mark.slow
@pytest.mark.parametrize("case", ["budget", "refined cameras", "visual hull"])
def test_fit_is_invariant_to_the_origin(case, tmp_path):
    """From files, whose cameras are in Earth-centred coordinates."""
    place = np.array([4.2e6, 1.7e5, -4.78e6])
    dataset = true_dataset()
    near = write_and_load(tmp_path / "near", dataset)
    train, test = (
        tuple(view.with_offset(place) for view in views) for views in (dataset.train, dataset.test)
    )
    far = write_and_load(tmp_path / "far", replace(dataset, train=train, test=test))
    assert near.origin == WORLD
    assert np.abs(np.array(far.origin) - place).max() < 10 < MAX_SCENE_SIZES
    assert "far from the origin: coordinates are relative to (42" in far.description
    expected, gaussians = images_and_result(case, near)
    images, found = images_and_result(case, far)
    assert capture.decibels(images, expected) > MIN_EQUAL_PSNR_DB
    assert found.origin == far.origin
    middle = np.median(found.means.astype(np.float64) + found.origin - place, axis=0)
    np.testing.assert_allclose(middle, np.median(gaussians.means, axis=0), atol=0.1)


def test_extent_with_one_training_camera_uses_all_cameras():
    dataset = true_dataset()
    one = replace(dataset, train=dataset.train[:1])
    centers = np.stack([v.center for v in (*one.train, *one.test)])
    expected = 1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max()
    assert one.extent == pytest.approx(expected)
