"""Lenses other than a pinhole: with distortion, fisheye, orthographic, with an aperture.

Layer 1, imported when a sensor or a dataset has such a lens. Each has the methods of
:class:`drgs.camera.Pinhole`. Coefficients are numbers of the host, or Dr.Jit scalars after
:meth:`upload`; one that is not given is left out (of a polynomial, those behind the last one that
is; or both tangential ones), so that nothing is computed for it.

Outside the part of the film's plane that a lens model is made for, its polynomials turn around and
would fold what lies far outside back into the picture: what is seen under a larger angle than that
at which the model first turns, in whatever direction, is not seen at all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from drgs.arrays import is_float64, types_of
from drgs.camera import Camera, Lens, Perspective

RADIUS_STEPS = 24
"""When the radius is looked for that a lens shows at a place: most need 4 or 5. Next to the place
where the function ends, each step at least halves the error."""

TANGENTIAL_STEPS = 5
"""Of Newton's method, for tangential terms: small beside the radial ones, it starts nearby."""

BORDER = 65
"""Points on each side of the film, whose rays tell what the film sees."""

MISSED = 1e-6
"""Squared, of slopes: how far Newton's method may end from the point that it looked for."""

UNBOUNDED = 1e4
"""A slope that no film shows."""

MAX_ANGLE = 0.95 * math.pi
"""From the axis of a fisheye: what is behind it has no place on the film."""

NEAR_AXIS = 0.1
"""tan^2 of the angle below which series are used: theta / rho is 0 / 0 on the axis, and what its
derivative needs is a difference that cancels near it."""

AXIS_TERMS = {False: 8, True: 16}
"""Terms of these series in single and in double precision: 0.1^n is below their roundings."""


# ----------------------------------------------------------------------------------------------
# Polynomials
# ----------------------------------------------------------------------------------------------


def _horner(coefficients: Sequence[Any], x: Any) -> Any:
    """c_0 + c_1 x + c_2 x^2 + ...; 0.0 without coefficients."""
    if not coefficients:
        return 0.0
    total = coefficients[-1]
    for c in reversed(coefficients[:-1]):
        total = total * x + c
    return total


def _polynomial(coefficients: Sequence[Any], x: Any) -> Any:
    """1 + c_1 x + c_2 x^2 + ..."""
    return _horner([1.0, *coefficients], x)


def _derivative(coefficients: Sequence[Any], x: Any) -> Any:
    """c_1 + 2 c_2 x + ..."""
    return _horner([power * c for power, c in enumerate(coefficients, 1)], x)


def _first_root(polynomial: np.ndarray) -> float:
    """The smallest positive root, coefficients from the constant term up; inf: there is none."""
    roots = np.polynomial.polynomial.polyroots(np.trim_zeros(polynomial, "b"))
    real = roots.real[(np.abs(roots.imag) < 1e-7 * (1 + np.abs(roots))) & (roots.real > 0)]
    return float(real.min(initial=math.inf))


