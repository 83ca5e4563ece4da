"""What must hold for every scene: the kernels are compared with themselves on random scenes.

Hypothesis draws the structure of a scene (its film, its size, what is rendered) and a seed; the
numbers come from the recipes of ``helpers`` and ``views``. Every run sees the same examples.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise, product

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from hypothesis import Phase, assume, given, settings
from hypothesis import strategies as st
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    as_images,
    assert_arrays_agree,
    assert_pictures_agree,
    both_precisions,
    device_camera,
    device_gaussians,
    frame_adjoint,
    frame_tangent,
    random_scene,
    rows,
    single,
    stacked_scene,
)
from support.views import Scene, View, image_of

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.reference import splatting as reference
from drgs.splatting import rendering
from drgs.splatting.projection import plain_opacity

examples = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=25,
    phases=[Phase.generate, Phase.shrink],
)

ROUNDOFF = {FLOAT64: 2.0**-53, FLOAT32: 2.0**-24}
"""The largest relative error of one operation."""


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


# ----------------------------------------------------------------------------------------------
# Random scenes
# ----------------------------------------------------------------------------------------------

# (SH degree, antialiased): each compiles projection anew, in each precision.
KINDS = ((0, False), (0, True), (3, False))

sizes = st.integers(1, 40)
seeds = st.integers(0, 2**32 - 1)


@st.composite
def cases(draw, kinds=KINDS, least=1) -> Case:
    """At least ``least`` Gaussians before a film of up to 3 x 3 tiles."""
    degree, antialiased = draw(st.sampled_from(kinds))
    return Case(
        "random", draw(sizes), draw(sizes), degree, draw(st.integers(least, 60)), antialiased,
        recipe=draw(st.sampled_from([random_scene, stacked_scene])),
        seed=draw(seeds),
    )  # fmt: skip


@st.composite
def plugin_scenes(draw) -> Scene:
    """The same for the plugin, on black."""
    degree, antialiased = draw(st.sampled_from(KINDS))
    view = View("random", draw(sizes), draw(sizes), fov=draw(st.sampled_from([30.0, 50.0, 80.0])))
    return Scene(
        view, degree, antialiased=antialiased, background=(0.0, 0.0, 0.0),
        count=draw(st.integers(4, 60)), seed=draw(seeds),
    )  # fmt: skip


def assume_decided(case) -> None:
    """Reject a scene in which rounding decides about a whole splat.

    Such decisions are the near plane, the order of two depths, and the clamps of slopes and of
    colours. Coordinates of at most 10 carry some ten roundings of 6e-8 in float32, on the film
    60 times that.
    """
    gaussians, camera = case.scene
    x, y, z = camera.rotation @ (gaussians.means - camera.center).T
    in_front = z >= camera.near
    x, y, z = x[in_front], y[in_front], z[in_front]
    film = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=-1)
    size = np.array([camera.width, camera.height])
    outside = np.abs(film - size / 2) - (0.5 + reference.FRUSTUM_MARGIN / 2) * size
    directions, _ = reference._view_directions(gaussians, camera)
    colors = reference._unclamped_colors(gaussians, directions, case.rendered_degree)
    for distances, margin in (
        (z - camera.near, 1e-5),
        (np.diff(np.sort(z)), 1e-5),
        (outside, 1e-3),
        (colors, 1e-5),
    ):
        assume((np.abs(distances) > margin).all())


def undecided_pixels(scene) -> np.ndarray:
    """(H, W): where a splat that moves by 2700 roundings (see ``MOVED``) may flip a decision.

    That is 1.6e-4 px in float32, and ln(alpha) changes by at most 6.1 per px: see NEAR_THRESHOLD.
    Rejects a scene in which these are more than 5% of the pixels.
    """
    picture = reference.render(
        scene.gaussians, scene.camera, np.zeros(3), scene.rendered_degree, scene.antialiased,
        threshold_width=1e-3,
    )  # fmt: skip
    assume(picture.near_threshold.mean() <= 0.05)
    return picture.near_threshold


def changed(gaussians, **rules) -> reference.Gaussians:
    """Gaussians with a function applied to each of some parameters."""
    return replace(gaussians, **{n: rule(getattr(gaussians, n)) for n, rule in rules.items()})


def taken(gaussians, indices) -> reference.Gaussians:
    """Rows of Gaussians."""
    return changed(gaussians, **dict.fromkeys(PARAMETER_NAMES, lambda values: values[indices]))


def with_row(gaussians, row, **values) -> reference.Gaussians:
    """Gaussians with one more before ``row``: a copy of the first, but for ``values``."""
    fields = {name: getattr(gaussians, name) for name in PARAMETER_NAMES}
    return reference.Gaussians(
        **{n: np.insert(v, row, values.get(n, v[0]), axis=0) for n, v in fields.items()}
    )


def point_at(camera, film, z) -> np.ndarray:
    """The world point that is seen at a film position (2,) px, at depth z."""
    slopes = (film - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    return single(z * np.array([*slopes, 1.0]) @ camera.rotation + camera.center)


# ----------------------------------------------------------------------------------------------
# Rendering
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Result:
    """A picture on black, and the gradients of sum(weights * planes)."""

    picture: dict  # what reference.Picture holds
    gradients: dict  # of the six parameters and means2d; visible


def random_weights(case) -> np.ndarray:
    """(1 + C, H, W): for the transmittance, red, green, blue and depth."""
    return single(np.random.default_rng(1).normal(0, 1, (5, case.height, case.width)))


def stored(values, precision):
    """A flat array in Dr.Jit's memory. How numpy's is aligned would be a part of the kernels."""
    array = precision.Float(np.ravel(values).tolist())
    dr.make_opaque(array)
    return array


def uploaded(gaussians, precision) -> Gaussians:
    """Gaussians on the device."""
    device = device_gaussians(gaussians, precision)
    return replace(device, logit_opacities=stored(gaussians.logit_opacities, precision))


def result_of(case, precision, weights, gaussians=None, camera=None) -> Result:
    """By the kernels. gaussians, camera (on the device): None for the case's."""
    gaussians = uploaded(gaussians or case.gaussians, precision)
    camera = camera or device_camera(case.camera, precision)
    frame = rendering.render(gaussians, camera, case.pipeline)
    d_transmittance, *d_features = [stored(plane, precision) for plane in weights]
    gradients = frame_adjoint(gaussians, frame, d_features, d_transmittance)
    return Result(
        picture=picture_of(frame),
        gradients={
            **{name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES},
            "means2d": np.stack([rows(column) for column in gradients.means2d], axis=-1),
            "visible": np.array(gradients.visible),
        },
    )


