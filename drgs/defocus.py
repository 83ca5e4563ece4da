"""Depth of field: what is out of focus is blurred, as a thin lens blurs it.

Layer 2, imported when a camera has an aperture. A point is spread over a disc; here the disc's
variance is added to the splat's covariance on the film, and its opacity falls such that its
integral stays. What a picture by many rays shows beyond that, such as what is seen past the blurred
edge of something near, needs the rays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr

from drgs.camera import Camera
from drgs.projection import FilmShape, GaussianRows


@dataclass(frozen=True)
class Defocused:
    """A projection (see ``drgs.projection.ewa``), blurred by the camera's aperture."""

    shape: Callable

    def __call__(
        self, rows: GaussianRows, camera: Camera, position: Any, low_pass: float
    ) -> FilmShape:
        """The blurred shape; its ``dimming`` keeps the integral. ``sharp`` and ``added`` are those
        of the low-pass alone.
        """
        film = self.shape(rows, camera, position, low_pass)
        spread = camera.aperture.variance(camera, position.z)
        blurred = self.shape(rows, camera, position, low_pass + spread)
        return replace(
            blurred,
            sharp=film.sharp,
            added=film.added,
            dimming=_root_determinant(blurred) / _root_determinant(film),
        )


def _root_determinant(film: FilmShape) -> Any:
    """sqrt(det(conic)) at the mean.

    The whitening of ``drgs.perspective`` is divided by |a_c|, whose inverse is its fourth number.
    """
    p, _, s = film.whitening
    if film.perspective is not None and len(film.perspective) > 3:
        p, s = p / film.perspective[3], s / film.perspective[3]
    return dr.abs(p * s)
