"""Cameras in OpenCV axes, and the lens that is there by default, a pinhole.

Layer 1. A :class:`Camera` is what projection reads. Its numbers are Dr.Jit scalars that live on
the device, so that kernels are compiled once for all views, and a Mitsuba sensor's transform is
never read back to the host.

How points come to the film is up to the camera's *lens*, an object with the methods of
:class:`Pinhole`. The other ones are in ``drgs.lenses``, imported when a sensor has one.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, ClassVar

import drjit as dr
import numpy as np

from drgs.arrays import types_of
from drgs.constants import TAN_CLAMP


@dataclass(frozen=True)
class Lens:
    """What all lenses have in common: by default nothing has to be prepared."""

    distorts: ClassVar[bool] = False
    """Whether a pinhole could take its place."""
    parallel: ClassVar[bool] = False
    """Whether its rays are, instead of meeting in the camera."""

    def upload(self, float_type: type) -> Lens:
        """The lens with Dr.Jit scalars of this type for its numbers."""
        del float_type
        return self

    def fitted(self, camera: Camera) -> Lens:
        """The lens that knows what the film of ``camera`` sees."""
        del camera
        return self

    def named(self) -> dict[str, Any]:
        """The lens's coefficients by name."""
        return {}

    def with_named(self, values: dict[str, Any]) -> Lens:
        """The same lens with other numbers for its coefficients."""
        del values
        return self

    def view_direction(self, camera: Camera, offset: Any) -> Any:
        """In which a mean is seen, Array3f, world, of any length; offset: from the centre."""
        del camera
        return offset

    def origin(self, camera: Camera, x: Any, y: Any) -> Any:
        """Where the ray through a point of the film (px) begins, Array3f, camera axes."""
        del camera, y
        return types_of(type(x)).Array3f(0, 0, 0)


@dataclass(frozen=True)
class Perspective(Lens):
    """What lenses have in common that see along rays from a centre, in front of them.

    Positions are Array3f in camera axes, one a lane. *Slopes* are x / z and y / z.
    """

    def look(self, camera: Camera, position: Any) -> tuple[Any, Any, Any]:
        """Whether a mean is seen, its position, and its depth (scene units).

        The position and the depth of one that is not seen are replaced: a masked lane must not
        divide by zero, as 0 * inf would poison the gradient of its neighbours.
        """
        x, y, z = position
        seen = z >= camera.near
        z = dr.select(seen, z, 1)
        return seen, type(position)(x, y, z), z

    def true_slopes(self, camera: Camera, position: Any) -> list[Any]:
        """Of a mean."""
        del camera
        return [position.x / position.z, position.y / position.z]

    def clamped_slopes(self, camera: Camera, position: Any) -> list[Any]:
        """The same, but not far outside the film: see ``constants.TAN_CLAMP``."""
        start, end = self.frustum(camera)
        margin = TAN_CLAMP * (end - start) / 2
        slopes = self.true_slopes(camera, position)
        bounds = zip(slopes, start - margin, end + margin, strict=True)
        return [dr.select(s < lo, lo, dr.select(s > hi, hi, s)) for s, lo, hi in bounds]

    def depth_direction(self, camera: Camera, position: Any) -> Any:
        """Derivative of the depth divided by the depth, Array3f, world."""
        return camera.rotation[2] / position.z

    def ray_range(self, direction: Any, near: Any, far: Any) -> tuple[Any, Any]:
        """Where a ray of unit ``direction`` (camera axes) reaches two depths."""
        return near / direction.z, far / direction.z


