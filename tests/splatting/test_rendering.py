"""The whole chain against the float64 reference and gsplat: picture, gradients, tangents, bytes."""

import math
from dataclasses import replace
from functools import cache
from itertools import pairwise

import drjit as dr
import numpy as np
import pytest
from conftest import SHARED_DATA
from support.helpers import (
    FLOAT32,
    FLOAT64,
    NEAR_THRESHOLD,
    Case,
    Cotangents,
    as_images,
    assert_arrays_agree,
    assert_pictures_agree,
    bitwise,
    both_precisions,
    clear,
    device_camera,
    device_gaussians,
    frame_adjoint,
    frame_tangent,
    kernel_gradients,
    picture_of,
    plane_cotangents,
    reference_gradients,
    render,
    rows,
    single,
    stacked_scene,
)

from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.reference import splatting as reference
from drgs.splatting import rendering
from drgs.splatting.projection import plain_opacity

# Relative to the largest value of each array.
#
# float64: some hundred operations of 1e-16 on each pixel. Measured 6e-15; gradients 6e-14.
#
# float32: a mean at 50 px carries 3 roundings, 1e-5 px. alpha changes by |U d| alpha / sqrt(0.3)
# <= 1.1 per px, so by 1e-5, and a pixel by a few such errors of either sign: measured 4e-6.
# Gradients: the same errors, and those of S / (1 - a), 1e-7 / 0.01 = 1e-5 of the largest term;
# then rows that cancel (a quaternion's gradient is small beside its terms). Measured 1e-5.
PICTURE = {FLOAT64: 1e-12, FLOAT32: 2e-5}
GRADIENTS = {FLOAT64: 1e-12, FLOAT32: 5e-5}

CASES = [
    Case("degree 3", 37, 29, 3),
    Case("degree 2, antialiased", 37, 29, 2, antialiased=True),
    Case("degree 1", 29, 53, 1),
    Case("degree 0, antialiased", 37, 29, 0, antialiased=True),
    Case("degree 1 of 3", 70, 18, 3, sh_degree=1),
    Case("one pixel", 1, 1, 3, count=12),
    Case("5x3", 5, 3, 1, count=25, antialiased=True),
    Case("whole tiles", 64, 48, 2, count=80),
    Case("many", 40, 40, 0, count=300),
    Case("one splat", 20, 20, 0, count=1, seed=5),
    Case("stacked", 37, 29, 2, count=24, recipe=stacked_scene),
    Case("stacked, antialiased", 33, 17, 1, count=40, recipe=stacked_scene, antialiased=True),
]
all_cases = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


# ----------------------------------------------------------------------------------------------
# Picture
# ----------------------------------------------------------------------------------------------


@both_precisions
@all_cases
def test_picture_equals_the_reference(precision, case):
    """No pixel is near a threshold, so none is left out."""
    case = clear(case)
    _, frame = render(case, precision)
    assert not case.picture.near_threshold.any()
    assert_pictures_agree(picture_of(frame, case), case.picture, PICTURE[precision])


@both_precisions
@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("antialiased", [False, True])
def test_larger_pictures_differ_only_at_marked_pixels(precision, seed, antialiased):
    """Scenes as they come: a few of the 10,800 pixels are near a threshold, at most one flips."""
    case = Case("large", 120, 90, 1, count=600, antialiased=antialiased, seed=seed)
    assert case.picture.near_threshold.any()
    _, frame = render(case, precision)
    assert_pictures_agree(picture_of(frame, case), case.picture, PICTURE[precision])


def test_stacked_scenes_stop_pixels_and_clamp_alphas():
    for case in map(clear, CASES[-2:]):
        splats = reference.project(case.gaussians, case.camera, case.antialiased)
        colors = reference.sh_colors(case.gaussians, case.camera, case.rendered_degree)
        _, stops = reference._composite_and_stops(
            splats.means2d, splats.conics, splats.opacities, colors, splats.depths,
            splats.visible, case.background, case.width, case.height, NEAR_THRESHOLD,
        )  # fmt: skip
        assert (stops < splats.visible.sum()).sum() >= 100
        y, x = np.mgrid[: case.height, : case.width] + 0.5
        clamped = 0
        for mean, conic, opacity in zip(
            splats.means2d, splats.conics, splats.opacities, strict=True
        ):
            d = np.stack([x, y], axis=-1) - mean
            alpha = opacity * np.exp(-0.5 * np.einsum("hwi,ij,hwj->hw", d, conic, d))
            clamped += (alpha > reference.ALPHA_MAX).sum()
        assert clamped >= 10


