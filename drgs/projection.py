"""From 3D Gaussians to 2D splats: culling, EWA projection, opacity and colour.

Layer 2, the first stage: ``Gaussians`` + ``Camera`` -> ``Splats2D``. One lane is one Gaussian;
every line is plain arithmetic, so Dr.Jit differentiates it. The equations are those of Zwicker
et al. 2002 ("EWA splatting") as used in section 4 of the 3DGS paper, written so that they do not
cancel in single precision.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr

from drgs import sh
from drgs.arrays import types_of
from drgs.camera import Camera
from drgs.constants import ALPHA_CUT, LOW_PASS, TAN_CLAMP
from drgs.gaussians import Gaussians


@dataclass(frozen=True)
class Splats2D:
    """N projected Gaussians, one per lane, in the order of the Gaussians.

    The conic (the inverse of the projected covariance) is kept as its upper triangular factor
    U = [[p, r], [0, s]] with conic = U^T U: U maps a pixel offset d to standard normal
    coordinates u = U d, and the splat's exponent is -|u|^2 / 2. A sum of squares is never
    negative, whatever the rounding, and stays accurate for needles, where
    a dx^2 + 2 b dx dy + c dy^2 cancels.
    """

    means2d: Any  # Array2f, px
    whitening: Any  # Array3f (p, r, s), 1 / px
    depths: Any  # Float, z in the camera, scene units
    opacities: Any  # Float in (0, 1)
    colors: Any  # Array3f, display space
    variances: Any  # Array2f, px^2: diagonal of the projected covariance, low-pass included
    visible: Any  # Bool: in front of the near plane, above the alpha cut, finite

    @property
    def conics(self) -> Any:
        """Array3f (a, b, c) of the exponent -(a dx^2 + 2 b dx dy + c dy^2) / 2, px^-2."""
        p, r, s = self.whitening
        return type(self.whitening)(p * p, p * r, r * r + s * s)


@dataclass(frozen=True)
class GaussianRows:
    """The parameters of Gaussians as one value per lane and component."""

    means: Any  # Array3f
    quats: Any  # Array4f, wxyz
    log_scales: Any  # Array3f
    logit_opacities: Any  # Float
    sh: list[Any]  # (degree + 1)^2 Array3f


def load_rows(gaussians: Gaussians, sh_degree: int) -> GaussianRows:
    """Load every Gaussian's parameters, detached; of the SH only what ``sh_degree`` needs."""
    flat = dr.detach(gaussians.logit_opacities)
    t = types_of(type(flat))
    row = dr.arange(t.UInt32, dr.width(flat))

    def load(tensor: Any, start: int, stride: int, width: int) -> list[Any]:
        source = dr.detach(tensor).array
        return [dr.gather(t.Float, source, row * stride + (start + k)) for k in range(width)]

    stride = 3 * gaussians.shN.shape[1]
    higher = range(sh.num_coefficients(sh_degree) - 1)
    return GaussianRows(
        means=t.Array3f(load(gaussians.means, 0, 3, 3)),
        quats=dr.gather(t.Array4f, dr.detach(gaussians.quats).array, row),
        log_scales=t.Array3f(load(gaussians.log_scales, 0, 3, 3)),
        logit_opacities=flat,
        sh=[t.Array3f(load(gaussians.sh0, 0, 3, 3))]
        + [t.Array3f(load(gaussians.shN, 3 * k, stride, 3)) for k in higher],
    )


def project(rows: GaussianRows, camera: Camera, sh_degree: int, opacity_rule: Any) -> Splats2D:
    """Project Gaussians onto the image plane of ``camera``.

    opacity_rule: how low-pass filtering affects opacity: :func:`plain_opacity` or
    :func:`compensated_opacity`.

    Differentiable in ``rows`` and in the camera's numbers. Not differentiated: visibility.
    """
    t = types_of(type(rows.logit_opacities))
    offset = rows.means - camera.center
    x, y, z = camera.rotation @ offset
    in_front = z >= camera.near
    # A masked lane must not divide by zero: 0 * inf would poison the gradient of its neighbours.
    z = dr.select(in_front, z, 1)

    m0, m1 = _screen_space_sqrt_cov(rows, camera, t.Array3f(x, y, z))
    xx, xy, yy = dr.dot(m0, m0), dr.dot(m0, m1), dr.dot(m1, m1) + LOW_PASS
    # U needs det / yy, the variance of x where y is given. det(M M^T) is the sum of the squared
    # 2x2 minors of M (Cauchy-Binet): never negative and free of the cancellation of
    # xx yy - xy^2. Its minors are divided by sqrt(yy) first, or the square of a giant's overflows.
    s = dr.rsqrt(yy)
    minors = dr.cross(m0, m1 * s)
    sharp, added = dr.dot(minors, minors), LOW_PASS * (xx / yy + 1)
    p = dr.rsqrt(sharp + added)
    whitening = t.Array3f(p, -p * (xy / yy), s)
    xx = xx + LOW_PASS
    means2d = camera.focal * t.Array2f(x, y) / z + camera.principal
    opacities = opacity_rule(_sigmoid(rows.logit_opacities), sharp, added)
    colors = sh.sh_color(rows.sh, _normalize(offset), sh_degree)
    finite = dr.isfinite(dr.detach(dr.sum(means2d) + dr.sum(whitening) + dr.sum(colors)))
    return Splats2D(
        means2d=means2d,
        whitening=whitening,
        depths=z,
        opacities=opacities,
        colors=colors,
        variances=t.Array2f(xx, yy),
        visible=in_front & (opacities > ALPHA_CUT) & finite & dr.isfinite(xx + yy),
    )