@dataclass(frozen=True)
class Pinhole(Perspective):
    """A point (x, y, z) is seen at focal (x, y) / z + principal."""

    def film_point(self, camera: Camera, position: Any) -> Any:
        """Where a point is on the film, Array2f, px."""
        x, y, z = position
        return camera.focal * types_of(type(z)).Array2f(x, y) / z + camera.principal

    def film_directions(self, camera: Camera, position: Any, slopes: list[Any]) -> list[Any]:
        """Derivatives of the place on the film, two Array3f, world: px per scene unit.

        J's rows are focal / z (e_axis - slope e_z), with the ``slopes`` of a mean at ``position``,
        or of another ray.
        """
        right, down, forward = camera.rotation
        return [
            (axis - slope * forward) * (focal / position.z)
            for axis, focal, slope in zip((right, down), camera.focal, slopes, strict=True)
        ]

    def frustum(self, camera: Camera) -> tuple[Any, Any]:
        """The least and the largest slopes on the film, Array2f."""
        # Of the whole film: a crop window is a part of the same picture.
        start = (camera.film_start - camera.principal) / camera.focal
        end = (camera.film_end - camera.principal) / camera.focal
        return start, end

    def ray(self, camera: Camera, x: Any, y: Any) -> Any:
        """Through a point of the film (px), Array3f, camera axes, of any length."""
        t = types_of(type(x))
        film = (t.Array2f(x, y) - camera.principal) / camera.focal
        return t.Array3f(film.x, film.y, 1)


MISSED = 0.01
"""px: how far from its place a ray's point may be seen."""


@dataclass(frozen=True)
class Camera:
    """A camera: x right, y down, z forward; pixel centres at (i + 0.5, j + 0.5).

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
    lens: Any = Pinhole()
    aperture: Any = None  # of a lens that blurs: see ``drgs.defocus``
    shutter: Any = None  # of a camera that moves while it is open: see ``drgs.shutter``

    @staticmethod
    def create(
        float_type: type,
        rotation: np.ndarray,
        center: np.ndarray,
        K: np.ndarray,
        width: int,
        height: int,
        near: float,
        lens: Lens = Pinhole(),
    ) -> Camera:
        """Upload a camera given as numpy arrays: rotation (3, 3), center (3,), K (3, 3) px."""
        t = types_of(float_type)
        rotation, center, K = (np.asarray(a, dtype=np.float64) for a in (rotation, center, K))

        def scalar(value: float) -> Any:
            return dr.opaque(float_type, float(value))

        camera = Camera(
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
        return camera.with_lens(lens)

    def look_through(self, x: Any, y: Any) -> tuple[Any, Any, Any]:
        """The ray through a place of the film (px): its origin, its direction, if it is one.

        Origin and direction (of any length) are Array3f in camera axes. A lens shows nothing at
        places where its model ends: what it looks for is then found elsewhere.
        """
        direction = self.lens.ray(self, x, y)
        origin = self.lens.origin(self, x, y)
        if not self.lens.distorts:
            return origin, direction, True
        seen, _, _ = self.lens.look(replace(self, near=type(self.near)(0)), direction)
        t = types_of(type(self.near))
        missed = self.lens.film_point(self, direction) - t.Array2f(x, y)
        return origin, direction, seen & (dr.squared_norm(missed) < MISSED**2)

    def at_row(self, y: Any) -> Camera:
        """Where a camera is whose rows are read one after the other, when it reads that of y, px.

        One that does not move is as it is.
        """
        if self.shutter is None:
            return self
        row = (y - self.film_start.y) / (self.film_end.y - self.film_start.y)
        return self.shutter.pose(self, row)

    def numbers(self) -> list[Any]:
        """Pose, focal lengths, principal point and lens as Float of one entry, in a fixed order."""
        return [n for name in _DIFFERENTIABLE for n in _numbers_of(getattr(self, name))]

    def by_lane(self, width: int) -> Camera:
        """The same camera with these numbers stored for each of ``width`` lanes.

        Derivatives of each lane's are then known apart, and can be summed in a fixed order.
        """
        lanes = dr.zeros(types_of(type(self.near)).UInt32, width)
        return replace(
            self, **{name: _gathered(getattr(self, name), lanes) for name in _DIFFERENTIABLE}
        )

    def with_lens(self, lens: Lens) -> Camera:
        """The same camera with another lens."""
        return replace(self, lens=lens.upload(type(self.near)).fitted(self))


_DIFFERENTIABLE = ("rotation", "center", "focal", "principal", "lens", "aperture", "shutter")


def _numbers_of(value: Any) -> list[Any]:
    if is_dataclass(value):
        return [n for f in fields(value) for n in _numbers_of(getattr(value, f.name))]
    if isinstance(value, tuple) or (dr.is_array_v(value) and dr.depth_v(value) > 1):
        return [n for item in value for n in _numbers_of(item)]
    return [value] if dr.is_array_v(value) else []


def _gathered(value: Any, lanes: Any) -> Any:
    if is_dataclass(value):
        changes = {f.name: _gathered(getattr(value, f.name), lanes) for f in fields(value)}
        return replace(value, **changes)
    if isinstance(value, tuple):
        return tuple(_gathered(item, lanes) for item in value)
    return dr.gather(type(value), value, lanes) if dr.is_array_v(value) else value


@dataclass(frozen=True)
class SensorState:
    """All that the camera of a Mitsuba sensor depends on, film and crop included.

    Holding it keeps the variables of ``device`` alive, so that equal indices mean equal values.
    """

    device: dict[str, Any]  # numbers on the device, by the names that Mitsuba gives them
    host: tuple[float, ...]  # film width and height, crop offset x and y, crop size, near
    make: Callable[[SensorState], Camera]

    @property
    def is_attached(self) -> bool:
        """Whether derivatives with respect to one of the sensor's parameters are asked for."""
        return any(dr.grad_enabled(value) for value in self.device.values())

    def detached(self) -> SensorState:
        """The same without derivatives."""
        return replace(self, device=dr.detach(self.device))

    def same_as(self, other: SensorState) -> bool:
        """Whether both give the same camera."""
        indices = dr.detail.collect_indices
        return (
            self.make == other.make
            and self.host == other.host
            and indices(self.device) == indices(other.device)
        )


