"""Other implementations, given the same Gaussians, camera and loss.

A :class:`Renderer` renders a frame, and renders one and differentiates the loss sum(weights *
image) / pixels with respect to all of its parameters. Each call returns when the device has
finished.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.bench.scenes import mitsuba_sensor
from drgs.config.schema import ModelConfig
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.scene import make_scene
from drgs.reference import splatting as reference

SHELL = 3.0
"""Standard deviations at which Mitsuba's ellipsoids end (its default, and 3DGS's extent)."""


@dataclass(frozen=True)
class Renderer:
    """One implementation with a scene loaded."""

    name: str
    forward: Callable[[], None]
    forward_backward: Callable[[], None]
    seconds: float  # roughly, for both: how often it can be repeated


@dataclass(frozen=True)
class Problem:
    """The input of every implementation."""

    gaussians: Gaussians  # numpy
    camera: reference.Camera
    weights: np.ndarray  # (H, W, 3): the loss is sum(weights * image) / (H W)


def drgs_renderer(problem: Problem) -> Renderer:
    """Return the ``splats`` integrator through ``mi.render``, as a user of Mitsuba calls it."""
    scene = make_scene(problem.gaussians, ModelConfig().of_file(), (1.0, 1.0, 1.0))
    return _mitsuba_renderer("drgs", scene, problem, "integrator.", 0.1)


def volprim_renderer(problem: Problem, shape: str, seconds: float) -> Renderer:
    """Return Mitsuba's ``volprim_rf_basic`` on ``ellipsoids`` or ``ellipsoidsmesh``."""
    scene = mi.load_dict(volprim_scene(problem.gaussians, shape, 256))
    return _mitsuba_renderer(f"volprim_rf_basic, {shape}", scene, problem, "shapes.", seconds)


def volprim_scene(gaussians: Gaussians, shape: str, max_depth: int) -> dict[str, object]:
    """Return ``ellipsoids`` or ``ellipsoidsmesh`` as a scene without sensor, in display space."""
    quats_xyzw = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    quats_xyzw = np.roll(quats_xyzw, -1, axis=1)
    sh = np.concatenate([gaussians.sh0, gaussians.shN], axis=1)
    attributes = {
        "data": np.concatenate([gaussians.means, gaussians.scales, quats_xyzw], axis=1),
        "opacities": gaussians.opacities[:, None],
        "sh_coeffs": sh.reshape(len(sh), -1),
    }
    tensors = {name: mi.TensorXf(v.astype(np.float32)) for name, v in attributes.items()}
    integrator = {"type": "volprim_rf_basic", "srgb_primitives": False, "max_depth": max_depth}
    return {
        "type": "scene",
        "integrator": integrator,
        "emitter": {"type": "constant"},
        "shapes": {"type": shape, "extent": SHELL, **tensors},
    }


def _mitsuba_renderer(
    name: str, scene: mi.Scene, problem: Problem, prefix: str, seconds: float
) -> Renderer:
    camera = problem.camera
    sensor = mi.load_dict(mitsuba_sensor(camera) | {"near_clip": 1e-3})
    params = mi.traverse(scene)
    names = [prefix + name for name in (*PARAMETER_NAMES, "data", "opacities", "sh_coeffs")]
    names = [name for name in names if name in params]
    weights = mi.TensorXf(problem.weights.astype(np.float32) / (camera.width * camera.height))
    integrator = scene.integrator()

    def forward() -> None:
        integrator.parameters_changed([])  # no frame of an earlier call may be used again
        with dr.suspend_grad():
            dr.eval(mi.render(scene, sensor=sensor, spp=1))
        dr.sync_thread()

    def forward_backward() -> None:
        integrator.parameters_changed([])
        values = [params[name] for name in names]
        dr.enable_grad(values)
        dr.clear_grad(values)
        image = mi.render(scene, params, sensor=sensor, spp=1)
        dr.backward(dr.sum(image * weights, axis=None))
        dr.eval(dr.grad(values))
        dr.sync_thread()
        dr.disable_grad(values)

    return Renderer(name, forward, forward_backward, seconds)


def reference_renderer(problem: Problem) -> Renderer:
    """Return the float64 numpy reference."""
    fields = [getattr(problem.gaussians, name) for name in PARAMETER_NAMES]
    gaussians, white = reference.Gaussians(*fields), np.ones(3)
    d_image = problem.weights / problem.weights[..., 0].size

    def forward() -> None:
        reference.render(gaussians, problem.camera, white)

    def forward_backward() -> None:
        reference.render(gaussians, problem.camera, white)
        reference.render_gradients(gaussians, problem.camera, white, d_image)

    seconds = 6e-4 * len(gaussians.means)
    return Renderer("numpy reference, float64", forward, forward_backward, seconds)
