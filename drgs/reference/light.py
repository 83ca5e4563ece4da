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
    segments = []
    for origin, direction, end in zip(origins, directions, far, strict=True):
        # Origin from the means, and direction, in coordinates of unit Gaussians.
        start = np.einsum("nij,nj->ni", whitening, origin - gaussians.means)
        along = whitening @ direction
        t = -np.sum(start * along, axis=1) / np.sum(along * along, axis=1)
        squared = np.sum(np.square(start + t[:, None] * along), axis=1)
        alphas = np.minimum(opacities * np.exp(-squared / 2), alpha_max)

        seen = np.flatnonzero((alphas >= alpha_cut) & (t > 0) & (t < end))
        seen = seen[np.argsort(t[seen], kind="stable")]
        behind = np.cumprod(1 - alphas[seen])
        count = np.count_nonzero(behind >= stop)  # it never rises
        before, shown = np.array([1.0, *behind]), seen[:count]
        unclamped = reference.unclamped_colors(gaussians, direction[None], sh_degree)
        color = (before[:count] * alphas[shown]) @ np.maximum(unclamped[shown], 0.0)

        near_ends = (np.abs(t) < close) | (np.abs(t - end) < close)
        near_cut = (np.abs(alphas / alpha_cut - 1) < close) & (t > -close) & (t < end + close)
        is_close = (
            np.any(near_cut | (near_ends & (alphas > alpha_cut * (1 - close))))
            or np.any(np.diff(t[seen]) < close)
            or np.any(np.abs(behind[: count + 1] / max(stop, 1e-300) - 1) < close)
        )
        segments.append((color, before[count], count, is_close))
    return SegmentRadiance(*map(np.array, zip(*segments, strict=True)))
