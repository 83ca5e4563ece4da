"""Compositing, its adjoint and its tangent against the float64 reference, stage alone."""

import math
from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from support.compositing_checks import (
    GRADIENTS,
    as_arrays,
    check_gradients_equal_the_reference,
    random_flat_scene,
    stack,
)
from support.helpers import (
    FLOAT32,
    FLOAT64,
    assert_arrays_agree,
    both_precisions,
    relative_errors,
    rows,
    single,
)

from drgs.core.constants import WHITENING_SCALE
from drgs.splatting import footprint
from drgs.splatting import lanes as lanes_module
from drgs.splatting import reduction as slots_module
from drgs.splatting.grid import MICROS, TileGrid
from drgs.splatting.rasterize import ONE_SAMPLE, composite_adjoint
from drgs.splatting.reduction import CompositedPairs, assign_slots, split_bands

# float64: some hundred terms of the size of the result. float32: an exponent of up to 8 carries
# 1e-6, so alpha 1e-6 and a pixel a few of them; measured 1e-6. In the adjoint, S is the
# difference of numbers of the size of C.g + T G, off by some 1e-7 of them, and is divided by
# 1 - a >= 0.01: behind an opaque splat a pixel may be off by 1e-5, and a derivative sums pixels
# of both signs. Measured: 3e-15 and 5e-6.
PLANES = {FLOAT64: 1e-12, FLOAT32: 1e-5}


SCENES = {
    "one pixel": random_flat_scene(1, 1, 20, 1),
    "37x29": random_flat_scene(37, 29, 90, 3),
    "five features": random_flat_scene(33, 18, 60, 5),
    "opaque": random_flat_scene(37, 29, 70, 3, opaque=True),
}


all_scenes = pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)


def test_scenes_enter_every_branch():
    opaque = SCENES["opaque"]
    assert opaque.num_stopped() >= 100 and opaque.num_clamped() >= 20
    bins, _, layers = opaque.composite(FLOAT64)
    assert bins.num_entries > 2 * 32
    # Some micro-tile has stopped before the end of its tile's entries.
    ends = np.repeat(np.array(bins.tile_start)[1:], MICROS)
    assert (np.array(layers.stop) <= ends).all() and (np.array(layers.stop) < ends).any()


# ----------------------------------------------------------------------------------------------
# Against the reference
# ----------------------------------------------------------------------------------------------


@both_precisions
@all_scenes
def test_planes_and_gradients_equal_the_reference(precision, scene):
    check_gradients_equal_the_reference(precision, scene)
    assert_arrays_agree(scene.kernel_planes(precision), scene.reference_planes(), PLANES[precision])


# ----------------------------------------------------------------------------------------------
# Decisions
# ----------------------------------------------------------------------------------------------


@both_precisions
def test_the_second_clamped_splat_stops_the_pixel(precision):
    """(1 - 0.99f)^2 is 2e-6, relative, below the stop; with the double 0.99 it is not."""
    planes = stack([0.999, 0.999, 0.5]).kernel_planes(precision)
    assert planes["transmittance"][0, 0] == pytest.approx(0.01, rel=1e-5)
    np.testing.assert_allclose(planes["features"][0, 0], [0.99], rtol=1e-6)


@pytest.mark.slow
@both_precisions
@pytest.mark.parametrize("count", [1, 31, 32, 33, 64, 65, 200])
def test_lists_around_32_entries_match_the_reference(precision, count):
    """On four tiles, so that three of the lists begin within a word."""
    opacities = np.random.default_rng(count).uniform(0.01, 0.06, count)
    scene = stack(opacities, 20, 20, sigma=9.0)
    assert_arrays_agree(scene.kernel_planes(precision), scene.reference_planes(), PLANES[precision])
    # Isotropic splats on a symmetric film: eight pixels may be near the cut at once.
    kept = ~scene.near_threshold()
    assert kept.sum() >= kept.size - 16
    d_features, d_transmittance = scene.random_cotangents(count)
    cotangents = d_features * kept[..., None], d_transmittance * kept
    assert_arrays_agree(
        scene.kernel_gradients(precision, *cotangents),
        scene.reference_gradients(*cotangents),
        GRADIENTS[precision],
    )


