"""Random draws that are functions of a key and a row: they have no state, and so nothing to save.

Part of ``drgs.training.density``: what strategies share that draw.
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np

from drgs.core.arrays import types_of

_WORD = 2.0**-24
"""Of the upper 24 bits of a random word, which float32 holds exactly, a number in [0, 1)."""


def in_proportion(weights: np.ndarray, count: int, key: list[int]) -> np.ndarray:
    """Return ``count`` row numbers, ascending, each as often as its weight calls for.

    weights: (N,) of at least 0, not all of them 0; NaN counts as 0. key: of the random numbers.

    Systematic sampling (Madow 1949): the row of share p among the weights is drawn
    floor(count p) or ceil(count p) times, count p on average; one of weight 0 is never drawn.

    Raises ValueError if no weight is positive and finite.
    """
    weights = np.where(weights > 0, weights, 0.0)
    ends = np.cumsum(weights)
    if not (len(ends) and 0 < ends[-1] < np.inf):
        raise ValueError("in_proportion(): the sum of the weights must be positive and finite")
    offset = np.random.default_rng(key).random()
    positions = (np.arange(count) + offset) * (ends[-1] / count if count else 0.0)
    # Rounding may put the last position onto the end, behind the last row of any weight.
    last = np.flatnonzero(weights)[-1]
    return np.minimum(np.searchsorted(ends, positions, side="right"), last)


def normals(float_type: type, rows: Any, iteration: Any, seed: Any) -> Any:
    """Return standard normal vectors, Array3f (N,), a function of iteration, seed and row.

    rows: UInt32 (N,); iteration, seed: UInt32 (1,), opaque, so that each value is no new kernel.

    Box and Muller's transform of a hash of the three (``pcg4d``: Jarzynski and Olano 2020, Hash
    Functions for GPU Rendering).
    """
    t = types_of(float_type)
    words = pcg4d(rows, t.UInt32(iteration), t.UInt32(seed), t.UInt32(0))
    first, second, third, fourth = (t.Float(word >> 8) * _WORD for word in words)
    # 1 - u is above 0, of which there is a logarithm.
    radius, other = (dr.sqrt(-2 * dr.log(1 - u)) for u in (first, third))
    sine, cosine = dr.sincos(dr.two_pi * second)
    return t.Array3f(radius * cosine, radius * sine, other * dr.cos(dr.two_pi * fourth))


def pcg4d(x: Any, y: Any, z: Any, w: Any) -> tuple[Any, Any, Any, Any]:
    """Four random words of four numbers, UInt32 each."""
    x, y, z, w = (1664525 * v + 1013904223 for v in (x, y, z, w))
    x, y, z, w = _mixed(x, y, z, w)
    x, y, z, w = (v ^ (v >> 16) for v in (x, y, z, w))
    return _mixed(x, y, z, w)


def _mixed(x: Any, y: Any, z: Any, w: Any) -> tuple[Any, Any, Any, Any]:
    x = x + y * w
    y = y + z * x
    z = z + x * y
    w = w + y * z
    return x, y, z, w