def _radius_of(distorted: Callable, target: Any, end: Any) -> Any:
    """Where an increasing function reaches ``target``; close to ``end`` if it never does.

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
    """In the middle on the scale r / (1 + r): a bracket may reach from 0 to very far."""
    middle = (low / (1 + low) + high / (1 + high)) / 2
    return middle / (1 - middle)


def _up_to_the_last(names: Sequence[str], given: Mapping[str, float]) -> tuple[float, ...]:
    """Coefficients of a polynomial: zero where one is not given but a later one is."""
    count = max((n for n, name in enumerate(names, 1) if name in given), default=0)
    return tuple(float(given.get(name, 0.0)) for name in names[:count])


def _uploaded(lens: Any, float_type: type) -> Any:
    """The lens with Dr.Jit scalars for its numbers, so that kernels are the same for all."""

    def opaque(value: Any) -> Any:
        if isinstance(value, tuple):
            return tuple(opaque(item) for item in value)
        return dr.opaque(float_type, value) if isinstance(value, float) else value

    return replace(lens, **{f.name: opaque(getattr(lens, f.name)) for f in fields(lens)})


# ----------------------------------------------------------------------------------------------
# Distortion
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RadialTangential(Perspective):
    """OpenCV's lens: slopes (x, y) are distorted before they come to the film.

    With r^2 = x^2 + y^2 and R = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),

        x' = R x + 2 p1 x y + p2 (r^2 + 2 x^2),  y' = R y + p1 (r^2 + 2 y^2) + 2 p2 x y

    (Brown 1966; OpenCV's documentation, "Camera Calibration and 3D Reconstruction"). Means whose r
    is beyond ``max_squared_radius`` are not seen.
    """

    distorts: ClassVar[bool] = True
    kind: ClassVar[str] = "opencv"
    names: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")

    numerator: tuple[Any, ...]  # k1, k2, k3
    denominator: tuple[Any, ...]  # k4, k5, k6
    tangential: tuple[Any, ...]  # p1, p2; or none
    max_squared_radius: Any  # of the slopes
    on_film: Any = None  # (2) Array2f: the least and the largest slopes on the film

    @staticmethod
    def of(**coefficients: float) -> RadialTangential:
        """From OpenCV's names, ``k1`` to ``k6``, ``p1``, ``p2``; what is not given is zero."""
        names = RadialTangential.names
        assert set(coefficients) <= set(names)
        p1, p2 = (float(coefficients.get(name, 0.0)) for name in names[6:])
        numerator = _up_to_the_last(names[:3], coefficients)
        denominator = _up_to_the_last(names[3:6], coefficients)
        return RadialTangential(
            numerator=numerator,
            denominator=denominator,
            tangential=(p1, p2) if set(coefficients) & set(names[6:]) else (),
            max_squared_radius=_largest_squared_radius(numerator, denominator, math.hypot(p1, p2)),
        )

    def upload(self, float_type: type) -> RadialTangential:
        """For kernels of this precision."""
        return _uploaded(self, float_type)

    def named(self) -> dict[str, Any]:
        """The coefficients that are not left out, by OpenCV's names."""
        names = (*self.names[: len(self.numerator)], *self.names[3 : 3 + len(self.denominator)])
        names += self.names[6:] if self.tangential else ()
        values = (*self.numerator, *self.denominator, *self.tangential)
        return dict(zip(names, values, strict=True))

    def with_named(self, values: dict[str, Any]) -> RadialTangential:
        """Other numbers for the same coefficients; where the model ends stays as it is."""
        k, p = self.names[:6], self.names[6:]
        return replace(
            self,
            numerator=tuple(values[name] for name in k[: len(self.numerator)]),
            denominator=tuple(values[name] for name in k[3 : 3 + len(self.denominator)]),
            tangential=tuple(values[name] for name in p[: len(self.tangential)]),
        )

    def distort(self, x: Any, y: Any) -> tuple[Any, Any]:
        """Slopes as the film shows them."""
        squared = x * x + y * y
        radial = self._radial(squared)
        if not self.tangential:
            return radial * x, radial * y
        p1, p2 = self.tangential
        return (
            radial * x + 2 * p1 * (x * y) + p2 * (squared + 2 * x * x),
            radial * y + p1 * (squared + 2 * y * y) + 2 * p2 * (x * y),
        )

    def distortion_jacobian(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """d x' / d x, d x' / d y = d y' / d x, d y' / d y."""
        squared = x * x + y * y
        radial, slope = self._radial(squared), 2 * self._radial_derivative(squared)
        xx, xy, yy = radial + slope * x * x, slope * (x * y), radial + slope * y * y
        if not self.tangential:
            return xx, xy, yy
        p1, p2 = self.tangential
        return (
            xx + 2 * p1 * y + 6 * p2 * x,
            xy + 2 * p1 * x + 2 * p2 * y,
            yy + 6 * p1 * y + 2 * p2 * x,
        )

    def undistort(self, x: Any, y: Any) -> tuple[Any, Any]:
        """The slopes that :meth:`distort` sends to (x, y).

        Where there are none, the result is finite and means nothing: :meth:`sees_slopes` and a
        second look tell. The search is not differentiated, but its last step: a step of Newton's
        method from the solution has the solution's derivative (the implicit function theorem).
        """
        with dr.suspend_grad():
            length = dr.sqrt(x * x + y * y)
            radius = _radius_of(self._radius, length, dr.sqrt(self.max_squared_radius))
            # In the middle, radius and length are the same.
            scale = dr.select(length > 0, radius / dr.select(length > 0, length, 1), 1)
            u, v = scale * x, scale * y
            if self.tangential:
                _, u, v = dr.while_loop(
                    state=(types_of(type(x)).UInt32(0), u, v),
                    cond=lambda count, u, v: count < TANGENTIAL_STEPS,
                    body=lambda count, u, v: (count + 1, *self._step(u, v, x, y)),
                    labels=("count", "u", "v"),
                )
        return self._step(u, v, x, y)

    def _radius(self, radius: Any) -> tuple[Any, Any]:
        """Distance from the middle at which a radius is seen, but for the tangential terms."""
        squared = radius * radius
        radial = self._radial(squared)
        return radial * radius, radial + 2 * squared * self._radial_derivative(squared)

    def _step(self, u: Any, v: Any, x: Any, y: Any) -> tuple[Any, Any]:
        """One step of Newton's method towards (x, y), unless it would leave the lens model."""
        at_x, at_y = self.distort(u, v)
        dx, dy = x - at_x, y - at_y
        with dr.suspend_grad():
            xx, xy, yy = self.distortion_jacobian(u, v)
            per_determinant = 1 / (xx * yy - xy * xy)
            xx, xy, yy = (value * per_determinant for value in (xx, xy, yy))
        following = u + (yy * dx - xy * dy), v + (xx * dy - xy * dx)
        inside = self.sees_slopes(*following)
        return tuple(dr.select(inside, b, a) for a, b in zip((u, v), following, strict=True))

    def sees_slopes(self, x: Any, y: Any) -> Any:
        """Whether they are within the part that the model is made for."""
        return x * x + y * y < self.max_squared_radius

    # What kernels call: see ``drgs.camera``.

    def look(self, camera: Camera, position: Any) -> tuple[Any, Any, Any]:
        """Whether a mean is seen, its position, and its depth."""
        x, y, z = position
        # Not divided by z, which may be zero.
        limit = self.max_squared_radius * z * z
        return _replaced(position, (z >= camera.near) & (x * x + y * y < limit))

    def film_point(self, camera: Camera, position: Any) -> Any:
        """Where a point is on the film, Array2f, px."""
        slopes = self.distort(*self.true_slopes(camera, position))
        return camera.focal * types_of(type(position.z)).Array2f(*slopes) + camera.principal

    def film_directions(self, camera: Camera, position: Any, slopes: list[Any]) -> list[Any]:
        """Derivatives of the place on the film, two Array3f, world."""
        xx, xy, yy = self.distortion_jacobian(*slopes)
        right, down, forward = camera.rotation
        dx, dy = (
            (axis - slope * forward) / position.z
            for axis, slope in zip((right, down), slopes, strict=True)
        )
        return [camera.focal.x * (xx * dx + xy * dy), camera.focal.y * (xy * dx + yy * dy)]

    def fitted(self, camera: Camera) -> RadialTangential:
        """The lens that knows what the film of ``camera`` sees."""
        return replace(self, on_film=_slopes_on_border(self, camera))

    def frustum(self, camera: Camera) -> tuple[Any, Any]:
        """The least and the largest slopes on the film."""
        del camera
        return self.on_film

    def ray(self, camera: Camera, x: Any, y: Any) -> Any:
        """Through a point of the film (px), Array3f, camera axes."""
        t = types_of(type(x))
        film = (t.Array2f(x, y) - camera.principal) / camera.focal
        return t.Array3f(*self.undistort(film.x, film.y), 1)

    def _radial(self, squared: Any) -> Any:
        return _polynomial(self.numerator, squared) / _polynomial(self.denominator, squared)

    def _radial_derivative(self, squared: Any) -> Any:
        """d R / d r^2."""
        denominator = _polynomial(self.denominator, squared)
        change = _derivative(self.numerator, squared)
        change = change - self._radial(squared) * _derivative(self.denominator, squared)
        return change / denominator


def _largest_squared_radius(
    numerator: Sequence[float], denominator: Sequence[float], tangential: float
) -> float:
    """r^2 within which no two slopes are distorted to the same; inf: wherever they are.

    With R = N / D and u = r^2, the radial part's Jacobian has the eigenvalues A = G / D^2, with
    G = N D + 2 u (N' D - N D'), along the slope, and R across it. With ``tangential``, the length
    q of (p2, p1), no eigenvalue of the tangential part's is below -6 r q. While A and R are larger
    than 6 r q, the sum is positive definite (Weyl's inequality), and as it is symmetric, its
    map one-to-one. The bound is reached where A <= R, on the side of -(p2, p1).
    """
    u = np.polynomial.Polynomial([0.0, 1.0])
    n, d = (np.polynomial.Polynomial([1.0, *c]) for c in (numerator, denominator))
    growth = n * d + 2 * u * (n.deriv() * d - n * d.deriv())
    first = min(_first_root(growth.coef), _first_root(d.coef))
    if tangential == 0:
        return first
    r = u
    folds = (
        growth(r**2) - 6 * tangential * r * d(r**2) ** 2,
        n(r**2) - 6 * tangential * r * d(r**2),
    )
    return min(first, *(_first_root(fold.coef) ** 2 for fold in folds))


def _replaced(position: Any, seen: Any) -> tuple[Any, Any, Any]:
    """Positions, with one on the axis for those that are not seen, and their z."""
    x, y, z = position
    z = dr.select(seen, z, 1)
    return seen, type(position)(dr.select(seen, x, 0), dr.select(seen, y, 0), z), z


def _slopes_on_border(lens: RadialTangential, camera: Camera) -> tuple[Any, Any]:
    """The box around the slopes of points on the film's border.

    Where the lens does not see all of them, the box says nothing about what it sees: then only the
    end of the lens model bounds the slopes.
    """
    t = types_of(type(camera.near))
    side = dr.linspace(t.Float, 0, 1, BORDER)
    zero, one = dr.zeros(t.Float, BORDER), dr.ones(t.Float, BORDER)
    start, end = camera.film_start, camera.film_end
    x = dr.concat([side, side, zero, one]) * (end.x - start.x) + start.x
    y = dr.concat([zero, one, side, side]) * (end.y - start.y) + start.y
    film = (t.Array2f(x, y) - camera.principal) / camera.focal
    slopes = lens.undistort(film.x, film.y)
    missed = dr.squared_norm(t.Array2f(*lens.distort(*slopes)) - film)
    bounded = dr.all(lens.sees_slopes(*slopes) & (missed < MISSED))
    return tuple(
        t.Array2f([dr.select(bounded, _mean_where(s, extreme(s)), other) for s in slopes])
        for extreme, other in ((dr.min, -UNBOUNDED), (dr.max, UNBOUNDED))
    )


def _mean_where(values: Any, extreme: Any) -> Any:
    """``extreme``, with the mean derivative of the values that are it.

    Several corners of a film may be equally far: Dr.Jit's own reductions add up their derivatives.
    """
    equal = values == extreme
    return dr.sum(dr.select(equal, values, 0)) / dr.count(equal)


# ----------------------------------------------------------------------------------------------
# Fisheye
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Fisheye(Lens):
    """A point at the angle theta from the axis is seen at a distance from the principal point of

        theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)

    in its direction (Kannala and Brandt 2006, as in OpenCV's ``fisheye`` module). What it shows may
    be beside and behind the camera, so that *depth* is the distance from the centre. Means whose
    angle has a cosine below ``min_cosine`` are not seen.
    """

    distorts: ClassVar[bool] = True
    kind: ClassVar[str] = "fisheye"
    names: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "k4")

    coefficients: tuple[Any, ...]
    min_cosine: Any

    @staticmethod
    def of(**coefficients: float) -> Fisheye:
        """From OpenCV's names, ``k1`` to ``k4``; what is not given is zero."""
        assert set(coefficients) <= set(Fisheye.names)
        kept = _up_to_the_last(Fisheye.names, coefficients)
        growth = [1.0, *((2 * n + 3) * k for n, k in enumerate(kept))]
        turn = math.sqrt(_first_root(np.array(growth)))
        return Fisheye(kept, math.cos(min(turn, MAX_ANGLE)))

    def upload(self, float_type: type) -> Fisheye:
        """For kernels of this precision."""
        return _uploaded(self, float_type)

    def named(self) -> dict[str, Any]:
        """The coefficients that are not left out, by OpenCV's names."""
        return dict(zip(self.names, self.coefficients, strict=False))

    def with_named(self, values: dict[str, Any]) -> Fisheye:
        """Other numbers for the same coefficients; where the model ends stays as it is."""
        names = self.names[: len(self.coefficients)]
        return replace(self, coefficients=tuple(values[name] for name in names))

    # What kernels call: see ``drgs.camera``.

    def look(self, camera: Camera, position: Any) -> tuple[Any, Any, Any]:
        """Whether a mean is seen, its position, and its distance."""
        distance = dr.norm(position)
        seen = (distance >= camera.near) & (position.z > self.min_cosine * distance)
        _, position, _ = _replaced(position, seen)
        return seen, position, dr.norm(position)

    def true_slopes(self, camera: Camera, position: Any) -> None:
        """None: the projection is linearised at the mean, wherever it is."""
        del camera, position

    clamped_slopes = true_slopes

    def film_point(self, camera: Camera, position: Any) -> Any:
        """Where a point is on the film, Array2f, px."""
        x, y, _ = position
        per_radius, _ = self._angle_per_radius(position)
        scale = per_radius * _polynomial(
            self.coefficients, self._squared_angle(position, per_radius)
        )
        return camera.focal * types_of(type(x)).Array2f(scale * x, scale * y) + camera.principal

    def film_directions(self, camera: Camera, position: Any, slopes: None) -> list[Any]:
        """Derivatives of the place on the film, two Array3f, world.

        With rho^2 = x^2 + y^2, n^2 = rho^2 + z^2, a = theta / rho, b = (d a / d rho) / rho, and
        theta_d = h theta: the place is A (x, y) with A = h a, (d A / d rho) / rho = B = h b +
        2 h' a^2 z / n^2, where h' = d h / d theta^2, and d A / d z = -(h + 2 h' theta^2) / n^2.
        """
        del slopes
        x, y, z = position
        a, b = self._angle_per_radius(position)
        squared = self._squared_angle(position, a)
        h, dh = _polynomial(self.coefficients, squared), _derivative(self.coefficients, squared)
        inverse = dr.rcp(dr.squared_norm(position))
        scale, bend = h * a, h * b + 2 * dh * (a * a) * (z * inverse)
        tilt = (h + 2 * dh * squared) * inverse
        right, down, forward = camera.rotation
        change = bend * (x * right + y * down) - tilt * forward
        return [
            focal * (scale * axis + c * change)
            for axis, c, focal in zip((right, down), (x, y), camera.focal, strict=True)
        ]

    def depth_direction(self, camera: Camera, position: Any) -> Any:
        """Derivative of the distance divided by the distance, Array3f, world."""
        right, down, forward = camera.rotation
        x, y, z = position / dr.squared_norm(position)
        return x * right + y * down + z * forward

    def ray_range(self, direction: Any, near: Any, far: Any) -> tuple[Any, Any]:
        """Where a ray of unit ``direction`` reaches two depths."""
        del direction
        return near, far

    def ray(self, camera: Camera, x: Any, y: Any) -> Any:
        """Through a point of the film (px), Array3f, camera axes."""
        t = types_of(type(x))
        film = (t.Array2f(x, y) - camera.principal) / camera.focal
        squared = dr.squared_norm(film)
        off_axis = squared > 0
        radius = dr.sqrt(dr.select(off_axis, squared, 1))
        with dr.suspend_grad():
            end = dr.acos(self.min_cosine)
            angle = _radius_of(self._distorted_angle, radius, end)
        # The last step of Newton's method is differentiated, as in ``RadialTangential``.
        value, slope = self._distorted_angle(angle)
        following = angle + (radius - value) / dr.detach(slope)
        sine, cosine = dr.sincos(dr.select(following < end, following, angle))
        scale = dr.select(off_axis, sine / radius, 1)
        return t.Array3f(scale * film.x, scale * film.y, dr.select(off_axis, cosine, 1))

    def _distorted_angle(self, angle: Any) -> tuple[Any, Any]:
        """theta_d of an angle, and its derivative."""
        squared = angle * angle
        h, dh = _polynomial(self.coefficients, squared), _derivative(self.coefficients, squared)
        return h * angle, h + 2 * dh * squared

    @staticmethod
    def _angle_per_radius(position: Any) -> tuple[Any, Any]:
        """a = theta / rho, and b = (z / n^2 - a) / rho^2; near the axis by their series.

        With t = rho / z: z a = 1 - t^2 / 3 + t^4 / 5 ..., z^3 b = -2/3 + 4/5 t^2 - 6/7 t^4 ...
        """
        x, y, z = position
        squared = x * x + y * y
        on_axis = (z > 0) & (squared < NEAR_AXIS * (z * z))
        depth = dr.select(on_axis, z, 1)
        t = dr.select(on_axis, squared, 0) / (depth * depth)
        terms = range(AXIS_TERMS[is_float64(type(z))])
        series_a = _polynomial([(-1) ** (k + 1) / (2 * k + 3) for k in terms], t) / depth
        series_b = [(-1) ** (k + 1) * (2 * k + 2) / (2 * k + 3) for k in terms]
        series_b = _horner(series_b, t) / (depth * depth * depth)
        squared = dr.select(on_axis, 1, squared)
        radius = dr.sqrt(squared)
        a = dr.atan2(radius, z) / radius
        b = (z / (squared + z * z) - a) / squared
        return dr.select(on_axis, series_a, a), dr.select(on_axis, series_b, b)

    @staticmethod
    def _squared_angle(position: Any, per_radius: Any) -> Any:
        return (per_radius * per_radius) * (dr.square(position.x) + dr.square(position.y))


# ----------------------------------------------------------------------------------------------
# Orthographic
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Orthographic(Lens):
    """A point (x, y, z) is seen at focal (x, y) + principal, with focal in px per scene unit.

    All rays are parallel: colours are seen along the camera's axis.
    """

    parallel: ClassVar[bool] = True

    def look(self, camera: Camera, position: Any) -> tuple[Any, Any, Any]:
        """Whether a mean is seen, its position, and its depth."""
        return _replaced(position, position.z >= camera.near)

    def true_slopes(self, camera: Camera, position: Any) -> None:
        """None: the projection is linear."""
        del camera, position

    clamped_slopes = true_slopes

    def film_point(self, camera: Camera, position: Any) -> Any:
        """Where a point is on the film, Array2f, px."""
        x, y, _ = position
        return camera.focal * types_of(type(x)).Array2f(x, y) + camera.principal

    def film_directions(self, camera: Camera, position: Any, slopes: None) -> list[Any]:
        """Derivatives of the place on the film, two Array3f, world."""
        del position, slopes
        right, down, _ = camera.rotation
        return [right * camera.focal.x, down * camera.focal.y]

    def depth_direction(self, camera: Camera, position: Any) -> Any:
        """Derivative of the depth divided by the depth, Array3f, world."""
        return camera.rotation[2] / position.z

    def view_direction(self, camera: Camera, offset: Any) -> Any:
        """In which a mean is seen: that of the axis."""
        del offset
        return camera.rotation[2]

    def ray(self, camera: Camera, x: Any, y: Any) -> Any:
        """The direction of the ray through a point of the film, Array3f, camera axes."""
        del camera, y
        return types_of(type(x)).Array3f(0, 0, 1)

    def origin(self, camera: Camera, x: Any, y: Any) -> Any:
        """Where the ray through a point of the film (px) begins, Array3f, camera axes."""
        t = types_of(type(x))
        film = (t.Array2f(x, y) - camera.principal) / camera.focal
        return t.Array3f(film.x, film.y, 0)

    def ray_range(self, direction: Any, near: Any, far: Any) -> tuple[Any, Any]:
        """Where a ray of unit ``direction`` (camera axes) reaches two depths."""
        return near / direction.z, far / direction.z


# ----------------------------------------------------------------------------------------------
# Aperture
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Aperture:
    """Of a thin lens: what is at ``focus_distance`` is sharp."""

    radius: Any  # Float, scene units
    focus_distance: Any  # Float, scene units, along the axis

    def variance(self, camera: Camera, depth: Any) -> Any:
        """Along either axis, px^2, of the disc over which a point at ``depth`` is spread.

        Its radius is focal radius |1 / focus_distance - 1 / depth| (similar triangles), and a
        uniform disc of radius R has the variance R^2 / 4. Pixels are square.
        """
        radius = camera.focal.x * self.radius * (1 / self.focus_distance - 1 / depth)
        return dr.square(radius) / 4