@both_precisions
def test_uninitialised_memory_is_never_read(precision):
    """Partial derivatives and rows are stored in uninitialised memory: fill it with NaN first."""
    scene = SCENES["opaque"]
    cotangents = scene.random_cotangents()
    expected = scene.kernel_gradients(precision, *cotangents)
    frame = scene.composite(precision)
    poison = [dr.opaque(precision.Float, math.nan, 2**k) for k in range(4, 20) for _ in range(6)]
    del poison
    assert np.isnan(np.array(dr.empty(precision.Float, 2**14))).all(), "freed memory is reused"
    gradients = as_arrays(
        composite_adjoint(
            *frame,
            [precision.array(plane) for plane in np.moveaxis(cotangents[0], -1, 0)],
            precision.array(cotangents[1]),
        )
    )
    for name, values in expected.items():
        np.testing.assert_array_equal(gradients[name], values)
    np.testing.assert_array_equal(
        scene.kernel_planes(precision)["features"], scene.as_images(frame[2].planes())["features"]
    )


# ----------------------------------------------------------------------------------------------
# Pieces
# ----------------------------------------------------------------------------------------------


def test_short_exp2_is_accurate_to_single_precision():
    x = np.linspace(-126, 127, 2_000_001).astype(np.float32)
    x = np.concatenate([x, np.float32([-126, -0.5, 0.5, 0, 127, -1e-30, -125.5])])
    actual = np.array(footprint.exp2_short(FLOAT32.Float(x))).astype(np.float64)
    exact = np.exp2(x.astype(np.float64))
    assert np.abs(actual / exact - 1).max() < 2.2e-7


