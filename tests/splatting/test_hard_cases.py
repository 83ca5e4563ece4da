"""Hard inputs stay finite and as accurate as float32 can be: an image and gradients for each.

Every family is rendered and differentiated in float64 and in float32 and compared with the
float64 reference (whose analytic gradients are compared with central differences in
``test_reference_splatting.py``, and for these families below).

In float32, every pixel and every single derivative may be wrong by

    30 (noise + 2^-24 sqrt(1 + n / 25) |value|)

where *noise* is what the problem's conditioning turns one rounding everywhere into (see
``support/hard_cases.py``), and n the number of Gaussians. 30 is lambda sqrt(k): between two places
where the model rounds once, a kernel makes at most some k = 25 roundings (from quaternion and
scales to M, M M^T, its determinant and the factor of its inverse; from a pixel's offset to alpha;
in the sums over the 16 pixels of a micro-tile and the micro-tiles of a splat), and lambda = 6 is
exceeded with a probability of 3e-8 a number. A sum over n layers has n more.
"""

from dataclasses import replace
from functools import cache

import drjit as dr
import numpy as np
import pytest
from support.hard_cases import (
    FAMILIES,
    PLANES,
    allowed,
    camera_for,
    cotangents_of,
    errors_over_bounds,
    expected,
    splats,
)
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    Cotangents,
    assert_images_agree,
    bitwise,
    both_precisions,
    clear,
    device_camera,
    device_gaussians,
    frame_adjoint,
    image_planes,
    kernel_gradients,
    plane_cotangents,
    reference_gaussians,
    reference_gradients,
    render,
    rows,
    single,
)
from support.reference_scenes import needle

from drgs.bench.scenes import bench_camera, bench_gaussians
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.splatting import rendering
from drgs.splatting.projection import compensated_opacity, load_rows, plain_opacity, project

all_families = pytest.mark.parametrize("name", FAMILIES)


# ----------------------------------------------------------------------------------------------
# Image and gradients of every family
# ----------------------------------------------------------------------------------------------


@both_precisions
@all_families
def test_image_and_gradients_are_within_the_bound(precision, name):
    case = FAMILIES[name]
    image_bounds, gradient_bounds = allowed(name)
    rendered, gradients = expected(name)
    marked = case.rendered.near_threshold
    assert marked.sum() <= max(2, 0.01 * marked.size)
    _, frame = render(case, precision)
    ratios = errors_over_bounds(
        image_planes(frame, case), rendered, image_bounds, precision, marked
    )
    actual = kernel_gradients(case, precision, cotangents_of(name))
    ratios |= errors_over_bounds(actual, gradients, gradient_bounds, precision)
    assert max(ratios.values()) <= 1, ratios


def test_error_bounds_are_tight():
    """A bound that allows anything proves nothing: most families have five digits or more."""
    relative = []
    for name in FAMILIES:
        bounds, values = allowed(name)[0]["image"], expected(name)[0]["image"]
        relative.append(bounds.max() / max(np.abs(values).max(), 1e-300))
    assert np.median(relative) < 2e-5 and max(relative) < 1e-2, sorted(relative)


def test_bound_distinguishes_textbook_from_stable_formulas():
    """The conic by xx yy - xy^2 in float32 loses needles: the bound tells the two apart."""
    case = FAMILIES["needles of ratio 1e6"]
    affine = reference.local_affine(case.gaussians, case.camera)
    M = affine.axes2d.astype(np.float32)
    low_pass = np.float32(0.3) * np.eye(2, dtype=np.float32)
    cov2d = M @ np.swapaxes(M, 1, 2) + low_pass
    a, b, c = cov2d[:, 0, 0], cov2d[:, 0, 1], cov2d[:, 1, 1]
    conics = np.stack([np.stack([c, -b], -1), np.stack([-b, a], -1)], -2)
    conics = conics / (a * c - b * b)[:, None, None]
    splats = reference.project(case.gaussians, case.camera)
    splats = replace(splats, conics=conics.astype(np.float64))
    colors = reference.sh_colors(case.gaussians, case.camera, case.degree)
    rendered = reference.composite(splats, colors, case.background, case.width, case.height)
    error = np.abs(rendered.image - case.rendered.image)
    assert (error > allowed(case.name)[0]["image"]).mean() > 0.05


