"""Gaussians changed in closed form so that other viewers show them about as they were fitted.

Viewers of 3DGS files add 0.3 square pixels to each splat's covariance and leave its opacity as it
is. Gaussians that were fitted with another low-pass, or with opacities that compensate for it
(Mip-Splatting, Yu et al. 2024, section 5), are blurred and too opaque there. What is added on the
film is taken from the Gaussians beforehand, as far as there is something to take from, and
opacities make up for the rest, such that a splat keeps its integral over the film.
``drgs.training.viewers`` goes on from there.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import drjit as dr
import numpy as np

from drgs.cameras.camera import Camera
from drgs.config.approximations import Approximations
from drgs.effects.smoothing import VARIANCE, smoothing_of
from drgs.gaussians.parameters import Gaussians
from drgs.splatting.projection import (
    GaussianRows,
    OpacityRule,
    compensated_opacity,
    load_rows,
    plain_opacity,
    project,
)

KEPT_VARIANCE = 0.04
"""Parts of its variance that a Gaussian keeps along each axis: flatter ones would have next to no
derivatives by their scales."""

USUAL = Approximations()
"""What viewers do."""


def baked_for_viewers(
    gaussians: Gaussians, cameras: Iterable[Camera], fitted: Approximations
) -> Gaussians:
    """Gaussians (numpy) that look about the same without ``fitted.low_pass`` and ``antialiased``.

    With l and L the low-pass of the fit and that of viewers, and nu the largest rate (px per scene
    unit) of the ``cameras`` that see a Gaussian,

        s'^2 = max(s^2 - (L - l) / nu^2, 0.04 s^2),   o' = o sum(a sqrt(det C)) / sum(sqrt(det C')),

    where C and C' are the covariances on the film, low-pass included, a is what compensation leaves
    of the opacity, and the sums go over the cameras that see the Gaussian. One that no camera sees
    keeps its opacity.

    gaussians: Dr.Jit arrays, without a smoothing filter. Detached.
    """
    cameras = list(cameras)
    host = dr.detach(gaussians).numpy()
    nyquist = np.array(smoothing_of(gaussians.means, cameras), np.float64)
    taken = (USUAL.low_pass - fitted.low_pass) * np.square(nyquist) / VARIANCE
    variances = np.exp(2 * host.log_scales.astype(np.float64))
    left = np.maximum(variances - taken[:, None], KEPT_VARIANCE * variances)
    baked = replace(host, log_scales=(np.log(left) / 2).astype(np.float32))
    before = _integrals(gaussians, cameras, fitted)
    after = _integrals(baked.to(type(gaussians.means)), cameras, USUAL)
    factor = np.divide(before, after, out=np.ones_like(after), where=after > 0)
    opacities = factor / (1 + np.exp(-host.logit_opacities.astype(np.float64)))
    tiny = np.finfo(np.float32).tiny
    opacities = np.clip(opacities, tiny, 1 - np.finfo(np.float32).eps)
    logits = np.log(opacities) - np.log1p(-opacities)
    return replace(baked, logit_opacities=logits.astype(np.float32))


def _integrals(
    gaussians: Gaussians, cameras: Iterable[Camera], approximations: Approximations
) -> np.ndarray:
    """Over the film, of each splat's alpha, over 2 pi: summed over ``cameras``; (N,) float64."""
    rule = compensated_opacity if approximations.antialiased else plain_opacity
    rows = load_rows(gaussians, 0)
    total = dr.zeros(type(rows.logit_opacities), gaussians.num_gaussians)
    for camera in cameras:
        total += _integral(rows, camera, rule, approximations.low_pass)
        dr.eval(total)
    return np.array(total, np.float64)


def _integral(rows: GaussianRows, camera: Camera, rule: OpacityRule, low_pass: float) -> Any:
    splats = project(rows, camera, 0, rule, low_pass=low_pass, least_alpha=0.0)
    beside = (splats.means2d < camera.film_start) | (splats.means2d > camera.film_end)
    p, _, s = splats.whitening
    seen = splats.visible & ~(beside.x | beside.y)
    return dr.select(seen, splats.opacities / dr.abs(p * s), 0)