# ----------------------------------------------------------------------------------------------
# Gradients
# ----------------------------------------------------------------------------------------------


@cache
def expected_gradients(case) -> dict[str, np.ndarray]:
    return reference_gradients(case, Cotangents.random(case))


@both_precisions
@all_cases
def test_gradients_equal_the_reference(precision, case):
    """Of the six parameters, the background (from the plane T) and the positions on the film."""
    case = clear(case)
    actual = kernel_gradients(case, precision, Cotangents.random(case))
    expected = expected_gradients(case)
    assert_arrays_agree(actual, expected, GRADIENTS[precision])
    lowered = (case.rendered_degree + 1) ** 2 - 1
    assert not actual["shN"][:, lowered:].any()
    # The comparison notices one percent, in every array.
    for name, values in actual.items():
        if values.any():
            with pytest.raises(AssertionError, match=rf"{name}\["):
                assert_arrays_agree({**actual, name: 1.01 * values}, expected, GRADIENTS[precision])


@pytest.mark.parametrize(
    ("field", "first", "end"),
    [("geometry", 0, 2), ("geometry", 2, 5), ("geometry", 5, 6), ("features", 0, 3)],
    ids=["means2d", "whitening", "opacities", "features"],
)
@both_precisions
def test_gradients_scaled_by_one_percent_are_noticed(precision, field, first, end, monkeypatch):
    """A mistake in one output of the hand-written adjoint reaches an array that is compared."""
    case = clear(CASES[0])
    adjoint = rendering.composite_adjoint

    def wrong(*args):
        gradients = adjoint(*args)
        values = getattr(gradients, field)
        scaled = [1.01 * v if first <= k < end else v for k, v in enumerate(values)]
        return replace(gradients, **{field: scaled})

    monkeypatch.setattr(rendering, "composite_adjoint", wrong)
    actual = kernel_gradients(case, precision, Cotangents.random(case))
    with pytest.raises(AssertionError, match="kernels"):
        assert_arrays_agree(actual, expected_gradients(case), GRADIENTS[precision])


@both_precisions
def test_gradients_of_a_larger_picture(precision):
    """The cotangent is zero at marked pixels, in both computations."""
    case = Case("large", 120, 90, 1, count=600, seed=1)
    marked = case.picture.near_threshold
    assert 0 < marked.sum() <= 50
    cotangents = Cotangents.random(case)
    actual = kernel_gradients(case, precision, cotangents)
    assert_arrays_agree(actual, reference_gradients(case, cotangents), GRADIENTS[precision])


@both_precisions
@pytest.mark.parametrize("output", ["d_image", "d_alpha", "d_depth"])
def test_each_output_alone_has_the_right_gradients(precision, output):
    case = clear(CASES[1])
    zeros = {name: np.zeros_like(v) for name, v in vars(Cotangents.random(case)).items()}
    cotangents = Cotangents(**{**zeros, output: getattr(Cotangents.random(case), output)})
    actual = kernel_gradients(case, precision, cotangents)
    expected = reference_gradients(case, cotangents)
    assert_arrays_agree(actual, expected, GRADIENTS[precision])


