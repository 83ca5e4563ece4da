"""The 3D smoothing filter: Gaussians no smaller than what the training cameras can tell apart.

Imported when Gaussians come with it. A scene that was photographed with a sampling rate nu (pixels
per scene unit, focal length over depth) says nothing about detail below its Nyquist limit; a
rendering that is nearer, or larger, shows what the fit has made up there. Mip-Splatting (Yu et al.
2024, section 4.1) therefore convolves each Gaussian with one of variance 0.2 / nu^2, nu being the
largest rate of all cameras that see it, and keeps its integral.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np

from drgs.cameras.camera import Camera
from drgs.core.arrays import types_of
from drgs.gaussians.parameters import Gaussians
from drgs.splatting.projection import GaussianRows

VARIANCE = 0.2
"""Of the filter, in squared distances between samples (Mip-Splatting, equation 9 and its code)."""

FILM_MARGIN = 0.15
"""Parts of the film's size by which a camera is taken to see beyond it (Mip-Splatting's code)."""


def smoothed(rows: GaussianRows) -> GaussianRows:
    """Gaussians whose covariance is widened by ``rows.smoothing``^2, and dimmed in proportion.

    The filter is differentiated where an object is scaled with it, and is no parameter itself.
    """
    variance = dr.square(rows.smoothing)
    log_scales = dr.log(dr.exp(2 * rows.log_scales) + variance) / 2
    dimming = dr.exp(dr.sum(rows.log_scales - log_scales))
    return replace(rows, log_scales=log_scales, smoothing=None, dimming=dimming)


def smoothing_of(means: Any, cameras: Iterable[Camera]) -> Any:
    """The filter's standard deviation (N,), scene units, of Gaussians that ``cameras`` look at.

    means: (N, 3). A mean that no camera sees gets the widest filter of all that one sees. Detached.
    """
    flat = dr.detach(means).array
    t = types_of(type(flat))
    row = dr.arange(t.UInt32, means.shape[0])
    points = t.Array3f([dr.gather(t.Float, flat, row * 3 + k) for k in range(3)])
    rates = dr.zeros(t.Float, means.shape[0])
    for camera in cameras:
        rates = dr.maximum(rates, _rates(points, camera))
        dr.eval(rates)
    lowest = dr.min(dr.select(rates > 0, rates, dr.inf))
    return math.sqrt(VARIANCE) / dr.select(rates > 0, rates, lowest)


def _rates(points: Any, camera: Camera) -> Any:
    lens = camera.lens
    seen, position, depth = lens.visibility(camera, camera.rotation @ (points - camera.center))
    film = lens.project_point(camera, position)
    margin = FILM_MARGIN * (camera.film_end - camera.film_start)
    beside = (film < camera.film_start - margin) | (film > camera.film_end + margin)
    # Written such that NaN is not seen.
    seen &= (film.x == film.x) & (film.y == film.y) & ~(beside.x | beside.y)
    return dr.select(seen, dr.max(camera.focal) / depth, 0)


def baked(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians (numpy) with the filter in their scales and opacities.

    For viewers that know nothing of it. Opacities are rounded to below 1.
    """
    g = gaussians.numpy()
    if g.smoothing is None:
        return g
    variances = np.exp(2 * g.log_scales.astype(np.float64))
    widened = variances + np.square(g.smoothing.astype(np.float64))[:, None]
    opacities = np.sqrt(np.prod(variances / widened, axis=1)) / (
        1 + np.exp(-g.logit_opacities.astype(np.float64))
    )
    tiny = np.finfo(np.float32).tiny
    opacities = np.clip(opacities, tiny, 1 - np.finfo(np.float32).eps)
    return replace(
        g,
        log_scales=(np.log(widened) / 2).astype(np.float32),
        logit_opacities=(np.log(opacities) - np.log1p(-opacities)).astype(np.float32),
        smoothing=None,
    )
