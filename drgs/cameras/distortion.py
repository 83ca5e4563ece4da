"""Models of distortion: their polynomials, and radial and tangential terms within a plane.

The plane is of slopes or angles. Coefficients are numbers of the host or Dr.Jit scalars.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Protocol

import drjit as dr
import numpy as np

from drgs.cameras.lens import Lens, check_coefficients
from drgs.core.arrays import types_of
from drgs.core.types import Bool, Float, Scalar, UInt32

NEGLIGIBLE_COEFFICIENT = 1e-30
"""A smaller one is as good as 0: at a slope of 1e4, k3 r^6 is 1e-6. With it, roots overflow."""

RADIUS_STEPS = 24
"""Steps of the search for a radius: most need 4 or 5; next to the end, each at least halves it."""

UNBOUNDED_SLOPE = 1e4  # a slope that no film shows

NEWTON_STEPS = 5  # steps for the other terms, which are small: the search starts nearby


def horner(coefficients: Sequence[Scalar], x: Scalar) -> Scalar:
    """Return c_0 + c_1 x + c_2 x^2 + ...; 0.0 without coefficients."""
    if not coefficients:
        return 0.0
    total = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        total = total * x + c
    return total


def polynomial(coefficients: Sequence[Scalar], x: Scalar) -> Scalar:
    """Return 1 + c_1 x + c_2 x^2 + ..."""
    return horner([1.0, *coefficients], x)


def derivative(coefficients: Sequence[Scalar], x: Scalar) -> Scalar:
    """Return c_1 + 2 c_2 x + ..."""
    return horner([power * c for power, c in enumerate(coefficients, 1)], x)


def first_root(coefficients: np.ndarray) -> float:
    """Return the smallest positive root, or inf. coefficients: from the constant term up."""
    roots = np.polynomial.polynomial.polyroots(np.trim_zeros(coefficients, "b"))
    real = roots.real[(np.abs(roots.imag) < 1e-7 * (1 + np.abs(roots))) & (roots.real > 0)]
    return float(real.min(initial=math.inf))


def radius_at(
    distorted: Callable[[Float], tuple[Float, Scalar]], target: Float, end: Scalar
) -> Float:
    """Return where an increasing function reaches ``target``; close to ``end`` if it never does.

    distorted: radius -> its value and its derivative; 0 at 0. Newton's method within a bracket,
    which is divided where a step would leave it (Press et al., "Numerical Recipes", 3rd ed., 9.4):
    it converges whatever the function, and stays finite. Not differentiated.
    """
    UInt32 = types_of(type(target)).UInt32
    high = dr.minimum(type(target)(end), UNBOUNDED_SLOPE)
    first = dr.select(target < high, target, _bracket_middle(0, high))

    def body(
        count: UInt32, low: Float, high: Float, radius: Float
    ) -> tuple[UInt32, Float, Float, Float]:
        value, slope = distorted(radius)
        below = value < target
        low, high = dr.select(below, radius, low), dr.select(below, high, radius)
        following = radius - (value - target) / slope
        inside = (following >= low) & (following <= high)
        following = dr.select(inside, following, _bracket_middle(low, high))
        return dr.select(following == radius, RADIUS_STEPS, count + 1), low, high, following

    # A loop, as most need few steps, and a kernel may have to do this for 16 pixels.
    *_, radius = dr.while_loop(
        state=(UInt32(0), type(target)(0), high, first),
        cond=lambda count, *_: count < RADIUS_STEPS,
        body=body,
        labels=("count", "low", "high", "radius"),
    )
    return radius


def _bracket_middle(low: Scalar, high: Float) -> Float:
    """Return the middle on the scale r / (1 + r): a bracket may reach from 0 to very far."""
    middle = (low / (1 + low) + high / (1 + high)) / 2
    return middle / (1 - middle)


def grouped_coefficients(
    lens: type[Lens], given: Mapping[str, float]
) -> Iterator[tuple[float, ...]]:
    """Yield the fields of ``Lens.groups``: polynomials to their last term, other groups whole.

    Missing and negligible coefficients are zero. A group of which none is given is empty.
    """
    check_coefficients(given)
    kept = {n: float(v) for n, v in given.items() if abs(v) >= NEGLIGIBLE_COEFFICIENT}
    for names in lens.groups.values():
        last = max((n for n, name in enumerate(names, 1) if name in given), default=0)
        count = last if names[0].startswith("k") else bool(last) * len(names)
        yield tuple(kept.get(name, 0.0) for name in names[:count])


class PlaneDistortion(Protocol):
    """The distortion of places (x, y), with r^2 = x^2 + y^2 and a factor L(r^2),

        x' = L x + 2 p1 x y + p2 (r^2 + 2 x^2),  y' = L y + p1 (r^2 + 2 y^2) + 2 p2 x y

    (Brown 1966). It is one-to-one where r^2 is below :meth:`squared_limit`.
    """

    tangential: tuple[Scalar, ...]  # p1, p2; or none

    def squared_limit(self) -> Scalar:
        """Return the r^2 at which the model ends."""
        ...

    def radial(self, squared: Float) -> Scalar:
        """Return L at r^2."""
        ...

    def radial_derivative(self, squared: Float) -> Scalar:
        """Return d L / d r^2."""
        ...

    def is_radial(self) -> bool:
        """Return whether places are moved along their radius alone."""
        return not self.tangential

    def distort(self, x: Float, y: Float) -> tuple[Float, Float]:
        """Return places as the film shows them."""
        squared = x * x + y * y
        radial = self.radial(squared)
        if not self.tangential:
            return radial * x, radial * y
        p1, p2 = self.tangential
        return (
            radial * x + 2 * p1 * (x * y) + p2 * (squared + 2 * x * x),
            radial * y + p1 * (squared + 2 * y * y) + 2 * p2 * (x * y),
        )

    def distortion_jacobian(self, x: Float, y: Float) -> tuple[Float, Float, Float, Float]:
        """Return d x' / d x, d x' / d y, d y' / d x, d y' / d y."""
        squared = x * x + y * y
        radial, slope = self.radial(squared), 2 * self.radial_derivative(squared)
        xx, xy, yy = radial + slope * x * x, slope * (x * y), radial + slope * y * y
        if not self.tangential:
            return xx, xy, xy, yy
        p1, p2 = self.tangential
        xx, xy = xx + 2 * p1 * y + 6 * p2 * x, xy + 2 * p1 * x + 2 * p2 * y
        return xx, xy, xy, yy + 6 * p1 * y + 2 * p2 * x

    def undistort(self, x: Float, y: Float) -> tuple[Float, Float]:
        """Return the places that :meth:`distort` sends to (x, y), or any finite ones.

        Only the last step of the search is differentiated: a step of Newton's method from the
        solution has the solution's derivative (the implicit function theorem).
        """
        with dr.suspend_grad():
            length = dr.sqrt(x * x + y * y)
            radius = radius_at(self._radius, length, dr.sqrt(self.squared_limit()))
            # In the middle, radius and length are the same.
            scale = dr.select(length > 0, radius / dr.select(length > 0, length, 1), 1)
            u, v = scale * x, scale * y
            if not self.is_radial():
                _, u, v = dr.while_loop(
                    state=(types_of(type(x)).UInt32(0), u, v),
                    cond=lambda count, u, v: count < NEWTON_STEPS,
                    body=lambda count, u, v: (count + 1, *self._step(u, v, x, y)),
                    labels=("count", "u", "v"),
                )
        return self._step(u, v, x, y)

    def _radius(self, radius: Float) -> tuple[Float, Scalar]:
        """Return the distorted radius by the radial terms alone, and its derivative."""
        squared = radius * radius
        radial = self.radial(squared)
        return radial * radius, radial + 2 * squared * self.radial_derivative(squared)

    def _step(self, u: Float, v: Float, x: Float, y: Float) -> tuple[Float, Float]:
        """Take a step of Newton's method towards (x, y), unless it would leave the lens model."""
        at_x, at_y = self.distort(u, v)
        dx, dy = x - at_x, y - at_y
        with dr.suspend_grad():
            xx, xy, yx, yy = self.distortion_jacobian(u, v)
            per_determinant = 1 / (xx * yy - xy * yx)
            xx, xy, yx, yy = (value * per_determinant for value in (xx, xy, yx, yy))
        next_u, next_v = u + (yy * dx - xy * dy), v + (xx * dy - yx * dx)
        inside = self.is_within(next_u, next_v)
        return dr.select(inside, next_u, u), dr.select(inside, next_v, v)

    def is_within(self, x: Float, y: Float) -> Bool:
        """Return whether places are within the model."""
        return x * x + y * y < self.squared_limit()


