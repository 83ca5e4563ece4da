"""Parallel rays: Mitsuba's ``orthographic``.

Imported when a sensor has them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from drgs.cameras.camera import Camera, Lens, with_unseen_on_axis
from drgs.core.arrays import types_of


@dataclass(frozen=True)
class Orthographic(Lens):
    """A point (x, y, z) is seen at focal (x, y) + principal, with focal in px per scene unit.

    All rays are parallel: colours are seen along the camera's axis.
    """

    label: ClassVar[str] = "Orthographic"
    parallel: ClassVar[bool] = True

    def look(self, camera: Camera, position: Any) -> tuple[Any, Any, Any]:
        """Whether a mean is seen, its position, and its depth."""
        return with_unseen_on_axis(position, position.z >= camera.near)

    def true_slopes(self, camera: Camera, position: Any) -> None:
        """None: the projection is linear."""
        del camera, position

    clamped_slopes = true_slopes

    def film_point(self, camera: Camera, position: Any) -> Any:
        """Where a point is on the film, Array2f, px."""
        x, y, _ = position
        return camera.focal * types_of(type(x)).Array2f(x, y) + camera.principal

    def film_directions(self, camera: Camera, position: Any, slopes: None) -> list[Any]:
        """Derivatives of the place on the film, two Array3f, world."""
        del position, slopes
        right, down, _ = camera.rotation
        return [right * camera.focal.x, down * camera.focal.y]

    def depth_direction(self, camera: Camera, position: Any) -> Any:
        """Derivative of the depth divided by the depth, Array3f, world."""
        return camera.rotation[2] / position.z

    def view_direction(self, camera: Camera, offset: Any) -> Any:
        """In which a mean is seen: that of the axis."""
        del offset
        return camera.rotation[2]

    def ray(self, camera: Camera, x: Any, y: Any) -> Any:
        """The direction of the ray through a point of the film, Array3f, camera axes."""
        del camera, y
        return types_of(type(x)).Array3f(0, 0, 1)

    def origin(self, camera: Camera, x: Any, y: Any) -> Any:
        """Where the ray through a point of the film (px) begins, Array3f, camera axes."""
        t = types_of(type(x))
        film = (t.Array2f(x, y) - camera.principal) / camera.focal
        return t.Array3f(film.x, film.y, 0)

    def place_of_ray(self, camera: Camera, origin: Any, direction: Any) -> Any:
        """Where on the film a ray (Array3f, camera axes) begins, Array2f, px."""
        del direction
        return self.film_point(camera, origin)

    def ray_range(self, direction: Any, near: Any, far: Any) -> tuple[Any, Any]:
        """Where a ray of unit ``direction`` (camera axes) reaches two depths."""
        return near / direction.z, far / direction.z
