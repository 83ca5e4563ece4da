"""The laws of ``drgs.testing`` on a matrix of cases: lens or effect x approximation.

``pytest tests/test_laws.py -k matrix -s`` prints the matrix. A new lens, effect or approximation is
covered by one line of a table below.
"""

from __future__ import annotations

import itertools
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.approximation_checks import APPROXIMATIONS
from support.helpers import NEAR_THRESHOLD
from support.lens_scenes import LENSES, kernel_lens

from drgs.cameras.motion import MotionBlur, RollingShutter
from drgs.core.arrays import types_of
from drgs.reference import effects, rays
from drgs.reference import splatting as reference
from drgs.splatting import footprint, projection
from drgs.splatting.footprint import GaussianFalloff
from drgs.testing import (
    LAWS,
    Case,
    adjoint_is_transpose,
    bytes_are_reproducible,
    gradients_equal_differences,
    image_equals_reference,
    laws_of,
    single_precision_is_accurate,
)

MOTION_SAMPLES = 3
PINHOLE = effects.Pinhole()


# ----------------------------------------------------------------------------------------------
# References
# ----------------------------------------------------------------------------------------------


def reference_camera(case) -> reference.Camera:
    (rotation, center), K = case.pose, case.K
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    return reference.Camera(rotation, center, fx, fy, cx, cy, case.width, case.height, 0.25)


def planes_of(rendered) -> tuple[np.ndarray, np.ndarray]:
    images = [rendered.transmittance, *np.moveaxis(rendered.image, -1, 0), rendered.depth]
    return np.reshape(images, (5, -1)), rendered.near_threshold.ravel()


def by_rays(case, values):
    """Approximations of a pinhole's image; the depth of other orders is the peaks'."""
    model = rays.ImageModel(**{k: v for k, v in case.approximations.items() if k in MODEL_FIELDS})
    image = partial(rays.render, camera=reference_camera(case), model=model)
    planes, marked = planes_of(image(reference.Gaussians(**values), threshold_width=NEAR_THRESHOLD))
    return planes if model.order == "center" else planes[:4], marked


MODEL_FIELDS = set(rays.ImageModel.__dataclass_fields__)


def by_effects(case, values, lens=PINHOLE):
    """Lenses, with an aperture and a smoothing filter."""
    if case.smoothing is not None:
        rates = np.full(case.count, np.sqrt(effects.SMOOTHING_VARIANCE) / case.smoothing)
        given = values["log_scales"], values["logit_opacities"], rates
        scales, opacities = effects.smoothing_filter(*given)
        logits = np.log(opacities / (1 - opacities))
        values = {**values, "log_scales": np.log(scales), "logit_opacities": logits}
    defocus = case.aperture and effects.ThinLens(*case.aperture)
    antialiased = case.approximations.get("antialiased", False)
    return planes_of(
        effects.render(
            reference.Gaussians(**values), reference_camera(case), lens, np.zeros(3), antialiased,
            defocus, case.degree, NEAR_THRESHOLD,
        )
    )  # fmt: skip


TRAVEL, TURN = np.array([0.125, -0.0625, 0.03125]), np.array([0.03125, 0.0625, -0.09375])


def close_camera(case) -> reference.Camera:
    """The camera when the shutter closes: moved by TRAVEL (world), turned by TURN (camera axes)."""
    camera = reference_camera(case)
    angle = np.linalg.norm(TURN)
    quat = np.array([[np.cos(angle / 2), *(np.sin(angle / 2) * TURN / angle)]])
    rotation = reference.quat_to_rotation(quat)[0] @ camera.rotation
    return replace(camera, rotation=rotation, center=camera.center + TRAVEL)


def shutter(kind, *arguments):
    """Make the shutter of a camera."""

    def make(camera):
        Array3f = types_of(type(camera.near)).Array3f
        return kind(Array3f(*map(float, TRAVEL)), Array3f(*map(float, TURN)), *arguments)

    return make


def by_motion(case, values, lens=PINHOLE):
    cameras = reference_camera(case), close_camera(case)
    gaussians = reference.Gaussians(**values)
    return planes_of(
        effects.render_motion_blur(gaussians, *cameras, MOTION_SAMPLES, np.zeros(3), lens)
    )


# ----------------------------------------------------------------------------------------------
# The matrix
# ----------------------------------------------------------------------------------------------

ALL_LENSES = {"pinhole": PINHOLE, **LENSES}

# px: films of fisheyes reach beyond 90 degrees from the axis; that of parallel rays is 3 units.
FOCAL = {effects.Fisheye: 10.0, effects.ThinPrismFisheye: 10.0, effects.Orthographic: 12.0}


