"""Kernels contain only what a lens needs; positions that are not finite."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Cotangents,
    clear,
    device_gaussians,
    frame_adjoint,
    plane_cotangents,
    render_composed,
    rows,
)
from support.kernels import kernels_of_a_frame
from support.lens_scenes import FORMS, LENSES, LensCase, case_of, kernel_lens

from drgs.accuracy.pipeline import pipeline_of
from drgs.accuracy.unscented import unscented_shape
from drgs.cameras.fisheye import Fisheye
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cameras.thin_prism_fisheye import ThinPrismFisheye
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import effects
from drgs.reference.effects import OpenCV
from drgs.reference.effects import ThinPrismFisheye as ThinPrism
from drgs.splatting.projection import ewa

# ----------------------------------------------------------------------------------------------
# Missing coefficients
# ----------------------------------------------------------------------------------------------


ALL_OPENCV = dict(zip(RadialTangential.coefficient_names(), range(1, 9), strict=True))
WITHOUT_PRISM = replace(LENSES["thin prism"], sx1=0.0, sy1=0.0)
ALL_THIN_PRISM = dict(zip(ThinPrismFisheye.coefficient_names(), range(1, 9), strict=True))


@pytest.mark.parametrize(
    ("kind", "given", "kept"),
    [
        (RadialTangential, {}, {}),
        (RadialTangential, {"k1": 0.5}, {"k1": 0.5}),
        (RadialTangential, {"k1": 0.0, "p1": 0.0}, {"k1": 0.0, "p1": 0.0, "p2": 0.0}),
        (RadialTangential, {"k5": 0.5}, {"k4": 0.0, "k5": 0.5}),
        (RadialTangential, ALL_OPENCV, ALL_OPENCV),
        (Fisheye, {}, {}),
        (Fisheye, {"k2": 0.5}, {"k1": 0.0, "k2": 0.5}),
        (ThinPrismFisheye, {"p2": 0.0}, {"p1": 0.0, "p2": 0.0}),
        (ThinPrismFisheye, {"k1": 0.5, "sx1": 0.25}, {"k1": 0.5, "sx1": 0.25, "sy1": 0.0}),
        (ThinPrismFisheye, ALL_THIN_PRISM, ALL_THIN_PRISM),
    ],
)
def test_missing_coefficients_are_left_out(kind, given, kept):
    lens = kind.from_coefficients(**given)
    assert lens.coefficients() == kept
    values = {name: -value for name, value in kept.items()}
    other = lens.with_coefficients({**values, "fx": 1.0})
    assert other.coefficients() == values
    assert limit_of(other) == limit_of(lens)


def limit_of(lens) -> float:
    """The largest slope or angle of the kernels' lens."""
    if isinstance(lens, RadialTangential):
        return math.sqrt(lens.max_squared_radius)
    return math.acos(lens.min_cosine)


@pytest.mark.parametrize(
    ("lens", "is_limited_by_tilt"),
    [
        *((lens, None) for lens in LENSES.values() if isinstance(lens, (OpenCV, effects.Fisheye))),
        (OpenCV(p1=0.125, p2=-0.0625), True),
        # Limited by the radial factor's derivative along the slope, then by the factor across it.
        (OpenCV(k1=-0.25, k2=0.03125, k4=0.0625, p1=-0.03125, p2=0.015625), True),
        (OpenCV(k1=0.0625, k4=0.03125, k5=-0.015625, p1=0.125, p2=0.125), True),
        # Nowhere; and not before the pole.
        (OpenCV(k1=0.25, k2=0.125, p1=0.0625), False),
        (OpenCV(k4=-0.25, p1=2.0**-30), False),
        (ThinPrism(p1=0.125, p2=-0.0625), True),
        (ThinPrism(sx1=-0.25, sy1=0.125), True),
        (ThinPrism(-0.0625, 0.03125, p1=0.125, p2=0.0625, sx1=0.25, sy1=-0.125), True),
        # Terms that cancel, and terms smaller than the radial ones.
        (ThinPrism(p1=0.0625, p2=-0.03125, sx1=0.09375, sy1=-0.1875), False),
        (ThinPrism(0.25, p1=0.03125, sx1=0.03125), False),
    ],
    ids=str,
)
def test_valid_region_matches_the_reference(lens, is_limited_by_tilt):
    name = "valid_radius" if isinstance(lens, OpenCV) else "valid_angle"
    limit = limit_of(kernel_lens(lens))
    assert limit == pytest.approx(getattr(lens, name), rel=1e-9)
    if is_limited_by_tilt is not None:
        tilted = {n: 0.0 for n in ("p1", "p2", "sx1", "sy1") if hasattr(lens, n)}
        radial = replace(lens, **tilted)
        assert (limit < 0.99 * getattr(radial, name)) == is_limited_by_tilt


