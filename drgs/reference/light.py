"""The reference for light between splats and surfaces: what a ray passes, looking at every splat.

A ray r(t) = o + t d, with d of unit length, meets a Gaussian of mean m and covariance S at its
peak, where the density along the ray is largest:

    t = d^T S^-1 (m - o) / d^T S^-1 d,   rho^2 = (r(t) - m)^T S^-1 (r(t) - m)
    alpha = min(alpha_max, opacity exp(-rho^2 / 2))

A segment 0 < t < far composites those whose peak lies on it, by t, as in ``reference.splatting``.
Imports nothing of this package but ``reference``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drgs.reference import splatting as reference
from drgs.reference.splatting import Gaussians


@dataclass(frozen=True)
class SegmentRadiance:
    """The radiance and transmittance of segments."""

    colors: np.ndarray  # (R, 3) display space, sum of w_i c_i
    transmittances: np.ndarray  # (R,)
    counts: np.ndarray  # (R,) splats composited
    is_close: np.ndarray  # (R,) bool: a decision was taken by less than ``close``


def composite_segments(
    gaussians: Gaussians,
    origins: np.ndarray,
    directions: np.ndarray,
    far: np.ndarray,
    alpha_max: float = reference.ALPHA_MAX,
    alpha_cut: float = reference.ALPHA_CUT,
    stop: float = reference.TRANSMITTANCE_STOP,
    sh_degree: int | None = None,
    close: float = 0.0,
) -> SegmentRadiance:
    """Composite the splats along R segments.

    origins: (R, 3) world; directions: (R, 3) unit; far: (R,) world units, inf: all; alpha_cut: a
    smaller alpha does not exist; stop: a segment ends before the splat that takes its transmittance
    below; close: relative, of alphas to the cut, of transmittances to the stop, of peaks to the
    ends of the segment and to each other.
    """
    rotations = reference.quat_to_rotation(gaussians.quats)
    whitening = np.transpose(rotations, (0, 2, 1)) / np.exp(gaussians.log_scales)[:, :, None]
    opacities = reference.sigmoid(gaussians.logit_opacities)
    degree = gaussians.sh_degree if sh_degree is None else sh_degree
    passed = [
        _composite_segment(
            np.einsum("nij,nj->ni", whitening, origins[r] - gaussians.means),
            whitening @ directions[r],
            far[r],
            opacities,
            np.maximum(reference.unclamped_colors(gaussians, directions[r][None], degree), 0.0),
            (alpha_max, alpha_cut, stop, close),
        )
        for r in range(len(origins))
    ]
    return SegmentRadiance(*(np.array(column) for column in zip(*passed, strict=True)))


def _composite_segment(
    start: np.ndarray,
    along: np.ndarray,
    far: float,
    opacities: np.ndarray,
    colors: np.ndarray,
    cutoffs: tuple[float, float, float, float],
) -> tuple[np.ndarray, float, int, bool]:
    """start, along: origin from the means, and direction, in coordinates of unit Gaussians."""
    alpha_max, alpha_cut, stop, close = cutoffs
    t = -np.sum(start * along, axis=1) / np.sum(along * along, axis=1)
    squared = np.sum(np.square(start + t[:, None] * along), axis=1)
    alpha = np.minimum(opacities * np.exp(-squared / 2), alpha_max)
    seen = (alpha >= alpha_cut) & (t > 0) & (t < far)
    near_ends = (np.abs(t) < close) | (np.abs(t - far) < close)
    is_close = bool(
        np.any((np.abs(alpha / alpha_cut - 1) < close) & (t > -close) & (t < far + close))
        or np.any(near_ends & (alpha > alpha_cut * (1 - close)))
    )
    chosen = np.flatnonzero(seen)
    chosen = chosen[np.argsort(t[chosen], kind="stable")]
    is_close |= bool(np.any(np.diff(t[chosen]) < close))
    color, transmittance, count = np.zeros(3), 1.0, 0
    for i in chosen:
        after = transmittance * (1 - alpha[i])
        is_close |= abs(after / max(stop, 1e-300) - 1) < close
        if after < stop:
            break
        color += transmittance * alpha[i] * colors[i]
        transmittance, count = after, count + 1
    return color, transmittance, count, is_close
