"""Splats before and behind a surface: planes and derivatives against the float64 reference."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    assert_arrays_agree,
    both_precisions,
    clear,
    device_camera,
    device_gaussians,
    frame_adjoint,
    frame_tangent,
    rows,
    single,
    stacked_scene,
)
from support.lens_scenes import directions, moved

from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.core.arrays import from_host
from drgs.effects.occlusion import OccludedFeatures, Surface
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.reference.effects import render_with_surfaces
from drgs.splatting import order, rendering
from drgs.splatting.grid import TileGrid

# Tolerances of test_rendering.
IMAGE = {FLOAT64: 1e-12, FLOAT32: 2e-5}
GRADIENTS = {FLOAT64: 1e-7, FLOAT32: 1e-4}

CASES = [
    Case("scattered", 37, 29, 2, count=60),
    Case("stacked", 37, 29, 1, count=24, recipe=stacked_scene),
    Case("one pixel", 1, 1, 1, count=12),
]
all_cases = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)

STEP = 1e-6


@cache
def surfaces_of(case) -> list[tuple[np.ndarray, np.ndarray]]:
    """Two surfaces' depths (H, W) amid the splats, no one's, and alphas: 0, 1 and between."""
    rng = np.random.default_rng(2)
    depths = np.sort(reference_depths(case))
    gaps = (depths[1:] + depths[:-1]) / 2
    shape, surfaces = (case.height, case.width), []
    for first in (len(gaps) // 8, len(gaps) // 2):
        z = rng.choice(gaps[first:], shape) if len(gaps) else depths
        z = single(np.resize(z, shape))
        z = np.maximum(z, surfaces[0][0]) if surfaces else z
        surfaces.append((z, rng.choice([0.0, 0.25, 0.625, 1.0], shape)))
    return surfaces


def on_device(surfaces, precision) -> tuple[Surface, ...]:
    """The same with the part of all light that each stops, in place of its alpha."""
    found, rest = [], 1.0
    for z, alpha in surfaces:
        found.append(Surface(*(from_host(precision.Float, p.ravel()) for p in (z, rest * alpha))))
        rest = rest * (1 - alpha)
    return tuple(found)


def reference_depths(case) -> np.ndarray:
    splats = reference.project(*case.scene)
    return splats.depths[splats.visible]


def occluded(pipeline, case, surfaces) -> rendering.Pipeline:
    """The pipeline with surfaces, and depth."""
    grid = TileGrid(case.width, case.height)
    features = OccludedFeatures(pipeline.model.features, surfaces, grid)
    return replace(
        pipeline,
        model=replace(pipeline.model, features=features),
        features=(*pipeline.features, rendering.depth_feature),
    )


def expected_planes(case, gaussians=None) -> np.ndarray:
    """(7, H W): the splats' own transmittance, color, depth, weights in front of each surface."""
    rendered = render_with_surfaces(gaussians or case.gaussians, case.camera, surfaces_of(case))
    plain = reference.render(gaussians or case.gaussians, case.camera)
    planes = [plain.transmittance, *np.moveaxis(rendered.color, -1, 0), rendered.depth]
    return np.reshape([*planes, *(1 - rendered.before)], (7, -1))


def render(case, precision):
    gaussians = device_gaussians(case.gaussians, precision)
    camera = device_camera(case.camera, precision)
    pipeline = occluded(case.pipeline, case, on_device(surfaces_of(case), precision))
    return gaussians, rendering.render(gaussians, camera, pipeline)


@both_precisions
@all_cases
def test_planes_match_the_reference(precision, case):
    case = clear(case)
    _, frame = render(case, precision)
    planes = rows(frame.planes()).T
    expected = expected_planes(case)
    names = ("transmittance", "red", "green", "blue", "depth", "front", "second front")
    assert_arrays_agree(
        dict(zip(names, planes, strict=True)),
        dict(zip(names, expected, strict=True)),
        IMAGE[precision],
    )