def read_sensor(sensor: Any, near: float) -> SensorState:
    """Collect a sensor's state without reading anything back from the device.

    near: near plane, scene units; the sensor's ``near_clip`` applies as well, the larger wins.

    Raises TypeError for a sensor that is none of ``perspective``, ``thinlens``, ``orthographic``
    and ``calibrated``.
    """
    import mitsuba as mi

    if hasattr(sensor, "lens"):  # ours: see ``plugins/calibrated.py``
        names, make = sensor.camera_parameters, sensor.camera_from_state
    elif isinstance(sensor, mi.ProjectiveCamera):
        names, make = _PROJECTIVE[sensor.class_name()]
    else:
        raise TypeError(
            "splats: the sensor must be of type perspective, thinlens, orthographic or "
            f"calibrated, got {sensor.class_name()} '{sensor.id()}'"
        )
    params = mi.traverse(sensor)
    device = {name: params[name] for name in names}
    device = {k: v.matrix if k.startswith("to_world") else v for k, v in device.items()}
    film = sensor.film()
    host = (*film.size(), *film.crop_offset(), *film.crop_size(), max(near, sensor.near_clip()))
    return SensorState(device=device, host=host, make=make)


def camera_from_sensor(state: SensorState) -> Camera:
    """The camera of a Mitsuba sensor's crop window, detached.

    ``state.make(state)`` is the one that Dr.Jit differentiates in the sensor's parameters.
    """
    state = state.detached()
    dr.make_opaque(state.device)  # or each value of a literal would be a new kernel
    camera = state.make(state)
    dr.make_opaque(camera)
    return camera


IGNORABLE = ("distortion", "defocus", "motion", "smoothing")
"""What a sensor or a file calls for and one may decide not to simulate; the last is no camera's."""


def without(camera: Camera, ignored: Collection[str]) -> Camera:
    """A camera of which some is not simulated: ``distortion``, ``defocus``, ``motion``."""
    if "distortion" in ignored and camera.lens.distorts:
        camera = replace(camera, lens=Pinhole())
    if "defocus" in ignored:
        camera = replace(camera, aperture=None)
    if "motion" in ignored:
        camera = replace(camera, shutter=None)
    return camera


def cameras_in_time(camera: Camera) -> list[Camera]:
    """The cameras whose pictures are averaged: one unless it is blurred by motion."""
    times = getattr(camera.shutter, "times", None)
    return [camera] if times is None else [camera.shutter.pose(camera, t) for t in times()]


