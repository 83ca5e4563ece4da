"""Kernels contain only what a lens needs; positions that are not finite."""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from support import lenses as reference
from support.cases import with_lens
from support.helpers import FLOAT32, FLOAT64, Case
from support.kernels import kernels_of_a_frame
from support.lens_scenes import FORMS, LENSES, kernel_lens, lens_camera
from support.lenses import OpenCV, Pinhole
from support.lenses import ThinPrismFisheye as ThinPrism

from drgs.cameras.fisheye import Fisheye
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cameras.thin_prism_fisheye import ThinPrismFisheye

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
        *(
            (lens, None)
            for lens in LENSES.values()
            if isinstance(lens, (OpenCV, reference.Fisheye))
        ),
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


def kernels_behind(lens) -> dict[str, list]:
    """[hash, operation count] of the kernels of a frame, its adjoint, and its tangent."""
    # Few enough entries that Dr.Jit's running maximum needs one pass.
    case = Case("kernels", 37, 29, 1, 20)
    return kernels_of_a_frame(case.pipeline, case, lens_camera(case.camera, lens, FLOAT32))


@pytest.mark.parametrize(
    "lenses",
    [
        [Pinhole(), LENSES["radial"], LENSES["rational"]],
        [LENSES["plain fisheye"], LENSES["fisheye"], WITHOUT_PRISM, LENSES["thin prism"]],
    ],
    ids=["slopes", "angles"],
)
def test_coefficients_add_operations_to_the_projection_only(lenses):
    for fewer, more in pairwise(kernels_behind(lens) for lens in lenses):
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
    ("name", "projection", "precision", "aperture"),
    [
        *((name, "ewa", FLOAT32, None) for name in FORMS),
        ("rational", "ewa", FLOAT64, None),
        ("rational", "unscented", FLOAT32, None),
        ("fisheye", "unscented", FLOAT32, None),
        ("rational", "ewa", FLOAT32, (0.21875, 2.0)),
        ("rational", "ewa", FLOAT64, (0.21875, 2.0)),
    ],
    ids=lambda value: value if isinstance(value, str) else None,
)
def test_invisible_positions_affect_no_other_gaussian(precision, name, projection, aperture):
    """The image and all other gradients are those of the same Gaussians far away."""
    given = {"approximations": {"projection": projection}, "aperture": aperture}
    case = with_lens(name, count=30, **given)
    rotation, center = case.pose
    bad = np.array([
        [np.nan, 0, 0], [0, np.nan, 0], [0, 0, np.nan], [np.inf, 0, 0], [0, -np.inf, 0],
        [0, 0, np.inf], [0, 0, -np.inf], [np.inf, np.inf, np.inf], [-np.inf, np.nan, np.inf],
        center, center - 20 * rotation[2],
    ])  # fmt: skip
    where = np.arange(10, 10 + len(bad))
    means, hidden = case.values["means"].copy(), case.values["logit_opacities"].copy()
    means[where], hidden[where] = bad, -50.0
    weights = np.random.default_rng(1).normal(size=(5, case.width * case.height))
    values = {**case.values, "means": means}, {**case.values, "logit_opacities": hidden}
    planes, expected_planes = (case.planes(v, precision.Float) for v in values)
    np.testing.assert_array_equal(planes, expected_planes)
    gradients, expected = (case.gradients(v, weights, precision.Float) for v in values)
    for n, gradient in expected.items():
        assert not gradients[n][where].any()
        np.testing.assert_array_equal(gradients[n], gradient)
        assert gradient.any()