@pytest.mark.slow
@both_precisions
@all_cases
def test_gradients_equal_differences_of_the_reference(precision, case):
    """Along a random direction of each parameter."""
    case = clear(case)
    gaussians, frame = render(case, precision)
    weights = single(np.random.default_rng(4).normal(0, 1, expected_planes(case).shape))
    d_transmittance, *d_features = (precision.array(w) for w in weights)
    gradients = frame_adjoint(gaussians, frame, d_features, d_transmittance)
    for name, direction in directions(case.gaussians, seed=5).items():
        forward, backward = (
            expected_planes(case, moved(case.gaussians, direction, sign * STEP)) for sign in (1, -1)
        )
        expected = np.sum(weights * (forward - backward)) / (2 * STEP)
        terms = getattr(direction, name) * np.array(getattr(gradients.parameters, name))
        limit = GRADIENTS[precision] * np.abs(terms).sum()
        assert abs(terms.sum() - expected) <= limit, name


@both_precisions
@all_cases
def test_adjoint_is_the_transpose_of_the_tangent(precision, case):
    case = clear(case)
    gaussians, frame = render(case, precision)
    rng = np.random.default_rng(6)
    tangent = {
        n: single(rng.normal(0, 1, getattr(case.gaussians, n).shape)) for n in PARAMETER_NAMES
    }
    planes = frame_tangent(
        gaussians, frame, device_gaussians(replace(case.gaussians, **tangent), precision)
    )
    weights = single(rng.normal(0, 1, expected_planes(case).shape))
    d_transmittance, *d_features = (precision.array(w) for w in weights)
    gradients = frame_adjoint(gaussians, frame, d_features, d_transmittance)
    left = weights * rows(planes).T
    right = [np.array(getattr(gradients.parameters, n)) * tangent[n] for n in PARAMETER_NAMES]
    size = np.sqrt(np.sum(left**2) + sum(np.sum(r**2) for r in right))
    limit = 1e-12 if precision is FLOAT64 else 5e-5
    assert abs(left.sum() - sum(r.sum() for r in right)) <= limit * size


@pytest.mark.slow
def test_surface_occludes_each_group_of_features(monkeypatch):
    """Two planes at a time, and the weights in front with each."""
    monkeypatch.setitem(order.FEATURES_AT_ONCE, 8, 2)
    test_planes_match_the_reference(FLOAT64, CASES[0])
    test_gradients_equal_differences_of_the_reference(FLOAT64, CASES[0])
    test_adjoint_is_the_transpose_of_the_tangent(FLOAT64, CASES[0])


@pytest.mark.parametrize("approximations", [{"sh_direction": "pixel"}, {"order": "pixel"}], ids=str)
def test_approximated_planes_are_linear_in_coverage(approximations):
    """Linear in the coverage: of nothing and of all; the sum in front does not depend on it."""
    case = clear(CASES[0])
    gaussians = device_gaussians(case.gaussians, FLOAT64)
    camera = device_camera(case.camera, FLOAT64)
    z, coverage = surfaces_of(case)[0]
    plain = pipeline_of(Approximations(**approximations), 2, features=case.pipeline.features)

    def planes(amount):
        pipeline = occluded(plain, case, on_device([(z, amount)], FLOAT64))
        return rows(rendering.render(gaussians, camera, pipeline).planes()).T

    nothing, everything, part = (planes(a) for a in (0 * coverage, 0 * coverage + 1, coverage))
    c = coverage.ravel()
    np.testing.assert_allclose(part, (1 - c) * nothing + c * everything, atol=1e-12)
    without = rows(rendering.render(gaussians, camera, plain).planes()).T
    np.testing.assert_allclose(nothing[:-1], without, atol=1e-12)
    assert np.abs(everything[1:4] - nothing[1:4]).max() > 0.1
    np.testing.assert_array_equal(part[-1], nothing[-1])
