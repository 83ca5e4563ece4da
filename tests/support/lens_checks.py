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
    lens_camera,
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