def picture_of(frame) -> dict[str, np.ndarray]:
    """The planes, under the names of ``reference.Picture``."""
    images = as_images(frame.planes(), frame.camera)
    return {
        "image": images["color"],
        "alpha": 1 - images["transmittance"],
        "depth": images["depth"],
        "transmittance": images["transmittance"],
    }


def rendered(case, precision, gaussians) -> dict[str, np.ndarray]:
    """The picture of other Gaussians than the case's."""
    gaussians = uploaded(gaussians, precision)
    return picture_of(
        rendering.render(gaussians, device_camera(case.camera, precision), case.pipeline)
    )


def assert_equal(actual, expected) -> None:
    """To the last bit, but for the signs of zeros; all is finite."""
    for of in ("picture", "gradients"):
        for name, values in getattr(expected, of).items():
            assert np.isfinite(values).all(), name
            np.testing.assert_array_equal(getattr(actual, of)[name], values, name)


# How far rounding moves a splat on the film, in roundoffs, if all roundings conspire. Measured on
# 400 scenes in either precision: at most 0.08 of what follows from it, and once 0.35.
#
# A camera coordinate is a row of the rotation times the difference of a mean and the centre. For
# a mean at a depth of 1 these are at most about 8, 3 and 2.5 in size. Rounded once each where they
# are moved, then once per operation, they make some 45 roundoffs, times a focal length of at most
# 56 px, and three roundings of up to 64 px. (Behind, coordinates grow less than the depth.)
MOVED = 45 * 56 + 3 * 64

# The principal point, the sum with it, and a pixel's distance from it, twice.
CROPPED = 6 * 64

# A rotation's entries are off by some eight roundoffs. That turns the rim of a splat, 3.3 standard
# deviations of up to 20 px from its mean.
TURNED = 8 * 3.3 * 20


def assert_agree(actual, expected, quats, undecided, px) -> None:
    """That no splat was displaced by more than ``px``, as far as pictures and gradients tell.

    quats: (N, 4); undecided: (H, W), pixels at which decisions may flip, of which one at most may.

    alpha changes by at most 1.1 opacities per px (see test_rendering), and so do a pixel and its
    transmittance. Its derivative of at most 1.1 per px changes by 1 / 0.3 = 3.3 per px^2, three
    times as much relative to it; another 1.1 comes from each of T, S and 1 / (1 - alpha): 6 per px.
    """
    picture = reference.Picture(**expected.picture, near_threshold=undecided)
    assert_pictures_agree(actual.picture, picture, 1.1 * px)
    assert_arrays_agree(*(_with_shapes(r.gradients, quats) for r in (actual, expected)), 6 * px)


