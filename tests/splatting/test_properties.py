"""Laws of every scene: what changes if its rows, its pose, its unit or its film change.

Hypothesis draws the structure of a scene (its film, its size, what is rendered) and a seed; the
numbers come from the recipes of ``helpers``. Every run sees the same examples.
"""

import math
from dataclasses import dataclass, replace
from itertools import pairwise, product

import drjit as dr
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    assert_arrays_agree,
    assert_images_agree,
    both_precisions,
    device_camera,
    device_gaussians,
    examples,
    frame_adjoint,
    image_planes,
    random_scene,
    rows,
    single,
    stacked_scene,
)

from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.splatting import rendering

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

ROUNDOFF = {FLOAT64: 2.0**-53, FLOAT32: 2.0**-24}
"""The largest relative error of one operation."""


# (SH degree, antialiased): each compiles projection anew, in each precision.
KINDS = ((0, False), (0, True), (3, False))
sizes = st.integers(1, 40)
seeds = st.integers(0, 2**32 - 1)


@st.composite
def cases(draw, kinds=KINDS) -> Case:
    """Gaussians before a film of up to 3 x 3 tiles."""
    degree, antialiased = draw(st.sampled_from(kinds))
    return Case(
        "random", draw(sizes), draw(sizes), degree, draw(st.integers(1, 60)), antialiased,
        recipe=draw(st.sampled_from([random_scene, stacked_scene])),
        seed=draw(seeds),
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
    colors = reference.unclamped_colors(gaussians, directions, case.rendered_degree)
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
    rendered = reference.render(
        scene.gaussians, scene.camera, np.zeros(3), scene.rendered_degree, scene.antialiased,
        threshold_width=1e-3,
    )  # fmt: skip
    assume(rendered.near_threshold.mean() <= 0.05)
    return rendered.near_threshold


def changed(gaussians, **rules) -> reference.Gaussians:
    """Gaussians with a function applied to each of some parameters."""
    return replace(gaussians, **{n: rule(getattr(gaussians, n)) for n, rule in rules.items()})


@dataclass(frozen=True)
class Result:
    """An image on black, and the gradients of sum(weights * planes)."""

    rendered: dict  # what reference.Image holds
    gradients: dict  # of the six parameters and means2d; visible


def random_weights(case) -> np.ndarray:
    """(1 + C, H, W): for the transmittance, red, green, blue and depth."""
    return single(np.random.default_rng(1).normal(0, 1, (5, case.height, case.width)))


def result_of(case, precision, weights, gaussians=None, camera=None) -> Result:
    """Compute by the kernels. gaussians, camera (on the device): None for the case's."""
    gaussians = device_gaussians(gaussians or case.gaussians, precision)
    camera = camera or device_camera(case.camera, precision)
    frame = rendering.render(gaussians, camera, case.pipeline)
    d_transmittance, *d_features = [precision.array(plane) for plane in weights]
    gradients = frame_adjoint(gaussians, frame, d_features, d_transmittance)
    return Result(
        rendered=image_planes(frame),
        gradients={
            **{name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES},
            "means2d": np.stack([rows(column) for column in gradients.means2d], axis=-1),
            "visible": np.array(gradients.visible),
        },
    )


def assert_agree(actual, expected, quats, undecided, px) -> None:
    """Check that no splat was displaced by more than ``px``, as far as images and gradients tell.

    quats: (N, 4); undecided: (H, W), pixels at which decisions may flip, of which one at most may.

    alpha changes by at most 1.1 opacities per px (see test_rendering), and so do a pixel and its
    transmittance. Its derivative of at most 1.1 per px changes by 1 / 0.3 = 3.3 per px^2, three
    times as much relative to it; another 1.1 comes from each of T, S and 1 / (1 - alpha): 6 per px.
    """
    rendered = reference.RenderedImage(**expected.rendered, near_threshold=undecided)
    assert_images_agree(actual.rendered, rendered, 1.1 * px)
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


@dataclass
class Change:
    """Another scene, the weights of its loss, and the result that it must have."""

    gaussians: reference.Gaussians
    camera: reference.Camera
    weights: np.ndarray
    expected: Result


def permute_rows(case, rng, weights, result) -> Change:
    """Only the depth orders the splats, and each row has its own gradient."""
    order = rng.permutation(case.count)
    rules = dict.fromkeys(PARAMETER_NAMES, lambda values: values[order])
    gradients = {name: values[order] for name, values in result.gradients.items()}
    expected = replace(result, gradients=gradients)
    return Change(changed(case.gaussians, **rules), case.camera, weights, expected)


def scale_quaternions(case, rng, weights, result) -> Change:
    """Gradients are divided by the factor, and nothing else changes."""
    signs, exponents = rng.choice([-1.0, 1.0], case.count), rng.integers(-20, 21, case.count)
    factors = (signs * 2.0**exponents)[:, None]
    scaled = changed(case.gaussians, quats=lambda quats: factors * quats)
    gradients = result.gradients | {"quats": result.gradients["quats"] / factors}
    return Change(scaled, case.camera, weights, replace(result, gradients=gradients))


def add_before_the_near_plane(case, rng, weights, result) -> Change:
    """Nearer than the near plane, or behind the camera."""
    camera, row = case.camera, rng.integers(0, case.count + 1)
    film = rng.uniform(0, 1, 2) * [case.width, case.height]
    slopes = (film - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    z = camera.near * rng.uniform(-10, 0.99)
    mean = single(z * np.array([*slopes, 1.0]) @ camera.rotation + camera.center)
    values = {name: getattr(case.gaussians, name) for name in PARAMETER_NAMES}
    added = {n: np.insert(v, row, mean if n == "means" else v[0], 0) for n, v in values.items()}
    gradients = {name: np.insert(v, row, 0, axis=0) for name, v in result.gradients.items()}
    expected = replace(result, gradients=gradients)
    return Change(reference.Gaussians(**added), camera, weights, expected)


def change_unit(case, rng, weights, result) -> Change:
    """Depths scale with the near plane, and the weights of depths inversely.

    Sizes are off by the roundings of their logarithms, of up to 11: less than the positions.
    """
    factor, camera = math.exp(rng.uniform(-10, 10)), case.camera
    scaled = changed(
        case.gaussians,
        means=lambda means: factor * means,
        log_scales=lambda logs: logs + math.log(factor),
    )
    camera = replace(camera, center=factor * camera.center, near=factor * camera.near)
    weights = np.concatenate([weights[:-1], weights[-1:] / factor])
    expected = Result(
        rendered=result.rendered | {"depth": factor * result.rendered["depth"]},
        gradients=result.gradients | {"means": result.gradients["means"] / factor},
    )
    return Change(scaled, camera, weights, expected)


def move_rigidly(case, rng, weights, result) -> Change:
    """Gradients of positions turn with the scene, those of quaternions as quaternions do.

    With q' = p q, p of norm 1, quaternions are multiplied by an orthogonal matrix P, and so are
    their gradients.
    """
    quat, shift, camera = rng.normal(0, 1, 4), rng.normal(0, 1, 3), case.camera
    R = reference.quat_to_rotation(quat[None])[0]
    w, x, y, z = quat / np.linalg.norm(quat)
    P = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    moved = changed(
        case.gaussians, means=lambda means: means @ R.T + shift, quats=lambda quats: quats @ P.T
    )
    camera = replace(camera, rotation=camera.rotation @ R.T, center=R @ camera.center + shift)
    turned = {"means": result.gradients["means"] @ R.T, "quats": result.gradients["quats"] @ P.T}
    expected = replace(result, gradients=result.gradients | turned)
    return Change(moved, camera, weights, expected)


CHANGES = [
    (permute_rows, KINDS, None),
    (scale_quaternions, KINDS, None),
    (add_before_the_near_plane, KINDS, None),
    (change_unit, KINDS, MOVED),
    (move_rigidly, KINDS[:2], MOVED),
]
"""What changes, in scenes of which kinds, and how far splats may move: None if no bit changes."""


@pytest.mark.slow
@both_precisions
@pytest.mark.parametrize(
    ("change", "kinds", "px"), CHANGES, ids=[change.__name__ for change, *_ in CHANGES]
)
def test_results_change_with_the_scene(precision, change, kinds, px):
    @examples
    @given(cases(kinds), seeds)
    def check(case, seed):
        assume_decided(case)
        undecided = undecided_pixels(case)
        weights = random_weights(case) * ~undecided
        result = result_of(case, precision, weights)
        given = change(case, np.random.default_rng(seed), weights, result)
        camera = device_camera(given.camera, precision)
        actual = result_of(case, precision, given.weights, given.gaussians, camera)
        if px is None:
            assert_equal(actual, given.expected)
        else:
            quats = given.gaussians.quats
            assert_agree(actual, given.expected, quats, undecided, px * ROUNDOFF[precision])

    check()


def assert_equal(actual, expected) -> None:
    """To the last bit, but for the signs of zeros; all is finite."""
    for kind in ("rendered", "gradients"):
        for name, values in getattr(expected, kind).items():
            assert np.isfinite(values).all(), name
            np.testing.assert_array_equal(getattr(actual, kind)[name], values, name)


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


@pytest.mark.slow
@both_precisions
@examples
@given(cases(), sizes, sizes)
def test_crop_windows_compose_the_whole_image(precision, case, x, y):
    """And their gradients add up to those of the whole image."""
    assume_decided(case)
    undecided = undecided_pixels(case)
    weights = random_weights(case) * ~undecided
    expected = result_of(case, precision, weights)
    rendered = {name: np.full_like(values, np.nan) for name, values in expected.rendered.items()}
    gradients = {name: np.zeros_like(values) for name, values in expected.gradients.items()}
    for piece in pieces(case.width, case.height, x, y):
        x0, y0, width, height = piece
        window = slice(y0, y0 + height), slice(x0, x0 + width)
        camera = window_of(case.camera, piece, precision)
        part = result_of(case, precision, [w[window] for w in weights], camera=camera)
        for name, values in part.rendered.items():
            rendered[name][window] = values
        for name, values in part.gradients.items():
            gradients[name] = gradients[name] + values
    actual = Result(rendered, gradients)
    assert_agree(actual, expected, case.gaussians.quats, undecided, CROPPED * ROUNDOFF[precision])
