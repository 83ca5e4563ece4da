"""The reference: 3D Gaussian splatting in float64 numpy, to be read beside the paper.

It imports nothing of this package, not even its constants, so that the fast kernels are compared
with an independent computation. The order of the file is the order of the data::

    Gaussians, Camera
      -> project     means2d, conics, depths, opacities       (N splats on the film)
      -> sh_colors   colors
      -> composite   image, alpha, depth                      (pixels)

followed by the gradients in the opposite order, each derived by hand and each beside the
equation that it differentiates. For a scalar loss L, ``d_x`` is the array dL/dx.

Sources, cited by these names:

- 3DGS: Kerbl, Kopanas, Leimkuehler, Drettakis, "3D Gaussian Splatting for Real-Time Radiance
  Field Rendering", ACM Transactions on Graphics 42(4), 2023, and its CUDA rasterizer.
- EWA: Zwicker, Pfister, van Baar, Gross, "EWA Splatting", IEEE TVCG 8(3), 2002.
- Mip-Splatting: Yu, Chen, Huang, Sattler, Geiger, CVPR 2024.

The paper's symbols, and their names here: mu ``means``, q ``quats``, S ``exp(log_scales)``, R
``quat_to_rotation``, Sigma ``covariances``, W ``camera.rotation``, J ``jacobians``, Sigma'
``cov2d``, alpha ``opacities`` (of a Gaussian) and ``alpha`` (at a pixel), c ``colors``.

Spaces: *world*; *camera* (x right, y down, z forward, world units); *film* (pixels, x right,
y down, pixel (i, j) has its centre at (i + 0.5, j + 0.5)). Images are indexed [row, column].
Colours are in display space (sRGB-encoded). Quaternions are wxyz.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

# The two thresholds on alpha are the single-precision numbers of the CUDA rasterizer (0.99f and
# 1.0f / 255.0f), not the decimals. For the clamp this decides images: behind one clamped
# splat T = 1 - 0.99, and a second one leaves (1 - 0.99)^2, which is just above 1e-4 with the
# double nearest to 0.99, and 2e-6 (relative) below it with 0.99f. So every single-precision
# rasterizer stops there, and so does this one.
ALPHA_MAX = float(np.float32(0.99))  # upper clamp of alpha (3DGS rasterizer)

ALPHA_CUT = float(np.float32(1.0) / np.float32(255.0))
"""A splat with a smaller alpha at a pixel does not exist there (3DGS rasterizer)."""

TRANSMITTANCE_STOP = 1e-4
"""A pixel is finished before the splat that would take it below this (3DGS rasterizer)."""

LOW_PASS = 0.3  # px^2 added to the diagonal of the covariance on the film (3DGS rasterizer)

FRUSTUM_MARGIN = 0.3
"""The Jacobian's x/z and y/z may leave the frustum by this part of its half extents (3DGS)."""

THRESHOLD_WIDTH = 1e-6
"""Relative distance from a threshold at which single precision may decide otherwise."""