@both_precisions
@pytest.mark.parametrize(
    "features",
    [
        (rendering.color_features,),
        (rendering.depth_feature,),
        (rendering.depth_feature, rendering.color_features, rendering.depth_feature),
    ],
    ids=["color", "depth", "depth color depth"],
)
def test_features_are_composited_in_the_order_that_was_asked_for(precision, features):
    case = clear(CASES[0])
    pipeline = rendering.Pipeline(3, plain_opacity, features)
    gaussians, frame = render(case, precision, pipeline)
    cotangents = Cotangents.random(case)
    picture = {
        rendering.color_features: list(
            np.moveaxis(case.picture.image, -1, 0)
            - case.background[:, None, None] * case.picture.transmittance
        ),
        rendering.depth_feature: [case.picture.depth],
    }
    weights = {
        rendering.color_features: list(np.moveaxis(cotangents.d_image, -1, 0)),
        rendering.depth_feature: [cotangents.d_depth],
    }
    expected = [case.picture.transmittance] + [p for f in features for p in picture[f]]
    actual = [rows(plane).reshape(case.height, case.width) for plane in frame.planes()]
    assert len(actual) == len(expected)
    assert_arrays_agree(dict(enumerate(actual)), dict(enumerate(expected)), PICTURE[precision])

    gradients = frame_adjoint(
        gaussians,
        frame,
        [precision.array(w) for feature in features for w in weights[feature]],
        precision.array(cotangents.d_alpha),
    )
    d_color = cotangents.d_image * (rendering.color_features in features)
    d_depth = cotangents.d_depth * features.count(rendering.depth_feature)
    reference_values = reference.render_gradients(
        *case.scene, np.zeros(3), d_color, -cotangents.d_alpha, d_depth
    )
    actual = {name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES}
    expected = {name: reference_values[name] for name in PARAMETER_NAMES}
    assert_arrays_agree(actual, expected, GRADIENTS[precision])


@both_precisions
def test_attached_parameters_are_detached(precision):
    """As in ``mi.render``: gradients are suspended while attached parameters are given."""
    case = clear(CASES[0])
    gaussians = device_gaussians(case.gaussians, precision)
    dr.enable_grad(gaussians)
    with dr.suspend_grad():
        camera = device_camera(case.camera, precision)
        frame = rendering.render(gaussians, camera, case.pipeline)
        cotangents = plane_cotangents(case, Cotangents.random(case), precision)
        gradients = frame_adjoint(gaussians, frame, *cotangents)
    assert_arrays_agree(
        {name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES},
        {name: expected_gradients(case)[name] for name in PARAMETER_NAMES},
        GRADIENTS[precision],
    )
    assert not any(np.array(dr.grad(getattr(gaussians, name))).any() for name in PARAMETER_NAMES)


@both_precisions
def test_visible_are_those_whose_extent_touches_the_film(precision):
    case = clear(CASES[0])
    gaussians, frame = render(case, precision)
    gradients = frame_adjoint(
        gaussians, frame, *plane_cotangents(case, Cotangents.random(case), precision)
    )
    visible = np.array(gradients.visible)
    assert 0 < visible.sum() < len(visible)
    in_front = reference.project(*case.scene).visible
    assert not (visible & ~in_front).any() and (in_front & ~visible).any()
    touched = expected_gradients(case)["means2d"].any(axis=1)
    assert visible[touched].all()
    assert not rows(gradients.means2d)[~visible].any()


@both_precisions
def test_without_a_visible_splat_there_is_only_the_background(precision):
    case = Case("hidden", 20, 13, 1, count=5)
    hidden = replace(case.gaussians, logit_opacities=np.full(5, -8.0))
    gaussians = device_gaussians(hidden, precision)
    frame = rendering.render(gaussians, device_camera(case.camera, precision), case.pipeline)
    picture = picture_of(frame, case)
    np.testing.assert_array_equal(picture["image"], np.broadcast_to(case.background, (13, 20, 3)))
    assert not picture["depth"].any() and not picture["alpha"].any()
    gradients = frame_adjoint(
        gaussians, frame, *plane_cotangents(case, Cotangents.random(case), precision)
    )
    for name in PARAMETER_NAMES:
        values = np.array(getattr(gradients.parameters, name))
        assert values.shape == getattr(hidden, name).shape and not values.any(), name
    assert not np.array(gradients.visible).any()


@both_precisions
@pytest.mark.parametrize("logit", [-np.inf, -900.0, -120.0])
def test_an_opacity_that_underflows_to_zero_has_no_gradient(precision, logit):
    case = clear(CASES[0])
    logits = case.gaussians.logit_opacities.copy()
    row = int(np.argmax(np.abs(expected_gradients(case)["logit_opacities"])))
    logits[row] = logit
    gaussians = device_gaussians(replace(case.gaussians, logit_opacities=logits), precision)
    frame = rendering.render(gaussians, device_camera(case.camera, precision), case.pipeline)
    cotangents = plane_cotangents(case, Cotangents.random(case), precision)
    gradients = frame_adjoint(gaussians, frame, *cotangents)
    for name in PARAMETER_NAMES:
        values = np.array(getattr(gradients.parameters, name))
        assert np.isfinite(values).all() and not values[row].any(), name


