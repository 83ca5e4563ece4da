"""Hard inputs under the approximations: finite, and as accurate as float32 can be.

The families are those of ``test_hard_cases``. In float64 the kernels' image has to be that of the
float64 reference. In float32, image and gradients may differ from those in float64 by the bound
of ``test_hard_cases``, whose noise comes of the float64 kernels here: inputs, and what the
projection hands on, are moved by one rounding each.
"""

from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import cache
from unittest import mock

import drjit as dr
import numpy as np
import pytest
from support.hard_cases import (
    EXACT,
    FAMILIES,
    U,
    bound_of,
    color_share,
    errors_over_bounds,
    opacity_size,
    rms,
    rounded_inputs,
)
from support.helpers import (
    FLOAT32,
    FLOAT64,
    device_camera,
    device_gaussians,
    frame_adjoint,
    rows,
    single,
)
from support.studies import reference_rays

from drgs.accuracy import exact, unscented
from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.splatting import projection, rendering

APPROXIMATIONS = {
    "exact": {"projection": "exact"},
    "unscented": {"projection": "unscented"},
    "pixel colours": {"sh_direction": "pixel"},
}

SMALL = [name for name, case in FAMILIES.items() if case.count < 1000]

SAMPLES = 8

SH_0 = 0.28209479177387814
"""1 / sqrt(4 pi): the first basis function."""

MARKED = 1e-4
"""Relative distance from a decision within which a pixel is left out."""


def planes_and_gradients(gaussians, camera, pipeline, weights, precision) -> tuple[dict, dict]:
    """weights: (H, W, 4), of the planes (transmittance, colour)."""
    device = device_gaussians(gaussians, precision)
    frame = rendering.render(device, device_camera(camera, precision), pipeline)
    planes = [rows(plane).reshape(camera.height, camera.width) for plane in frame.planes()]
    d_transmittance, *d_features = (precision.array(w) for w in np.moveaxis(weights, -1, 0))
    gradients = frame_adjoint(device, frame, d_features, d_transmittance).parameters
    return {"planes": np.stack(planes, axis=-1)}, {
        name: np.array(getattr(gradients, name)) for name in PARAMETER_NAMES
    }


@cache
def expected(name, approximation):
    """The reference's image, and weights that are zero where it is near a decision."""
    case, values = FAMILIES[name], Approximations(**APPROXIMATIONS[approximation])
    fields = set(reference_rays.ImageModel.__dataclass_fields__) & set(vars(values))
    model = reference_rays.ImageModel(**{field: getattr(values, field) for field in fields})
    rendered = reference_rays.render(
        case.gaussians, case.camera, (0, 0, 0), model, threshold_width=MARKED
    )
    planes = np.concatenate([rendered.transmittance[..., None], rendered.image], axis=-1)
    weights = np.random.default_rng(0).normal(size=planes.shape)
    return planes, single(weights * ~rendered.near_threshold[..., None]), rendered.near_threshold


def noises(case, pipeline, weights, base) -> tuple[dict, dict]:
    """Root mean square change of planes and gradients under one rounding everywhere."""
    moved = []
    for sample in range(SAMPLES):
        rng = np.random.default_rng([sample, 17])
        gaussians, camera = rounded_inputs(rng, case.gaussians, case.camera)
        gaussians = rounded_appearance(rng, gaussians)
        with rounded_axes(sample):
            moved.append(planes_and_gradients(gaussians, camera, pipeline, weights, FLOAT64))

    return tuple(rms([m[k] for m in moved], b) for k, b in enumerate(base))


def rounded_appearance(rng, gaussians) -> reference.Gaussians:
    """Opacities and colours moved as in ``hard_cases``: also by the roundings of the sums that
    they are added to.
    """
    opacities = reference.sigmoid(gaussians.logit_opacities)
    size, slope = opacity_size(opacities), np.maximum(opacities * (1 - opacities), 1e-30)
    logits = gaussians.logit_opacities + U * size / slope * rng.uniform(-1, 1, len(opacities))
    colors = U / color_share(opacities)[:, None, None] * rng.uniform(-1, 1, (len(opacities), 1, 3))
    sh0 = gaussians.sh0 + colors / SH_0
    return replace(gaussians, logit_opacities=logits, sh0=sh0)


@contextmanager
def rounded_axes(seed):
    """The projection with a rounding of each number of a Gaussian's half axes, and of its sigma
    points' places.

    Equal numbers are rounded equally wherever they are computed again. A derivative does not know
    of the rounding.
    """
    # The sigma points are a stage within the projection, which nothing else needs to name.
    film_axes, sigma_offsets = projection.film_axes, unscented._sigma_offsets

    def moved(rng, x):
        size = max(1, dr.width(x))
        return x + dr.detach(x) * FLOAT64.array(U * rng.uniform(-1, 1, size))

    def rounded_film_axes(*arguments):
        rng = np.random.default_rng([seed, 5])
        return tuple(type(v)(*(moved(rng, x) for x in v)) for v in film_axes(*arguments))

    def rounded_offsets(*arguments):
        rng = np.random.default_rng([seed, 6])
        return [moved(rng, x) for x in sigma_offsets(*arguments)]

    with ExitStack() as patches:
        for module in (projection, exact, unscented):
            patches.enter_context(mock.patch.object(module, "film_axes", rounded_film_axes))
        patches.enter_context(mock.patch.object(unscented, "_sigma_offsets", rounded_offsets))
        yield


@pytest.mark.slow
@pytest.mark.parametrize("approximation", APPROXIMATIONS)
@pytest.mark.parametrize("name", SMALL)
def test_image_and_gradients_are_within_the_bound(name, approximation):
    case = FAMILIES[name]
    planes, weights, marked = expected(name, approximation)
    assert marked.sum() <= max(2, 0.01 * marked.size)
    pipeline = pipeline_of(Approximations(**APPROXIMATIONS[approximation]), case.degree)
    inputs = case.gaussians, case.camera, pipeline, weights
    double, single_precision = (planes_and_gradients(*inputs, p) for p in (FLOAT64, FLOAT32))
    error = np.abs(double[0]["planes"] - planes)[~marked]
    assert error.max(initial=0) <= EXACT * max(1, np.abs(planes).max())
    ratios = {}
    for noise, wanted, actual in zip(
        noises(case, pipeline, weights, double), double, single_precision, strict=True
    ):
        bounds = {key: bound_of(case, noise[key], value) for key, value in wanted.items()}
        left_out = marked if "planes" in wanted else None
        ratios |= errors_over_bounds(actual, wanted, bounds, FLOAT32, left_out)
    assert max(ratios.values()) <= 1, ratios


@pytest.mark.slow
@pytest.mark.parametrize("name", SMALL)
def test_all_approximations_together_stay_finite(name):
    case = FAMILIES[name]
    approximations = Approximations(
        projection="exact", order="pixel", sh_direction="pixel", alpha_cut=0.0,
        transmittance_stop=0.0, low_pass=0.0,
    )  # fmt: skip
    weights = single(
        np.random.default_rng(0).normal(size=(case.camera.height, case.camera.width, 4))
    )
    pipeline = pipeline_of(approximations, case.degree)
    for results in planes_and_gradients(case.gaussians, case.camera, pipeline, weights, FLOAT32):
        assert all(np.isfinite(values).all() for values in results.values())