@pytest.mark.slow
@all_families
def test_reference_gradient_is_the_slope_of_the_reference(name):
    """Central differences along a random direction of all parameters.

    Means move parallel to the film where depths are tied or a mean is at the near plane: a
    change of order or visibility has no derivative.
    """
    case = FAMILIES[name]
    cotangents, (_, gradients) = cotangents_of(name), expected(name)
    gaussians, camera = case.gaussians, case.camera
    rng = np.random.default_rng(3)
    step = 2.0**-20
    z = (gaussians.means - camera.center) @ camera.rotation[2]
    film = rng.normal(0, 1, (len(z), 3)) * np.maximum(np.abs(z), camera.near)[:, None] / camera.fx
    gaps = np.abs(np.subtract.outer(z, z)) + np.where(np.eye(len(z)), np.inf, 0)
    tied = (gaps.min(axis=1, initial=np.inf) < 100 * step) | (np.abs(z - camera.near) < 0.02)
    film[:, 2] *= np.where(tied, 0, 1)
    norms = np.linalg.norm(gaussians.quats, axis=1)
    direction = {
        "means": film @ camera.rotation,
        "quats": rng.normal(0, 0.1, (len(z), 4)) * norms[:, None],
        "log_scales": rng.normal(0, 0.1, (len(z), 3)),
        "logit_opacities": rng.normal(0, 0.1, len(z)),
        "sh0": rng.normal(0, 0.1, gaussians.sh0.shape),
        "shN": rng.normal(0, 0.1, gaussians.shN.shape),
    }  # fmt: skip

    def moved(sign):
        return {key: getattr(gaussians, key) + sign * step * d for key, d in direction.items()}

    def loss(fields):
        rendered = reference.render(
            reference.Gaussians(**fields), camera, case.background, case.rendered_degree,
            case.antialiased,
        )  # fmt: skip
        pairs = [
            (cotangents.d_image, rendered.image),
            (cotangents.d_alpha, rendered.alpha),
            (cotangents.d_depth, rendered.depth),
        ]
        return np.concatenate([np.ravel(weights * values) for weights, values in pairs])

    fields, fields_before = moved(1), moved(-1)
    after, before = loss(fields), loss(fields_before)
    slope = np.sum(after - before) / (2 * step)
    # The actual changes of the parameters: far from the origin, means move in coarse steps.
    terms = [gradients[key] * (fields[key] - fields_before[key]) / (2 * step) for key in direction]
    analytic = sum(term.sum() for term in terms)
    size = np.sqrt(sum((term**2).sum() for term in terms))
    # step^2 = 1e-12 times third derivatives of some 1e3 to 1e5, and roundings of the loss's terms,
    # one for each layer.
    rounding = 2.0**-53 * np.sqrt(len(z) * np.sum(after**2)) / step
    assert abs(slope - analytic) <= 1e-6 * size + 6 * rounding


# ----------------------------------------------------------------------------------------------
# Inputs of which more can be said
# ----------------------------------------------------------------------------------------------


def test_means_at_the_near_plane_are_drawn_and_nearer_ones_are_not():
    case = FAMILIES["means at, just before, just behind and far behind the near plane"]
    visible = [True, True, False, False, False, True] + [False] * 6
    assert (
        reference.project(case.gaussians, case.camera).visible[: len(visible)].tolist() == visible
    )
    for precision in (FLOAT64, FLOAT32):
        gradients = kernel_gradients(case, precision, cotangents_of(case.name))
        moved = np.abs(gradients["means"]).max(axis=1) > 0
        assert not (moved[: len(visible)] & ~np.array(visible)).any()
        assert moved[[0, 1]].any()