def _with_shapes(gradients, quats) -> dict:
    """Gradients, those of quaternions and logarithms of scales as one array in a common unit.

    The derivative with respect to a rotation's angle, |q| times the quaternion's, and that with
    respect to the logarithm of a scale are sums of the same terms. A round splat's rotation has
    none but rounding errors of these.
    """
    gradients = {name: values for name, values in gradients.items() if name != "visible"}
    turns = gradients.pop("quats") * np.linalg.norm(quats, axis=1, keepdims=True)
    return gradients | {"shapes": np.concatenate([turns, gradients.pop("log_scales")], axis=1)}


# ----------------------------------------------------------------------------------------------
# Not a bit changes
# ----------------------------------------------------------------------------------------------


@both_precisions
@examples
@given(cases(), seeds)
def test_rows_may_come_in_any_order(precision, case, seed):
    """Only the depth orders the splats, and each row has its own gradient."""
    assume_decided(case)
    weights = random_weights(case)
    order = np.random.default_rng(seed).permutation(case.count)
    result = result_of(case, precision, weights)
    gradients = {name: values[order] for name, values in result.gradients.items()}
    permuted = result_of(case, precision, weights, taken(case.gaussians, order))
    assert_equal(permuted, replace(result, gradients=gradients))


@both_precisions
@examples
@given(cases(), seeds)
def test_quaternions_negated_or_scaled_by_powers_of_two_are_the_same_rotations(
    precision, case, seed
):
    """Their gradients are divided by the factor, and nothing else changes."""
    rng = np.random.default_rng(seed)
    signs, exponents = rng.choice([-1.0, 1.0], case.count), rng.integers(-20, 21, case.count)
    factors = (signs * 2.0**exponents)[:, None]
    weights = random_weights(case)
    result = result_of(case, precision, weights)
    gradients = result.gradients | {"quats": result.gradients["quats"] / factors}
    scaled = changed(case.gaussians, quats=lambda quats: factors * quats)
    assert_equal(result_of(case, precision, weights, scaled), replace(result, gradients=gradients))


@both_precisions
@examples
@given(cases(), st.floats(-10, 0.99), seeds)
def test_a_gaussian_nearer_than_the_near_plane_does_not_exist(precision, case, depth, seed):
    """depth: in units of the near plane's; negative ones are behind the camera."""
    rng = np.random.default_rng(seed)
    row = rng.integers(0, case.count + 1)
    film = rng.uniform(0, 1, 2) * [case.width, case.height]
    added = with_row(
        case.gaussians, row, means=point_at(case.camera, film, depth * case.camera.near)
    )
    weights = random_weights(case)
    result = result_of(case, precision, weights)
    gradients = {name: np.insert(v, row, 0, axis=0) for name, v in result.gradients.items()}
    assert_equal(result_of(case, precision, weights, added), replace(result, gradients=gradients))


@both_precisions
@examples
@given(cases([(0, False), (3, False)]), st.integers(-20, 20))
def test_points_and_camera_may_be_scaled_by_powers_of_two(precision, case, exponent):
    """Depths scale, and the weights of depths inversely: the loss is the same.

    Points, since the logarithm of a scaled size would be rounded: e^-1000 is zero.
    """
    factor = 2.0**exponent
    points = changed(case.gaussians, log_scales=lambda logs: np.full_like(logs, -1000.0))
    scaled = changed(points, means=lambda means: factor * means)
    camera = case.camera
    camera = replace(camera, center=factor * camera.center, near=factor * camera.near)
    weights = random_weights(case)
    result = result_of(case, precision, weights, points)
    weights[-1] /= factor
    actual = result_of(case, precision, weights, scaled, device_camera(camera, precision))
    assert_equal(actual, scaled_result(result, factor))


def scaled_result(result, factor) -> Result:
    """What becomes of a result when the unit of length is divided by ``factor``."""
    return Result(
        picture=result.picture | {"depth": factor * result.picture["depth"]},
        gradients=result.gradients | {"means": result.gradients["means"] / factor},
    )


