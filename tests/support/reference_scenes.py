"""Small scenes for the float64 reference, and comparisons of what it computes."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache

import numpy as np

from drgs.reference.splatting import Camera, Gaussians
from support.reference_lenses import gaussians_at

PARAMETERS = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")


def rotation_about(axis, angle) -> np.ndarray:
    """(3, 3) by Rodrigues' formula: not a quaternion's."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def small_camera() -> Camera:
    """Rotated, away from the origin, with an off-centre principal point and fx != fy."""
    return Camera(
        rotation=rotation_about([0.3, -1.0, 0.5], 0.7),
        center=np.array([0.4, -0.7, 1.1]),
        fx=23.0,
        fy=19.0,
        cx=13.6,
        cy=8.3,
        width=24,
        height=20,
    )


def small_scene() -> tuple[Gaussians, Camera]:
    """12 Gaussians of degree 3 on a 24 x 20 film.

    0 to 4 anything; 5 a wall behind them, so opaque that its alpha is clamped; 6 to 8 a stack
    that stops pixels; 9 so far outside the film that both ratios in the Jacobian are clamped, and
    large enough to reach into it; 10 behind the camera; 11 too transparent to be seen.
    """
    rng = np.random.default_rng(8)
    camera = small_camera()
    points = np.column_stack(
        [rng.uniform(-0.8, 0.7, 12), rng.uniform(-0.6, 0.8, 12), rng.uniform(1.4, 3.0, 12)]
    )
    points[5] = [-0.65, 0.3, 2.9]
    points[6:9] = [[0.10, 0.05, 1.5], [0.06, 0.09, 1.8], [0.12, 0.11, 2.1]]
    points[9] = [2.1, -1.3, 2.0]
    points[10] = [0.1, 0.2, -1.0]
    log_scales = rng.normal(np.log(0.15), 0.4, (12, 3))
    log_scales[5] = np.log([1.4, 1.8, 1.6])
    log_scales[6:9] = np.log([0.4, 0.3, 0.5])
    log_scales[9] = np.log([0.7, 0.5, 0.6])
    logit_opacities = rng.normal(0.8, 0.8, 12)
    logit_opacities[5:9] = [9.0, 5.0, 5.0, 5.0]
    logit_opacities[11] = -6.0
    gaussians = Gaussians(
        means=points @ camera.rotation + camera.center,
        quats=rng.normal(0, 1, (12, 4)) * rng.uniform(0.3, 3.0, (12, 1)),
        log_scales=log_scales,
        logit_opacities=logit_opacities,
        sh0=rng.normal(0, 1.2, (12, 1, 3)),
        shN=rng.normal(0, 0.3, (12, 15, 3)),
    )
    return gaussians, camera


def only(gaussians, kept) -> Gaussians:
    return Gaussians(**{name: getattr(gaussians, name)[kept] for name in PARAMETERS})


def with_invisible(gaussians, camera, point_logit=-1e3) -> Gaussians:
    """Seven more Gaussians at the end, which no image shows.

    At the camera's centre, behind it (one of them huge), nearer than the near plane, on the
    camera's plane, transparent; and a point without extent, of the given logit.
    """
    points = [[0, 0, 0], [0, 0, -1], [0, 1e30, -1e30], [0, 0, 0.0099], [1e3, 0, 0]]
    points += [[0.1, 0, 2]] * 2
    sizes = np.array([0.0, 80, 0, -2.3, -np.inf, 0, -np.inf])
    strange = {
        "means": np.array(points) @ camera.rotation + camera.center,
        "quats": np.zeros((7, 4)),
        "log_scales": np.repeat(sizes, 3).reshape(7, 3),
        "logit_opacities": [*[1e3] * 5, -1e3, point_logit],
        "sh0": np.ones((7, 1, 3)),
        "shN": np.ones((7, 15, 3)),
    }
    return Gaussians(
        **{name: np.concatenate([getattr(gaussians, name), strange[name]]) for name in PARAMETERS}
    )


BACKGROUND = np.array([0.9, 0.4, 0.2])


def cotangents() -> dict[str, np.ndarray]:
    """One random weight for each number of the image."""
    rng = np.random.default_rng(5)
    return {
        "d_image": rng.normal(0, 1, (20, 24, 3)),
        "d_alpha": rng.normal(0, 1, (20, 24)),
        "d_depth": rng.normal(0, 1, (20, 24)),
    }


# The largest change of log(alpha) for a step of a mean is |A d| f / z with |A d| below
# sqrt(2 ln 255 / 0.3) = 6.1 per px and f / z below 23 / 1.4: 100 per world unit, so 1e-4 for
# this step. For a step of a conic's number it is d^2 / 2, below 24^2 / 2 = 288 or 3e-4; the
# other parameters change it less. The scene has no pixel within 5e-4 of a threshold, which a
# test asserts: no perturbation flips a decision.
STEP = 1e-6


def numeric_gradients(outputs, weights, parameters) -> dict[str, np.ndarray]:
    """Central differences of sum(weight * output), differences taken before sums.

    outputs: a function of keyword arrays that returns a list of arrays like ``weights``.
    """
    gradients = {}
    for name, value in parameters.items():
        value = np.asarray(value, dtype=np.float64)
        gradient = np.zeros_like(value)
        for index in np.ndindex(value.shape):
            moved = value.copy()
            moved[index] = value[index] + STEP
            forward = outputs(**{**parameters, name: moved})
            moved[index] = value[index] - STEP
            backward = outputs(**{**parameters, name: moved})
            gradient[index] = sum(
                np.sum(w * (f - b)) for w, f, b in zip(weights, forward, backward, strict=True)
            ) / (2 * STEP)
        gradients[name] = gradient
    return gradients


@lru_cache
def legendre_sh_basis(direction: tuple, degree: int) -> np.ndarray:
    """(K,) from associated Legendre functions, with the Condon-Shortley phase, and angles."""
    x, y, z = direction
    azimuth, sine = math.atan2(y, x), math.hypot(x, y)
    basis = []
    for ell in range(degree + 1):
        for m in range(-ell, ell + 1):
            order = abs(m)
            legendre = np.polynomial.Legendre.basis(ell)
            derivative = legendre.deriv(order) if order else legendre
            associated = (-1) ** order * sine**order * derivative(z)
            norm = (2 * ell + 1) / (4 * math.pi)
            norm *= math.factorial(ell - order) / math.factorial(ell + order)
            angular = math.cos(m * azimuth) if m >= 0 else math.sin(order * azimuth)
            basis.append(math.sqrt(norm * (2 if m else 1)) * associated * angular)
    return np.array(basis)


def needle(log_scales) -> tuple[Gaussians, Camera]:
    """One Gaussian on the axis at z = 1, its long axis at 45 degrees on the film, f = 1 px."""
    camera = Camera(np.eye(3), np.zeros(3), 1.0, 1.0, 4.0, 4.0, 8, 8)
    eighth_turn = [math.cos(math.pi / 8), 0, 0, math.sin(math.pi / 8)]
    gaussians = gaussians_at([0, 0, 1], quats=eighth_turn)
    return replace(gaussians, log_scales=[log_scales], logit_opacities=[3.0]), camera


MARKED_DISTANCES = [(-2e-6, False), (-5e-7, True), (5e-7, True), (2e-6, False)]
"""(relative distance from a threshold, whether a width of 1e-6 marks the pixel)"""


def assert_images_agree(rendered, expected, atol) -> None:
    for name in ("image", "depth", "transmittance"):
        found, wanted = getattr(rendered, name), getattr(expected, name)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=atol, err_msg=name)
