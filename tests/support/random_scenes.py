"""Random scenes that Hypothesis draws, and what the kernels make of them."""

from dataclasses import dataclass, replace

import drjit as dr
import numpy as np
from hypothesis import Phase, assume, settings
from hypothesis import strategies as st

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.reference import splatting as reference
from drgs.splatting import rendering
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    as_images,
    assert_arrays_agree,
    assert_images_agree,
    device_camera,
    device_gaussians,
    frame_adjoint,
    random_scene,
    rows,
    single,
    stacked_scene,
)

examples = settings(
    derandomize=True,
    database=None,
    deadline=None,
    max_examples=25,
    phases=[Phase.generate, Phase.shrink],
)


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
    """Compute by the kernels. gaussians, camera (on the device): None for the case's."""
    gaussians = uploaded(gaussians or case.gaussians, precision)
    camera = camera or device_camera(case.camera, precision)
    frame = rendering.render(gaussians, camera, case.pipeline)
    d_transmittance, *d_features = [stored(plane, precision) for plane in weights]
    gradients = frame_adjoint(gaussians, frame, d_features, d_transmittance)
    return Result(
        rendered=image_planes(frame),
        gradients={
            **{name: np.array(getattr(gradients.parameters, name)) for name in PARAMETER_NAMES},
            "means2d": np.stack([rows(column) for column in gradients.means2d], axis=-1),
            "visible": np.array(gradients.visible),
        },
    )


def image_planes(frame) -> dict[str, np.ndarray]:
    """The planes, under the names of ``reference.RenderedImage``."""
    images = as_images(frame.planes(), frame.camera)
    return {
        "image": images["color"],
        "alpha": 1 - images["transmittance"],
        "depth": images["depth"],
        "transmittance": images["transmittance"],
    }


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