# ---- Types -----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Camera:
    """A pinhole camera in OpenCV axes: a world point x is at ``rotation (x - center)``."""

    rotation: np.ndarray  # (3, 3) world to camera
    center: np.ndarray  # (3,) world
    fx: float  # px
    fy: float  # px
    cx: float  # px, film
    cy: float  # px, film
    width: int  # px
    height: int  # px
    near: float = 0.01  # world units, > 0: means with a smaller camera z are culled

    def __post_init__(self) -> None:
        """Convert to float64."""
        for name in ("rotation", "center"):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))

    @property
    def focal(self) -> np.ndarray:
        """(fx, fy), px."""
        return np.array([self.fx, self.fy])

    @property
    def principal(self) -> np.ndarray:
        """(cx, cy), px, film."""
        return np.array([self.cx, self.cy])

    @property
    def size(self) -> np.ndarray:
        """(width, height), px."""
        return np.array([self.width, self.height])

    def film_points(self, points: np.ndarray) -> np.ndarray:
        """Return (fx x/z + cx, fy y/z + cy), (..., 2) px, of points (..., 3) in camera axes."""
        return self.focal * points[..., :2] / points[..., 2:] + self.principal


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians; ``log_`` and ``logit_`` mark values before their activation."""

    means: np.ndarray  # (N, 3) world
    quats: np.ndarray  # (N, 4) wxyz, not normalised
    log_scales: np.ndarray  # (N, 3) natural logarithm of standard deviations in world units
    logit_opacities: np.ndarray  # (N,)
    sh0: np.ndarray  # (N, 1, 3) coefficient of degree 0, RGB, display space
    shN: np.ndarray  # (N, K - 1, 3) the others, K = (degree + 1)^2, degree 0 to 3  # noqa: N815

    def __post_init__(self) -> None:
        """Convert to float64."""
        for name in vars(self):
            object.__setattr__(self, name, np.asarray(getattr(self, name), dtype=np.float64))

    @property
    def sh(self) -> np.ndarray:
        """All coefficients (N, K, 3)."""
        return np.concatenate([self.sh0, self.shN], axis=1)

    @property
    def sh_degree(self) -> int:
        """Highest degree stored, 0 to 3."""
        return {0: 0, 3: 1, 8: 2, 15: 3}[self.shN.shape[1]]


@dataclass(frozen=True)
class Projection:
    """N splats on the film. Rows that are not ``visible`` hold finite, meaningless numbers."""

    means2d: np.ndarray  # (N, 2) px, film
    cov2d: np.ndarray  # (N, 2, 2) px^2, low-pass included
    conics: np.ndarray  # (N, 2, 2) px^-2, inverse of cov2d
    depths: np.ndarray  # (N,) camera z, world units; the true one for culled rows too
    opacities: np.ndarray  # (N,) activated; after compensation, if requested
    visible: np.ndarray  # (N,) bool: depths >= near and opacities > ALPHA_CUT; may be off film
    cuts: np.ndarray | float = ALPHA_CUT  # (N,) or for all: smallest alphas at a pixel

    @property
    def all_cuts(self) -> np.ndarray:
        """The cuts (N,)."""
        return np.broadcast_to(self.cuts, self.depths.shape)


@dataclass(frozen=True)
class RenderedImage:
    """The image of a camera."""

    image: np.ndarray  # (H, W, 3) display space, background included
    alpha: np.ndarray  # (H, W) = 1 - transmittance
    depth: np.ndarray  # (H, W) sum of T alpha z: premultiplied by alpha, world units
    transmittance: np.ndarray  # (H, W) share of the background that is seen
    near_threshold: np.ndarray  # (H, W) bool: a decision of this pixel may flip in float32
    stops: np.ndarray | None = None  # (H, W) of ``composite``: rank in depth at which it stopped


# ---- Gaussians in the world ------------------------------------------------------------------


def quat_to_rotation(quats: np.ndarray) -> np.ndarray:
    """Return rotations (N, 3, 3) of quaternions (N, 4) wxyz of any norm; of zero, the identity."""
    unit_quats, _ = _normalize(quats, fallback=(1.0, 0.0, 0.0, 0.0))
    w, x, y, z = unit_quats.T
    return _rows_of_matrices(
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    )


def covariances(quats: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    """Return Sigma = R S S^T R^T (3DGS, equation 6): (N, 3, 3), world units squared.

    quats: (N, 4) wxyz; log_scales: (N, 3). Projection works with the factor R S instead: the
    determinant of a needle's covariance cancels, that of its factor does not.
    """
    factors = quat_to_rotation(quats) * np.exp(log_scales)[:, None, :]
    return factors @ _transpose(factors)


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """Return 1 / (1 + exp(-x)), accurate and without overflow for every x."""
    return np.exp(-np.logaddexp(0.0, -logits))


# ---- Colour ----------------------------------------------------------------------------------

# Normalisation of the real spherical harmonics (Condon-Shortley phase, as in 3DGS), with l the
# degree: C_LM multiplies the polynomials of order +-m.
C_00 = np.sqrt(1 / (4 * np.pi))
C_1 = np.sqrt(3 / (4 * np.pi))
C_20 = np.sqrt(5 / (16 * np.pi))
C_21 = np.sqrt(15 / (4 * np.pi))
C_22 = np.sqrt(15 / (16 * np.pi))
C_30 = np.sqrt(7 / (16 * np.pi))
C_31 = np.sqrt(21 / (32 * np.pi))
C_32 = np.sqrt(105 / (16 * np.pi))
C_33 = np.sqrt(35 / (32 * np.pi))


def sh_basis(directions: np.ndarray, degree: int) -> np.ndarray:
    """Return the real spherical harmonics (N, K) of unit directions (N, 3), K = (degree + 1)^2.

    Column l^2 + l + m: degree l, order m, with the signs of 3DGS; orthonormal on the sphere.
    """
    x, y, z = directions.T
    basis = [
        C_00 * np.ones_like(x),
        -C_1 * y,
        C_1 * z,
        -C_1 * x,
        2 * C_22 * x * y,
        -C_21 * y * z,
        C_20 * (2 * z * z - x * x - y * y),
        -C_21 * x * z,
        C_22 * (x * x - y * y),
        -C_33 * y * (3 * x * x - y * y),
        2 * C_32 * x * y * z,
        -C_31 * y * (4 * z * z - x * x - y * y),
        C_30 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -C_31 * x * (4 * z * z - x * x - y * y),
        C_32 * z * (x * x - y * y),
        -C_33 * x * (x * x - 3 * y * y),
    ]
    return np.stack(basis[: (degree + 1) ** 2], axis=-1)


def sh_basis_gradient(directions: np.ndarray, degree: int) -> np.ndarray:
    """Return (N, K, 3): the derivatives of the polynomials of ``sh_basis`` with respect to x, y, z.

    x, y, z vary independently here; the unit length of a direction is the caller's business.
    """
    x, y, z = directions.T
    zero, one = np.zeros_like(x), np.ones_like(x)
    gradient = [
        [zero, zero, zero],
        [zero, -C_1 * one, zero],
        [zero, zero, C_1 * one],
        [-C_1 * one, zero, zero],
        [2 * C_22 * y, 2 * C_22 * x, zero],
        [zero, -C_21 * z, -C_21 * y],
        [-2 * C_20 * x, -2 * C_20 * y, 4 * C_20 * z],
        [-C_21 * z, zero, -C_21 * x],
        [2 * C_22 * x, -2 * C_22 * y, zero],
        [-6 * C_33 * x * y, -3 * C_33 * (x * x - y * y), zero],
        [2 * C_32 * y * z, 2 * C_32 * x * z, 2 * C_32 * x * y],
        [2 * C_31 * x * y, -C_31 * (4 * z * z - x * x - 3 * y * y), -8 * C_31 * y * z],
        [-6 * C_30 * x * z, -6 * C_30 * y * z, C_30 * (6 * z * z - 3 * x * x - 3 * y * y)],
        [-C_31 * (4 * z * z - 3 * x * x - y * y), 2 * C_31 * x * y, -8 * C_31 * x * z],
        [2 * C_32 * x * z, -2 * C_32 * y * z, C_32 * (x * x - y * y)],
        [-3 * C_33 * (x * x - y * y), 6 * C_33 * x * y, zero],
    ]
    return _rows_of_matrices(*gradient[: (degree + 1) ** 2])


def sh_colors(gaussians: Gaussians, camera: Camera, degree: int | None = None) -> np.ndarray:
    """Return the colours (N, 3) that the camera sees, display space, >= 0, not bounded above.

    color = max(0, sum_k Y_k(direction) coefficient_k + 0.5), with the direction from the camera's
    centre to the mean (3DGS rasterizer). ``degree`` may be below the stored one, the default.
    """
    directions, _ = _view_directions(gaussians, camera)
    return np.maximum(unclamped_colors(gaussians, directions, degree), 0.0)


def _view_directions(gaussians: Gaussians, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return unit directions (N, 3) and distances (N,) from the camera's centre to the means."""
    return _normalize(gaussians.means - camera.center, fallback=(0.0, 0.0, 1.0))


