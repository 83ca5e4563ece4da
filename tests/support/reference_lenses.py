"""Lenses of the float64 reference, and Gaussians before a camera at the origin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from drgs.reference.splatting import Camera, Gaussians
from support.lenses import Fisheye, ThinPrismFisheye

FISHEYE = Fisheye(-0.03125, 0.015625, -0.0078125, 0.001953125)

THIN_PRISM = ThinPrismFisheye(
    -0.03125, 0.015625, -0.0078125, 0.001953125, 0.0078125, -0.00390625, -0.015625, 0.01171875
)


def camera_at_origin(**changes) -> Camera:
    """260 x 210 px, fx != fy, off-centre; half the field of view is about 30 degrees."""
    camera = Camera(
        rotation=np.eye(3), center=np.zeros(3), fx=230.0, fy=190.0, cx=140.0, cy=95.0, width=260,
        height=210,
    )  # fmt: skip
    return replace(camera, **changes)


def gaussians_at(
    means, scales=0.1, opacity=0.5, colors=0.5, quats=(1.0, 0.0, 0.0, 0.0)
) -> Gaussians:
    """Gaussians of degree 0, grey; scales and colors broadcast to (N, 3), opacity to (N,)."""
    means = np.atleast_2d(np.asarray(means, dtype=np.float64))
    n = len(means)
    opacities = np.broadcast_to(opacity, n)
    return Gaussians(
        means=means,
        quats=np.tile(quats, (n, 1)),
        log_scales=np.log(np.broadcast_to(scales, (n, 3))),
        logit_opacities=np.log(opacities / (1 - opacities)),
        sh0=(np.broadcast_to(colors, (n, 3)) - 0.5)[:, None] * np.sqrt(4 * np.pi),
        shN=np.zeros((n, 0, 3)),
    )


def whitened_samples(count, seed=0) -> np.ndarray:
    """(count, 3) normal samples with exactly the mean 0 and the covariance I."""
    samples = np.random.default_rng(seed).normal(0, 1, (count, 3))
    samples -= samples.mean(axis=0)
    return samples @ np.linalg.inv(np.linalg.cholesky(samples.T @ samples / count)).T