def kernels_of(lens, camera_seed=0) -> dict[str, list]:
    """[hash, operation count] of the kernels of a frame, its adjoint, and its tangent."""
    # Few enough entries that Dr.Jit's running maximum needs one pass.
    case = LensCase("kernels", 37, 29, 1, 20, seed=camera_seed, lens=lens)
    # The pipeline of the other tests, for the same kernels.
    return kernels_of_a_frame(case.pipeline, case, case.device_camera(FLOAT32))


@pytest.mark.parametrize(
    ("lens", "other"),
    [
        (LENSES["rational"], OpenCV(0.1, 0.02, -0.01, 0.02, 0.01, 0.003, -0.002, 0.001)),
        (LENSES["thin prism"], ThinPrism(*(0.01 * k for k in range(1, 9)))),
    ],
    ids=["rational", "thin prism"],
)
def test_kernels_do_not_depend_on_the_numbers_of_a_lens(lens, other):
    """Otherwise each camera, and each step of a calibration, would compile its own."""
    kernels = kernels_of(lens)
    assert kernels == kernels_of(other, camera_seed=5)
    assert all(len(entries) >= 3 for entries in kernels.values())


@pytest.mark.parametrize(
    "lenses",
    [
        [effects.Pinhole(), LENSES["radial"], LENSES["rational"]],
        [LENSES["plain fisheye"], LENSES["fisheye"], WITHOUT_PRISM, LENSES["thin prism"]],
    ],
    ids=["slopes", "angles"],
)
def test_coefficients_add_operations_to_the_projection_only(lenses):
    for fewer, more in pairwise(kernels_of(lens) for lens in lenses):
        for name, entries in fewer.items():
            before, after = (sum(count for _, count in each) for each in (entries, more[name]))
            assert before < after, name
        # All but the kernel that projects, which is the first.
        assert fewer["forward"][1:] == more["forward"][1:]


# ----------------------------------------------------------------------------------------------
# Numbers that are none
# ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "shape", "precision", "defocus"),
    [
        *((name, ewa, FLOAT32, None) for name in FORMS),
        ("rational", ewa, FLOAT64, None),
        ("rational", unscented_shape, FLOAT32, None),
        ("fisheye", unscented_shape, FLOAT32, None),
        ("rational", ewa, FLOAT32, effects.ThinLens(0.21875, 2.0)),
        ("rational", ewa, FLOAT64, effects.ThinLens(0.21875, 2.0)),
    ],
    ids=lambda value: value if isinstance(value, str) else getattr(value, "__name__", None),
)
def test_invisible_positions_affect_no_other_gaussian(precision, name, shape, defocus):
    """The image and all other gradients are those of the same Gaussians far away."""
    case = clear(case_of(name, count=30, defocus=defocus))
    means = case.gaussians.means.copy()
    bad = np.array([
        [np.nan, 0, 0], [0, np.nan, 0], [0, 0, np.nan], [np.inf, 0, 0], [0, -np.inf, 0],
        [0, 0, np.inf], [0, 0, -np.inf], [np.inf, np.inf, np.inf], [-np.inf, np.nan, np.inf],
        case.camera.center, case.camera.center - 20 * case.camera.rotation[2],
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
        frame = render_composed(device, case.device_camera(precision), pipeline)
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


@pytest.mark.parametrize("name", ["rational", "orthographic"])
def test_exact_projection_refuses_lenses_other_than_pinholes(name):
    case = LensCase("tiny", 13, 11, 0, 5, lens=LENSES[name])
    kind = type(kernel_lens(LENSES[name])).__name__
    message = f"^splats: projection 'exact' needs a pinhole, got {kind}"
    with pytest.raises(ValueError, match=message):
        case.render(FLOAT32, pipeline_of(Approximations(projection="exact"), 0))