def unclamped_colors(
    gaussians: Gaussians, directions: np.ndarray, degree: int | None = None
) -> np.ndarray:
    """Return colours (N, 3) before clamping at zero; directions: unit, world, (N, 3) or (1, 3)."""
    degree = gaussians.sh_degree if degree is None else degree
    colors = sh_basis(directions, degree)[..., None] * gaussians.sh[:, : (degree + 1) ** 2]
    return np.sum(colors, axis=1) + 0.5


# ---- Projection ------------------------------------------------------------------------------


@dataclass(frozen=True)
class LocalAffine:
    """The affine approximation of the projection at each mean, with its intermediate results.

    Rows behind the near plane have the camera mean (0, 0, 1): no division meets a zero.
    """

    in_front: np.ndarray  # (N,) bool: camera z >= near
    means: np.ndarray  # (N, 3) camera
    ratios: np.ndarray  # (N, 2) x/z and y/z, clamped to the widened frustum
    unclamped: np.ndarray  # (N, 2) bool: the clamp left this ratio as it was
    jacobians: np.ndarray  # (N, 2, 3) J, px per world unit
    rotations: np.ndarray  # (N, 3, 3) R(q)
    scales: np.ndarray  # (N, 3) s, world units
    axes: np.ndarray  # (N, 3, 3) V = W R(q) diag(s), camera: the ellipsoid's half axes in columns
    axes2d: np.ndarray  # (N, 2, 3) M = J V, px


def local_affine(gaussians: Gaussians, camera: Camera) -> LocalAffine:
    """Linearise the projection at each mean (EWA, section 4; 3DGS, equation 5).

    M = J W R(q) diag(s), with W the camera's rotation and J the Jacobian of
    (fx x/z + cx, fy y/z + cy). In J only, x/z and y/z are clamped: far outside the film the
    affine approximation makes splats so large that they would reach back into the image.
    """
    camera_means = (gaussians.means - camera.center) @ camera.rotation.T
    in_front = camera_means[:, 2] >= camera.near
    camera_means = np.where(in_front[:, None], camera_means, (0.0, 0.0, 1.0))
    z = camera_means[:, 2]

    lower = (0 - camera.principal) / camera.focal
    upper = (camera.size - camera.principal) / camera.focal
    margin = FRUSTUM_MARGIN * (upper - lower) / 2
    true_ratios = camera_means[:, :2] / z[:, None]
    ratios = np.clip(true_ratios, lower - margin, upper + margin)

    zero = np.zeros_like(z)
    jacobians = _rows_of_matrices(
        [camera.fx / z, zero, -camera.fx * ratios[:, 0] / z],
        [zero, camera.fy / z, -camera.fy * ratios[:, 1] / z],
    )
    rotations = quat_to_rotation(gaussians.quats)
    scales = np.exp(gaussians.log_scales)
    axes = camera.rotation @ rotations * scales[:, None, :]
    axes2d, unclamped = jacobians @ axes, ratios == true_ratios
    return LocalAffine(
        in_front, camera_means, ratios, unclamped, jacobians, rotations, scales, axes, axes2d
    )


