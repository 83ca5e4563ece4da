"""The order of Gaussians in memory."""

import numpy as np

from drgs.gaussians.morton import BITS, space_order


def interleaved(cell) -> int:
    """The bits of three numbers, the lowest first, in turn: by strings, not by shifts."""
    columns = [f"{number:0{BITS}b}"[::-1] for number in cell]
    return int("".join(x + y + z for x, y, z in zip(*columns, strict=True))[::-1], 2)


def test_rows_are_sorted_by_interleaved_bits():
    cells = np.random.default_rng(0).integers(0, 2**BITS, (300, 3))
    cells[0], cells[1] = 0, 2**BITS - 1  # the bounds
    cells[7] = cells[3]
    expected = sorted(range(300), key=lambda row: interleaved(cells[row].tolist()))
    np.testing.assert_array_equal(space_order(cells * 0.25 - 3.0), expected)


def test_neighbours_stay_together_beside_a_far_point_and_numbers_that_are_not_finite():
    means = np.random.default_rng(1).uniform(-1, 1, (4096, 3))
    steps = np.diff(means[space_order(means)], axis=0)
    assert np.median(np.linalg.norm(steps, axis=1)) < 0.25, "a cell of each has sides of 0.125"
    far = np.concatenate([means, [[1000.0, 0, 0], [np.nan, 0, 0], [0, -np.inf, 0]]])
    order = space_order(far)
    np.testing.assert_array_equal(np.sort(order), np.arange(len(far)))
    close = means[order[order < len(means)]]
    assert np.median(np.linalg.norm(np.diff(close, axis=0), axis=1)) < 0.25


def test_what_has_no_order_keeps_its_own():
    for means in (np.zeros((5, 3)), np.full((5, 3), np.nan), np.zeros((1, 3))):
        np.testing.assert_array_equal(space_order(means), np.arange(len(means)))