@pytest.mark.slow
@both_precisions
def test_million_gaussians_in_one_pixel_match_the_reference(precision):
    """The pixel stops after some 2,130 layers of alpha 1.1 / 255: the nearest 3,000 are all.

    The others are equally visible, but the pixel is finished: their gradient is zero.
    """
    count, near = 1_000_000, 3000
    rng = np.random.default_rng(0)
    camera = camera_for(20, 18)
    alpha = 1.2 / 255
    z = single(rng.permutation(count) * 2e-6 + 1)
    logit = np.log(alpha / (1 - alpha))
    gaussians = splats(rng, camera, np.full((count, 2), [9.6, 9.3]), z, 1e-4, logit, 0)
    first = np.sort(np.argsort(gaussians.means[:, 2], kind="stable")[:near])
    nearest = reference.Gaussians(*(value[first] for value in vars(gaussians).values()))
    case = Case("a million", 20, 18, 0, count=count, recipe=lambda *_: (gaussians, camera))
    small = replace(case, name="3,000 of a million", recipe=lambda *_: (nearest, camera))
    assert not small.rendered.near_threshold.any()
    assert 0.9e-4 < small.rendered.transmittance.min() < 1.1e-4
    cotangents = Cotangents.random(small)
    actual_image = image_planes(render(case, precision)[1], case)
    actual = kernel_gradients(case, precision, cotangents)
    wanted = reference_gradients(small, cotangents)
    # sqrt(2,130 layers) roundings, with lambda = 6, of sums that cancel: 1e-16 and 2e-5.
    tolerance = {FLOAT64: 1e-11, FLOAT32: 5e-5}[precision]
    for plane in PLANES:
        values = getattr(small.rendered, plane)
        assert np.abs(actual_image[plane] - values).max() <= tolerance * np.abs(values).max()
    rest = np.delete(np.arange(count), first)
    for key in ("means", "log_scales", "logit_opacities", "sh0"):
        assert not actual[key][rest].any(), key
        error = np.abs(actual[key][first] - wanted[key]).max()
        assert error <= tolerance * np.abs(wanted[key]).max(), key


@both_precisions
def test_a_colour_of_zero_keeps_its_gradient(precision):
    """The weight of the pixel, opacity 0.5, times the basis function."""
    camera = camera_for(17, 13)
    gaussians = splats(np.random.default_rng(0), camera, [[8.5, 6.5]], 2.0, 0.3, 0.0, 0)
    # The sum is exactly 0 in both precisions.
    gaussians.sh0[:] = -0.5 / float(precision.dtype(reference.C_00))
    case = Case("black", 17, 13, 0, recipe=lambda *_: (gaussians, camera))
    weights = Cotangents(np.zeros((13, 17, 3)), np.zeros((13, 17)), np.zeros((13, 17)))
    weights.d_image[6, 8] = [1.0, 0.5, 0.25]
    expected = 0.5 * reference.C_00 * np.array([1.0, 0.5, 0.25])
    gradient = kernel_gradients(case, precision, weights)["sh0"][0, 0]
    np.testing.assert_allclose(gradient, expected, rtol=1e-6)


@both_precisions
def test_a_splat_without_area_is_invisible_when_compensated(precision):
    gaussians, camera = needle([0.0, -80.0, -80.0])
    camera = device_camera(camera, precision)
    parameter_rows = load_rows(device_gaussians(gaussians, precision), 0)
    assert project(parameter_rows, camera, 0, plain_opacity).visible[0]
    dr.enable_grad(parameter_rows)
    splats_2d = project(parameter_rows, camera, 0, compensated_opacity)
    assert not splats_2d.visible[0] and splats_2d.opacities[0] == 0
    dr.backward(splats_2d.opacities)
    assert not rows(dr.grad(parameter_rows.log_scales)).any()


# ----------------------------------------------------------------------------------------------
# Ordinary scenes
# ----------------------------------------------------------------------------------------------


def bench_scene(seed, width, height, degree, count):
    return reference_gaussians(bench_gaussians(count, seed)), bench_camera(width)


ORDINARY = [
    Case("bench scene", 400, 400, 3, count=10_000, recipe=bench_scene),
    Case("splats of all sizes, antialiased", 200, 150, 1, count=10_000, antialiased=True),
]


