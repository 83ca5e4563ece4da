"""Parallel rays: Mitsuba's ``orthographic``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from drgs.cameras.lens import (
    CameraParameters,
    Perspective,
    film_coordinates,
    pixel_coordinates,
    with_unseen_on_axis,
)
from drgs.core.arrays import types_of


@dataclass(frozen=True)
class Orthographic(Perspective):
    """A point (x, y, z) is seen at focal (x, y) + principal, with focal in px per scene unit."""

    distorts: ClassVar[bool] = False
    parallel: ClassVar[bool] = True

    def visibility(self, camera: CameraParameters, position: Any) -> tuple[Any, Any, Any]:
        """Return whether a point is seen, its position, and its depth."""
        return with_unseen_on_axis(position, position.z >= camera.near)

    def true_slopes(self, camera: CameraParameters, position: Any) -> None:
        """Return None: the projection is linear."""

    clamped_slopes = true_slopes

    def project_point(self, camera: CameraParameters, position: Any) -> Any:
        """Return the place of a point on the film, Array2f, px."""
        return pixel_coordinates(camera, position.x, position.y)

    def projection_jacobian(
        self, camera: CameraParameters, position: Any, slopes: None = None
    ) -> list[Any]:
        """Return the derivatives of the place on the film, two Array3f, world."""
        right, down, _ = camera.rotation
        return [right * camera.focal.x, down * camera.focal.y]

    def view_direction(self, camera: CameraParameters, offset: Any) -> Any:
        """Return the axis: all points are seen along it."""
        return camera.rotation[2]

    def ray(self, camera: CameraParameters, x: Any, y: Any) -> Any:
        """Return the direction of the ray through a place of the film, Array3f, camera axes."""
        return types_of(type(x)).Array3f(0, 0, 1)

    def origin(self, camera: CameraParameters, x: Any, y: Any) -> Any:
        """Return where the ray through a place of the film (px) begins, Array3f, camera axes."""
        film = film_coordinates(camera, x, y)
        return types_of(type(x)).Array3f(film.x, film.y, 0)

    def place_of_ray(self, camera: CameraParameters, origin: Any, direction: Any) -> Any:
        """Return the place on the film of a ray (Array3f, camera axes), Array2f, px."""
        return self.project_point(camera, origin)
