"""Cameras of the projection from Mitsuba's sensors, and images of several sensors side by side."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Protocol, runtime_checkable

import drjit as dr
import mitsuba as mi
from typing_extensions import override

from drgs.cameras.camera import Aperture, Camera, cameras_in_time
from drgs.core.arrays import types_of
from drgs.core.errors import PluginError, PluginTypeError
from drgs.core.types import Array3f, Float, Matrix3f, Matrix4f
from drgs.effects.compose import without_effects
from drgs.integrator.film import Channels, SamplePoints
from drgs.splatting.footprint import SamplePositions

Pair = tuple[Float, Float]  # numbers along the two sides of the film


@dataclass(frozen=True)
class SensorState:
    """State that the camera of a Mitsuba sensor depends on, film and crop included.

    Holding it keeps the variables of ``device`` alive, so that equal indices mean equal values.
    """

    device: dict[str, Any]  # arrays on the device, by the names that Mitsuba gives them
    host: tuple[float, ...]  # film width and height, crop offset x and y, crop size, near
    make: Callable[[SensorState], Camera]

    @property
    def is_attached(self) -> bool:
        """True if one of the sensor's parameters is attached."""
        return any(dr.grad_enabled(value) for value in self.device.values())

    def detach(self) -> SensorState:
        """Return a detached copy."""
        return replace(self, device=dr.detach(self.device))

    @property
    def settings(self) -> tuple[object, ...]:
        """State besides the device's numbers, compared by ==."""
        return self.make, self.host


@runtime_checkable
class CameraSensor(Protocol):
    """A sensor that makes its camera itself: ``calibrated``, a class of each variant."""

    def camera_parameters(self) -> list[str]:
        """Return the parameters that the camera depends on, named as by ``mi.traverse``."""
        ...

    def camera_from_state(self, state: SensorState) -> Camera:
        """Return the camera with these values of its parameters; OpenCV axes, px."""
        ...

    def num_poses(self) -> int:
        """Return the number of poses whose images are averaged: 1 unless motion blurs them."""
        ...

    def near_clip(self) -> float:
        """Return the near clip distance, scene units."""
        ...

    def far_clip(self) -> float:
        """Return the far clip distance, scene units."""
        ...


def num_poses(sensor: mi.Sensor) -> int:
    """Return the number of poses whose images are averaged: 1 unless motion blurs them."""
    return sensor.num_poses() if isinstance(sensor, CameraSensor) else 1


def is_batch(sensor: mi.Sensor) -> bool:
    """Return whether a sensor is a ``batch``, which has no type in Python."""
    return sensor.class_name() == "BatchSensor"


def sensors_of(sensor: mi.Sensor) -> list[mi.Sensor]:
    """Return the sensors of a batch, or the one."""
    if not is_batch(sensor):
        return [sensor]
    return SideBySide.from_batch(sensor).sensors


def depth_range(sensor: mi.Sensor) -> tuple[float, float]:
    """Return the depths of a sensor's near and far plane, scene units.

    Raises PluginTypeError for a sensor that is none of ``perspective``, ``thinlens``,
    ``orthographic`` and ``calibrated``.
    """
    if isinstance(sensor, (CameraSensor, mi.ProjectiveCamera)):
        return sensor.near_clip(), sensor.far_clip()
    raise PluginTypeError(
        "splats: the sensor must be of type perspective, thinlens, orthographic or "
        f"calibrated, got {sensor.class_name()} '{sensor.id()}'"
    )


def read_sensor(sensor: mi.Sensor, near: float) -> SensorState:
    """Collect a sensor's state without reading anything back from the device.

    near: scene units; the larger of it and ``near_clip`` applies. Raises as :func:`depth_range`.
    """
    near_clip, _ = depth_range(sensor)
    if isinstance(sensor, CameraSensor):
        names, make = sensor.camera_parameters(), sensor.camera_from_state
    else:
        names, make = _PROJECTIVE[sensor.class_name()]
    params = mi.traverse(sensor)
    device: dict[str, Any] = {name: params[name] for name in names}
    device = {k: v.matrix if k.startswith("to_world") else v for k, v in device.items()}
    film = sensor.film()
    host = (*film.size(), *film.crop_offset(), *film.crop_size(), max(near, near_clip))
    return SensorState(device=device, host=host, make=make)


def camera_from_sensor(state: SensorState) -> Camera:
    """Create the camera of a crop window, detached; ``state.make(state)`` is differentiable."""
    state = state.detach()
    dr.make_opaque(state.device)  # or each value of a literal would be a new kernel
    camera = state.make(state)
    dr.make_opaque(camera)
    return camera


def accumulate_in_sensor(cameras: Sequence[Camera], gradients: list[list[Float]]) -> None:
    """Accumulate derivatives by ``Camera.numbers()``, by time; see :func:`attached_cameras`."""
    pairs = zip(chain(*(camera.numbers() for camera in cameras)), chain(*gradients), strict=True)
    attached = [(value, gradient) for value, gradient in pairs if dr.grad_enabled(value)]
    for value, gradient in attached:
        dr.accum_grad(value, gradient)
    dr.enqueue(dr.ADMode.Backward, [value for value, _ in attached])
    dr.traverse(dr.ADMode.Backward, flags=dr.ADFlag.ClearVertices)


def attached_cameras(
    state: SensorState, ignored: Collection[str], samples: int | None = None
) -> list[Camera]:
    """Return the cameras of a sensor with its derivatives; samples: of an open shutter."""
    dr.make_opaque(state.device)  # or each value of a literal would be a new kernel
    return cameras_in_time(without_effects(state.make(state), ignored), samples)