def with_lens(name, effect, reference_of, **options) -> Case:
    """A case with a lens of the reference and of the kernels."""
    lens = ALL_LENSES[name]
    if name != "pinhole":
        options["lens"] = kernel_lens(lens)
    options.setdefault("focal", FOCAL.get(type(lens), 26.0))
    found = reference_of and partial(reference_of, lens=lens)
    return Case(f"{effect}, {name}", reference=found, **options)


EFFECTS = {
    "no effect": (by_effects, {}),
    "antialiased": (by_effects, {"approximations": {"antialiased": True}}),
    "thin lens": (by_effects, {"aperture": (0.0625, 2.0)}),
    "smoothing": (by_effects, {"smoothing": 0.0625}),
    "motion blur": (by_motion, {"shutter": shutter(MotionBlur, MOTION_SAMPLES)}),
    "rolling shutter": (None, {"shutter": shutter(RollingShutter)}),
}

NO_SENSOR = "in focus by z in kernels, by distance in the reference; no sensor has both"
HOLES = {
    ("thin lens", "orthographic"): "parallel rays meet in no aperture",
    **{("thin lens", name): NO_SENSOR for name in ("plain fisheye", "fisheye", "thin prism")},
}
"""Cells of the matrix without a case, and the reason."""

CASES = [
    *(
        with_lens(lens, effect, reference_of, **options)
        for effect, (reference_of, options) in EFFECTS.items()
        for lens in ALL_LENSES
        if (effect, lens) not in HOLES
    ),
    *(
        Case(f"{name}, pinhole", approximations=options, reference=by_rays)
        for name, options in APPROXIMATIONS.items()
    ),
]

QUICK = (
    *("pinhole", "rational", "thin prism", "orthographic"),
    *("exact", "unscented", "pixel order", "pixel colours", "other cuts", "no low-pass"),
)
"""Lenses and approximations of the default tests; combinations with others are slow tests."""


def is_quick(case) -> bool:
    first, _, lens = case.name.rpartition(", ")
    if first in APPROXIMATIONS:
        return first in QUICK
    return lens in QUICK if first == "no effect" else lens == "rational"


PAIRS = [
    pytest.param(
        *(case, law),
        id=f"{case.name}-{law.__name__}",
        marks=[] if is_quick(case) else pytest.mark.slow,
    )
    for case in CASES
    for law in laws_of(case)
]


@pytest.mark.parametrize(("case", "law"), PAIRS)
def test_law_holds(case, law):
    law(case)


def test_matrix_has_a_case_or_a_reason_in_each_cell():
    names = {case.name for case in CASES}
    print("\n" + " " * 16 + " ".join(f"{lens[:12]:12}" for lens in ALL_LENSES))
    for effect in EFFECTS:
        marks = ["x" if f"{effect}, {lens}" in names else "-" for lens in ALL_LENSES]
        print(f"{effect:16}" + " ".join(f"{mark:12}" for mark in marks))
        for lens, mark in zip(ALL_LENSES, marks, strict=True):
            assert (mark == "-") == ((effect, lens) in HOLES)
    print(*(f"- {effect}, {lens}: {reason}" for (effect, lens), reason in HOLES.items()), sep="\n")
    print("with a pinhole:", *(f"{name};" for name in APPROXIMATIONS))
    without = sorted(case.name for case in CASES if case.reference is None)
    print("without a reference, by differences of the kernels:", "; ".join(without))


# ----------------------------------------------------------------------------------------------
# Broken kernels
# ----------------------------------------------------------------------------------------------

factor_conic, short = projection.factor_conic, footprint.exp2_short
derivatives, tangent = GaussianFalloff.derivatives, GaussianFalloff.tangent
moments, runs = GaussianFalloff.moments, itertools.count()

BROKEN = {
    image_equals_reference: (
        *(projection, "factor_conic"),
        lambda mean, x, y, low: factor_conic(mean, x, y, 0 * low),  # no low-pass
    ),
    gradients_equal_differences: (
        *(GaussianFalloff, "derivatives"),
        lambda *a: [1.01 * d for d in derivatives(*a)],
    ),
    adjoint_is_transpose: (
        *(GaussianFalloff, "tangent"),
        lambda *a: [1.01 * d for d in tangent(*a)],
    ),
    bytes_are_reproducible: (
        *(GaussianFalloff, "moments"),
        lambda *a: [m * (1 + 1e-6 * next(runs)) for m in moments(*a)],
    ),
    single_precision_is_accurate: (
        *(footprint, "exp2_short"),
        lambda x: 1.001 * short(x),
    ),
}
"""For each law, a kernel that breaks it."""


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__)
def test_broken_kernel_violates_the_law(law, monkeypatch):
    monkeypatch.setattr(*BROKEN[law])
    with pytest.raises(AssertionError, match="broken"):
        law(Case("broken", reference=by_effects))