def project(gaussians: Gaussians, camera: Camera, antialiased: bool = False) -> Projection:
    """Return the splats that Gaussians leave on the film.

    cov2d = J W Sigma W^T J^T + 0.3 I = M M^T + 0.3 I    (3DGS, equation 5, and its rasterizer)

    ``antialiased`` multiplies each opacity by sqrt(det(M M^T) / det(cov2d)), which undoes the
    brightening that the low-pass causes (Mip-Splatting, section 4.2).
    """
    affine = local_affine(gaussians, camera)
    cov2d, dets, areas = widened_covariances(affine.axes2d, LOW_PASS)
    opacities = sigmoid(gaussians.logit_opacities)
    if antialiased:
        opacities = opacities * areas / np.sqrt(dets)
    means2d, visible = camera.film_points(affine.means), affine.in_front & (opacities > ALPHA_CUT)
    depths = (gaussians.means - camera.center) @ camera.rotation[2]
    return Projection(means2d, cov2d, _inverses(cov2d, dets), depths, opacities, visible)


def widened_covariances(
    axes2d: np.ndarray, widening: ArrayLike
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return cov2d = M M^T + diag(t) (N, 2, 2), det(cov2d) (N,) and sqrt(det(M M^T)) (N,).

    axes2d: M (N, 2, K), px; widening: t (N, 2), px^2, or one number for all.

    The determinants are sums of squares, which cannot cancel: by Cauchy-Binet det(M M^T) is the
    sum of the squared 2 x 2 minors of M, each of which stands twice in x y^T - y x^T with the rows
    x and y of M, and det(A + diag(t)) = det(A) + t0 A11 + t1 A00 + t0 t1.
    """
    x, y = axes2d[:, 0], axes2d[:, 1]
    minors = x[:, :, None] * y[:, None, :] - y[:, :, None] * x[:, None, :]
    areas = np.sqrt(np.sum(minors**2, axis=(1, 2)) / 2)
    t = np.broadcast_to(widening, (len(x), 2))
    dets = areas**2 + t[:, 0] * np.sum(y**2, axis=-1) + t[:, 1] * np.sum(x**2, axis=-1)
    cov2d = axes2d @ _transpose(axes2d) + t[:, :, None] * np.eye(2)
    return cov2d, dets + t[:, 0] * t[:, 1], areas


def _inverses(matrices: np.ndarray, dets: np.ndarray) -> np.ndarray:
    """Return the inverses of symmetric matrices (N, 2, 2) whose determinants (N,) are given."""
    a, b, c = matrices[:, 0, 0], matrices[:, 0, 1], matrices[:, 1, 1]
    return _rows_of_matrices([c / dets, -b / dets], [-b / dets, a / dets])


# ---- Compositing -----------------------------------------------------------------------------


def pixel_centers(width: int, height: int) -> np.ndarray:
    """Return the centres (height, width, 2), px, (x, y), of the film's pixels."""
    y, x = np.mgrid[:height, :width] + 0.5
    return np.stack([x, y], axis=-1)


@dataclass(frozen=True)
class _Footprint:
    """A splat on h x w pixels."""

    offsets: np.ndarray  # (h, w, 2) d, px, from the splat's mean to the pixel centres
    falloff: np.ndarray  # (h, w) exp(-d^T A d / 2)
    raw_alpha: np.ndarray  # (h, w) opacity * falloff, before the clamp


def _footprint(
    splats: Projection, i: int, centers: np.ndarray, period: float | None = None
) -> _Footprint:
    """Evaluate G(d) = exp(-d^T A d / 2) (3DGS, equation 4, on the film) at centers (h, w, 2)."""
    offsets = centers - splats.means2d[i]
    if period is not None:
        offsets[..., 0] -= period * np.round(offsets[..., 0] / period)
    falloff = np.exp(-0.5 * np.einsum("hwi,hwi->hw", offsets @ splats.conics[i], offsets))
    return _Footprint(offsets, falloff, splats.opacities[i] * falloff)


def _pixel_boxes(
    splats: Projection, order: np.ndarray, width: int, height: int, threshold_width: float = 0.0
) -> list[tuple[slice, slice]]:
    """Return the rows and columns outside which each splat of ``order`` is below its cut.

    opacity exp(-d^T A d / 2) >= cut is the ellipse d^T A d <= k with k = 2 ln(opacity / cut), where
    a cut is lower by ``threshold_width``; with A = cov2d^-1 its half width is sqrt(k cov2d_xx) and
    its half height sqrt(k cov2d_yy). One pixel is added for rounding.
    """
    means2d, cuts = splats.means2d[order], splats.all_cuts[order] * (1 - threshold_width)
    k = 2 * np.log(np.maximum(splats.opacities[order], cuts) / cuts)
    variances = np.diagonal(splats.cov2d[order], axis1=1, axis2=2)
    half_sizes = np.sqrt(k[:, None] * variances) + 1.0
    # fmin and fmax also send a NaN to the film's border, so that the conversion is defined.
    film = np.array([width, height], dtype=np.float64)
    first = np.fmin(np.fmax(np.ceil(means2d - half_sizes - 0.5), 0.0), film).astype(int)
    last = np.fmax(np.fmin(np.floor(means2d + half_sizes - 0.5), film - 1.0), -1.0).astype(int)
    return [
        (slice(y0, max(y0, y1 + 1)), slice(x0, max(x0, x1 + 1)))
        for (x0, y0), (x1, y1) in zip(first, last, strict=True)
    ]


def depth_order(depths: np.ndarray, visible: np.ndarray) -> np.ndarray:
    """Return the indices of the visible splats, nearest first, ties by index."""
    indices = np.flatnonzero(visible)
    return indices[np.argsort(depths[indices], kind="stable")]


def composite(
    splats: Projection,
    colors: np.ndarray,
    background: ArrayLike,
    width: int,
    height: int,
    threshold_width: float = THRESHOLD_WIDTH,
    period: float | None = None,
) -> RenderedImage:
    """Return the image of N splats: C = sum_i T_i alpha_i c_i + T background (3DGS, equation 3).

    T_i = prod_{j < i} (1 - alpha_j), alpha_i = min(0.99, o_i exp(-d^T A_i d / 2)), over the
    visible splats i in ascending depth (ties by index) whose alpha is at least their cut. A pixel
    is finished before the first splat that would take T below 1e-4: that splat is not composited.

    colors (N, 3) and background (3,) display space; width and height of the film, px;
    threshold_width: relative distance from a threshold within which
    ``RenderedImage.near_threshold`` marks a pixel. Marked are pixels at which an alpha, evaluated
    before the pixel is finished, is that close to the cut or (before clamping) to the clamp, or the
    transmittance behind a splat is that close to the stop.

    period: px along x after which splats recur, of which a pixel has the nearest; None: never.
    """
    order = depth_order(splats.depths, splats.visible)
    centers, cuts = pixel_centers(width, height), splats.all_cuts
    boxes = _pixel_boxes(splats, order, width, height, threshold_width)
    if period is not None:
        boxes = [(rows, slice(0, width)) for rows, _ in boxes]
    never = len(order)

    def is_near(values: np.ndarray, threshold: float | np.ndarray) -> np.ndarray:
        return np.abs(values - threshold) <= threshold_width * threshold

    image = np.zeros((height, width, 3))
    depth = np.zeros((height, width))
    transmittance = np.ones((height, width))
    stops = np.full((height, width), never)
    near_threshold = np.zeros((height, width), dtype=bool)
    for rank, (i, box) in enumerate(zip(order, boxes, strict=True)):
        splat = _footprint(splats, i, centers[box], period)
        alpha = np.minimum(splat.raw_alpha, ALPHA_MAX)
        unfinished = stops[box] == never
        contributes = unfinished & (alpha >= cuts[i])
        behind = transmittance[box] * (1 - alpha)
        stopping = contributes & (behind < TRANSMITTANCE_STOP)

        near_threshold[box] |= unfinished & (
            is_near(splat.raw_alpha, cuts[i]) | is_near(splat.raw_alpha, ALPHA_MAX)
        )
        near_threshold[box] |= contributes & is_near(behind, TRANSMITTANCE_STOP)

        stops[box][stopping] = rank
        contributes &= ~stopping
        weight = np.where(contributes, transmittance[box] * alpha, 0.0)
        image[box] += weight[..., None] * colors[i]
        depth[box] += weight * splats.depths[i]
        transmittance[box] = np.where(contributes, behind, transmittance[box])

    image += transmittance[..., None] * np.asarray(background)
    return RenderedImage(image, 1 - transmittance, depth, transmittance, near_threshold, stops)


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: ArrayLike = (0.0, 0.0, 0.0),
    sh_degree: int | None = None,
    antialiased: bool = False,
    threshold_width: float = THRESHOLD_WIDTH,
) -> RenderedImage:
    """Return the image of Gaussians.

    background: (3,) display space; sh_degree: None for all that is stored; antialiased: see
    ``project``; threshold_width: see ``composite``.
    """
    splats = project(gaussians, camera, antialiased)
    colors = sh_colors(gaussians, camera, sh_degree)
    return composite(splats, colors, background, camera.width, camera.height, threshold_width)