# ----------------------------------------------------------------------------------------------
# Nothing but rounding changes
# ----------------------------------------------------------------------------------------------


@both_precisions
@examples
@given(cases(KINDS[:2]), seeds)
def test_scene_and_camera_may_be_rotated_and_moved_together(precision, case, seed):
    """Gradients of positions turn with the scene, those of quaternions as quaternions do.

    With q' = p q, p of norm 1, quaternions are multiplied by an orthogonal matrix P, and so are
    their gradients.
    """
    assume_decided(case)
    undecided = undecided_pixels(case)
    weights = random_weights(case) * ~undecided
    rng = np.random.default_rng(seed)
    quat = rng.normal(0, 1, 4)
    R = reference.quat_to_rotation(quat[None])[0]
    P = hamilton_product(quat / np.linalg.norm(quat))
    shift = rng.normal(0, 1, 3)

    moved = changed(
        case.gaussians, means=lambda means: means @ R.T + shift, quats=lambda quats: quats @ P.T
    )
    camera = case.camera
    camera = replace(camera, rotation=camera.rotation @ R.T, center=R @ camera.center + shift)
    actual = result_of(case, precision, weights, moved, device_camera(camera, precision))

    result = result_of(case, precision, weights)
    turned = {"means": result.gradients["means"] @ R.T, "quats": result.gradients["quats"] @ P.T}
    expected = replace(result, gradients=result.gradients | turned)
    assert_agree(actual, expected, moved.quats, undecided, MOVED * ROUNDOFF[precision])


def hamilton_product(quat) -> np.ndarray:
    """The matrix (4, 4) that multiplies a quaternion by ``quat`` from the left, wxyz."""
    w, x, y, z = quat
    return np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])


@both_precisions
@examples
@given(cases(), st.floats(-10, 10))
def test_scene_and_camera_may_be_scaled_together(precision, case, exponent):
    """With the near plane; depths scale, and the weights of depths inversely.

    Sizes are off by the roundings of their logarithms, of up to 11: less than the positions.
    """
    assume_decided(case)
    undecided = undecided_pixels(case)
    weights = random_weights(case) * ~undecided
    factor = 2.0**exponent
    scaled = changed(
        case.gaussians,
        means=lambda means: factor * means,
        log_scales=lambda logs: logs + math.log(factor),
    )
    camera = case.camera
    camera = replace(camera, center=factor * camera.center, near=factor * camera.near)
    expected = scaled_result(result_of(case, precision, weights), factor)
    weights[-1] /= factor
    actual = result_of(case, precision, weights, scaled, device_camera(camera, precision))
    assert_agree(actual, expected, scaled.quats, undecided, MOVED * ROUNDOFF[precision])


@both_precisions
@examples
@given(cases(), seeds)
def test_quaternions_of_any_norm_are_rotations(precision, case, seed):
    """A gradient is divided by the factor of its quaternion."""
    undecided = undecided_pixels(case)
    weights = random_weights(case) * ~undecided
    factors = np.exp(np.random.default_rng(seed).uniform(-5, 5, (case.count, 1)))
    scaled = changed(case.gaussians, quats=lambda quats: factors * quats)
    actual = result_of(case, precision, weights, scaled)
    result = result_of(case, precision, weights)
    divided = {"quats": result.gradients["quats"] / factors}
    expected = replace(result, gradients=result.gradients | divided)
    assert_agree(actual, expected, scaled.quats, undecided, TURNED * ROUNDOFF[precision])


@both_precisions
@examples
@given(cases())
def test_gradients_of_quaternions_are_orthogonal_to_them(precision, case):
    """The norm of a quaternion is of no effect.

    A gradient's four components are sums of some 20 terms, each rounded about five times; how
    large these are, gradients of scales tell too (see ``_with_shapes``).
    Measured below 50 roundoffs.
    """
    result = result_of(case, precision, random_weights(case))
    quats = case.gaussians.quats
    terms = _with_shapes(result.gradients, quats)["shapes"]
    along = np.sum(quats * result.gradients["quats"], axis=1)
    assert np.abs(along).max() <= 400 * ROUNDOFF[precision] * np.abs(terms).max()


