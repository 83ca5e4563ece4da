"""OpenCV's lens with radial and tangential distortion.

Imported when a sensor or a dataset has one. Coefficients are numbers of the host, or Dr.Jit scalars
after :meth:`Lens.upload`; one that is not given is left out (of a polynomial, those
behind the last one that is; or both tangential ones), so that nothing is computed for it.

Outside the part of the film's plane that the model is made for, its polynomials turn around and
would fold what lies far outside back into the picture: what is seen under a larger angle than that
at which the model first turns, in whatever direction, is not seen at all.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import drjit as dr

from drgs.cameras.distortion import PlaneDistortion, largest_squared_radius, steepest_fall
from drgs.cameras.lens import LENSES, CameraParameters, Perspective, with_unseen_on_axis
from drgs.cameras.polynomials import (
    UNBOUNDED,
    derivative,
    polynomial,
    up_to_the_last,
    usable_coefficients,
)
from drgs.core.arrays import types_of

BORDER = 65
"""Points on each side of the film, whose rays tell what the film sees."""

MISSED = 1e-6
"""Squared, of slopes: how far Newton's method may end from the point that it looked for."""


@LENSES.register("opencv")
@dataclass(frozen=True)
class RadialTangential(PlaneDistortion, Perspective):
    """OpenCV's lens: slopes (x, y) are distorted before they come to the film.

    With r^2 = x^2 + y^2 and L = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6),

        x' = L x + 2 p1 x y + p2 (r^2 + 2 x^2),  y' = L y + p1 (r^2 + 2 y^2) + 2 p2 x y

    (Brown 1966; OpenCV's documentation, "Camera Calibration and 3D Reconstruction"). Means whose r
    is beyond ``max_squared_radius`` are not seen.
    """

    names: ClassVar[tuple[str, ...]] = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")

    numerator: tuple[Any, ...]  # k1, k2, k3
    denominator: tuple[Any, ...]  # k4, k5, k6
    tangential: tuple[Any, ...]  # p1, p2; or none
    max_squared_radius: Any  # of the slopes
    on_film: Any = None  # (2) Array2f: the least and the largest slopes on the film

    @classmethod
    def from_coefficients(cls, **coefficients: float) -> RadialTangential:
        """Return the lens with OpenCV's ``k1`` to ``k6``, ``p1``, ``p2``; others are zero."""
        names, coefficients = cls.names, usable_coefficients(coefficients)
        p1, p2 = (float(coefficients.get(name, 0.0)) for name in names[6:])
        numerator = up_to_the_last(names[:3], coefficients)
        denominator = up_to_the_last(names[3:6], coefficients)
        return cls(
            numerator=numerator,
            denominator=denominator,
            tangential=(p1, p2) if set(coefficients) & set(names[6:]) else (),
            max_squared_radius=largest_squared_radius(
                numerator, denominator, steepest_fall((p1, p2))
            ),
        )

    def coefficients(self) -> dict[str, Any]:
        """Return the coefficients that are not left out."""
        names = (*self.names[: len(self.numerator)], *self.names[3 : 3 + len(self.denominator)])
        names += self.names[6:] if self.tangential else ()
        values = (*self.numerator, *self.denominator, *self.tangential)
        return dict(zip(names, values, strict=True))

    def with_coefficients(self, values: Mapping[str, Any]) -> RadialTangential:
        """Return other numbers for the same coefficients; where the model ends stays as it is."""
        k, p = self.names[:6], self.names[6:]
        return replace(
            self,
            numerator=tuple(values[name] for name in k[: len(self.numerator)]),
            denominator=tuple(values[name] for name in k[3 : 3 + len(self.denominator)]),
            tangential=tuple(values[name] for name in p[: len(self.tangential)]),
        )

    def radial(self, squared: Any) -> Any:
        """L at r^2."""
        return polynomial(self.numerator, squared) / polynomial(self.denominator, squared)

    def radial_derivative(self, squared: Any) -> Any:
        """d L / d r^2."""
        denominator = polynomial(self.denominator, squared)
        change = derivative(self.numerator, squared)
        change = change - self.radial(squared) * derivative(self.denominator, squared)
        return change / denominator

    def visibility(self, camera: CameraParameters, position: Any) -> tuple[Any, Any, Any]:
        """Return whether a point is seen, its position, and its depth."""
        x, y, z = position
        # Not divided by z, which may be zero.
        limit = self.max_squared_radius * z * z
        return with_unseen_on_axis(position, (z >= camera.near) & (x * x + y * y < limit))

    def project_point(self, camera: CameraParameters, position: Any) -> Any:
        """Return the place of a point on the film, Array2f, px."""
        slopes = self.distort(*self.true_slopes(camera, position))
        return camera.focal * types_of(type(position.z)).Array2f(*slopes) + camera.principal

    def projection_jacobian(
        self, camera: CameraParameters, position: Any, slopes: list[Any]
    ) -> list[Any]:
        """Return the derivatives of the place on the film, two Array3f, world."""
        xx, xy, yx, yy = self.distortion_jacobian(*slopes)
        right, down, forward = camera.rotation
        dx, dy = (
            (axis - slope * forward) / position.z
            for axis, slope in zip((right, down), slopes, strict=True)
        )
        return [camera.focal.x * (xx * dx + xy * dy), camera.focal.y * (yx * dx + yy * dy)]

    def for_camera(self, camera: CameraParameters) -> RadialTangential:
        """Return the lens that knows what the film of ``camera`` sees."""
        return replace(self, on_film=_slopes_on_border(self, camera))

    def frustum(self, camera: CameraParameters) -> tuple[Any, Any]:
        """Return the least and the largest slopes on the film."""
        del camera
        return self.on_film

    def ray(self, camera: CameraParameters, x: Any, y: Any) -> Any:
        """Return the direction of the ray through a place of the film (px), Array3f."""
        t = types_of(type(x))
        film = (t.Array2f(x, y) - camera.principal) / camera.focal
        return t.Array3f(*self.undistort(film.x, film.y), 1)


def _slopes_on_border(lens: RadialTangential, camera: CameraParameters) -> tuple[Any, Any]:
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
    bounded = dr.all(lens.is_within(*slopes) & (missed < MISSED))
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
