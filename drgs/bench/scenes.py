"""Scenes and cameras of the measurements; cameras are the reference's."""

from __future__ import annotations

import mitsuba as mi
import numpy as np

from drgs.cameras.camera import Camera
from drgs.cameras.viewpoints import OPENCV_TO_OPENGL
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import film_description
from drgs.reference import splatting as reference

BENCH_TO_WORLD = np.array(
    [[-1.0, 0.0, 0.0, 0.0], [0.0, -0.73411, 0.679031, 2.73726], [0.0, 0.679031, 0.73411, 2.959292]]
)
"""Camera to world in OpenGL axes: the first test camera of the NeRF-synthetic Lego."""

BENCH_FIELD_OF_VIEW = 0.691111  # rad, horizontal


def bench_gaussians(count: int, seed: int = 0) -> Gaussians:
    """Return ``count`` Gaussians in and on the box [-1, 1]^3, as numpy arrays.

    80 % are on a random face, moved inwards by |N(0, 0.05)|, the rest uniform inside. Scales
    are log-normal around 0.01, rotations uniform, opacities uniform in [0.1, 0.95]; SH of degree
    3, with base colours uniform in [0, 1].
    """
    rng = np.random.default_rng(seed)
    means = rng.uniform(-1, 1, (count, 3))
    on_face = np.flatnonzero(rng.random(count) < 0.8)
    axis, side = rng.integers(0, 3, count), rng.choice([-1, 1], count)
    inwards = np.abs(rng.normal(0, 0.05, count))
    means[on_face, axis[on_face]] = (side * (1 - inwards))[on_face]
    opacities = rng.uniform(0.1, 0.95, count)
    values = {
        "means": means,
        "quats": rng.normal(size=(count, 4)),
        "log_scales": rng.normal(np.log(0.01), 0.5, (count, 3)),
        "logit_opacities": np.log(opacities / (1 - opacities)),
        "sh0": (rng.uniform(0, 1, (count, 1, 3)) - 0.5) / reference.C_00,
        "shN": rng.normal(0, 0.05, (count, 15, 3)),
    }
    return Gaussians(**{name: value.astype(np.float32) for name, value in values.items()})


def bench_camera(size: int) -> reference.Camera:
    """Return the bench scene's camera with a square film of ``size`` px."""
    focal = float(np.float32(size / (2 * np.tan(BENCH_FIELD_OF_VIEW / 2))))
    rotation = (BENCH_TO_WORLD[:, :3] * OPENCV_TO_OPENGL.diagonal()[:3]).T.astype(np.float32)
    center = BENCH_TO_WORLD[:, 3].astype(np.float32)
    return reference.Camera(rotation, center, focal, focal, size / 2, size / 2, size, size)


def mitsuba_pose(camera: reference.Camera, shift: float = 0.0) -> mi.ScalarTransform4f:
    """Return a camera's ``to_world``; shift: to its right, world units."""
    pose = np.eye(4)
    pose[:3, :3] = camera.rotation.T * [-1, -1, 1]  # Mitsuba's x is to the left, its y up
    pose[:3, 3] = camera.center + shift * camera.rotation[0]
    return mi.ScalarTransform4f(pose)  # pyright: ignore[reportCallIssue, reportArgumentType]  # the stub lacks float64


def mitsuba_sensor(camera: reference.Camera) -> dict[str, object]:
    """Return a perspective sensor with a box filter; the camera's fx and fy must agree."""
    return {
        "type": "perspective",
        "fov": float(np.degrees(2 * np.arctan(camera.width / 2 / camera.fx))),
        "fov_axis": "x",
        "to_world": mitsuba_pose(camera),
        "film": film_description(camera.width, camera.height),
        "sampler": {"type": "independent", "sample_count": 1},
    }


def device_camera(camera: reference.Camera, float_type: type) -> Camera:
    """Return the camera as Dr.Jit scalars of ``float_type``."""
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    size = camera.width, camera.height
    return Camera.create(float_type, camera.rotation, camera.center, K, *size, camera.near)
