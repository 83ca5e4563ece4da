"""Places of bits in the words of entries."""

import numpy as np
from drjit.llvm.ad import UInt32

from drgs.splatting import lanes

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
    assert lanes.find_lowest_bit(UInt32(0))[0] == 1
    assert lanes._find_highest_bit(UInt32(0))[0] == 0