@pytest.mark.slow
@pytest.mark.parametrize("case", ORDINARY, ids=lambda case: case.name)
def test_ten_thousand_gaussians_match_the_reference_in_float32(case):
    """Images within 2e-5 of the reference, gradients within 1e-4, cosines above 0.99999.

    A mean at 400 px carries 3 roundings of 2.4e-5 px or less, of either sign, and alpha changes by
    at most 1.1 per px: some 1e-5 in a pixel that a dozen splats share. Measured 1.9e-5 and 1.9e-5.
    Pixels near a threshold may flip, at most 1e-4 of them.
    """
    cotangents = Cotangents.random(case)
    rendered = image_planes(render(case, FLOAT32)[1], case)
    assert_images_agree(rendered, case.rendered, 2e-5)
    actual = kernel_gradients(case, FLOAT32, cotangents)
    for name, wanted in reference_gradients(case, cotangents).items():
        error = np.abs(actual[name] - wanted).max()
        assert error <= 1e-4 * np.abs(wanted).max(), name
        # A background's three numbers, say: a product of norms in float64 throughout.
        found = actual[name].astype(np.float64)
        cosine = np.sum(found * wanted) / np.linalg.norm(found) / np.linalg.norm(wanted)
        assert cosine > 0.99999, name


# ----------------------------------------------------------------------------------------------
# Rows that are not finite
# ----------------------------------------------------------------------------------------------


NOT_FINITE = Case("not finite", 21, 18, 1, count=30)

MEANINGFUL_INFINITIES = {
    ("log_scales", -np.inf): "a scale of 0: a point, which the low-pass makes a pixel wide",
    ("logit_opacities", np.inf): "an opacity of 1",
    ("sh0", -np.inf): "a colour of 0",
    ("shN", -np.inf): "a colour of 0, or of infinity, which is dropped",
    ("shN", np.inf): "the same, by the sign of the basis",
}


def planes_and_gradients(gaussians, case, precision):
    device = device_gaussians(gaussians, precision)
    frame = rendering.render(device, device_camera(case.camera, precision), case.pipeline)
    gradients = frame_adjoint(
        device, frame, *plane_cotangents(case, Cotangents.random(case), precision)
    )
    planes = [np.array(plane) for plane in frame.planes()]
    return planes, vars(reference_gaussians(gradients.parameters))


@pytest.mark.slow
@both_precisions
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", PARAMETER_NAMES)
def test_nonfinite_value_affects_no_other_row(precision, antialiased, value, name):
    """The row is dropped: the image and all other gradients are, bit by bit, those without it."""
    case = clear(replace(NOT_FINITE, antialiased=antialiased))
    row = most_important_row(case)
    spoiled = {key: getattr(case.gaussians, key).copy() for key in PARAMETER_NAMES}
    spoiled[name].reshape(len(spoiled[name]), -1)[row, 0] = value
    planes, gradients = planes_and_gradients(reference.Gaussians(**spoiled), case, precision)
    assert all(np.isfinite(plane).all() for plane in planes)
    assert all(np.isfinite(gradient).all() for gradient in gradients.values())
    if (name, value) in MEANINGFUL_INFINITIES:
        return
    without = {key: np.delete(array, row, 0) for key, array in vars(case.gaussians).items()}
    expected_planes, expected_gradients = planes_and_gradients(
        reference.Gaussians(**without), case, precision
    )
    assert bitwise(planes) == bitwise(expected_planes)
    for key, gradient in gradients.items():
        assert not gradient[row].any(), key
        np.testing.assert_array_equal(np.delete(gradient, row, 0), expected_gradients[key], key)


@cache
def most_important_row(case) -> int:
    gradients = reference_gradients(case, Cotangents.random(case))
    return int(np.argmax(np.abs(gradients["logit_opacities"])))


@both_precisions
@pytest.mark.parametrize(
    ("name", "value"), [("log_scales", -np.inf), ("logit_opacities", np.inf), ("sh0", -np.inf)]
)
def test_meaningful_infinities_are_rendered_as_limits(precision, name, value):
    """The limit of large numbers: the image is that of -1e4 (or 1e4), to the last bit."""
    case = clear(NOT_FINITE)
    row = most_important_row(case)
    images = []
    for number in (value, np.sign(value) * 1e4):
        fields = {key: getattr(case.gaussians, key).copy() for key in PARAMETER_NAMES}
        fields[name].reshape(len(fields[name]), -1)[row, :] = number
        images.append(planes_and_gradients(reference.Gaussians(**fields), case, precision)[0])
    assert bitwise(images[0]) == bitwise(images[1])
    without = {key: np.delete(array, row, 0) for key, array in vars(case.gaussians).items()}
    dropped = planes_and_gradients(reference.Gaussians(**without), case, precision)[0]
    assert bitwise(images[0]) != bitwise(dropped)
