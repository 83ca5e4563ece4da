"""Kernels contain only what a lens needs; positions that are not finite."""

import math
from dataclasses import replace
from itertools import pairwise

import drjit as dr
import numpy as np
import pytest
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Cotangents,
    clear,
    device_gaussians,
    frame_adjoint,
    frame_tangent,
    plane_cotangents,
    rows,
)
from support.kernels import drain_kernels
from support.lens_checks import FORMS, case_of, every_lens
from support.lens_scenes import (
    LENSES,
    LensCase,
    kernel_lens,
    lens_camera,
)

from drgs.accuracy.pipeline import pipeline_of
from drgs.accuracy.unscented import unscented_shape
from drgs.cameras import fisheye, orthographic
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cameras.thin_prism_fisheye import ThinPrismFisheye as KernelThinPrism
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import effects
from drgs.reference.effects import Fisheye, OpenCV, Orthographic, ThinPrismFisheye
from drgs.splatting import rendering
from drgs.splatting.projection import ewa

# ----------------------------------------------------------------------------------------------
# Missing coefficients
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({}, {}),
        ({"k1": 0.5}, {"k1": 0.5}),
        ({"k2": 0.5}, {"k1": 0.0, "k2": 0.5}),
        ({"k1": 0.0, "p1": 0.0}, {"k1": 0.0, "p1": 0.0, "p2": 0.0}),
        ({"k5": 0.5}, {"k4": 0.0, "k5": 0.5}),
        ({"p2": 0.5}, {"p1": 0.0, "p2": 0.5}),
        (
            dict(zip(RadialTangential.coefficient_names(), (1, 2, 3, 4, 5, 6, 7, 8), strict=True)),
            dict(zip(RadialTangential.coefficient_names(), (1, 2, 3, 4, 5, 6, 7, 8), strict=True)),
        ),
    ],
)
def test_missing_coefficients_are_left_out(given, named):
    lens = RadialTangential.from_coefficients(**given)
    assert lens.coefficients() == named
    values = {name: -value for name, value in named.items()}
    assert lens.with_coefficients(values).coefficients() == values
    assert lens.with_coefficients(values).max_squared_radius == lens.max_squared_radius


def test_fisheye_leaves_out_missing_coefficients():
    assert fisheye.Fisheye.from_coefficients().coefficients() == {}
    assert fisheye.Fisheye.from_coefficients(k2=0.5).coefficients() == {"k1": 0.0, "k2": 0.5}
    assert fisheye.Fisheye.from_coefficients(k1=0.0).coefficients() == {"k1": 0.0}
    lens = fisheye.Fisheye.from_coefficients(k1=0.5, k2=0.25)
    assert lens.with_coefficients({"k1": 0.25, "k2": 0.125, "fx": 1.0}).coefficients() == {
        "k1": 0.25, "k2": 0.125
    }  # fmt: skip
    assert orthographic.Orthographic().coefficients() == {}


@pytest.mark.parametrize(
    ("given", "named"),
    [
        ({}, {}),
        ({"k2": 0.5}, {"k1": 0.0, "k2": 0.5}),
        ({"p2": 0.0}, {"p1": 0.0, "p2": 0.0}),
        ({"k1": 0.5, "sx1": 0.25}, {"k1": 0.5, "sx1": 0.25, "sy1": 0.0}),
        (
            dict(zip(KernelThinPrism.coefficient_names(), range(1, 9), strict=True)),
            dict(zip(KernelThinPrism.coefficient_names(), range(1, 9), strict=True)),
        ),
    ],
)
def test_thin_prism_fisheye_leaves_out_missing_coefficients(given, named):
    lens = KernelThinPrism.from_coefficients(**given)
    assert lens.coefficients() == named
    values = {name: -value for name, value in named.items()}
    assert lens.with_coefficients({**values, "fx": 1.0}).coefficients() == values
    assert lens.with_coefficients(values).min_cosine == lens.min_cosine


