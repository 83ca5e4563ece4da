"""Places of bits in the words of entries, and sums over the pixels of a micro-tile."""

import numpy as np
import pytest
from drjit.llvm.ad import UInt32
from support.helpers import FLOAT32, FLOAT64

from drgs.splatting import lanes
from drgs.splatting.footprint import Footprint, PixelCenters

WORDS = np.unique(
    [
        *(1 << np.arange(32, dtype=np.uint64)),
        *((1 << np.arange(1, 33, dtype=np.uint64)) - 1),
        *np.random.default_rng(0).integers(1, 2**32, 1000, dtype=np.uint64),
    ]
).astype(np.uint32)


def test_bits_are_found():
    lowest = [(int(word) & -int(word)).bit_length() - 1 for word in WORDS]
    highest = [int(word).bit_length() - 1 for word in WORDS]
    np.testing.assert_array_equal(lanes.find_lowest_bit(UInt32(WORDS)), lowest)
    np.testing.assert_array_equal(lanes._find_highest_bit(UInt32(WORDS)), highest)


def test_of_no_bit_a_place_in_the_word_is_found():
    assert lanes.find_lowest_bit(UInt32(0))[0] < lanes.WORD
    assert lanes._find_highest_bit(UInt32(0))[0] == 0


@pytest.mark.parametrize("precision", [FLOAT32, FLOAT64], ids=["float32", "float64"])
@pytest.mark.parametrize("variance", [0.1, 0.3, 10.0])
def test_moments_are_sums_over_the_pixels(precision, variance):
    """Splats are no sharper than a low-pass filter; errors are a few roundings of the terms' sizes.

    Size: of a term in which the pixel is up to two pixels away.
    """
    rng, count = np.random.default_rng(0), 5000
    p, r, s = np.sqrt(0.72 / variance) * rng.uniform(-1, 1, (3, count))
    x, y = rng.uniform(-4, 1, (2, count))  # from the mean to the first pixel
    j, i = np.divmod(np.arange(16), 4)
    dx, dy = x + i[:, None], y + j[:, None]
    u, v = p * dx + r * dy, s * dy
    w = rng.normal(size=u.shape) * np.exp2(-u * u - v * v)
    expected = np.sum([w, w * u, w * u * dx, w * u * dy, w * dy, w * dy * dy], 1)
    w_size, u_size = np.abs(w), np.abs(u) + 2 * np.abs(p) + 2 * np.abs(r)
    x_size, y_size = np.abs(dx) + 2, np.abs(dy) + 2
    sizes = [1, u_size, u_size * x_size, u_size * y_size, y_size, y_size**2]

    Float = precision.Float
    columns, rows = [Float(each) for each in dx[:4]], [Float(each) for each in dy[::4]]
    footprint = Footprint(
        dx=[columns] * 4,
        dy=[[each] * 4 for each in rows],
        u=[],
        v=[],
        p=Float(p),
        r=Float(r),
        log2_alpha=[],
    )
    found = np.array(PixelCenters().gaussian_moments(footprint, map(Float, w)))
    error = np.abs(found - expected) / [(w_size * size).sum(0) for size in sizes]
    assert error.max() < 4 * np.finfo(precision.dtype).eps