# ----------------------------------------------------------------------------------------------
# Tangents
# ----------------------------------------------------------------------------------------------


def random_direction(case, seed=7) -> reference.Gaussians:
    """One number for each parameter."""
    rng = np.random.default_rng(seed)
    return reference.Gaussians(
        **{n: single(rng.normal(0, 1, getattr(case.gaussians, n).shape)) for n in PARAMETER_NAMES}
    )


def kernel_tangent(case, precision, direction) -> dict[str, np.ndarray]:
    gaussians, frame = render(case, precision)
    tangents = device_gaussians(direction, precision)
    return as_images(frame_tangent(gaussians, frame, tangents), case.camera)


@both_precisions
@all_cases
def test_adjoint_is_the_transpose_of_the_tangent(precision, case):
    case = clear(case)
    direction = random_direction(case)
    images = kernel_tangent(case, precision, direction)
    cotangents = Cotangents.random(case, seed=4)
    gradients = kernel_gradients(case, precision, cotangents)
    d_transmittance = cotangents.d_image @ case.background - cotangents.d_alpha
    left = [
        cotangents.d_image * images["color"],
        cotangents.d_depth * images["depth"],
        d_transmittance * images["transmittance"],
    ]
    right = [gradients[name] * getattr(direction, name) for name in PARAMETER_NAMES]
    size = math.sqrt(sum((term**2).sum() for term in [*left, *right]))
    assert size > 0
    pixels, parameters = (sum(term.sum() for term in terms) for terms in (left, right))
    # Relative to the root of the sum of the squared terms: the sums themselves may cancel.
    tolerance = GRADIENTS[precision]
    assert abs(pixels - parameters) <= tolerance * size


@both_precisions
@all_cases
def test_tangent_equals_central_differences_of_the_reference(precision, case):
    case = clear(case)
    direction = random_direction(case)
    # ln(alpha) changes by at most some 1e3 per unit of a direction with a dozen components: no
    # decision flips, see NEAR_THRESHOLD. The error is step^2 / 6 = 1e-16 times third derivatives
    # of up to 1e8, and 1e-16 / step = 4e-9 from rounding.
    step = 2.0**-25

    def moved(sign):
        fields = {
            name: getattr(case.gaussians, name) + sign * step * getattr(direction, name)
            for name in PARAMETER_NAMES
        }
        return reference.render(
            reference.Gaussians(**fields), case.camera, np.zeros(3), case.rendered_degree,
            case.antialiased,
        )  # fmt: skip

    forward, backward = moved(1), moved(-1)
    expected = {
        key: (getattr(forward, name) - getattr(backward, name)) / (2 * step)
        for key, name in [
            ("color", "image"),
            ("depth", "depth"),
            ("transmittance", "transmittance"),
        ]
    }
    actual = kernel_tangent(case, precision, direction)
    assert_arrays_agree(actual, expected, max(1e-7, GRADIENTS[precision]))


# ----------------------------------------------------------------------------------------------
# Several frames of a camera that is differentiated, too
# ----------------------------------------------------------------------------------------------

OF_CAMERA = [
    Case("of the camera", 37, 29, 1),
    Case("of the camera, antialiased", 33, 17, 0, antialiased=True),
]

CAMERA_FIELDS = ("rotation", "center", "fx", "fy", "cx", "cy")


@cache
def camera_differences(case) -> np.ndarray:
    """(18, 5, H W): each number of a camera's, by central differences of the reference's planes.

    A matrix that is no rotation is meant, too: it maps the world to the camera as any does.
    """
    step = 2.0**-25
    found = []
    for name in CAMERA_FIELDS:
        for index in np.ndindex(np.shape(getattr(case.camera, name))):
            planes = []
            for sign in (1, -1):
                value = np.array(getattr(case.camera, name))
                value[index] += sign * step
                picture = reference.render(
                    case.gaussians, replace(case.camera, **{name: value}), np.zeros(3),
                    case.rendered_degree, case.antialiased,
                )  # fmt: skip
                images = [picture.transmittance, *np.moveaxis(picture.image, -1, 0), picture.depth]
                planes.append(np.reshape(images, (5, -1)))
            found.append((planes[0] - planes[1]) / (2 * step))
    return np.array(found)


