"""Pinhole cameras in OpenCV axes.

Layer 1. A :class:`Camera` is what projection reads. Its numbers are Dr.Jit scalars that live on
the device, so that kernels are compiled once for all views, and a Mitsuba sensor's transform is
never read back to the host.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from drgs.arrays import types_of


@dataclass(frozen=True)
class Camera:
    """A pinhole camera: x right, y down, z forward; pixel centres at (i + 0.5, j + 0.5).

    A world point x has camera coordinates ``rotation (x - center)``. The centre is kept rather
    than the translation ``-rotation center``, which cancels far from the origin.
    """

    rotation: Any  # 3 x 3 (Matrix3f), world to camera
    center: Any  # Array3f, world
    focal: Any  # Array2f (fx, fy), px
    principal: Any  # Array2f (cx, cy), px
    film_start: Any  # Array2f, px: where the whole film begins, (0, 0) unless this is a crop window
    film_end: Any  # Array2f, px: where it ends, (width, height) unless this is a crop window
    near: Any  # Float, scene units: means with smaller z are culled
    width: int
    height: int

    @staticmethod
    def create(
        float_type: type,
        rotation: np.ndarray,
        center: np.ndarray,
        K: np.ndarray,
        width: int,
        height: int,
        near: float,
    ) -> Camera:
        """Upload a camera given as numpy arrays: rotation (3, 3), center (3,), K (3, 3) px."""
        t = types_of(float_type)
        rotation, center, K = (np.asarray(a, dtype=np.float64) for a in (rotation, center, K))

        def scalar(value: float) -> Any:
            return dr.opaque(float_type, float(value))

        return Camera(
            rotation=t.Matrix3f([[scalar(v) for v in row] for row in rotation]),
            center=t.Array3f([scalar(v) for v in center]),
            focal=t.Array2f(scalar(K[0, 0]), scalar(K[1, 1])),
            principal=t.Array2f(scalar(K[0, 2]), scalar(K[1, 2])),
            film_start=t.Array2f(scalar(0), scalar(0)),
            film_end=t.Array2f(scalar(width), scalar(height)),
            near=scalar(near),
            width=int(width),
            height=int(height),
        )


@dataclass(frozen=True)
class SensorState:
    """All that the camera of a Mitsuba ``perspective`` sensor depends on, film and crop included.

    Holding it keeps the variables of ``device`` alive, so that equal indices mean equal values.
    """

    device: tuple[Any, ...]  # to_world (4 x 4), horizontal field of view (degrees), offsets x, y
    host: tuple[float, ...]  # film width and height, crop offset x and y, crop size, near


def read_sensor(sensor: Any, near: float) -> SensorState:
    """Collect a sensor's state without reading anything back from the device.

    near: near plane, scene units; the sensor's ``near_clip`` applies as well, the larger wins.

    Raises TypeError for sensors other than ``perspective``.
    """
    import mitsuba as mi

    params = mi.traverse(sensor)
    if not isinstance(sensor, mi.ProjectiveCamera) or "principal_point_offset_x" not in params:
        raise TypeError(
            f"splats: the sensor must be of type 'perspective', got {sensor.class_name()} "
            f"'{sensor.id()}'"
        )
    film = sensor.film()
    device = (
        params["to_world"].matrix,
        params["x_fov"],
        params["principal_point_offset_x"],
        params["principal_point_offset_y"],
    )
    near = max(near, sensor.near_clip())
    host = (*film.size(), *film.crop_offset(), *film.crop_size(), near)
    return SensorState(device=dr.detach(device), host=host)


def camera_from_sensor(state: SensorState) -> Camera:
    """The pinhole camera of a Mitsuba ``perspective`` sensor's crop window.

    Not differentiated: the sensor's parameters.
    """
    to_world, x_fov, offset_x, offset_y = state.device
    t = types_of(type(x_fov))
    # No number may be compiled into a kernel: each film, crop or view would compile its own.
    width, height, crop_x, crop_y, *_, near = [dr.opaque(t.Float, v) for v in state.host]
    *_, crop_width, crop_height, _ = state.host
    # Mitsuba's camera has x to the left and y up, OpenCV's x to the right and y down. A camera
    # has no unit of length: if to_world scales, its axes are normalised.
    columns = [t.Array3f([to_world[row, column] for row in range(3)]) for column in range(4)]
    right, down, forward = -columns[0], -columns[1], columns[2]
    # x_fov is the horizontal field of view of the whole film, whatever 'fov_axis' was given.
    focal = width / (2 * dr.tan(dr.deg2rad(x_fov) / 2))
    camera = Camera(
        rotation=t.Matrix3f([list(dr.normalize(axis)) for axis in (right, down, forward)]),
        center=columns[3],
        focal=t.Array2f(focal, focal),
        principal=t.Array2f(
            width / 2 - offset_x * width - crop_x, height / 2 - offset_y * height - crop_y
        ),
        film_start=t.Array2f(-crop_x, -crop_y),
        film_end=t.Array2f(width - crop_x, height - crop_y),
        near=near,
        width=int(crop_width),
        height=int(crop_height),
    )
    dr.make_opaque(camera)
    return camera
