"""Checks of lenses: small scenes, planes and gradients of the kernels."""

import numpy as np
import pytest

from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.splatting.projection import ewa, load_rows, plain_opacity, project
from support.helpers import (
    FLOAT32,
    FLOAT64,
    device_gaussians,
    frame_adjoint,
    plane_cotangents,
    rows,
)
from support.lens_scenes import (
    LENSES,
    LensCase,
    camera_behind,
    gaussians_at_points,
    lens_camera,
    points_at,
    points_near_lens_limit,
)

every_lens = pytest.mark.parametrize("name", LENSES)


FORMS = ("rational", "barrel", "fisheye", "thin prism", "orthographic")
"""One of each form; of a barrel, pixels that show nothing. Where Dr.Jit differentiates, or kernels
take long to compile, the others, which are these without some terms, tell no more."""


# Relative to the largest value of each array.
#
# float64: the reference's J, by differences, is off by 1e-13 of itself. Measured 4e-13.
#
# float32: as in test_rendering, and a few roundings more on the way to the film.
IMAGE = {FLOAT64: 1e-11, FLOAT32: 2e-5}


def case_of(name, **others) -> LensCase:
    """Wide films, and tall ones of another degree, antialiased."""
    return LensCase(name, 37, 29, 1, lens=LENSES[name], **others)


def kernel_gradients(case, precision, cotangents, pipeline=None) -> dict[str, np.ndarray]:
    gaussians, frame = case.render(precision, pipeline)
    d_features, d_transmittance = plane_cotangents(case, cotangents, precision)
    gradients = frame_adjoint(gaussians, frame, d_features, d_transmittance)
    return {n: np.array(getattr(gradients.parameters, n)) for n in PARAMETER_NAMES}


def keep_bounds(case, monkeypatch) -> None:
    """The camera stays: what its film sees is looked for once, not for each difference."""
    bounds = case.lens.slope_bounds(case.camera)
    monkeypatch.setattr(type(case.lens), "slope_bounds", lambda *_: bounds)


def tiny_scene(case, rng):
    camera = camera_behind(case, rng)
    size = np.array([case.width, case.height])
    film = rng.uniform(0.2, 0.8, (case.count, 2)) * size
    film[0], film[1] = (camera.cx, camera.cy), size * [1.5, 0.4]
    distances = rng.uniform(1, 3, case.count)
    points = points_at(case.lens, camera, film, distances)
    near_the_end = points_near_lens_limit(case.lens, camera, film, distances)
    points = np.where(np.isnan(points), near_the_end, points)
    sizes = rng.uniform(0.7, 3.0, (case.count, 3))
    sizes[1] = 0.5 * max(size)
    logits = rng.normal(0, 1, case.count)
    return gaussians_at_points(case, rng, camera, points, sizes, logits), camera


def splats_of(gaussians, camera, lens, precision, shape=ewa, low_pass=0.3, degree=0):
    """Projected by the kernels."""
    parameter_rows = load_rows(device_gaussians(gaussians, precision), degree)
    camera = lens_camera(camera, lens, precision)
    return project(parameter_rows, camera, degree, plain_opacity, shape, low_pass=low_pass)


def covariances(splats) -> np.ndarray:
    """(N, 2, 2), px^2."""
    p, r, s = rows(splats.conic_factor).T
    factors = np.moveaxis(np.array([[p, r], [np.zeros_like(s), s]]), -1, 0)
    return np.linalg.inv(np.swapaxes(factors, 1, 2) @ factors)


def planes_of(frame) -> np.ndarray:
    """(4, H W): transmittance and colour."""
    return np.array([rows(plane) for plane in frame.planes()])