@every_lens
def test_valid_region_matches_the_reference(name):
    lens = LENSES[name]
    if isinstance(lens, OpenCV):
        expected, actual = lens.valid_radius**2, kernel_lens(lens).max_squared_radius
    elif isinstance(lens, Fisheye):
        expected, actual = np.cos(lens.valid_angle), kernel_lens(lens).min_cosine
    else:
        return
    assert actual == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize(
    ("lens", "ends"),
    [
        (OpenCV(p1=0.125, p2=-0.0625), True),
        # Limited by the radial factor's derivative along the slope, then by the factor across it.
        (OpenCV(k1=-0.25, k2=0.03125, k4=0.0625, p1=-0.03125, p2=0.015625), True),
        (OpenCV(k1=0.0625, k4=0.03125, k5=-0.015625, p1=0.125, p2=0.125), True),
        # Nowhere; and not before the pole.
        (OpenCV(k1=0.25, k2=0.125, p1=0.0625), False),
        (OpenCV(k4=-0.25, p1=2.0**-30), False),
    ],
    ids=str,
)
def test_valid_region_with_tangential_terms_matches_the_reference(lens, ends):
    radius = math.sqrt(kernel_lens(lens).max_squared_radius)
    assert radius == pytest.approx(lens.valid_radius, rel=1e-9)
    plain = replace(lens, p1=0.0, p2=0.0).valid_radius
    assert (radius < 0.99 * plain) == ends


@pytest.mark.parametrize(
    ("lens", "ends"),
    [
        (ThinPrismFisheye(p1=0.125, p2=-0.0625), True),
        (ThinPrismFisheye(sx1=-0.25, sy1=0.125), True),
        (ThinPrismFisheye(-0.0625, 0.03125, p1=0.125, p2=0.0625, sx1=0.25, sy1=-0.125), True),
        # Terms that cancel, and terms smaller than the radial ones.
        (ThinPrismFisheye(p1=0.0625, p2=-0.03125, sx1=0.09375, sy1=-0.1875), False),
        (ThinPrismFisheye(0.25, p1=0.03125, sx1=0.03125), False),
    ],
    ids=str,
)
def test_valid_region_with_thin_prisms_matches_the_reference(lens, ends):
    angle = math.acos(kernel_lens(lens).min_cosine)
    assert angle == pytest.approx(lens.valid_angle, rel=1e-9)
    assert (angle < 0.99 * Fisheye(lens.k1, lens.k2, lens.k3, lens.k4).valid_angle) == ends


def kernels_of(lens, camera_seed=0) -> dict[str, list]:
    """[hash, operation count] of the kernels of a frame, its adjoint, and its tangent."""
    # Few enough entries that Dr.Jit's running maximum needs one pass.
    case = LensCase("kernels", 37, 29, 1, 20, seed=camera_seed, lens=lens)
    gaussians, camera = device_gaussians(case.gaussians, FLOAT32), case.device_camera(FLOAT32)
    # Aligned as Dr.Jit's own memory: see test_composition.
    flat = gaussians.logit_opacities + dr.opaque(FLOAT32.Float, 0)
    gaussians = replace(gaussians, logit_opacities=flat)
    ones = dr.opaque(FLOAT32.Float, 1, case.width * case.height)
    dr.eval(gaussians, ones)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history()
        # The pipeline of the other tests, for the same kernels.
        frame = rendering.render(gaussians, camera, case.pipeline)
        dr.eval(frame.planes())
        forward = drain_kernels()
        frame_adjoint(gaussians, frame, [ones] * (len(frame.planes()) - 1), ones)
        adjoint = drain_kernels()
        dr.eval(frame_tangent(gaussians, frame, gaussians))
        tangent = drain_kernels()
    return {"forward": forward, "adjoint": adjoint, "tangent": tangent}


def operations(kernels) -> dict[str, int]:
    return {name: sum(count for _, count in entries) for name, entries in kernels.items()}


@pytest.mark.parametrize(
    ("lens", "other"),
    [
        (OpenCV(k1=-0.25), OpenCV(k1=0.125)),
        (LENSES["rational"], OpenCV(0.1, 0.02, -0.01, 0.02, 0.01, 0.003, -0.002, 0.001)),
        (LENSES["fox"], OpenCV(k1=-0.3, k2=0.1, p1=0.001, p2=0.002)),
        (LENSES["fisheye"], Fisheye(0.02, -0.001, 0.003, 0.001)),
        (LENSES["thin prism"], ThinPrismFisheye(*(0.01 * k for k in range(1, 9)))),
        (Orthographic(), Orthographic()),
    ],
    ids=["k1", "rational", "fox", "fisheye", "thin prism", "orthographic"],
)
def test_kernels_do_not_depend_on_the_numbers_of_a_lens(lens, other):
    """Otherwise each camera, and each step of a calibration, would compile its own."""
    kernels = kernels_of(lens)
    assert kernels == kernels_of(other, camera_seed=5)
    assert all(len(entries) >= 3 for entries in kernels.values())