def two_frames(case) -> tuple[Gaussians, list[rendering.Frame]]:
    gaussians, frame = render(case, FLOAT64)
    return gaussians, [frame, frame]


@pytest.mark.parametrize("case", OF_CAMERA, ids=lambda case: case.name)
def test_camera_gradients_of_two_frames_equal_differences_of_the_reference(case):
    """And those of the parameters are the reference's. Differences: as for the tangents."""
    case = clear(case)
    gaussians, frames = two_frames(case)
    cotangents = Cotangents.random(case)
    d_features, d_transmittance = plane_cotangents(case, cotangents, FLOAT64)
    weights = [d_transmittance, *d_features]
    parts = [[0.25 * w for w in weights], [0.75 * w for w in weights]]
    gradients = rendering.frames_adjoint(gaussians, frames, parts, of_camera=True)
    expected = np.sum(camera_differences(case) * rows(weights).T, axis=(1, 2))
    actual = rows(gradients.camera)[0]
    assert_arrays_agree({"camera": actual}, {"camera": expected}, 1e-7)
    assert_arrays_agree(
        {name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES},
        {name: reference_gradients(case, cotangents)[name] for name in PARAMETER_NAMES},
        GRADIENTS[FLOAT64],
    )


@pytest.mark.parametrize("case", OF_CAMERA, ids=lambda case: case.name)
def test_camera_tangents_of_two_frames_equal_differences_of_the_reference(case):
    case = clear(case)
    gaussians, frames = two_frames(case)
    direction = np.random.default_rng(3).normal(size=len(camera_differences(case)))
    still = device_gaussians(
        reference.Gaussians(
            **{n: np.zeros_like(getattr(case.gaussians, n)) for n in PARAMETER_NAMES}
        ),
        FLOAT64,
    )
    tangents = [FLOAT64.Float(number) for number in direction]
    expected = np.einsum("i,ijk->jk", direction, camera_differences(case))
    for planes in rendering.frames_tangent(gaussians, frames, still, tangents):
        assert_arrays_agree({"planes": rows(planes).T}, {"planes": expected}, 1e-7)


# ----------------------------------------------------------------------------------------------
# The same bytes
# ----------------------------------------------------------------------------------------------

BUSY = Case("busy", 100, 70, 1, count=400, seed=11)


def frame_and_gradients(case, precision, gaussians=None, order=None) -> dict[str, np.ndarray]:
    """Planes, and everything that the adjoint returns, as numpy arrays."""
    fields = gaussians or case.gaussians
    device = device_gaussians(fields, precision)
    frame = rendering.render(device, device_camera(case.camera, precision), case.pipeline)
    gradients = frame_adjoint(
        device, frame, *plane_cotangents(case, Cotangents.random(case), precision)
    )
    tangents = random_direction(case)
    if order is not None:
        tangents = permuted(tangents, order)
    d_planes = frame_tangent(device, frame, device_gaussians(tangents, precision))
    return {
        **{f"plane {k}": np.array(plane) for k, plane in enumerate(frame.planes())},
        **{f"tangent {k}": np.array(plane) for k, plane in enumerate(d_planes)},
        **{name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES},
        "means2d": np.array(gradients.means2d).T,
        "visible": np.array(gradients.visible),
    }


def permuted(gaussians, order) -> reference.Gaussians:
    return reference.Gaussians(**{n: getattr(gaussians, n)[order] for n in PARAMETER_NAMES})


@pytest.fixture
def thread_count():
    before = dr.thread_count()
    yield dr.set_thread_count
    dr.set_thread_count(before)


@both_precisions
def test_every_run_gives_the_same_bytes_on_any_number_of_threads(precision, thread_count):
    runs = []
    for threads in (1, 2, 2, 4, 1):
        thread_count(threads)
        runs.append(frame_and_gradients(BUSY, precision))
    for first, second in pairwise(runs):
        assert bitwise(first) == bitwise(second)