@both_precisions
@examples
@given(cases(), seeds)
def test_adjoint_is_the_transpose_of_the_tangent(precision, case, seed):
    """<J v, w> = <v, J^T w>, and both replay the decisions of the same frame.

    The terms are products of the same numbers in another order, rounded some hundred times each
    in either direction. The sums may cancel, so the error is relative to the terms.
    Measured below 25 roundoffs.
    """
    rng = np.random.default_rng(seed)
    draw = dict.fromkeys(PARAMETER_NAMES, lambda values: single(rng.normal(0, 1, values.shape)))
    direction = changed(case.gaussians, **draw)
    weights = random_weights(case)
    gaussians = uploaded(case.gaussians, precision)
    frame = rendering.render(gaussians, device_camera(case.camera, precision), case.pipeline)
    tangents = frame_tangent(gaussians, frame, uploaded(direction, precision))
    gradients = result_of(case, precision, weights).gradients
    left = [w.ravel() * rows(plane) for w, plane in zip(weights, tangents, strict=True)]
    right = [gradients[name] * getattr(direction, name) for name in PARAMETER_NAMES]
    size = math.sqrt(sum((term**2).sum() for term in [*left, *right]))
    pixels, parameters = (sum(term.sum() for term in terms) for terms in (left, right))
    assert abs(pixels - parameters) <= 200 * ROUNDOFF[precision] * size


# ----------------------------------------------------------------------------------------------
# Crop windows
# ----------------------------------------------------------------------------------------------


def pieces(width, height, x, y) -> list[tuple[int, int, int, int]]:
    """The up to four (x, y, width, height) px into which a film is cut at column x and row y."""
    columns, lines = (0, min(x, width), width), (0, min(y, height), height)
    return [
        (x0, y0, x1 - x0, y1 - y0)
        for (x0, x1), (y0, y1) in product(pairwise(columns), pairwise(lines))
        if x1 > x0 and y1 > y0
    ]


def window_of(camera, piece, precision):
    """The camera of a piece of the film, on the device."""
    x, y, width, height = piece
    moved = replace(camera, cx=camera.cx - x, cy=camera.cy - y, width=width, height=height)
    film = (-x, -y, camera.width - x, camera.height - y)
    corners = [dr.opaque(precision.Float, v) for v in film]
    return replace(
        device_camera(moved, precision),
        film_start=precision.Array2f(corners[:2]),
        film_end=precision.Array2f(corners[2:]),
    )


@both_precisions
@examples
@given(cases(), sizes, sizes)
def test_windows_together_are_the_whole_picture(precision, case, x, y):
    """And their gradients add up to those of the whole picture."""
    assume_decided(case)
    undecided = undecided_pixels(case)
    weights = random_weights(case) * ~undecided
    expected = result_of(case, precision, weights)
    picture = {name: np.full_like(values, np.nan) for name, values in expected.picture.items()}
    gradients = {name: np.zeros_like(values) for name, values in expected.gradients.items()}
    for piece in pieces(case.width, case.height, x, y):
        x0, y0, width, height = piece
        window = slice(y0, y0 + height), slice(x0, x0 + width)
        camera = window_of(case.camera, piece, precision)
        part = result_of(case, precision, [w[window] for w in weights], camera=camera)
        for name, values in part.picture.items():
            picture[name][window] = values
        for name, values in part.gradients.items():
            gradients[name] = gradients[name] + values
    actual = Result(picture, gradients)
    assert_agree(actual, expected, case.gaussians.quats, undecided, CROPPED * ROUNDOFF[precision])


@examples
@given(plugin_scenes(), sizes, sizes)
def test_windows_of_a_mitsuba_film_together_are_the_whole_picture(scene, x, y):
    undecided = undecided_pixels(scene)
    loaded = scene.load()
    whole, image = image_of(loaded), np.full((scene.view.height, scene.view.width, 4), np.nan)
    for piece in pieces(scene.view.width, scene.view.height, x, y):
        view = replace(scene.view, crop=piece)
        image[view.window] = image_of(loaded, sensor=mi.load_dict(view.sensor()))
    differs = (np.abs(image - whole) > 1.1 * CROPPED * ROUNDOFF[FLOAT32] * whole.max()).any(axis=-1)
    assert not (differs & ~undecided).any() and differs.sum() <= 1


# ----------------------------------------------------------------------------------------------
# The image model
# ----------------------------------------------------------------------------------------------