def _perspective(state: SensorState) -> Camera:
    width, height, *_ = host = opaque_host(state)
    device = state.device
    # x_fov is the horizontal field of view of the whole film, whatever 'fov_axis' was given.
    focal = width / (2 * dr.tan(dr.deg2rad(device["x_fov"]) / 2))
    offset_x = device.get("principal_point_offset_x", 0)
    offset_y = device.get("principal_point_offset_y", 0)
    principal = (width / 2 - offset_x * width, height / 2 - offset_y * height)
    return on_crop_window(state, host, device["to_world"], (focal, focal), principal)


def _thin_lens(state: SensorState) -> Camera:
    device = state.device
    scales = axis_lengths(device["to_world"])
    aperture = Aperture(device["aperture_radius"] * scales[0], device["focus_distance"] * scales[2])
    return replace(_perspective(state), aperture=aperture)


def _orthographic(state: SensorState) -> Camera:
    from drgs.cameras.orthographic import Orthographic

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
"""Parameters of a camera and the function that makes it, by the class name: it has no type."""


def opaque_host(state: SensorState) -> list[Float]:
    """Move the host's numbers to the device: as literals, each film would compile its kernels."""
    Float = type(state.device["to_world"][0, 0])
    return [dr.opaque(Float, value) for value in state.host]


def on_crop_window(
    state: SensorState, host: list[Float], to_world: Matrix4f, focal: Pair, principal: Pair
) -> Camera:
    """Create a crop window's camera; to_world: Mitsuba's; focal, principal: the whole film's px."""
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


def pose_from_to_world(to_world: Matrix4f) -> tuple[Matrix3f, Array3f]:
    """Return rotation (world to camera, OpenCV axes) and centre of Mitsuba's ``to_world``.

    Mitsuba's camera has x to the left and y up, OpenCV's x to the right and y down. A camera has
    no unit of length: if ``to_world`` scales, its axes are normalised.
    """
    right, down, forward, center = _columns(to_world)
    t = types_of(type(center.x))
    return t.Matrix3f([list(dr.normalize(axis)) for axis in (-right, -down, forward)]), center


def axis_lengths(to_world: Matrix4f) -> list[Float]:
    """Return the world units in a unit of the camera, by axis."""
    return [dr.norm(column) for column in _columns(to_world)[:3]]


def _columns(matrix: Matrix4f) -> list[Array3f]:
    t = types_of(type(matrix[0, 0]))
    return [t.Array3f([matrix[row, column] for row in range(3)]) for column in range(4)]


@dataclass(frozen=True)
class SideBySide:
    """The sensors of a batch, with images of one size (px) side by side."""

    sensors: list[mi.Sensor]  # may contain one several times
    width: int
    height: int

    @staticmethod
    def from_batch(batch: mi.Sensor) -> SideBySide:
        """Read a batch; PluginError if its film has a crop window."""
        sensors, film = _children(batch), batch.film()
        if list(film.crop_size()) != list(film.size()):
            raise PluginError("splats: the film of a batch sensor must not have a crop window")
        return SideBySide(sensors, film.size()[0] // len(sensors), film.size()[1])

    def positions(
        self, positions: Sequence[SamplePositions], index: int
    ) -> tuple[SamplePositions, ...]:
        """Return the sample positions of one image, by pass."""
        return tuple(
            replace(p, x=self._cut(p.x, index), y=self._cut(p.y, index))
            if isinstance(p, SamplePoints)
            else p
            for p in positions
        )

    def cut(self, passes: Sequence[Channels], index: int) -> list[Channels]:
        """Return one image's part of the film's channels, by pass."""
        return [[self._cut(plane, index) for plane in channels] for channels in passes]

    def concatenate(self, images: Sequence[Sequence[Channels]]) -> list[Channels]:
        """Return the film's channels, by pass; images: by sensor, each by pass."""
        return [
            [self._concatenate(planes) for planes in zip(*of_pass, strict=True)]
            for of_pass in zip(*images, strict=True)
        ]

    def _cut(self, plane: mi.Float, index: int) -> mi.Float:
        pixel = dr.arange(mi.UInt32, dr.width(plane) // len(self.sensors))
        row = pixel // dr.opaque(mi.UInt32, self.width)
        place = pixel + row * ((len(self.sensors) - 1) * self.width) + index * self.width
        return dr.gather(mi.Float, plane, place, mode=dr.ReduceMode.Permute)

    def _concatenate(self, planes: Sequence[mi.Float]) -> mi.Float:
        whole = len(self.sensors) * self.width
        pixel = dr.arange(mi.UInt32, len(planes) * dr.width(planes[0]))
        row = pixel // dr.opaque(mi.UInt32, whole)
        column = pixel - row * whole
        sensor = column // dr.opaque(mi.UInt32, self.width)
        place = row * self.width + column - sensor * self.width
        # Each pixel is read once, so that derivatives are written, not added.
        parts = [
            dr.gather(mi.Float, plane, place, sensor == k, mode=dr.ReduceMode.Permute)
            for k, plane in enumerate(planes)
        ]
        return sum(parts[1:], parts[0])


def _children(batch: mi.Sensor) -> list[mi.Sensor]:
    """Return the sensors of a batch in their order; ``mi.traverse`` names each once."""

    class Children(mi.TraversalCallback):  # of the variant that is set
        @override
        def put(self, name: str, value: object, flags: int, cpptype: object = None) -> None:
            del name, flags, cpptype
            if isinstance(value, mi.Sensor):
                sensors.append(value)

    sensors: list[mi.Sensor] = []
    batch.traverse(Children())
    return sensors
