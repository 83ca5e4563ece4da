"""Gradients of cases with a camera of their own, along a direction of each parameter."""

import numpy as np

from support.helpers import Cotangents, plane_cotangents, rows
from support.lens_scenes import directions, moved

STEP = 1e-6
"""Of the differences of the float64 reference."""


def check_against_differences(case, kernel_gradients, tolerance) -> dict[str, np.ndarray]:
    """Derivatives in double precision along a direction equal differences of the reference.

    kernel_gradients(case, cotangents) -> arrays by name; tolerance: relative to the sum of the
    terms' sizes, as they have both signs. Returns the terms, by parameter.
    """
    cotangents = Cotangents.random(case, seed=2)
    gradients, found = kernel_gradients(case, cotangents), {}
    for parameter, direction in directions(case.gaussians, seed=3).items():
        forward, backward = (
            case.reference_picture(moved(case.gaussians, direction, sign * STEP))
            for sign in (1, -1)
        )
        expected = sum(
            np.sum(getattr(cotangents, f"d_{n}") * (getattr(forward, n) - getattr(backward, n)))
            for n in ("image", "alpha", "depth")
        ) / (2 * STEP)
        terms = found[parameter] = getattr(direction, parameter) * gradients[parameter]
        assert abs(terms.sum() - expected) <= tolerance * np.abs(terms).sum(), parameter
    return found


def check_transpose(case, precision, kernel_gradients, planes_along, tolerance) -> None:
    """The adjoint is the transpose of the tangent: <w, J v> = <J^T w, v>.

    kernel_gradients(case, cotangents): as above; planes_along(direction): tangents of the planes of
    pixels; tolerance: relative, of sums of thousands of terms, each as accurate as the arrays are.
    """
    cotangents = Cotangents.random(case, seed=4)
    gradients = kernel_gradients(case, cotangents)
    d_features, d_transmittance = plane_cotangents(case, cotangents, precision)
    weights = np.array([rows(d) for d in (d_transmittance, *d_features)])
    for parameter, direction in directions(case.gaussians, seed=5).items():
        left = weights * np.array(planes_along(direction))
        right = getattr(direction, parameter) * gradients[parameter]
        size = np.abs(left).sum() + np.abs(right).sum()
        assert abs(left.sum() - right.sum()) <= tolerance * size, parameter
