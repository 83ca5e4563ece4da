"""A camera that moves while its shutter is open: motion blur and rolling shutter.

Time runs from 0, at the camera's pose, to 1, at the second pose: the centre moves on a line, and
the camera turns at a constant rate.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import drjit as dr
from typing_extensions import override

from drgs.cameras.camera import Camera, RowReading, Shutter
from drgs.core.arrays import types_of
from drgs.core.types import Array3f, Bool, Float, Matrix3f, Scalar

NEWTON_STEPS = 3
"""Steps of the search for a splat's time: pixels move little while the film is read."""

MAX_ROW_RATE = 0.5
"""Rows per row: where points run away from a rolling shutter as fast as it reads, they have no time
at which they are read. Faster ones are taken as still."""

MARGIN = 0.5  # of the time of all rows: the motion of splats beside the film goes on for it

MIN_TURN_RAD = 1e-4
"""Radians: turns below this are composed by their series, the formulas being 0 / 0 at 0."""


@dataclass(frozen=True)
class Motion(Shutter):
    """The motion of a camera from the first pose to the second while its shutter is open."""

    travel: Array3f  # world: of the centre
    turn: Array3f  # camera axes: axis times angle (radians), below half a turn

    @staticmethod
    def relative_motion(
        camera: Camera, rotation: Matrix3f, center: Array3f
    ) -> tuple[Array3f, Array3f]:
        """Return ``travel`` and ``turn`` to a pose; rotation: world to camera; center: world."""
        return center - camera.center, rotation_vector(rotation @ camera.rotation.T)

    @override
    def pose(self, camera: Camera, time: Scalar) -> Camera:
        return replace(
            camera,
            rotation=rotation_matrix(self.turn * time) @ camera.rotation,
            center=camera.center + self.travel * time,
            shutter=None,
        )

    @override
    def in_axes(self, rotation: Matrix3f) -> Motion:
        return replace(self, travel=rotation @ self.travel)

    def velocity(self, camera: Camera, offset: Array3f) -> Array3f:
        """Return the velocity of a point relative to the camera, camera axes, per unit of time.

        camera: at the time in question; offset: from its centre to the point, world.
        """
        return dr.cross(self.turn, camera.rotation @ offset) - camera.rotation @ self.travel


@dataclass(frozen=True)
class MotionBlur(Motion):
    """The mean of images at ``samples`` times."""

    label: ClassVar[str] = "blurred"

    samples: int

    @override
    def cameras(self, camera: Camera, samples: int | None) -> list[Camera]:
        count = samples or self.samples
        # In the middle of equal intervals of time.
        return [self.pose(camera, (k + 0.5) / count) for k in range(count)]


@dataclass(frozen=True)
class RollingShutter(Motion):
    """The film's rows are read from the first, at time 0, to the last, at time 1."""

    label: ClassVar[str] = "rolling shutter"
    reads_rows: ClassVar[bool] = True

    @override
    def camera_of(self, means: Array3f, camera: Camera) -> Camera:
        """Return the camera when it reads the row of the film that shows a mean.

        The time is that of the row on which the mean is seen then, by Newton's method, of which the
        last step is differentiated (the implicit function theorem); before the first and after the
        last row, the motion goes on for :data:`MARGIN`. Other points of a splat are read at other
        times: see ``drgs.effects.rolling_shutter``, which uses the ``reading`` of the result.
        """
        still = dr.detach((means, camera))
        time = dr.full(type(means.x), 0.5, dr.width(means))
        for _ in range(NEWTON_STEPS):
            time, _ = self._step(*still, time)
            time = dr.clip(time, -MARGIN, 1 + MARGIN)
        moved, inside = self._step(means, camera, dr.detach(time))
        time = dr.select(inside, moved, time)
        at = self.pose(camera, time)
        velocity = dr.select(inside, self.velocity(at, means - at.center), 0)
        travel = camera.rotation @ (self.travel * time)
        return replace(at, reading=RowReading(velocity, rotation_matrix(self.turn * time), travel))

    def _step(self, means: Array3f, camera: Camera, time: Float) -> tuple[Float, Bool]:
        """Take a step of Newton's method; return the time, and whether it is on the film."""
        at = self.pose(camera, time)
        offset = means - at.center
        seen, position, _ = at.lens.visibility(at, at.rotation @ offset)
        height = camera.film_end.y - camera.film_start.y
        row = (at.lens.project_point(at, position).y - camera.film_start.y) / height
        with dr.suspend_grad():
            _, down = at.lens.projection_jacobian(at.in_own_axes(), position)
            rate = dr.dot(down, self.velocity(at, offset)) / height
            rate = dr.select(seen & (rate < MAX_ROW_RATE), rate, 0)
        moved = time + (row - time) / (1 - rate)
        return moved, seen & (moved > -MARGIN) & (moved < 1 + MARGIN)


def rotation_vector(rotation: Matrix3f) -> Array3f:
    """Return axis times angle, radians, of a rotation by less than half a turn."""
    t = types_of(type(rotation[0, 0]))
    twice_sine = t.Array3f(
        rotation[2, 1] - rotation[1, 2],
        rotation[0, 2] - rotation[2, 0],
        rotation[1, 0] - rotation[0, 1],
    )
    squared = dr.squared_norm(twice_sine)
    trace = rotation[0, 0] + rotation[1, 1] + rotation[2, 2]
    turns = (squared > (2 * MIN_TURN_RAD) ** 2) | (trace < 1)
    sine = dr.sqrt(dr.select(turns, squared, 1)) / 2
    angle = dr.atan2(sine, (trace - 1) / 2)
    return twice_sine * dr.select(turns, angle / (2 * sine), 0.5)


def rotation_matrix(turn: Array3f) -> Matrix3f:
    """Return the rotation matrix of axis times angle, radians (Rodrigues)."""
    t = types_of(type(turn.x))
    squared = dr.squared_norm(turn)
    turns = squared > MIN_TURN_RAD**2
    angle = dr.sqrt(dr.select(turns, squared, 1))
    a = dr.select(turns, dr.sin(angle) / angle, 1 - squared / 6)
    # (1 - cos) / angle^2, which cancels for small angles.
    half = dr.sin(angle / 2) / angle
    b = dr.select(turns, 2 * half * half, 0.5)
    x, y, z = turn
    return t.Matrix3f(
        [
            [1 - b * (y * y + z * z), b * (x * y) - a * z, b * (x * z) + a * y],
            [b * (x * y) + a * z, 1 - b * (x * x + z * z), b * (y * z) - a * x],
            [b * (x * z) - a * y, b * (y * z) + a * x, 1 - b * (x * x + y * y)],
        ]
    )
