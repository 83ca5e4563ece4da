import numpy as np
import pytest

from drgs.io.quantization import MORTON_BITS, morton_order


def interleaved(cell):
    return sum(
        (int(value) >> bit & 1) << (3 * bit + axis)
        for bit in range(MORTON_BITS)
        for axis, value in enumerate(cell)
    )


def test_points_are_sorted_by_interleaved_bits():
    rng = np.random.default_rng(0)
    cells = rng.integers(0, 2**MORTON_BITS, (300, 3))
    cells[:2] = [[0, 0, 0], [2**MORTON_BITS - 1] * 3]  # the box that cells are counted in
    cells[-1] = cells[-2]
    codes = [interleaved(cell) for cell in cells]
    expected = sorted(range(300), key=lambda index: (codes[index], index))
    assert morton_order(cells.astype(np.float32)).tolist() == expected


@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((4, 3), 7.5)], ids=["none", "one"])
def test_coinciding_points_keep_their_order(points):
    assert morton_order(points).tolist() == list(range(len(points)))
