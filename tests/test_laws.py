"""The laws of ``drgs.testing`` on a matrix of cases: lens or effect x approximation.

``pytest tests/test_laws.py -k matrix -s`` prints the matrix. A new lens, effect or approximation is
covered by one line of a table below.
"""

from __future__ import annotations

import itertools
from dataclasses import fields, is_dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from drjit.llvm import ad as llvm
from support.cases import (
    ALL_LENSES,
    APPROXIMATIONS,
    CASES,
    EFFECTS,
    HOLES,
    OF_SCENES,
    SCENE_HOLES,
    SCENES,
    SPECIAL_CASES,
    by_rays,
)
from support.kernels import kernel_hashes
from support.views import tensors

import drgs
from drgs.accuracy import pipeline
from drgs.accuracy.lens_rays import LensRayFalloff
from drgs.cameras.camera import Aperture, Camera
from drgs.cameras.fisheye import Fisheye
from drgs.cameras.lens import LENSES
from drgs.cameras.motion import MotionBlur, RollingShutter
from drgs.cameras.thin_prism_fisheye import ThinPrismFisheye
from drgs.config.approximations import FALLOFFS, ORDERS, PROJECTIONS, Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.splatting import footprint, projection
from drgs.splatting.footprint import GaussianFalloff
from drgs.testing import (
    LAWS,
    adjoint_is_transpose,
    bytes_are_reproducible,
    camera_gradients_equal_differences,
    gradients_equal_differences,
    image_equals_reference,
    jacobian_equals_differences,
    laws_of,
    rays_meet_their_points,
    single,
    single_precision_is_accurate,
)

QUICK = {
    *("no effect, pinhole", "no effect, rational", "no effect, thin prism"),
    *("no effect, orthographic", "default, edges", "default, stacked", "default, degree 1 of 3"),
    *(f"{effect}, rational" for effect in EFFECTS if ", " not in effect),
    *(f"{name}, pinhole" for name in ("exact", "unscented", "pixel order", "pixel colours")),
    *(f"{name}, pinhole" for name in ("other cuts", "no low-pass")),
}
"""Cases of the default tests; those of combinations are slow tests."""


def is_quick(case) -> bool:
    return case.name in QUICK


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


@pytest.mark.parametrize("make", SPECIAL_CASES, ids=lambda make: make.__name__)
def test_laws_hold_for_special_cases(make):
    case = make()
    for law in SPECIAL_CASES[make]:
        law(case)


def test_matrix_has_a_case_or_a_reason_in_each_cell():
    names = {case.name for case in CASES}
    tables = {
        "effects": (ALL_LENSES, EFFECTS, HOLES),
        "scenes": (SCENES, OF_SCENES, SCENE_HOLES),
        "approximations": (("pinhole",), APPROXIMATIONS, {}),
    }
    for table, (columns, rows, holes) in tables.items():
        print(f"\n{table:22}" + " ".join(f"{column[:12]:12}" for column in columns))
        for row in rows:
            marks = ["x" if f"{row}, {column}" in names else "-" for column in columns]
            print(f"{row:22}" + " ".join(f"{mark:12}" for mark in marks))
            found = {(row, c) for c, mark in zip(columns, marks, strict=True) if mark == "-"}
            assert found == {cell for cell in holes if cell[0] == row}
        print(
            *(f"- {row}, {column}: {reason}" for (row, column), reason in holes.items()), sep="\n"
        )
    without = sorted(case.name for case in CASES if case.reference is None)
    print("without a reference, by differences of the kernels:", "; ".join(without))


@pytest.mark.parametrize("registry", [LENSES, PROJECTIONS, ORDERS, FALLOFFS], ids=lambda r: r.kind)
def test_shipped_extensions_are_in_the_matrix(registry):
    used = {case.lens.kind for case in CASES}
    for selected in (Approximations(**case.approximations) for case in CASES):
        used |= {selected.projection, selected.order, selected.falloff}
    assert set(registry.shipped_names) <= used