# ---- Gradients, from the pixels back to the Gaussians ----------------------------------------


def composite_gradients(
    splats: Projection,
    colors: np.ndarray,
    background: ArrayLike,
    d_image: np.ndarray,
    d_alpha: ArrayLike = 0.0,
    d_depth: ArrayLike = 0.0,
) -> dict[str, np.ndarray]:
    """Return the gradients of L = sum d_image image + sum d_alpha alpha + sum d_depth depth.

    The first three arguments are ``composite``'s. d_image (H, W, 3); d_alpha and d_depth (H, W), or
    a number for all. The result has ``means2d`` (N, 2), ``conics`` (N, 2, 2), ``opacities`` (N,),
    ``colors`` (N, 3), ``depths`` (N,) and ``background`` (3,), zero for splats that are left out.

    ``conics`` is the symmetric matrix G with dL = sum_ij G_ij dA_ij. In terms of the three
    numbers of a dx^2 + 2 b dx dy + c dy^2: dL/da = G_00, dL/db = 2 G_01, dL/dc = G_11.

    At one pixel, let v_i = d_image . c_i + d_alpha + d_depth z_i be what one unit of weight of
    splat i adds to L, and v_bg = d_image . background the same for the background. Then

        L = sum_i T_i alpha_i v_i + T v_bg      (d_alpha: 1 - T = sum_i T_i alpha_i)
        dL/dv_i = T_i alpha_i
        dL/dalpha_i = T_i v_i - S_i / (1 - alpha_i),  S_i = sum_{j > i} T_j alpha_j v_j + T v_bg

    since every later weight, and T, has the factor (1 - alpha_i). The suffix sums S_i build up
    from the back to the front (3DGS, section 6), where T_i = T_{i+1} / (1 - alpha_i) is
    recovered by division: alpha <= 0.99 keeps that accurate.

    Not differentiated: the depth order and the decisions at the thresholds. Where alpha is
    clamped its derivative is zero.
    """
    height, width, _ = d_image.shape
    d_alpha, d_depth = (np.broadcast_to(each, (height, width)) for each in (d_alpha, d_depth))
    rendered = composite(splats, colors, background, width, height)
    assert rendered.stops is not None, "composite sets it"
    order = depth_order(splats.depths, splats.visible)
    centers, cuts = pixel_centers(width, height), splats.all_cuts
    boxes = _pixel_boxes(splats, order, width, height)

    of_splats = ("means2d", "conics", "opacities", "depths")
    gradients = {name: np.zeros_like(getattr(splats, name)) for name in of_splats}
    gradients["colors"] = np.zeros_like(colors)
    gradients["background"] = np.einsum("hw,hwc->c", rendered.transmittance, d_image)

    transmittance = rendered.transmittance.copy()
    suffix_sum = transmittance * (d_image @ np.asarray(background))
    for rank in reversed(range(len(order))):
        i, box = order[rank], boxes[rank]
        splat = _footprint(splats, i, centers[box])
        alpha = np.minimum(splat.raw_alpha, ALPHA_MAX)
        contributes = (rank < rendered.stops[box]) & (alpha >= cuts[i])
        alpha = np.where(contributes, alpha, 0.0)

        transmittance[box] /= 1 - alpha
        weight = transmittance[box] * alpha
        value = d_image[box] @ colors[i] + d_alpha[box] + d_depth[box] * splats.depths[i]
        d_splat_alpha = transmittance[box] * value - suffix_sum[box] / (1 - alpha)
        suffix_sum[box] += weight * value

        gradients["colors"][i] = np.einsum("hw,hwc->c", weight, d_image[box])
        gradients["depths"][i] = np.sum(weight * d_depth[box])

        # alpha = o G(d) where it is neither cut nor clamped, G = exp(p), p = -d^T A d / 2.
        differentiable = contributes & (splat.raw_alpha < ALPHA_MAX)
        d_splat_alpha = np.where(differentiable, d_splat_alpha, 0.0)
        gradients["opacities"][i] = np.sum(d_splat_alpha * splat.falloff)
        d_power = d_splat_alpha * alpha

        # dp/dA = -d d^T / 2 and, since d = pixel - mean2d, dp/dmean2d = A d.
        weighted = d_power[..., None] * splat.offsets
        gradients["means2d"][i] = splats.conics[i] @ np.sum(weighted, axis=(0, 1))
        gradients["conics"][i] = -0.5 * np.einsum("hwi,hwj->ij", weighted, splat.offsets)
    return gradients