@both_precisions
@pytest.mark.parametrize("case", [BUSY, CASES[-2]], ids=lambda case: case.name)
def test_rows_may_come_in_any_order(precision, case):
    """Depths are distinct, in float32 too: only the depth orders the splats."""
    depths = reference.project(case.gaussians, case.camera).depths.astype(np.float32)
    assert len(np.unique(depths)) == len(depths)
    order = np.random.default_rng(2).permutation(len(depths))
    expected = frame_and_gradients(case, precision)
    actual = frame_and_gradients(case, precision, permuted(case.gaussians, order), order)
    for name, values in expected.items():
        is_image = name.startswith(("plane", "tangent"))
        np.testing.assert_array_equal(actual[name], values if is_image else values[order], name)


# ----------------------------------------------------------------------------------------------
# gsplat
# ----------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def gsplat():
    """10,000 Gaussians, their camera, and gsplat's float32 picture, cotangent and gradients."""
    folder = SHARED_DATA / "gsplat_reference"
    if not folder.is_dir():
        pytest.skip("the shared data folder gsplat_reference is not here")
    data, pose = np.load(folder / "gauss_10k.npz"), np.load(folder / "cam.npz")
    scales, opacities = data["scales"].astype(float), data["opacities"].astype(float)
    gaussians = reference.Gaussians(
        means=data["means"],
        quats=data["quats"],
        log_scales=np.log(scales),
        logit_opacities=np.log(opacities) - np.log1p(-opacities),
        sh0=data["sh"][:, :1],
        shN=data["sh"][:, 1:],
    )
    viewmat, K = pose["viewmat"].astype(float), pose["K"].astype(float)
    camera = reference.Camera(
        rotation=viewmat[:3, :3],
        center=-np.linalg.solve(viewmat[:3, :3], viewmat[:3, 3]),
        fx=K[0, 0],
        fy=K[1, 1],
        cx=K[0, 2],
        cy=K[1, 2],
        width=int(pose["width"]),
        height=int(pose["height"]),
    )
    return gaussians, camera, np.load(folder / "ref_10k.npy"), np.load(folder / "refgrad_10k.npz")


def gsplat_frame(scene, precision):
    gaussians, camera = (
        device_gaussians(scene[0], precision),
        device_camera(scene[1], precision),
    )
    frame = rendering.render(gaussians, camera, rendering.Pipeline(3))
    height, width = scene[1].height, scene[1].width
    planes = np.stack([rows(plane).reshape(height, width) for plane in frame.planes()], axis=-1)
    return gaussians, frame, planes[..., 1:] + planes[..., :1]


@pytest.fixture(scope="module")
def gsplat_marked(gsplat):
    """The reference's picture, with marks."""
    return reference.render(*gsplat[:2], np.ones(3), threshold_width=NEAR_THRESHOLD)


@both_precisions
def test_picture_agrees_with_gsplat(precision, gsplat, gsplat_marked):
    _, _, image = gsplat_frame(gsplat, precision)
    errors = np.abs(image - gsplat[2])
    # gsplat's positions of 200 px carry 1e-5 px: measured 7e-7 on average, and 4 flipped pixels.
    assert errors.mean() <= 2e-6
    far = errors.max(axis=-1) > 1e-4
    assert far.mean() <= 1e-4 and gsplat_marked.near_threshold[far].all()


@both_precisions
def test_gradients_agree_with_gsplat(precision, gsplat):
    scene, _, _, expected = gsplat
    gaussians, frame, _ = gsplat_frame(gsplat, precision)
    w = expected["w"].astype(float)
    gradients = frame_adjoint(
        gaussians,
        frame,
        [precision.array(w[..., k]) for k in range(3)],
        precision.array(w.sum(axis=-1)),
    ).parameters.numpy()
    # gsplat's are with respect to activated values: ds = s dlog(s), do = o (1 - o) dlogit(o).
    opacities = reference.sigmoid(scene.logit_opacities)
    activated = {
        "means": gradients.means,
        "quats": gradients.quats,
        "scales": gradients.log_scales / np.exp(scene.log_scales),
        "opacities": gradients.logit_opacities / (opacities * (1 - opacities)),
        "sh": np.concatenate([gradients.sh0, gradients.shN], axis=1),
    }
    for name, ours in activated.items():
        theirs = expected[name].astype(float)
        cosine = np.sum(ours * theirs) / np.linalg.norm(ours) / np.linalg.norm(theirs)
        assert cosine >= 0.9999, name
        # Nearly all of it in the Gaussians of the flipped pixels. Measured at most 5e-4.
        assert np.linalg.norm(ours - theirs) <= 1e-3 * np.linalg.norm(theirs), name


