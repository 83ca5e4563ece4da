"""Gradients of cases with a camera of their own, along a direction of each parameter."""

import numpy as np

from support.helpers import (
    FLOAT64,
    Cotangents,
    device_gaussians,
    frame_tangent,
    plane_cotangents,
    rows,
)
from support.lens_scenes import directions, moved

STEP = 1e-6
"""Step of central differences of the float64 reference."""


def check_against_differences(case, kernel_gradients, tolerance) -> dict[str, np.ndarray]:
    """Derivatives in double precision along a direction equal differences of the reference.

    kernel_gradients(case, precision, cotangents) -> arrays by name; tolerance: relative to the sum
    of the terms' sizes, as they have both signs. Returns the terms, by parameter.
    """
    cotangents = Cotangents.random(case, seed=2)
    gradients, found = kernel_gradients(case, FLOAT64, cotangents), {}
    for parameter, direction in directions(case.gaussians, seed=3).items():
        forward, backward = (
            case.reference_image(moved(case.gaussians, direction, sign * STEP)) for sign in (1, -1)
        )
        expected = sum(
            np.sum(getattr(cotangents, f"d_{n}") * (getattr(forward, n) - getattr(backward, n)))
            for n in ("image", "alpha", "depth")
        ) / (2 * STEP)
        terms = found[parameter] = getattr(direction, parameter) * gradients[parameter]
        assert abs(terms.sum() - expected) <= tolerance * np.abs(terms).sum(), parameter
    return found


def check_transpose(case, precision, gaussians, frames, kernel_gradients, tolerance) -> None:
    """The adjoint is the transpose of the tangent: <w, J v> = <J^T w, v>.

    frames: the case's image is their mean; kernel_gradients: as above; tolerance: relative, of
    sums of thousands of terms, each as accurate as the arrays are.
    """
    cotangents = Cotangents.random(case, seed=4)
    gradients = kernel_gradients(case, precision, cotangents)
    d_features, d_transmittance = plane_cotangents(case, cotangents, precision)
    weights = np.array([rows(d) for d in (d_transmittance, *d_features)])
    for parameter, direction in directions(case.gaussians, seed=5).items():
        tangents = device_gaussians(direction, precision)
        planes = [frame_tangent(gaussians, frame, tangents) for frame in frames]
        left = weights * np.mean([[rows(plane) for plane in of_time] for of_time in planes], axis=0)
        right = getattr(direction, parameter) * gradients[parameter]
        size = np.abs(left).sum() + np.abs(right).sum()
        assert abs(left.sum() - right.sum()) <= tolerance * size, parameter