def plain_opacity(opacity: Any, sharp: Any, added: Any) -> Any:
    """The opacity as it is: low-pass filtering makes small splats larger and thus brighter."""
    del sharp, added
    return opacity


def compensated_opacity(opacity: Any, sharp: Any, added: Any) -> Any:
    """Opacity scaled by sqrt(det without / det with low-pass): the splat's integral is kept.

    sharp, added: in the ratio of the determinant without low-pass to what the low-pass adds.

    Mip-Splatting (Yu et al. 2024), section 5; gsplat's "antialiased" mode. The derivative of
    the square root at 0 (a splat of no area) is taken as 0.
    """
    thin = sharp < 1e-12 * added
    # Not sharp / (sharp + added), whose derivative is a difference that cancels for giants.
    return dr.select(thin, 0, opacity * dr.rsqrt(1 + added / dr.select(thin, 1, sharp)))


def _screen_space_sqrt_cov(rows: GaussianRows, camera: Camera, position: Any) -> tuple[Any, Any]:
    """The rows of M = J R_camera R(q) diag(s), 2 x 3: the projected covariance is M M^T."""
    z = position.z
    # Of the whole film: a crop window is a part of the same picture.
    start = (camera.film_start - camera.principal) / camera.focal
    end = (camera.film_end - camera.principal) / camera.focal
    margin = TAN_CLAMP * (end - start) / 2
    limits = zip(start - margin, end + margin, strict=True)
    scales = dr.exp(rows.log_scales)
    world_from_splat = quat_to_rotation(rows.quats)
    right, down, forward = camera.rotation
    sqrt_cov = []
    for axis, coordinate, focal, (lo, hi) in zip(
        (right, down), (position.x, position.y), camera.focal, limits, strict=True
    ):
        slope = coordinate / z
        slope = dr.select(slope < lo, lo, dr.select(slope > hi, hi, slope))
        # J's row is focal / z (e_axis - slope e_z).
        gradient = (axis - slope * forward) * (focal / z)
        sqrt_cov.append((world_from_splat.T @ gradient) * scales)
    return sqrt_cov[0], sqrt_cov[1]


def quat_to_rotation(quats: Any) -> Any:
    """Rotation matrix (3 x 3) of ``quats`` (Array4f, wxyz, any norm).

    The quaternion is first divided by its largest component, so that norms of 1e-20 and 1e20
    neither underflow nor overflow. A zero quaternion is the identity, with zero gradient.
    """
    t = types_of(type(quats.x))
    size = dr.detach(dr.max(dr.abs(quats)))
    usable = ~(size <= 0)  # a NaN goes through: projection then drops the Gaussian
    q = dr.select(usable, quats, t.Array4f(1, 0, 0, 0)) / dr.select(usable, size, 1)
    w, x, y, z = q
    two = 2 / dr.squared_norm(q)
    return t.Matrix3f(
        [
            [1 - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
            [two * (x * y + w * z), 1 - two * (x * x + z * z), two * (y * z - w * x)],
            [two * (x * z - w * y), two * (y * z + w * x), 1 - two * (x * x + y * y)],
        ]
    )


def _normalize(vector: Any) -> Any:
    """Unit vector; a zero vector stays zero, with zero gradient."""
    squared_norm = dr.squared_norm(vector)
    usable = squared_norm > 0
    return vector * dr.select(usable, dr.rsqrt(dr.select(usable, squared_norm, 1)), 0)


def _sigmoid(x: Any) -> Any:
    """1 / (1 + e^-x) without overflow for large |x|."""
    # Not dr.abs: its derivative at 0 is 0, and a logit of exactly 0 would never move.
    decayed = dr.exp(dr.select(x >= 0, -x, x))
    return dr.select(x >= 0, 1, decayed) / (1 + decayed)