@both_precisions
def test_gsplat_scene_agrees_with_the_reference(precision, gsplat, gsplat_marked):
    """10,000 Gaussians at 400 x 400: nothing but marked pixels may differ, at most 16 of them."""
    scene, camera, _, data = gsplat
    gaussians, frame, image = gsplat_frame(gsplat, precision)
    marked = gsplat_marked.near_threshold
    errors = np.abs(image - gsplat_marked.image).max(axis=-1)
    # float32 positions of 200 px carry 4e-5 px at worst, and a pixel 1.1 times that.
    bad = errors > {FLOAT64: 1e-12, FLOAT32: 4e-5}[precision]
    assert bad.mean() <= 1e-4 and marked[bad].all()

    w = single(data["w"] * ~marked[..., None])
    gradients = frame_adjoint(
        gaussians,
        frame,
        [precision.array(w[..., k]) for k in range(3)],
        precision.array(w.sum(axis=-1)),
    )
    expected = reference.render_gradients(scene, camera, np.ones(3), w)
    del expected["background"]
    actual = {
        **{name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES},
        "means2d": rows(gradients.means2d),
    }
    assert_arrays_agree(actual, expected, {FLOAT64: 1e-12, FLOAT32: 1e-4}[precision])


@both_precisions
@pytest.mark.parametrize("order", ["center", "pixel"])
def test_transmittance_alone_is_rendered_and_differentiated(precision, order):
    """A pipeline without features: what an alpha mask needs."""
    pipeline = pipeline_of(Approximations(order=order), 1)
    case = clear(Case("alpha only", 21, 18, 1))
    gaussians = device_gaussians(case.gaussians, precision)
    camera = device_camera(case.camera, precision)
    rng = np.random.default_rng(5)
    cotangent = precision.Float(rng.normal(size=21 * 18))
    with_color = rendering.render(gaussians, camera, pipeline)
    alone = rendering.render(gaussians, camera, replace(pipeline, features=()))
    assert len(alone.planes()) == 1
    assert dr.all(alone.planes()[0] == with_color.planes()[0])
    zero = dr.zeros(precision.Float, 21 * 18)
    expected = frame_adjoint(gaussians, with_color, [zero] * 3, cotangent)
    got = frame_adjoint(gaussians, alone, [], cotangent)
    for name in ("means", "quats", "log_scales"):
        expected_array = np.array(getattr(expected.parameters, name))
        got_array = np.array(getattr(got.parameters, name))
        # The same sums with zeros added: equal but for the sign of zero.
        assert np.array_equal(got_array, expected_array), name


def test_row_that_is_not_finite_has_zero_gradient_and_spoils_no_other():
    case = clear(Case("not finite", 21, 18, 1))
    good = device_gaussians(case.gaussians, FLOAT32).numpy()
    bad = {}
    for name in PARAMETER_NAMES:
        values = getattr(good, name).copy()
        bad[name] = np.concatenate([values, np.full_like(values[:1], np.nan)])
    camera = device_camera(case.camera, FLOAT32)
    cotangents = [FLOAT32.Float(np.random.default_rng(k).normal(size=21 * 18)) for k in range(4)]
    results = []
    for values in (good, Gaussians(**bad)):
        gaussians = values.to(FLOAT32.TensorXf)
        frame = rendering.render(gaussians, camera, rendering.Pipeline(1))
        gradients = frame_adjoint(gaussians, frame, cotangents[:3], cotangents[3])
        results.append((frame.planes(), gradients.parameters.numpy()))
    (planes, gradients), (planes_bad, gradients_bad) = results
    for plane, plane_bad in zip(planes, planes_bad, strict=True):
        assert dr.all(plane == plane_bad)
    for name in PARAMETER_NAMES:
        rows = getattr(gradients_bad, name)
        assert np.array_equal(rows[:-1], getattr(gradients, name)), name
        assert np.all(rows[-1] == 0), name
