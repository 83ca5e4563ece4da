"""Splats that a rolling shutter shears and stretches: a stage of the projection.

A splat is projected at the time when the row of its mean is read. A point that is dy rows below is
read dy / height later, when it has moved by v dy / height with the velocity v on the film, px. An
offset d from the mean is therefore read at A d, and the covariance C becomes A C A^T, with

    A = (I - v e_y^T / height)^-1,  U A^-1 = [[p, (1 - v_y / height) r - v_x / height p],
                                              [0, (1 - v_y / height) s]]
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr

from drgs.cameras.camera import Camera
from drgs.cameras.motion import MAX_ROW_RATE
from drgs.core.types import Array3f, Float
from drgs.splatting.projection import FilmProjection, FilmShape, GaussianRows


@dataclass(frozen=True)
class Sheared:
    """A projection, read row after row."""

    shape: FilmProjection

    def __call__(
        self, rows: GaussianRows, camera: Camera, position: Array3f, low_pass: Float | float
    ) -> FilmShape:
        """Return the sheared shape; the opacity is that of the still splat."""
        film = self.shape(rows, camera, position, low_pass)
        assert camera.reading is not None, "as RollingShutter.camera_of makes it"
        slopes = camera.lens.clamped_slopes(camera, position)
        jacobian = camera.lens.projection_jacobian(camera.in_own_axes(), position, slopes)
        height = camera.film_end.y - camera.film_start.y
        drift, rate = (dr.dot(row, camera.reading.velocity) / height for row in jacobian)
        can_be_read = rate < MAX_ROW_RATE
        drift, rate = dr.select(can_be_read, drift, 0), dr.select(can_be_read, rate, 0)
        p, r, s = film.conic_factor
        r, s = dr.fma(-drift, p, (1 - rate) * r), (1 - rate) * s
        # The mean of a projection may not be the place of the Gaussian's.
        place = camera.lens.project_point(camera, position)
        moved_x, moved_y = camera.lens.offset(camera, place, film.means2d)
        moved_y = moved_y / (1 - rate)
        Array2f = type(film.means2d)
        means2d = place + Array2f(dr.fma(drift, moved_y, moved_x), moved_y)
        conic_factor = type(film.conic_factor)(p, r, s)
        variances = Array2f((1 + dr.square(r / s)) / dr.square(p), 1 / dr.square(s))
        return replace(film, means2d=means2d, conic_factor=conic_factor, variances=variances)