def steepest_fall(tangential: Sequence[float], prism: Sequence[float] = ()) -> float:
    """Return c >= 0, where -c r is the least eigenvalue of the other terms at radius r.

    That is of the symmetric part of their Jacobian, in any direction. tangential: p1, p2 or none;
    prism: sx1, sy1 or none, of terms sx1 r^2 in x' and sy1 r^2 in y'. At w = (x, y), with
    p = (p2, p1) and s = (sx1, sy1), all of them are r^2 (p + s) + 2 (p . w) w, the symmetric part
    is q w^T + w q^T + 2 (p . w) I with q = 2 p + s, its least eigenvalue (4 p + s) . w - r |q|.
    """
    p, s = (np.array(pair or (0.0, 0.0)) for pair in (tangential[::-1], prism))
    return math.hypot(*(4 * p + s)) + math.hypot(*(2 * p + s))


def largest_squared_radius(
    numerator: Sequence[float], denominator: Sequence[float], fall: float
) -> float:
    """Return r^2 within which no two places are distorted to the same; inf: there is no limit.

    numerator, denominator: of L, coefficients of r^2, r^4, ... beside 1. fall: the
    :func:`steepest_fall` of the other terms.

    With L = N / D and u = r^2, the radial part's Jacobian has the eigenvalues A = G / D^2, with
    G = N D + 2 u (N' D - N D'), along the radius, and L across it. While both are larger than
    ``fall`` r, the symmetric part of the whole Jacobian is positive definite (Weyl's inequality),
    and its map one-to-one: from one place of a disc to another, what the film shows moves with them
    all the way. The bound is reached where A <= L, on one side.
    """
    u = np.polynomial.Polynomial([0.0, 1.0])
    n, d = (np.polynomial.Polynomial([1.0, *c]) for c in (numerator, denominator))
    growth = n * d + 2 * u * (n.deriv() * d - n * d.deriv())
    first = min(first_root(growth.coef), first_root(d.coef))
    if fall == 0:
        return first
    r = u
    folds = (growth(r**2) - fall * r * d(r**2) ** 2, n(r**2) - fall * r * d(r**2))
    return min(first, *(first_root(fold.coef) ** 2 for fold in folds))
