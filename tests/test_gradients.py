"""Doubt the gradients? ``pytest tests/test_gradients.py -s`` takes ten seconds.

Splats are rendered and differentiated by ``drgs.rasterization`` in double precision. Images and
derivatives are compared with ``drgs.reference``, a float64 numpy program that shares no code with
the kernels, and last, five wrong kernels must fail the same comparison.
"""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from drjit.llvm.ad import TensorXf64

import drgs
from drgs.reference import splatting as reference
from drgs.splatting import projection
from drgs.splatting.footprint import GaussianFalloff
from drgs.splatting.rendering import CenterOrder

mi.set_variant("llvm_ad_rgb")

COUNT, WIDTH, HEIGHT, FOCAL = 40, 48, 36, 60.0
BACKGROUND = np.array([0.9, 0.2, 0.4])

STEP = 1e-5
"""Step of central differences; their error is STEP^2 (truncation) plus 1e-16 / STEP (rounding)."""

IMAGE_TOLERANCE = 1e-13
"""Some 40 additions of numbers below 1, in another order than the reference's."""

GRADIENT_TOLERANCE = 1e-7
"""Relative to the largest derivative of a parameter: truncation, with curvatures of up to 1e3."""


def random_scene():
    """Return the arguments of ``drgs.rasterization`` by name, float64, and weights of the loss."""
    rng = np.random.default_rng(3)
    scene = {
        "means": rng.normal([0, 0, 4], 0.6, (COUNT, 3)),
        "quats": rng.normal(0, 1, (COUNT, 4)),
        "scales": np.exp(rng.uniform(-3.0, -1.2, (COUNT, 3))),
        "opacities": rng.uniform(0.1, 0.95, COUNT),
        "colors": rng.normal(0, 0.3, (COUNT, 16, 3)),
        "backgrounds": BACKGROUND[None].copy(),
    }
    return scene, rng.normal(0, 1, (HEIGHT, WIDTH, 3))


def rasterize(scene):
    """Return the image (1, H, W, 3) by drgs."""
    K = np.array([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    scene = dict(scene, viewmats=np.eye(4)[None], Ks=K[None], width=WIDTH, height=HEIGHT)
    image, _, _ = drgs.rasterization(**scene, sh_degree=3)
    return image


def reference_image(scene):
    """Return the image (H, W, 3) by the reference, whose Gaussians are not activated."""
    opacities, colors = scene["opacities"], scene["colors"]
    gaussians = reference.Gaussians(
        scene["means"], scene["quats"], np.log(scene["scales"]),
        np.log(opacities / (1 - opacities)), colors[:, :1], colors[:, 1:],
    )  # fmt: skip
    camera = reference.Camera(
        np.eye(3), np.zeros(3), FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT
    )
    return reference.render(gaussians, camera, scene["backgrounds"][0]).image


def tensors(scene):
    """Return Dr.Jit tensors of double precision."""
    return {name: TensorXf64(value) for name, value in scene.items()}


def gradients(scene, weights):
    """Return dL/d(parameter) by drgs, for L = sum(weights * image)."""
    inputs = tensors(scene)
    dr.enable_grad(inputs)
    dr.backward(dr.sum(rasterize(inputs) * TensorXf64(weights[None])))
    return {name: dr.grad(value).numpy() for name, value in inputs.items()}


def difference(scene, weights, name, index):
    """Return the central difference of the reference's loss in one entry of a parameter."""
    losses = []
    for step in (STEP, -STEP):
        moved = dict(scene, **{name: scene[name].copy()})
        moved[name][index] += step
        losses.append(np.sum(weights * reference_image(moved)))
    return (losses[0] - losses[1]) / (2 * STEP)


def is_correct(scene, weights, entries=3, report=print):
    """Compare the image, and the derivatives of ``entries`` entries of every parameter."""
    error = np.abs(rasterize(scene)[0] - reference_image(scene)).max()
    report(f"\nimage: largest difference {error:.1e}")
    correct, rng = error <= IMAGE_TOLERANCE, np.random.default_rng(5)
    analytic = gradients(scene, weights)
    report(f"{'parameter':>12} {'index':>12} {'analytic':>20} {'numeric':>20} {'error':>8}")
    for name, gradient in analytic.items():
        largest = np.abs(gradient).max()
        for flat in rng.choice(gradient.size, min(entries, gradient.size), replace=False):
            index = np.unravel_index(flat, gradient.shape)
            numeric = difference(scene, weights, name, index)
            error = abs(gradient[index] - numeric) / largest
            place = ",".join(map(str, index))
            report(f"{name:>12} {place:>12} {gradient[index]:20.12f} {numeric:20.12f} {error:8.1e}")
            correct = correct and error <= GRADIENT_TOLERANCE
    return correct


def test_image_and_gradients_match_the_reference():
    assert is_correct(*random_scene(), entries=8)


def test_reverse_mode_is_the_transpose_of_forward_mode():
    """<J v, w> = <v, J^T w> for a random direction v of all parameters."""
    scene, w = random_scene()
    rng = np.random.default_rng(7)
    v = {name: rng.normal(0, 1, value.shape) for name, value in scene.items()}
    inputs = tensors(scene)
    dr.enable_grad(inputs)
    for name, value in inputs.items():
        dr.set_grad(value, TensorXf64(v[name]))
    forward = np.sum(dr.forward_to(rasterize(inputs)).numpy()[0] * w)
    reverse = sum(np.sum(v[name] * gradient) for name, gradient in gradients(scene, w).items())
    print(f"\n<J v, w> = {forward:.15g}, <v, J^T w> = {reverse:.15g}")
    assert forward == pytest.approx(reverse, rel=1e-12)


derivatives, adjoint = GaussianFalloff.derivatives, CenterOrder.adjoint
rotation, factor_conic = projection.quat_to_rotation, projection.factor_conic

MUTANTS = {
    "factor 1.01": (GaussianFalloff, "derivatives", lambda *a: [1.01 * d for d in derivatives(*a)]),
    "wrong sign": (GaussianFalloff, "derivatives", lambda *a: [-d for d in derivatives(*a)]),
    "no background term": (
        CenterOrder,
        "adjoint",
        lambda order, tiles, d, *a: adjoint(order, tiles, [0 * d[0], *d[1:]], *a),
    ),
    "quaternion xyzw": (projection, "quat_to_rotation", lambda q: rotation(type(q)(q.yzwx))),
    "no low-pass": (
        projection,
        "factor_conic",
        lambda mean, x, y, low: factor_conic(mean, x, y, 0 * low),
    ),
}


@pytest.mark.parametrize("name", MUTANTS)
def test_wrong_kernels_fail(name, monkeypatch):
    monkeypatch.setattr(*MUTANTS[name])
    assert not is_correct(*random_scene(), report=lambda line: None)
