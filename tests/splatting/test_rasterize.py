"""Compositing and its adjoint: lists of any length, bands of any size, uninitialised memory."""

import math

import drjit as dr
import numpy as np
import pytest
from support.cases import by_effects, splats_at, stacked
from support.helpers import FLOAT32, both_precisions

from drgs.splatting import footprint, reduction
from drgs.splatting.rasterize import ONE_SAMPLE
from drgs.splatting.reduction import CompositedPairs, split_bands
from drgs.testing import Case, gradients_equal_differences, image_equals_reference

STACKED = Case("stacked", scene=stacked, count=70)


def faint_layers(case):
    """Splats behind each other around the corner of four tiles."""
    rng, n = np.random.default_rng(case.seed), case.count
    film = case.width / 2 + rng.normal(0, 0.5, (n, 2))
    logits = rng.uniform(-4.5, -2.75, n)
    return splats_at(case, rng, film, np.linspace(2, 3, n), rng.uniform(7, 11, (n, 3)), logits)


@pytest.mark.parametrize("count", [31, 32, 33, 65])
def test_lists_around_32_entries_match_the_reference(count):
    """On four tiles, so that three of the lists begin within a word."""
    film = {"width": 32, "height": 32, "degree": 0}
    case = Case("layers", scene=faint_layers, count=count, reference=by_effects, **film)
    for law in (image_equals_reference, gradients_equal_differences):
        law(case)


@both_precisions
def test_uninitialised_memory_is_never_read(precision):
    """Partial derivatives and rows are stored in uninitialised memory: fill it with NaN first."""
    weights = np.random.default_rng(0).normal(size=(5, STACKED.width * STACKED.height))

    def results():
        gradients = STACKED.gradients(STACKED.values, weights, precision.Float)
        return {"planes": STACKED.planes(STACKED.values, precision.Float), **gradients}

    expected = results()
    poison = [dr.opaque(precision.Float, math.nan, 2**k) for k in range(4, 20) for _ in range(6)]
    del poison
    assert np.isnan(np.array(dr.empty(precision.Float, 2**14))).all(), "freed memory is reused"
    for name, values in results().items():
        np.testing.assert_array_equal(values, expected[name], name)


@pytest.mark.parametrize("band_slots", [1, 400])
def test_band_size_does_not_change_the_result(band_slots, monkeypatch):
    """Not even to the last bit, though fewer tiles than there are in a row have slots at a time."""
    weights = np.random.default_rng(0).normal(size=(5, STACKED.width * STACKED.height))

    def gradients() -> list[bytes]:
        found = STACKED.gradients(STACKED.values, weights, FLOAT32.Float)
        return [values.tobytes() for values in found.values()]

    (frame,) = STACKED.frames(STACKED.values, FLOAT32.Float)[1]
    pairs = CompositedPairs.find(frame.tiles.bins, frame.tiles.stop, ONE_SAMPLE)
    (whole,), expected = split_bands(frame.tiles.bins, pairs), gradients()
    assert whole.num_slots == 16 * len(whole.entries), "the host knows no better"
    monkeypatch.setattr(reduction, "BAND_SLOTS", band_slots)
    monkeypatch.setattr(reduction, "PAIRS_AT_ONCE", 0)
    bands = split_bands(frame.tiles.bins, pairs)
    pairs_composited = sum(int(mask).bit_count() for mask in np.array(pairs.masks))
    assert len(bands) > 1 and sum(band.num_slots for band in bands) == pairs_composited
    assert [tile for band in bands for tile in band.tiles] == [*whole.tiles]
    assert gradients() == expected


def test_short_exp2_is_accurate_to_single_precision():
    x = np.linspace(-126, 127, 2_000_001).astype(np.float32)
    x = np.concatenate([x, np.float32([-126, -0.5, 0.5, 0, 127, -1e-30, -125.5])])
    actual = np.array(footprint.exp2_short(FLOAT32.Float(x))).astype(np.float64)
    exact = np.exp2(x.astype(np.float64))
    assert np.abs(actual / exact - 1).max() < 2.2e-7