def _perspective(state: SensorState) -> Camera:
    """Of type ``perspective``; a thin lens has no offsets of the principal point."""
    width, height, *_ = host = opaque_host(state)
    device = state.device
    # x_fov is the horizontal field of view of the whole film, whatever 'fov_axis' was given.
    focal = width / (2 * dr.tan(dr.deg2rad(device["x_fov"]) / 2))
    offset_x = device.get("principal_point_offset_x", 0)
    offset_y = device.get("principal_point_offset_y", 0)
    principal = (width / 2 - offset_x * width, height / 2 - offset_y * height)
    return on_crop_window(state, host, device["to_world"], (focal, focal), principal)


def _thin_lens(state: SensorState) -> Camera:
    """Of type ``thinlens``: what is not at the focus distance is blurred."""
    from drgs.lenses import Aperture

    device = state.device
    scales = axis_lengths(device["to_world"])
    aperture = Aperture(device["aperture_radius"] * scales[0], device["focus_distance"] * scales[2])
    return replace(_perspective(state), aperture=aperture)


def _orthographic(state: SensorState) -> Camera:
    """Of type ``orthographic``: its film is 2 units of its own wide."""
    from drgs.lenses import Orthographic

    width, height, *_ = host = opaque_host(state)
    scale_x, scale_y, _ = axis_lengths(state.device["to_world"])
    focal = (width / (2 * scale_x), width / (2 * scale_y))
    camera = on_crop_window(state, host, state.device["to_world"], focal, (width / 2, height / 2))
    return camera.with_lens(Orthographic())


_PROJECTIVE = {
    "PerspectiveCamera": (
        ("to_world", "x_fov", "principal_point_offset_x", "principal_point_offset_y"),
        _perspective,
    ),
    "ThinLensCamera": (("to_world", "x_fov", "aperture_radius", "focus_distance"), _thin_lens),
    "OrthographicCamera": (("to_world",), _orthographic),
}
"""By Mitsuba's class: the parameters that the camera depends on, and who makes it."""


def opaque_host(state: SensorState) -> list[Any]:
    """The numbers of the host on the device.

    None may be compiled into a kernel: each film, crop or view would compile its own.
    """
    Float = type(state.device["to_world"][0, 0])
    return [dr.opaque(Float, value) for value in state.host]


def on_crop_window(
    state: SensorState, host: list[Any], to_world: Any, focal: Any, principal: Any
) -> Camera:
    """A camera of the crop window of a film.

    to_world: 4 x 4, from Mitsuba's camera axes; focal and principal: pairs, px, of the whole film.
    """
    width, height, crop_x, crop_y, *_, near = host
    *_, crop_width, crop_height, _ = state.host
    t = types_of(type(near))
    rotation, center = pose_from_to_world(to_world)
    return Camera(
        rotation=rotation,
        center=center,
        focal=t.Array2f(*focal),
        principal=t.Array2f(principal[0] - crop_x, principal[1] - crop_y),
        film_start=t.Array2f(-crop_x, -crop_y),
        film_end=t.Array2f(width - crop_x, height - crop_y),
        near=near,
        width=int(crop_width),
        height=int(crop_height),
    )


def pose_from_to_world(to_world: Any) -> tuple[Any, Any]:
    """Rotation (world to camera, OpenCV axes) and centre of Mitsuba's 4 x 4 ``to_world``.

    Mitsuba's camera has x to the left and y up, OpenCV's x to the right and y down. A camera has
    no unit of length: if ``to_world`` scales, its axes are normalised.
    """
    right, down, forward, center = _columns(to_world)
    t = types_of(type(center.x))
    axes = [list(dr.normalize(axis)) for axis in (-right, -down, forward)]
    return t.Matrix3f(axes), center


def axis_lengths(to_world: Any) -> list[Any]:
    """World units in a unit of the camera, by axis."""
    return [dr.norm(column) for column in _columns(to_world)[:3]]


def _columns(matrix: Any) -> list[Any]:
    t = types_of(type(matrix[0, 0]))
    return [t.Array3f([matrix[row, column] for row in range(3)]) for column in range(4)]