def test_each_coefficient_adds_operations_to_the_projection_only():
    """A lens without any has those of a pinhole with a bound; compositing never changes."""
    radial, rational = LENSES["radial"], LENSES["rational"]
    lenses_of = [effects.Pinhole(), OpenCV(), LENSES["barrel"], radial]
    lenses_of += [replace(rational, p1=0.0, p2=0.0), rational]
    kernels = [kernels_of(lens) for lens in lenses_of]
    for fewer, more in pairwise(kernels):
        before, after = operations(fewer), operations(more)
        assert all(before[name] < after[name] for name in before), (before, after)
        # All but the kernel that projects, which is the first.
        assert fewer["forward"][1:] == more["forward"][1:]


def test_each_coefficient_of_a_fisheye_adds_operations():
    steps = [LENSES["plain fisheye"], Fisheye(0.01), LENSES["fisheye"]]
    with_prism = LENSES["thin prism"]
    steps += [replace(with_prism, sx1=0.0, sy1=0.0), with_prism]
    for fewer, more in pairwise(kernels_of(lens) for lens in steps):
        before, after = operations(fewer), operations(more)
        assert all(before[name] < after[name] for name in before), (before, after)


# ----------------------------------------------------------------------------------------------
# Numbers that are none
# ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "shape", "precision"),
    [(name, ewa, precision) for name in FORMS for precision in (FLOAT32, FLOAT64)]
    + [("rational", unscented_shape, FLOAT32), ("fisheye", unscented_shape, FLOAT32)],
    ids=lambda value: value if isinstance(value, str) else getattr(value, "__name__", None),
)
def test_nonfinite_positions_affect_no_other_gaussian(precision, name, shape):
    """The image and all other gradients are those of the same Gaussians far away."""
    case = clear(case_of(name, count=30))
    means = case.gaussians.means.copy()
    bad = np.array([
        [np.nan, 0, 0], [0, np.nan, 0], [0, 0, np.nan], [np.inf, 0, 0], [0, -np.inf, 0],
        [0, 0, np.inf], [0, 0, -np.inf], [np.inf, np.inf, np.inf], [-np.inf, np.nan, np.inf],
        case.camera.center,
    ])  # fmt: skip
    where = np.arange(10, 10 + len(bad))
    means[where] = bad
    hidden = case.gaussians.logit_opacities.copy()
    hidden[where] = -50.0
    pipeline = replace(case.pipeline, shape=shape)
    cotangents = Cotangents.random(case)
    d_features, d_transmittance = plane_cotangents(case, cotangents, precision)

    def rendered(gaussians):
        device = device_gaussians(gaussians, precision)
        frame = rendering.render(device, case.device_camera(precision), pipeline)
        gradients = frame_adjoint(device, frame, d_features, d_transmittance).parameters
        planes = {n: rows(plane) for n, plane in enumerate(frame.planes())}
        return planes, {n: np.array(getattr(gradients, n)) for n in PARAMETER_NAMES}

    planes, gradients = rendered(replace(case.gaussians, means=means))
    expected_planes, expected = rendered(replace(case.gaussians, logit_opacities=hidden))
    for n, plane in expected_planes.items():
        np.testing.assert_array_equal(planes[n], plane)
    for n, gradient in expected.items():
        assert not gradients[n][where].any()
        np.testing.assert_array_equal(gradients[n], gradient)
        assert gradient.any()


@pytest.mark.parametrize("name", LENSES)
def test_exact_projection_refuses_lenses_other_than_pinholes(name):
    case = LensCase("tiny", 13, 11, 0, 5, lens=LENSES[name])
    kind = type(kernel_lens(LENSES[name])).__name__
    pipeline = pipeline_of(Approximations(projection="exact"), 0)
    gaussians = device_gaussians(case.gaussians, FLOAT32)
    with pytest.raises(
        ValueError, match=f"^splats: projection 'exact' needs a pinhole, got {kind}"
    ):
        rendering.render(gaussians, lens_camera(case.camera, case.lens, FLOAT32), pipeline)