# ----------------------------------------------------------------------------------------------
# Entry points: mi.render, the batch sensor and drgs.rasterization
# ----------------------------------------------------------------------------------------------

CALIBRATED = [
    *(case for case in CASES if case.name.startswith(("no effect", "antialiased"))),
    *(case for case in CASES if case.reference is by_rays and case.count > 1),
]
"""Cases with a sensor whose numbers are the case's; others compute theirs from matrices."""
CALIBRATED = [case for case in CALIBRATED if case.degree and case.lens.kind]

PINHOLES = [case for case in CALIBRATED if case.lens.kind == "pinhole"]


def some(cases):
    """The first of a few kinds by default, all with the slow tests."""
    return [
        pytest.param(case, id=case.name, marks=[] if is_quick(case) else pytest.mark.slow)
        for case in cases
    ]


def mitsuba_scene(case, sensors=1) -> mi.Scene:
    """The case with a ``calibrated`` sensor, or with several of them in a ``batch``."""
    rotation, center = case.pose
    to_world = np.eye(4)
    to_world[:3] = np.column_stack([rotation.T * [-1, -1, 1], center])
    lens = getattr(case.reference, "keywords", {}).get("lens")
    coefficients = {n: v for n, v in (vars(lens) if lens else {}).items() if v}
    film = {
        "type": "hdrfilm", "width": case.width, "height": case.height, "pixel_format": "rgb",
        "component_format": "float32", "rfilter": {"type": "box"},
    }  # fmt: skip
    K = case.K
    intrinsics = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    sensor = {
        "type": "calibrated", "lens": case.lens.kind, **coefficients, "near_clip": 0.25,
        **({} if case.lens.whole_turn else intrinsics), "film": film,
        "to_world": mi.ScalarTransform4f(to_world),
        "sampler": {"type": "independent", "sample_count": 1},
    }  # fmt: skip
    if sensors > 1:
        film = {**film, "width": sensors * case.width}
        parts = {f"sensor{k}": sensor for k in range(sensors)}
        sensor = {"type": "batch", "film": film, "sampler": sensor["sampler"], **parts}
    integrator = {
        "type": "splats", "srgb_primitives": False, "sh_degree": case.degree,
        **case.approximations, **tensors(reference.Gaussians(**case.values)),
    }  # fmt: skip
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})


def color_weights(case) -> np.ndarray:
    """Weights (5, H * W) of a loss of the colours alone."""
    weights = single(np.random.default_rng(4).normal(size=(5, case.width * case.height)))
    return weights * np.array([[0], [1], [1], [1], [0]])


@pytest.mark.parametrize("case", some(CALIBRATED))
def test_mitsuba_gives_the_same_bytes(case):
    scene, shape = mitsuba_scene(case), (case.height, case.width, 3)
    params = mi.traverse(scene)
    for name in PARAMETER_NAMES:
        dr.enable_grad(params[f"integrator.{name}"])
    image, weights = mi.render(scene, params), color_weights(case)
    weighted = image * mi.TensorXf(np.reshape(weights[1:4].T, shape))
    dr.backward(dr.sum(weighted, axis=None))
    planes = case.planes(case.values, llvm.Float)
    np.testing.assert_array_equal(np.array(image), np.reshape(planes[1:4].T, shape))
    for name, expected in case.gradients(case.values, weights, llvm.Float).items():
        found = np.array(dr.grad(params[f"integrator.{name}"]))
        np.testing.assert_array_equal(found, expected, name)


@pytest.mark.parametrize("case", some(CALIBRATED))
def test_batch_gives_the_same_bytes(case):
    alone, both = (np.array(mi.render(mitsuba_scene(case, count))) for count in (1, 2))
    np.testing.assert_array_equal(both, np.concatenate([alone, alone], axis=1))


