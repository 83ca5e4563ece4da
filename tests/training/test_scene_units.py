"""Scenes of any size, anywhere: what is fitted is the same in other units, and far from the origin.

Positions, depths and points are scaled and moved as a whole, so that the photographs stay as they
are. Rounding differs, and over the iterations of Adam it grows to some thousandths of a colour.
"""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support import small_capture as capture
from support.small_fits import true_dataset, with_all_views

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

    return with_all_views(true_dataset(), moved)


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
    expected = unit * np.median(gaussians.scales)
    np.testing.assert_allclose(np.median(found.scales), expected, rtol=0.02)


def write_and_load(folder, dataset: Dataset) -> Dataset:
    """Half transparent photographs in the NeRF-synthetic layout; then the true ones."""
    capture.write_dataset(folder, dataset)
    true = iter((*dataset.train, *dataset.test))

    def as_true(view):
        photo = next(true)
        return replace(view, image=photo.image, alpha=photo.alpha)

    # The half extent is about the origin.
    return with_all_views(replace(load_dataset(folder), start_half_extent=None), as_true)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["budget", "refined cameras", "visual hull"])
def test_fit_is_invariant_to_the_origin(case, tmp_path):
    """From files, whose cameras are in Earth-centred coordinates."""
    place = np.array([4.2e6, 1.7e5, -4.78e6])
    dataset = true_dataset()
    near = write_and_load(tmp_path / "near", dataset)
    moved = with_all_views(dataset, lambda view: view.with_offset(place))
    far = write_and_load(tmp_path / "far", moved)
    assert near.origin == WORLD
    assert np.abs(np.array(far.origin) - place).max() < 10 < MAX_SCENE_SIZES
    assert "far from the origin: coordinates are relative to (42" in far.description
    expected, gaussians = images_and_result(case, near)
    images, found = images_and_result(case, far)
    assert capture.decibels(images, expected) > MIN_EQUAL_PSNR_DB
    assert found.origin == far.origin
    middle = np.median(found.means.astype(np.float64) + found.origin - place, axis=0)
    np.testing.assert_allclose(middle, np.median(gaussians.means, axis=0), atol=0.1)