@examples
@given(plugin_scenes())
def test_white_minus_black_is_the_transmittance_and_alpha_the_rest(scene):
    """In Mitsuba's film: three channels and alpha."""
    loaded = scene.load()
    black, white = image_of(loaded), image_of(replace(scene, background=(1.0, 1.0, 1.0)).load())
    integrator = loaded.integrator()
    camera = camera_from_sensor(read_sensor(loaded.sensors()[0], integrator.near))
    frame = rendering.render(integrator.gaussians, camera, integrator.pipeline)
    transmittance = rows(frame.planes()[0]).reshape(camera.height, camera.width)
    for image in (black, white):
        np.testing.assert_array_equal(image[..., 3], single(1 - transmittance))
    # color + transmittance is rounded once, and color is exact.
    difference = white[..., :3] - black[..., :3]
    error = np.abs(difference - transmittance[..., None])
    assert (error <= ROUNDOFF[FLOAT32] * white[..., :3]).all()


@both_precisions
@examples
@given(cases(), seeds)
def test_pictures_are_linear_in_the_features_and_weights_add_up_to_alpha(precision, case, seed):
    rng = np.random.default_rng(seed)
    a, b = rng.normal(0, 1, (2, case.count))
    s, t = rng.normal(0, 1, 2)
    columns = [stored(c, precision) for c in (a, b, s * a + t * b, np.ones(case.count))]
    pipeline = rendering.Pipeline(case.degree, plain_opacity, (lambda *_: columns,))
    gaussians = uploaded(case.gaussians, precision)
    frame = rendering.render(gaussians, device_camera(case.camera, precision), pipeline)
    transmittance, of_a, of_b, of_sum, of_one = (rows(plane) for plane in frame.planes())
    # Each splat rounds the transmittance and the sum once, and a few roundings precede.
    tolerance = 2 * (case.count + 4) * ROUNDOFF[precision]
    largest = np.abs(s * a).max() + np.abs(t * b).max()
    assert np.abs(s * of_a + t * of_b - of_sum).max() <= tolerance * largest
    assert np.abs(of_one - (1 - transmittance)).max() <= tolerance


@both_precisions
@examples
@given(cases(least=2), seeds)
def test_a_scene_is_its_front_over_its_back(precision, case, seed):
    """C = C_front + T_front C_back and T = T_front T_back, if no pixel stops.

    60 splats of an opacity of at most sigmoid(-2) leave a transmittance of 5e-4.
    """
    assume_decided(case)
    faint = changed(case.gaussians, logit_opacities=lambda logits: np.minimum(logits - 2, -2))
    depths = (faint.means - case.camera.center) @ case.camera.rotation[2]
    order, split = np.argsort(depths), np.random.default_rng(seed).integers(1, case.count)
    whole, front, back = (
        rendered(case, precision, taken(faint, indices))
        for indices in (order, order[:split], order[split:])
    )
    T = front["transmittance"]
    composed = {
        "image": front["image"] + T[..., None] * back["image"],
        "depth": front["depth"] + T * back["depth"],
        "transmittance": T * back["transmittance"],
    }
    # Each splat rounds the transmittance and the sums once, in either computation, and no term is
    # negative.
    tolerance = 4 * (case.count + 1) * ROUNDOFF[precision]
    assert_arrays_agree(composed, {name: whole[name] for name in composed}, tolerance)


@both_precisions
@examples
@given(cases(), seeds)
def test_a_splat_behind_all_others_takes_its_share_of_the_transmittance(precision, case, seed):
    """Nowhere more light comes through; what is lost has the splat's colour and depth."""
    rng = np.random.default_rng(seed)
    camera = case.camera
    mean = point_at(camera, rng.uniform(0, 1, 2) * [case.width, case.height], 5.0)
    z = camera.rotation[2] @ (mean - camera.center)
    color = rng.uniform(0, 1, 3)
    added = with_row(
        case.gaussians,
        rng.integers(0, case.count + 1),
        means=mean,
        log_scales=np.log(rng.uniform(0.5, 10, 3) * z / camera.fx),
        logit_opacities=rng.normal(0, 3),
        sh0=(color - 0.5) / reference.C_00,
        shN=0,
    )
    before, after = (rendered(case, precision, g) for g in (case.gaussians, added))
    lost = before["transmittance"] - after["transmittance"]
    assert (lost >= 0).all() and (after["transmittance"] >= reference.TRANSMITTANCE_STOP).all()
    for name, value in {"image": color, "depth": z}.items():
        gained = after[name] - before[name]
        assert not gained[lost == 0].any(), name
        expected = np.multiply.outer(lost, value)
        # A depth of 5 is rounded some six times, like MOVED; weight, transmittance and sum once.
        tolerance = 12 * ROUNDOFF[precision] * max(after[name].max(), np.max(value))
        assert np.abs(gained - expected).max() <= tolerance, name