@pytest.mark.parametrize("case", some(PINHOLES))
def test_rasterization_gives_the_same_image(case):
    """Equal to rounding: the centre of the camera and the parameters are computed from others."""
    rotation, center = case.pose
    viewmat = np.eye(4)
    viewmat[:3] = np.column_stack([rotation, -rotation @ center])
    values, options = case.values, dict(case.approximations)
    mode = "antialiased" if options.pop("antialiased", False) else "classic"
    low_pass = {"eps2d": options.pop("low_pass")} if "low_pass" in options else {}
    image, alpha, _ = drgs.rasterization(
        values["means"], values["quats"], np.exp(values["log_scales"]),
        1 / (1 + np.exp(-values["logit_opacities"])),
        np.concatenate([values["sh0"], values["shN"]], axis=1), viewmat[None], case.K[None],
        case.width, case.height, near_plane=0.25, sh_degree=case.degree, render_mode="RGB+D",
        rasterize_mode=mode, **low_pass, **options,
    )  # fmt: skip
    planes, kept = case.planes(values), ~case.near_threshold
    found = np.concatenate([1 - alpha[0], image[0]], axis=-1).reshape(-1, 5).T
    np.testing.assert_allclose(found[:, kept], planes[:, kept], atol=1e-11 * np.abs(planes).max())


# ----------------------------------------------------------------------------------------------
# Kernels: no trace of what a case does not use
# ----------------------------------------------------------------------------------------------

REPLACED_KERNELS = {
    **{"no effect": 0, "antialiased": 2, "smoothing": 2, "unscented": 3, "wide low-pass": 2},
    **{"other cuts": 6, "rolling shutter": 6, "thin lens": 8, "exact": 11, "pixel colours": 12},
    "motion blur": 3,
}
"""Kernels of an image and its gradients, of some 38, that are not those of a plain case: for most,
projection and its adjoint; and what reads the cuts, the time, the ray or the colour of a pixel."""


def kernels_of(case) -> set[int]:
    """Hashes of the kernels of an image and its gradients."""
    weights, values = np.ones((5, case.width * case.height)), case.values
    return kernel_hashes(lambda: case.gradients(values, weights, llvm.Float))


WITH_PINHOLE = {case.name.removesuffix(", pinhole"): case for case in CASES}


@pytest.mark.parametrize("effect", REPLACED_KERNELS)
def test_effects_leave_other_kernels_as_they_are(effect):
    plain, kernels = (kernels_of(WITH_PINHOLE[name]) for name in ("no effect", effect))
    assert len(plain) > 25
    assert len(plain - kernels) <= REPLACED_KERNELS[effect]


def nudged(value):
    """The value with its numbers changed by a millionth: as many splats, tiles and pairs."""
    if isinstance(value, float):
        return value * (1 + 1e-6)
    if isinstance(value, tuple):
        return tuple(map(nudged, value))
    if is_dataclass(value):
        return replace(value, **{f.name: nudged(getattr(value, f.name)) for f in fields(value)})
    return value


@pytest.mark.parametrize("case", some(CASES))
def test_kernels_do_not_depend_on_numbers(case):
    """Another view, lens or filter compiles nothing."""
    numbers = {name: nudged(getattr(case, name)) for name in ("lens", "aperture", "smoothing")}
    other = replace(case, focal=nudged(case.focal), **numbers)
    assert kernels_of(other) == kernels_of(case)


# ----------------------------------------------------------------------------------------------
# Broken kernels
# ----------------------------------------------------------------------------------------------

factor_conic, short, compensated = (
    projection.factor_conic, footprint.exp2_short, projection.compensated_opacity
)  # fmt: skip
derivatives, tangent = GaussianFalloff.derivatives, GaussianFalloff.tangent
of_rays = LensRayFalloff.derivatives
moments, runs = GaussianFalloff.moments, itertools.count()
numbers, variance, cameras = Camera.numbers, Aperture.variance, MotionBlur.cameras
seen_at, camera_of = Fisheye.project_point, RollingShutter.camera_of
jacobian, ray, shows = ThinPrismFisheye.projection_jacobian, Fisheye.ray, Fisheye.shows

