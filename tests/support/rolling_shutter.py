"""The image of a rolling shutter, by the float64 reference."""

from __future__ import annotations

from unittest import mock

import numpy as np
from scipy.optimize import brentq

from drgs.reference import effects
from drgs.reference import splatting as reference


def row_time(camera_at, lens, mean) -> float:
    """When the row that shows a mean is read: the root of its row less the time."""

    def behind(time) -> float:
        camera = camera_at(time)
        point = (mean - camera.center) @ camera.rotation.T
        return lens.film_points(camera, point[None])[0, 1] / camera.height - time

    if behind(0) <= 0:
        return 0.0
    return 1.0 if behind(1) >= 0 else brentq(behind, 0, 1, xtol=1e-15, rtol=1e-14)


def rolling_image(gaussians, camera_at, lens, degree, threshold_width) -> reference.RenderedImage:
    """Each splat as a whole at the time of its mean, on black; camera_at: the camera at a time."""
    cameras = [camera_at(row_time(camera_at, lens, mean)) for mean in gaussians.means]
    pairs = [
        (reference.Gaussians(*(values[k : k + 1] for values in vars(gaussians).values())), camera)
        for k, camera in enumerate(cameras)
    ]
    bounds = lens.slope_bounds(cameras[0])  # wherever the camera is, and slow to compute
    with mock.patch.object(type(lens), "slope_bounds", lambda *_: bounds):
        splats = [effects.project(*pair, lens) for pair in pairs]
    colors = np.concatenate([effects.sh_colors(*pair, lens, degree) for pair in pairs])
    arrays = ("means2d", "cov2d", "conics", "depths", "opacities", "visible")
    splats = reference.Projection(
        *(np.concatenate([getattr(each, name) for each in splats]) for name in arrays)
    )
    size = cameras[0].width, cameras[0].height
    return reference.composite(splats, colors, np.zeros(3), *size, threshold_width)
