"""Parallel rays: Mitsuba's ``orthographic``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from typing_extensions import override

from drgs.cameras.lens import (
    CameraParameters,
    Perspective,
    film_coordinates,
    pixel_coordinates,
    with_unseen_on_axis,
)
from drgs.core.arrays import types_of
from drgs.core.types import Array2f, Array3f, Bool, Float


@dataclass(frozen=True)
class Orthographic(Perspective):
    """A point (x, y, z) is seen at focal (x, y) + principal, with focal in px per scene unit."""

    distorts: ClassVar[bool] = False
    parallel: ClassVar[bool] = True

    @override
    def visibility(
        self, camera: CameraParameters, position: Array3f
    ) -> tuple[Bool, Array3f, Float]:
        return with_unseen_on_axis(position, position.z >= camera.near)

    @override
    def true_slopes(self, camera: CameraParameters, position: Array3f) -> None:
        """Return None: the projection is linear."""

    clamped_slopes = true_slopes

    @override
    def project_point(self, camera: CameraParameters, position: Array3f) -> Array2f:
        return pixel_coordinates(camera, position.x, position.y)

    @override
    def projection_jacobian(
        self, camera: CameraParameters, position: Array3f, slopes: list[Float] | None = None
    ) -> list[Array3f]:
        right, down, _ = camera.rotation
        return [right * camera.focal.x, down * camera.focal.y]

    @override
    def view_direction(self, camera: CameraParameters, offset: Array3f) -> Array3f:
        """Return the axis: all points are seen along it."""
        return camera.rotation[2]

    @override
    def ray(self, camera: CameraParameters, x: Float, y: Float) -> Array3f:
        return types_of(type(x)).Array3f(0, 0, 1)

    @override
    def origin(self, camera: CameraParameters, x: Float, y: Float) -> Array3f:
        film = film_coordinates(camera, x, y)
        return types_of(type(x)).Array3f(film.x, film.y, 0)

    @override
    def place_of_ray(
        self, camera: CameraParameters, origin: Array3f, direction: Array3f
    ) -> Array2f:
        return self.project_point(camera, origin)