BROKEN = {
    "no low-pass": (
        *("no effect, pinhole", image_equals_reference, projection, "factor_conic"),
        lambda mean, x, y, low: factor_conic(mean, x, y, 0 * low),
    ),
    "a derivative of 1.01": (
        *("no effect, pinhole", gradients_equal_differences, GaussianFalloff, "derivatives"),
        lambda *a: [1.01 * d for d in derivatives(*a)],
    ),
    "derivatives of the camera in another order": (
        *("no effect, pinhole", camera_gradients_equal_differences, Camera, "numbers"),
        lambda camera: numbers(camera)[::-1],
    ),
    "a tangent of 1.01": (
        *("no effect, pinhole", adjoint_is_transpose, GaussianFalloff, "tangent"),
        lambda *a: [1.01 * d for d in tangent(*a)],
    ),
    "sums that change from run to run": (
        *("no effect, pinhole", bytes_are_reproducible, GaussianFalloff, "moments"),
        lambda *a: [m * (1 + 1e-6 * next(runs)) for m in moments(*a)],
    ),
    "an exponential that is too short": (
        *("no effect, pinhole", single_precision_is_accurate, footprint, "exp2_short"),
        lambda x: 1.001 * short(x),
    ),
    "a derivative along rays of 1.01": (
        *("along rays, fisheye", gradients_equal_differences, LensRayFalloff, "derivatives"),
        lambda *a: [1.01 * d for d in of_rays(*a)],
    ),
    "rays that stay where the lens changes": (
        *(
            "along rays, fisheye",
            camera_gradients_equal_differences,
            LensRayFalloff,
            "with_camera_tangents",
        ),
        lambda falloff, tangents: falloff,
    ),
    # Lenses
    "a Jacobian of 1.001": (
        *("no effect, thin prism", jacobian_equals_differences, ThinPrismFisheye),
        *("projection_jacobian", lambda *a: [1.001 * row for row in jacobian(*a)]),
    ),
    "rays a thousandth of a pixel off": (
        *("no effect, fisheye", rays_meet_their_points, Fisheye, "ray"),
        lambda lens, camera, x, y: ray(lens, camera, x + 1e-3, y),
    ),
    "a lens that shows too little": (
        *("no effect, fisheye", rays_meet_their_points, Fisheye, "shows"),
        lambda lens, position: shows(lens, position) & (position.x < position.z),
    ),
    # Features
    "an aperture one percent too large": (
        *("thin lens, pinhole", image_equals_reference, Aperture, "variance"),
        lambda *a: 1.02 * variance(*a),
    ),
    "a coefficient of the fisheye left out": (
        *("no effect, fisheye", image_equals_reference, Fisheye, "project_point"),
        lambda lens, *a: seen_at(replace(lens, radial_terms=lens.radial_terms[:-1]), *a),
    ),
    "motion blur with one time": (
        *("motion blur, pinhole", image_equals_reference, MotionBlur, "cameras"),
        lambda *a: cameras(*a)[:1],
    ),
    "a rolling shutter whose turn has no derivative": (
        *(
            "rolling shutter, pinhole",
            camera_gradients_equal_differences,
            RollingShutter,
            "camera_of",
        ),
        lambda shutter, *a: camera_of(replace(shutter, turn=dr.detach(shutter.turn)), *a),
    ),
    "antialiasing without its derivative": (
        *("antialiased, pinhole", gradients_equal_differences, pipeline, "compensated_opacity"),
        lambda opacity, *a: opacity * dr.detach(compensated(opacity, *a) / opacity),
    ),
}
"""Mistakes in kernels and features by name: the case and the law that find them, what is replaced,
and by what."""


@pytest.mark.parametrize("name", BROKEN)
def test_mistake_violates_its_law(name, monkeypatch):
    case_name, law, *replacement = BROKEN[name]
    case = next(case for case in CASES if case.name == case_name)
    monkeypatch.setattr(*replacement)
    with pytest.raises(AssertionError, match=case_name):
        law(replace(case, name=case_name))  # without the results of the case before


def test_mistakes_violate_all_laws():
    assert {law for _, law, *_ in BROKEN.values()} == set(LAWS)
