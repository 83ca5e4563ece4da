"""The order of points along a curve through space, in which neighbours are near each other."""

from __future__ import annotations

import numpy as np

BITS = 21
"""Per axis: three of them in 63 bits. A cell is half a millionth of the box's longest side."""

_SPREAD = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)


def morton_order(positions: np.ndarray) -> np.ndarray:
    """Indices (N,) that sort positions (N, 3) along the Z-order curve; ties by index.

    Morton 1966, "A computer oriented geodetic data base": the bits of the three coordinates in
    turn.
    """
    positions = positions.astype(np.float64)
    low = positions.min(axis=0, initial=np.inf)
    side = (positions - low).max(initial=0) or 1.0
    cells = ((positions - low) / side * (2**BITS - 1)).astype(np.uint64)
    x, y, z = (_spread(cells[:, axis]) for axis in range(3))
    return np.argsort(x | y << np.uint64(1) | z << np.uint64(2), kind="stable")


def _spread(values: np.ndarray) -> np.ndarray:
    """Two zero bits before each bit but the first."""
    for shift, mask in _SPREAD:
        values = (values | values << np.uint64(shift)) & np.uint64(mask)
    return values