def project_gradients(
    gaussians: Gaussians, camera: Camera, d_splats: dict[str, np.ndarray], antialiased: bool = False
) -> dict[str, np.ndarray]:
    """Return the gradients with respect to means, quats, log_scales and logit_opacities.

    d_splats: from ``composite_gradients``. Rows that are not visible get zero, and so does a
    quaternion of norm zero. A clamped ratio of the Jacobian is a constant; J still depends on z.

    Not differentiated: the camera.
    """
    affine = local_affine(gaussians, camera)
    splats = project(gaussians, camera, antialiased)
    opacities, d_opacities = sigmoid(gaussians.logit_opacities), d_splats["opacities"]

    # A = cov2d^-1, so dA = -A dcov2d A.
    d_cov2d = -splats.conics @ d_splats["conics"] @ splats.conics
    d_axes2d = np.zeros_like(affine.axes2d)
    if antialiased:
        _, dets, areas = widened_covariances(affine.axes2d, LOW_PASS)
        compensations = areas / np.sqrt(dets)
        d_compensations = d_opacities * opacities
        d_opacities = d_opacities * compensations
        # det(cov2d)^-1/2 varies as -1/2 det(cov2d)^-1/2 trace(A dcov2d).
        d_cov2d += (-0.5 * d_compensations * compensations)[:, None, None] * splats.conics
        d_areas = d_compensations / np.sqrt(dets)
        d_axes2d += d_areas[:, None, None] * _area_gradients(affine.axes2d)

    # cov2d = M M^T + 0.3 I, M = J V, V = W R diag(s).
    d_axes2d += 2 * d_cov2d @ affine.axes2d
    d_axes = _transpose(affine.jacobians) @ d_axes2d
    d_jacobians = d_axes2d @ _transpose(affine.axes)
    d_factors = camera.rotation.T @ d_axes
    d_scales = np.einsum("nij,nij->nj", affine.rotations, d_factors)
    d_rotations = d_factors * affine.scales[:, None, :]

    d_camera_means = _camera_mean_gradients(affine, camera, d_splats["means2d"], d_jacobians)
    d_camera_means[:, 2] += d_splats["depths"]
    gradients = {
        "means": d_camera_means @ camera.rotation,
        "quats": _quat_gradients(gaussians.quats, d_rotations),
        "log_scales": d_scales * affine.scales,
        "logit_opacities": d_opacities * opacities * sigmoid(-gaussians.logit_opacities),
    }
    return {name: _rows_where(splats.visible, value) for name, value in gradients.items()}


