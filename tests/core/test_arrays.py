"""Rows, packets, and numbers that come from the host."""

from functools import partial

import drjit as dr
import numpy as np
import pytest
from support.helpers import both_precisions
from support.kernels import kernel_hashes

from drgs.core import arrays, private

UInt32, Bool = dr.llvm.ad.UInt32, dr.llvm.ad.Bool


def numbered(precision, count, length=5) -> list:
    """Columns whose numbers say where they belong."""
    return [precision.array(np.arange(length) * 100.0 + k) for k in range(count)]


def table(count, length=5) -> np.ndarray:
    return np.arange(length)[:, None] * 100.0 + np.arange(count)


@both_precisions
@pytest.mark.parametrize("count", [1, 2, 3, 4, 6, 7, 9, 12, 16, 45])
def test_rows_are_stored_and_loaded_for_active_lanes_only(precision, count):
    rows = arrays.Rows.empty(precision.Float, count, 6)
    rows.store([precision.array(np.full(6, -1.0))] * count, dr.arange(UInt32, 6))
    lanes, active = UInt32(5, 0, 2, 3, 1), Bool(True, True, True, False, True)
    rows.store(numbered(precision, count), lanes, active)
    expected = np.full((6, count), -1.0)
    expected[[5, 0, 2, 1]] = table(count)[[0, 1, 2, 4]]
    lanes, active = UInt32(4, 4, 0, 2, 1, 3, 5), Bool(True, False, *[True] * 5)
    loaded = np.stack([np.array(v) for v in rows.load(lanes, active)], axis=1)
    expected = expected[np.array(lanes)] * np.array(active)[:, None]
    np.testing.assert_array_equal(loaded, expected)


# Arrays of one to five rows of 9, 11 and 45 numbers end anywhere in a packet.
@pytest.mark.slow
@both_precisions
@pytest.mark.parametrize("num_rows", [1, 2, 3, 4, 5])
@pytest.mark.parametrize("width", [1, 3, 4, 6, 9, 11, 24, 45])
def test_contiguous_rows_are_loaded_and_stored(precision, width, num_rows):
    flat = precision.array(table(width, num_rows).ravel())
    lanes = UInt32(np.arange(num_rows)[::-1].copy())
    for count in {1, width // 2 + 1, width}:
        loaded = arrays.load_columns(flat, lanes, dr.opaque(UInt32, num_rows), width, count)
        loaded = np.stack([np.array(v) for v in loaded], axis=1)
        np.testing.assert_array_equal(loaded, table(width, num_rows)[::-1, :count])
    stored = arrays.store_columns(numbered(precision, width, num_rows))
    dr.eval(stored)
    np.testing.assert_array_equal(arrays.first_numbers(stored, num_rows * width), np.array(flat))


@both_precisions
@pytest.mark.parametrize("is_evaluated", [True, False])
def test_shifted_views_are_parts_of_an_array(precision, is_evaluated, monkeypatch):
    """They share its memory, or are gathered where Dr.Jit has no such functions."""
    expected = np.arange(80) * 2.0
    assert private._view_functions() is not None
    for functions in (private._view_functions, lambda: None):
        monkeypatch.setattr(private, "_view_functions", functions)
        array = dr.arange(precision.Float, 80) * 2
        if is_evaluated:
            dr.eval(array)
        views = private.shifted_views(array, [0, 3, 17], 63)
        begin, second = (each.numpy().ctypes.data for each in (array, views[1]))
        is_same_memory = second == begin + 3 * dr.itemsize_v(array)
        assert is_same_memory == (private._view_functions() is not None)
        for start, view in zip((0, 3, 17), views, strict=True):
            np.testing.assert_array_equal(np.array(view + 1), expected[start:][:63] + 1)
        literal = private.shifted_views(dr.full(precision.Float, 3, 9), [2], 7)
        np.testing.assert_array_equal(np.array(literal[0]), np.full(7, 3.0))


@pytest.mark.parametrize("starts", [[-1, 2], [0, 4]])
def test_views_beyond_an_array_are_refused(starts):
    with pytest.raises(IndexError, match=r"shifted_views\(\): 7 of 10 numbers from "):
        private.shifted_views(dr.arange(dr.llvm.Float, 10), starts, 7)


def test_alignment_of_numpy_arrays_does_not_affect_kernels():
    hashes = set()
    for offset in range(8):
        values = np.arange(64, dtype=np.float32)[offset : offset + 40]
        result = arrays.from_host(dr.llvm.ad.Float, values) * 1.25 + 0.5
        hashes |= kernel_hashes(partial(dr.eval, result))
    assert len(hashes) == 1


@pytest.mark.parametrize("divisor", [1, 3, 400, 1265, 65535, 2**19 - 1])
def test_quotients_are_exact_around_multiples(divisor):
    last = 2**32 - 1
    multiples = np.unique(np.linspace(0, last // divisor, 1000).astype(np.uint64)) * divisor
    index = np.concatenate([multiples, multiples[1:] - 1, multiples + (divisor - 1), [last]])
    index = index[index <= last].astype(np.uint32)
    np.testing.assert_array_equal(
        np.array(arrays.quotient(UInt32(index), divisor)), index // divisor
    )
