"""Polynomials of distortion models: values, derivatives, first roots, and inverses.

Coefficients are numbers of the host or Dr.Jit scalars.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import drjit as dr
import numpy as np

from drgs.cameras.lens import check_coefficients
from drgs.core.arrays import types_of

NEGLIGIBLE_COEFFICIENT = 1e-30
"""A smaller one is as good as 0: at a slope of 1e4, k3 r^6 is 1e-6. With it, roots overflow."""

RADIUS_STEPS = 24
"""Steps of the search for a radius: most need 4 or 5; next to the end of the function, each at
least halves the error."""

UNBOUNDED = 1e4  # a slope that no film shows


def horner(coefficients: Sequence[Any], x: Any) -> Any:
    """Return c_0 + c_1 x + c_2 x^2 + ...; 0.0 without coefficients."""
    if not coefficients:
        return 0.0
    total = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        total = total * x + c
    return total


def polynomial(coefficients: Sequence[Any], x: Any) -> Any:
    """Return 1 + c_1 x + c_2 x^2 + ..."""
    return horner([1.0, *coefficients], x)


def derivative(coefficients: Sequence[Any], x: Any) -> Any:
    """Return c_1 + 2 c_2 x + ..."""
    return horner([power * c for power, c in enumerate(coefficients, 1)], x)


def first_root(coefficients: np.ndarray) -> float:
    """Return the smallest positive root, or inf. coefficients: from the constant term up."""
    roots = np.polynomial.polynomial.polyroots(np.trim_zeros(coefficients, "b"))
    real = roots.real[(np.abs(roots.imag) < 1e-7 * (1 + np.abs(roots))) & (roots.real > 0)]
    return float(real.min(initial=math.inf))


def radius_at(distorted: Callable, target: Any, end: Any) -> Any:
    """Return where an increasing function reaches ``target``; close to ``end`` if it never does.

    distorted: radius -> its value and its derivative; 0 at 0. Newton's method within a bracket,
    which is divided where a step would leave it (Press et al., "Numerical Recipes", 3rd ed., 9.4):
    it converges whatever the function, and stays finite. Not differentiated.
    """
    UInt32 = types_of(type(target)).UInt32
    high = dr.minimum(end, UNBOUNDED)
    first = dr.select(target < high, target, _between(0, high))

    def body(count: Any, low: Any, high: Any, radius: Any) -> tuple[Any, Any, Any, Any]:
        value, slope = distorted(radius)
        below = value < target
        low, high = dr.select(below, radius, low), dr.select(below, high, radius)
        following = radius - (value - target) / slope
        inside = (following >= low) & (following <= high)
        following = dr.select(inside, following, _between(low, high))
        return dr.select(following == radius, RADIUS_STEPS, count + 1), low, high, following

    # A loop, as most need few steps, and a kernel may have to do this for 16 pixels.
    *_, radius = dr.while_loop(
        state=(UInt32(0), type(target)(0), high, first),
        cond=lambda count, *_: count < RADIUS_STEPS,
        body=body,
        labels=("count", "low", "high", "radius"),
    )
    return radius


def _between(low: Any, high: Any) -> Any:
    """Return the middle on the scale r / (1 + r): a bracket may reach from 0 to very far."""
    middle = (low / (1 + low) + high / (1 + high)) / 2
    return middle / (1 - middle)


def usable_coefficients(given: Mapping[str, float]) -> dict[str, float]:
    """Return the same coefficients with 0 for negligible ones.

    Raises :class:`UserError` naming the first that is larger than ``MAX_COEFFICIENT``.
    """
    check_coefficients(given)
    return {n: v if abs(v) >= NEGLIGIBLE_COEFFICIENT else 0.0 for n, v in given.items()}


def up_to_the_last(names: Sequence[str], given: Mapping[str, float]) -> tuple[float, ...]:
    """Return coefficients of a polynomial: zero where one is not given but a later one is."""
    count = max((n for n, name in enumerate(names, 1) if name in given), default=0)
    return tuple(float(given.get(name, 0.0)) for name in names[:count])


def both_or_none(names: Sequence[str], given: Mapping[str, float]) -> tuple[float, ...]:
    """Return coefficients if one is given, zero for another that is not."""
    return tuple(float(given.get(name, 0.0)) for name in names if set(names) & set(given))