def _area_gradients(axes2d: np.ndarray) -> np.ndarray:
    """Return the derivatives (N, 2, 3) of |m_0 x m_1| with respect to the rows m_0, m_1 of M.

    With n the unit vector along m_0 x m_1: d|m_0 x m_1| = (m_1 x n) . dm_0 + (n x m_0) . dm_1.
    A degenerate M, whose compensated opacity is zero, gets zero.
    """
    normals, lengths = _normalize(np.cross(axes2d[:, 0], axes2d[:, 1]), fallback=(0.0, 0.0, 1.0))
    normals = _rows_where(np.isfinite(lengths), normals)
    return np.stack([np.cross(axes2d[:, 1], normals), np.cross(normals, axes2d[:, 0])], axis=1)


def _camera_mean_gradients(
    affine: LocalAffine, camera: Camera, d_means2d: np.ndarray, d_jacobians: np.ndarray
) -> np.ndarray:
    """Return the gradients (N, 3) with respect to the camera-space mean (x, y, z).

    means2d = (fx x/z + cx, fy y/z + cy); J = [[fx/z, 0, -fx rx/z], [0, fy/z, -fy ry/z]], with
    (rx, ry) = (x/z, y/z), or constants where they are clamped.
    """
    x, y, z = affine.means.T
    d_x, d_y, d_z = np.zeros_like(x), np.zeros_like(y), np.zeros_like(z)
    for row, (focal, u, d_u) in enumerate([(camera.fx, x, d_x), (camera.fy, y, d_y)]):
        d_u += d_means2d[:, row] * focal / z
        d_z -= d_means2d[:, row] * focal * u / z**2

        d_diagonal, d_last = d_jacobians[:, row, row], d_jacobians[:, row, 2]
        ratio = affine.ratios[:, row]
        d_z -= d_diagonal * focal / z**2
        d_z += d_last * focal * ratio / z**2

        d_ratio = np.where(affine.unclamped[:, row], -d_last * focal / z, 0.0)
        d_u += d_ratio / z
        d_z -= d_ratio * u / z**2
    return np.stack([d_x, d_y, d_z], axis=-1)


