"""The order of Gaussians in memory: neighbours in space are neighbours in memory.

A tile's splats then share cache lines, and the Gaussians that a view does not see share vectors,
which skip them. On a Morton curve (Morton 1966, "A computer oriented geodetic data base"), points
are sorted by the interleaved bits of their coordinates.
"""

from __future__ import annotations

import numpy as np

BITS = 21  # of a coordinate: three fit into a word


def space_order(means: np.ndarray) -> np.ndarray:
    """Return the row numbers of ``means``, (N, 3), along a Morton curve; ties by row number.

    Means that are not finite are treated as the nearest that are.
    """
    finite = means[np.isfinite(means).all(axis=1)]
    if len(finite) == 0:
        return np.arange(len(means))
    low, high = finite.min(axis=0).astype(float), finite.max(axis=0).astype(float)
    size = max(float((high - low).max()) / (2**BITS - 1), np.finfo(float).tiny)  # of a cell
    cells = (np.clip(np.nan_to_num(means), low, high) - low) / size
    codes = np.zeros(len(means), np.uint64)
    for axis, column in enumerate(cells.T.astype(np.uint64)):
        for bit in range(BITS):
            codes |= (column >> np.uint64(bit) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(codes, kind="stable")