@pytest.mark.parametrize("size", [(1, 1), (37, 29), (64, 48), (160, 16), (100, 90)])
def test_lanes_visit_every_micro_tile_once(size):
    grid = TileGrid(*size)
    lanes = lanes_module.make_lanes(FLOAT32.Float, grid)
    micro_tile, micro, tile, x, y = (
        np.array(getattr(lanes, name)).astype(int)
        for name in ("micro_tile", "micro", "tile", "x", "y")
    )
    np.testing.assert_array_equal(np.sort(micro_tile), np.arange(grid.num_tiles * MICROS))
    np.testing.assert_array_equal(micro_tile, tile * MICROS + micro)
    np.testing.assert_array_equal(x, tile % grid.columns * 16 + micro % 4 * 4)
    np.testing.assert_array_equal(y, tile // grid.columns * 16 + micro // 4 * 4)


@both_precisions
@pytest.mark.parametrize("count", [0, 1, 2, 3, 7])
def test_records_contain_geometry_and_features_of_each_overlapping_entry(precision, count):
    scene = SCENES["37x29"]
    features = np.random.default_rng(0).normal(size=(len(scene.depths), count))
    scene = replace(scene, features=single(features))
    bins, records, _ = scene.composite(precision)
    entries = dr.arange(type(bins.ranks), bins.num_entries)
    packed = np.stack([np.array(column) for column in records.rows.load(entries)], axis=1)
    gaussians = np.array(bins.order)[np.array(bins.ranks)[: bins.num_entries]]
    expected = np.column_stack(
        [
            rows(precision.vectors(scene.means2d)),
            rows(precision.vectors(scene.conic_factor) * WHITENING_SCALE),
            np.array(dr.log2(precision.array(scene.opacities))),
            *(np.array(precision.array(column)) for column in scene.features.T),
        ]
    )
    touches = np.array(bins.masks)[: bins.num_entries] != 0
    np.testing.assert_array_equal(packed[touches], expected[gaussians][touches])
    assert 0 < touches.sum() < len(touches) and not packed[~touches].any()


@both_precisions
def test_composited_pairs_have_unique_contiguous_slots(precision):
    """Every pair that is composited has a slot of its own, and a lane's slots are contiguous."""
    scene = SCENES["opaque"]
    bins, _, layers = scene.composite(precision)
    composited_pairs = CompositedPairs.find(bins, layers.stop, ONE_SAMPLE)
    (band,) = split_bands(bins, composited_pairs)
    slots, composited = assign_slots(composited_pairs, band), np.array(composited_pairs.masks)
    pairs = np.array(slots.pairs).astype(np.int64).reshape(-1, MICROS, 2)
    tiles, stop = np.array(bins.tiles), np.array(layers.stop).reshape(-1, MICROS)
    masks, found = np.array(bins.masks), {}
    for micro in range(MICROS):
        for entry in range(bins.num_entries):
            expected = masks[entry] >> micro & 1 and entry < stop[tiles[entry], micro]
            assert composited[entry] >> micro & 1 == expected
            if expected:
                first, word = pairs[entry // 32, micro]
                found[micro, entry] = first + bin(word & ((1 << entry % 32) - 1)).count("1")
    assert list(found.values()) == list(range(band.num_slots)) and band.num_slots > 0

    lanes = lanes_module.make_lanes(precision.Float, bins.grid)
    lane_stop = dr.gather(dr.llvm.ad.UInt32, layers.stop, lanes.micro_tile)
    number = np.array(slots.number(lanes_module.Entries(bins, lanes, lane_stop)))
    begins = np.searchsorted(tiles[: bins.num_entries], np.arange(bins.grid.num_tiles))
    expected = [
        sum(1 for m, entry in found if m == micro and begins[tile] <= entry < stop[tile, micro])
        for tile, micro in zip(np.array(lanes.tile), np.array(lanes.micro), strict=True)
    ]
    np.testing.assert_array_equal(number, expected)
    counted = lanes_module.count_entries(lanes_module.Entries(bins, lanes, lane_stop))
    np.testing.assert_array_equal(counted, expected)
    assert len(set(expected)) > 3
    similar = lanes_module.group_by_work(
        precision.Float, bins.grid, slots.number(lanes_module.Entries(bins, lanes, lane_stop))
    )
    np.testing.assert_array_equal(np.sort(similar.micro_tile), np.sort(lanes.micro_tile))
    assert band.num_slots < sum(bin(mask).count("1") for mask in masks), (
        "some pairs are behind a stop"
    )


@pytest.mark.parametrize("band_slots", [1, 50, 400])
def test_band_size_does_not_change_the_result(band_slots, monkeypatch):
    """Not even to the last bit, though fewer tiles than there are in a row have slots at a time."""
    scene = SCENES["opaque"]
    bins, records, layers = scene.composite(FLOAT32)
    rng = np.random.default_rng(0)
    size = bins.grid.width * bins.grid.height
    d_planes = [FLOAT32.array(rng.normal(size=size)) for _ in range(1 + layers.count)]

    def gradients() -> list[bytes]:
        found = composite_adjoint(bins, records, layers, d_planes[1:], d_planes[0])
        return [np.array(column).tobytes() for column in found.geometry + found.features]

    pairs = CompositedPairs.find(bins, layers.stop, ONE_SAMPLE)
    (whole,), expected = split_bands(bins, pairs), gradients()
    monkeypatch.setattr(slots_module, "BAND_SLOTS", band_slots)
    bands = split_bands(bins, pairs)
    assert len(bands) > 1 and sum(band.num_slots for band in bands) == whole.num_slots
    assert [tile for band in bands for tile in band.tiles] == [*whole.tiles]
    assert gradients() == expected


def test_comparison_is_relative_to_each_array():
    errors = relative_errors({"a": np.array([2.0, 1.0])}, {"a": np.array([2.0, 1.5])})
    assert errors == {"a": 0.25}
    with pytest.raises(AssertionError, match=r"a\[1\]: kernels nan"):
        assert_arrays_agree({"a": np.array([2.0, np.nan])}, {"a": np.array([2.0, 1.5])}, 1.0)