def _quat_gradients(quats: np.ndarray, d_rotations: np.ndarray) -> np.ndarray:
    """Return the gradients (N, 4) with respect to the quaternions as stored, not normalised.

    First the derivatives of R(q) by w, x, y, z (3DGS, appendix A), then those of q -> q / |q|.
    """
    unit_quats, norms = _normalize(quats, fallback=(1.0, 0.0, 0.0, 0.0))
    w, x, y, z = unit_quats.T
    zero = np.zeros_like(w)
    derivatives = [
        _rows_of_matrices([zero, -z, y], [z, zero, -x], [-y, x, zero]),
        _rows_of_matrices([zero, y, z], [y, -2 * x, -w], [z, w, -2 * x]),
        _rows_of_matrices([-2 * y, x, w], [x, zero, z], [-w, z, -2 * y]),
        _rows_of_matrices([-2 * z, -w, x], [w, -2 * z, y], [x, y, zero]),
    ]
    d_unit = [2 * np.einsum("nij,nij->n", each, d_rotations) for each in derivatives]
    d_unit_quats = np.stack(d_unit, axis=-1)
    return _normalize_gradients(unit_quats, norms, d_unit_quats)


def sh_colors_gradients(
    gaussians: Gaussians, camera: Camera, degree: int | None, d_colors: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the gradients with respect to means, sh0 and shN, given d_colors (N, 3).

    A mean acts through the direction in which it is seen. Where a colour is clamped to zero its
    gradient is zero; so is that of the coefficients above ``degree``.
    """
    degree = gaussians.sh_degree if degree is None else degree
    used = slice((degree + 1) ** 2)
    directions, distances = _view_directions(gaussians, camera)
    d_colors = np.where(unclamped_colors(gaussians, directions, degree) >= 0, d_colors, 0.0)

    d_sh = np.zeros_like(gaussians.sh)
    d_sh[:, used] = np.einsum("nk,nc->nkc", sh_basis(directions, degree), d_colors)

    d_basis = np.einsum("nkc,nc->nk", gaussians.sh[:, used], d_colors)
    d_directions = np.einsum("nkx,nk->nx", sh_basis_gradient(directions, degree), d_basis)
    return {
        "means": _normalize_gradients(directions, distances, d_directions),
        "sh0": d_sh[:, :1],
        "shN": d_sh[:, 1:],
    }


def render_gradients(
    gaussians: Gaussians,
    camera: Camera,
    background: ArrayLike,
    d_image: np.ndarray,
    d_alpha: ArrayLike = 0.0,
    d_depth: ArrayLike = 0.0,
    sh_degree: int | None = None,
    antialiased: bool = False,
) -> dict[str, np.ndarray]:
    """Return the gradients of L = sum d_image image + sum d_alpha alpha + sum d_depth depth.

    d_image (H, W, 3), d_alpha, d_depth: see ``composite_gradients``; the rest as in ``render``. The
    result has the six fields of ``Gaussians`` in their shapes, ``background`` (3,), and
    ``means2d`` (N, 2), per pixel of position on the film. Not differentiated: see
    ``composite_gradients`` and ``project_gradients``.
    """
    splats = project(gaussians, camera, antialiased)
    colors = sh_colors(gaussians, camera, sh_degree)
    d_splats = composite_gradients(splats, colors, background, d_image, d_alpha, d_depth)
    through_projection = project_gradients(gaussians, camera, d_splats, antialiased)
    through_color = sh_colors_gradients(gaussians, camera, sh_degree, d_splats["colors"])
    return {
        **through_projection,
        **through_color,
        "means": through_projection["means"] + through_color["means"],
        "background": d_splats["background"],
        "means2d": d_splats["means2d"],
    }


# ---- Small helpers ---------------------------------------------------------------------------


def _normalize(vectors: np.ndarray, fallback: tuple) -> tuple[np.ndarray, np.ndarray]:
    """Return v / |v| (N, D) and |v| (N,).

    A zero vector becomes ``fallback``, of infinite norm: ``_normalize_gradients`` is zero for it.
    """
    norms = np.linalg.norm(vectors, axis=-1)
    norms = np.where(norms == 0, np.inf, norms)
    units = np.where(np.isinf(norms)[:, None], fallback, vectors / norms[:, None])
    return units, norms


def _normalize_gradients(units: np.ndarray, norms: np.ndarray, d_units: np.ndarray) -> np.ndarray:
    """Return the gradients (N, D) with respect to v: (I - u u^T) d_u / |v|, where u = v / |v|."""
    along = np.sum(units * d_units, axis=-1, keepdims=True)
    return (d_units - units * along) / norms[:, None]


def _rows_of_matrices(*rows: list[np.ndarray]) -> np.ndarray:
    """Return (N, rows, columns) from rows of entries that are (N,) each."""
    return np.moveaxis(np.array(rows), -1, 0)


def _rows_where(condition: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return ``values`` (N, ...) with zeros in the rows where ``condition`` (N,) is false."""
    return np.where(condition.reshape((-1,) + (1,) * (values.ndim - 1)), values, 0.0)


def _transpose(matrices: np.ndarray) -> np.ndarray:
    return np.swapaxes(matrices, -1, -2)
