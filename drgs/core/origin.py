"""Coordinates far from their origin, which float32 cannot tell apart: kept relative to a near one.

At 4 million metres, as in Earth-centred coordinates, float32 has steps of half a metre. Positions
are therefore read as float64, and what lies far away is stored relative to an *origin*, three
float64 numbers that travel beside it.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

Origin = tuple[float, float, float]  # world position of zero, exact in float64

WORLD: Origin = (0.0, 0.0, 0.0)  # the world's own origin

MAX_SCENE_SIZES = 1000
"""Sizes of a scene: farther away, its positions are kept relative to another origin. At that
distance float32 resolves 6e-5 of the size, which costs a fit nothing that was measured; three times
as far it costs 0.3 dB, a million times as far 5 dB."""


def near_origin(middle: ArrayLike, size: float) -> Origin:
    """Return the origin to which positions around ``middle`` are to be relative.

    middle: (3,) world; size: of what is there, world units. :data:`WORLD` unless that is far away;
    else ``middle``, rounded to as many decimal digits as do not matter beside ``size``.
    """
    middle = np.asarray(middle)
    if not (size > 0 and np.abs(middle).max() > MAX_SCENE_SIZES * size):
        return WORLD
    digits = -math.floor(math.log10(size))
    x, y, z = (round(float(value), digits) + 0.0 for value in middle)
    return x, y, z


def near_means(means: np.ndarray) -> tuple[np.ndarray, Origin]:
    """Return positions (N, 3) float64, and the origin that they are relative to.

    means: (N, 3) float64, world, relative to another origin than the world's where most of them
    are far away from that.
    """
    middle = np.median(means, axis=0)
    origin = near_origin(middle, float(np.median(np.linalg.norm(means - middle, axis=1))))
    return means - origin, origin


def shown_origin(origin: Origin) -> str:
    """Format the origin as messages write it."""
    return f"({', '.join(f'{value:.15g}' for value in origin)})"
