"""The reference, one approximation at a time: each that 3DGS makes is a choice here.

Studies and tests import it. It imports nothing of drgs but ``drgs.reference``, and is to be read
after it. The default ``ImageModel`` is ``reference.render``; every field of it replaces one
approximation, so that a kernel which makes other choices has an independent float64 computation to
agree with.

Where ``reference`` walks over splats, this file works on matrices of P pixels by N splats::

    Gaussians, Camera
      -> _splats     the splats on the film, and along its rays      (N splats)
      -> _boxes      the pixels that each may reach                  (N boxes)
      -> _blocks     parts of the film with the splats that reach into them
      -> _peaks      response, sort key and depth                    (P, N)
      -> _composite  weights, transmittance                          (P, N) and (P,)

Notation, with m the mean, S the covariance, both in camera axes, (fx, fy) the focal lengths in
px, u0 = (m_x / m_z, m_y / m_z) the mean's slope:

    F  = diag(fx, fy)           A0 = [I | -u0], the 2 x 3 projection along the mean's ray
    C  = F A0 S A0^T F / m_z^2 + low_pass I   px^2, covariance on the film   (EWA, section 4)
    k  = F A0 S e_z / m_z^2     px, covariance of the place on the film with relative depth
    w  = S_zz / m_z^2           variance of relative depth
    d  = pixel - mean2d         px

A point p = t r of the ray r through the pixel is at (q d, q - 1), q = t / m_z, in the coordinates
(F A0 (p - m) / m_z, (p_z - m_z) / m_z), in which the covariance is [[C, k], [k^T, w]]. With the
Schur complement h = w - k^T C^-1 k and a = 1 - k^T C^-1 d, the squared Mahalanobis distance is

    rho^2(q) = q^2 d^T C^-1 d + (q a - 1)^2 / h

which is least at q = a / D, D = a^2 + h d^T C^-1 d, where it is d^T C^-1 d / D. EWA is D = 1.

Sources are those of ``reference``, and:

- UT: Julier, "The Scaled Unscented Transformation", American Control Conference, 2002; for
  splats: Wu et al., "3DGUT", CVPR 2025.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from math import inf, isfinite
from types import SimpleNamespace
from typing import Literal, TypeVar, cast

import numpy as np
import pydantic
from drgs.reference import splatting as reference
from drgs.reference.splatting import Camera, Gaussians, RenderedImage
from numpy.typing import ArrayLike
from pydantic import Field

Rows = TypeVar("Rows")  # a dataclass of arrays (N, ...)

MAX_PAIRS = 2**15
"""Pairs of a pixel and a splat that are evaluated at a time: some 100 numbers each, so 25 MB,
whatever the film and the scene; with more, fewer of them reach each other."""

MIN_RELATIVE_STD = 1e-30
"""Least standard deviation of an exact splat, relative to its largest (without a low-pass) or to
its depth (with one): far below rounding, so that it changes nothing, and far from overflow in the
fourth powers of its inverse. It gives a disc of thickness zero its limit."""

MIN_POINT_DEPTH = 1 / 3
"""Sigma points nearer than this part of the mean's depth say nothing about a splat."""

OPEN_CONE = 1e-6
"""An ellipsoid this close (squared, relative) to the plane z = 0 is given the whole film."""


# ---- Types -----------------------------------------------------------------------------------


@pydantic.dataclasses.dataclass(frozen=True)
class ImageModel:
    """The approximations of an image of Gaussians; the defaults are those of 3DGS.

    projection: ``"ewa"``, the affine approximation at the mean; ``"unscented"``, mean and
    covariance of seven projected sigma points; ``"exact"``, the peak along each pixel's ray.

    order: by ``"center"``, the mean's camera z; by ``"pixel"``, the depth of the peak along the
    pixel's ray; by ``"entry"``, where that ray enters the ellipsoid of ``extent`` (exact only).

    sh_direction: colours are seen along the ray to the ``"mean"`` or to the ``"pixel"``.

    stop: a pixel is finished ``"before"`` the splat that takes its transmittance below
    transmittance_stop, which is then not composited, or ``"after"`` it. step: of order ``"entry"``;
    a ray that has entered a splat goes on so far behind the entry, passing over what it enters.

    Raises ValueError for unknown choices and numbers out of range.
    """

    projection: Literal["ewa", "unscented", "exact"] = "ewa"
    order: Literal["center", "pixel", "entry"] = "center"
    sh_direction: Literal["mean", "pixel"] = "mean"
    stop: Literal["before", "after"] = "before"
    alpha_max: float = Field(default=reference.ALPHA_MAX, gt=0, le=1)  # upper clamp; 1: none
    alpha_cut: float = Field(default=reference.ALPHA_CUT, ge=0, lt=1)  # smaller: does not exist
    transmittance_stop: float = Field(default=reference.TRANSMITTANCE_STOP, ge=0, lt=1)  # 0: none
    extent: float = Field(default=inf, gt=0)  # standard deviations of a splat
    step: float = Field(default=0.0, ge=0, lt=inf)  # world units along the ray
    low_pass: float = Field(default=reference.LOW_PASS, ge=0, lt=inf)  # px^2; 0: none
    antialiased: bool = False  # opacities compensate for the low-pass (Mip-Splatting)
    sh_degree: int | None = None  # None: all that is stored

    def __post_init__(self) -> None:
        """Refuse an entry that nothing defines."""
        if self.order == "entry" and not (self.projection == "exact" and isfinite(self.extent)):
            raise ValueError("order 'entry' needs projection 'exact' and a finite extent")
        if self.step > 0 and self.order != "entry":
            raise ValueError("a step needs order 'entry'")


DEFAULT_MODEL = ImageModel()


@dataclass(frozen=True)
class _Splats:
    """N visible splats, in ascending index of their Gaussians; see the module for the symbols."""

    depths: np.ndarray  # (N,) m_z, world units
    opacities: np.ndarray  # (N,) after compensation
    means2d: np.ndarray  # (N, 2) px, film
    cov2d: np.ndarray  # (N, 2, 2) C, px^2, low-pass included
    dets: np.ndarray  # (N,) det C
    depth_cov: np.ndarray  # (N, 2) k, px
    depth_var: np.ndarray  # (N,) w
    whitened: np.ndarray  # (N, 3, 3) "exact": see ``_whitened_rays``; else zeros
    colors: np.ndarray  # (N, 3) display space, seen along the ray to the mean
    sh: np.ndarray  # (N, K, 3) coefficients


@dataclass(frozen=True)
class _Peaks:
    """The peaks of N splats along the rays of P pixels, (P, N)."""

    rho_sq: np.ndarray  # squared distance from the mean, standard deviations
    depths: np.ndarray  # t, camera z of the peak, world units
    keys: np.ndarray  # what compositing sorts by, world units
    ahead: np.ndarray  # relative to m_z: the splat does not exist where this is <= 0


# ---- The image -------------------------------------------------------------------------------


def render(
    gaussians: Gaussians,
    camera: Camera,
    background: ArrayLike = (0.0, 0.0, 0.0),
    model: ImageModel = DEFAULT_MODEL,
    region: tuple[slice, slice] | None = None,
    positions: np.ndarray | None = None,
    threshold_width: float = reference.THRESHOLD_WIDTH,
) -> RenderedImage:
    """Return the image of Gaussians under a model; with a region, that part of it.

    background: (3,) display space; region: rows and columns of the film, None for all; positions:
    (camera.height, camera.width, 2) px, film, the (x, y) at which each pixel is evaluated, None for
    the centres; threshold_width: relative distance from a threshold within which a pixel is marked
    in ``RenderedImage.near_threshold``: alpha from the cut and the clamp, transmittance from the
    stop, rho^2 from extent^2, the peak (or entry) from the ray's origin, and, unless order is
    ``"center"``, the sort keys of consecutive splats from each other.

    ``RenderedImage.depth`` sums the means' camera z for order ``"center"``, else that of the peaks.
    """
    if positions is None:
        positions = reference.pixel_centers(camera.width, camera.height)
    positions = positions if region is None else positions[region]
    background = np.asarray(background, dtype=np.float64)
    splats = _splats(gaussians, camera, model)
    boxes = _boxes(splats, model, positions, threshold_width)

    shape = positions.shape[:2]
    image, depth = np.zeros((*shape, 3)), np.zeros(shape)
    transmittance, near_threshold = np.ones(shape), np.zeros(shape, dtype=bool)
    whole = slice(0, shape[0]), slice(0, shape[1])
    for place, near in _blocks(*whole, boxes, np.arange(len(boxes))):
        points, local = positions[place].reshape(-1, 2), _rows(splats, near)
        slopes = (points - camera.principal) / camera.focal
        rays = np.column_stack([slopes, np.ones(len(slopes))])
        steps = model.step / np.linalg.norm(rays, axis=1)  # in camera z
        peaks = _peaks(local, points, model)
        weights, behind, marks = _composite(local, peaks, steps, model, threshold_width)
        if model.sh_direction == "mean":
            colors = weights @ local.colors
        else:
            colors = _colors_along(local, rays @ camera.rotation, weights)
        block_shape = transmittance[place].shape
        image[place] = (colors + behind[:, None] * background).reshape(*block_shape, 3)
        depth[place] = np.sum(weights * peaks.depths, axis=1).reshape(block_shape)
        transmittance[place] = behind.reshape(block_shape)
        near_threshold[place] = marks.reshape(block_shape)
    return RenderedImage(image, 1 - transmittance, depth, transmittance, near_threshold)


def render_along(
    gaussians: Gaussians,
    origins: np.ndarray,
    directions: np.ndarray,
    colors: np.ndarray | None = None,
    widening: np.ndarray | float = 0.0,
    centers: np.ndarray | None = None,
    far: ArrayLike = inf,
    background: ArrayLike = (0.0, 0.0, 0.0),
    model: ImageModel = DEFAULT_MODEL,
    threshold_width: float = reference.THRESHOLD_WIDTH,
) -> RenderedImage:
    """Return the image along given rays, which may be those of any lens and of any motion.

    A Gaussian's response to a ray is that of its peak along it, ``ImageModel.projection`` exact.

    origins, directions: (H, W, 3) world, depth grows by 1 along a direction; NaN: no ray. colors:
    (N, 3), display space; None: along each ray. widening: (N, 3, 3) added to the covariances,
    world. centers: (N,) depths of the means, by which splats are sorted; None: by the depths of
    their peaks. far: (H, W) depths from which on nothing is seen.

    With W W^T = S^-1, m = W^T (mean - origin), v = W^T direction: the peak is at t = m . v / |v|^2,
    and rho^2 = |m x v|^2 / |v|^2.
    """
    height, width, _ = origins.shape
    rotations = reference.quat_to_rotation(gaussians.quats)
    if np.any(widening):
        axes = rotations * np.exp(gaussians.log_scales)[:, None]
        total = axes @ np.swapaxes(axes, 1, 2) + widening
        whitening = np.linalg.inv(np.linalg.cholesky(total))
    else:
        whitening = np.swapaxes(rotations, 1, 2) / np.exp(gaussians.log_scales)[:, :, None]
    rows = whitening.reshape(-1, 3).T
    start = np.nan_to_num(origins).reshape(-1, 3)
    means = np.einsum("nij,nj->ni", whitening, gaussians.means - start[0])
    m = means - ((start - start[0]) @ rows).reshape(len(start), -1, 3)
    v = (np.nan_to_num(directions).reshape(-1, 3) @ rows).reshape(len(start), -1, 3)
    squared = np.maximum(np.sum(v**2, axis=-1), 1e-300)
    t = np.sum(m * v, axis=-1) / squared
    rho_sq = np.sum(np.cross(m, v) ** 2, axis=-1) / squared
    keys = t if centers is None else np.broadcast_to(centers, t.shape)
    within = np.minimum(t, np.broadcast_to(far, (height, width)).reshape(-1, 1) - t)
    is_ray = np.isfinite(directions).all(axis=-1).reshape(-1, 1)
    peaks = _Peaks(rho_sq, keys, keys, np.where(is_ray, within, -inf))
    opacities = reference.sigmoid(gaussians.logit_opacities)
    splats = cast(_Splats, SimpleNamespace(opacities=opacities, sh=gaussians.sh))
    weights, behind, marks = _composite(splats, peaks, np.zeros(len(t)), model, threshold_width)
    if colors is None:
        seen = _colors_along(splats, directions.reshape(-1, 3), weights)
    else:
        seen = weights @ colors
    image = (seen + behind[:, None] * background).reshape(height, width, 3)
    depth = np.sum(weights * keys, axis=1).reshape(height, width)
    behind = behind.reshape(height, width)
    return RenderedImage(image, 1 - behind, depth, behind, marks.reshape(height, width))


def _colors_along(splats: _Splats, rays: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return (P, 3), display space: sums of weights (P, N) times colours along rays (P, 3)."""
    directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    basis = reference.sh_basis(directions, round(splats.sh.shape[1] ** 0.5) - 1)
    colors = np.maximum(np.einsum("pk,nkc->pnc", basis, splats.sh) + 0.5, 0.0)
    return np.einsum("pn,pnc->pc", weights, colors)


# ---- Splats ----------------------------------------------------------------------------------


def _splats(gaussians: Gaussians, camera: Camera, model: ImageModel) -> _Splats:
    """Return the splats of the Gaussians that are in front of the near plane and not too faint.

    Those whose covariance on the film is singular, which low_pass = 0 permits, cover no pixel and
    are left out; an exact splat needs only one of its three scales to be positive.
    """
    camera_z = (gaussians.means - camera.center) @ camera.rotation[2]
    gaussians = _rows(gaussians, camera_z >= camera.near)
    degree = gaussians.sh_degree if model.sh_degree is None else model.sh_degree

    affine = reference.local_affine(gaussians, camera)
    z = affine.means[:, 2]
    slopes = affine.means[:, :2] / z[:, None] if model.projection == "exact" else affine.ratios
    axes2d = _film_axes(affine, camera, slopes)
    depth_cov = np.einsum("nij,nj->ni", axes2d, affine.axes[:, 2]) / z[:, None]
    means2d = camera.film_points(affine.means)
    if model.projection == "unscented":
        means2d, axes2d = _unscented_transform(affine, camera, means2d)
    cov2d, dets, areas = reference.widened_covariances(axes2d, model.low_pass)

    opacities = reference.sigmoid(gaussians.logit_opacities)
    if model.antialiased and model.low_pass > 0:
        opacities = opacities * areas / np.sqrt(dets)
    extended, whitened = dets > 0, np.zeros((len(z), 3, 3))
    if model.projection == "exact":
        extended = affine.scales.max(axis=1) > 0
        whitened = _whitened_rays(affine, camera, model.low_pass)
    depth_var = np.sum((affine.axes[:, 2] / z[:, None]) ** 2, axis=-1)
    colors = reference.sh_colors(gaussians, camera, degree)
    sh = gaussians.sh[:, : (degree + 1) ** 2]
    splats = _Splats(z, opacities, means2d, cov2d, dets, depth_cov, depth_var, whitened, colors, sh)
    return _rows(splats, (opacities > model.alpha_cut) & (extended | (model.low_pass > 0)))


def _film_axes(affine: reference.LocalAffine, camera: Camera, slopes: np.ndarray) -> np.ndarray:
    """Return M = F A0 V / m_z (N, 2, 3), px, S = V V^T, where A0 has the given slopes (N, 2)."""
    along_film = affine.axes[:, :2] - slopes[:, :, None] * affine.axes[:, 2:]
    return along_film * camera.focal[:, None] / affine.means[:, 2, None, None]


def _unscented_transform(
    affine: reference.LocalAffine, camera: Camera, means2d: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean (N, 2), px, and M (N, 2, 7), px, with covariance M M^T, of sigma points.

    They are the mean and, for each half axis a_i, m +- sqrt(3) a_i: UT with n = 3, alpha = 1,
    beta = 2, kappa = 0, hence lambda = 0, weights of the mean 0 and 1/6, and of the covariance 2
    and 1/6. Splats that have a point nearer than ``MIN_POINT_DEPTH`` of their depth, or whose slope
    is clamped, are projected by the affine approximation. means2d: projections of the means.
    """
    steps = np.sqrt(3.0) * np.swapaxes(affine.axes, 1, 2)
    means = affine.means[:, None]
    points = np.concatenate([means, means + steps, means - steps], axis=1)
    nearest = points[..., 2].min(axis=1)
    usable = affine.unclamped.all(axis=1) & (nearest >= MIN_POINT_DEPTH * affine.means[:, 2])
    film = camera.film_points(np.where(usable[:, None, None], points, means))
    centers = np.sum(film[:, 1:], axis=1) / 6
    weights = np.array([2.0] + 6 * [1 / 6])
    axes2d = np.swapaxes((film - centers[:, None]) * np.sqrt(weights)[:, None], 1, 2)
    affine_axes = np.zeros_like(axes2d)
    affine_axes[:, :, :3] = affine.axes2d
    usable = usable[:, None]
    return np.where(usable, centers, means2d), np.where(usable[:, None], axes2d, affine_axes)


def _whitened_rays(affine: reference.LocalAffine, camera: Camera, low_pass: float) -> np.ndarray:
    """Return (N, 3, 3), columns B e_x / fx, B e_y / fy and B m / m_z, with B^T B = S'^-1.

    The ray through the pixel at ``mean2d + d`` is whitened to B r = (B m / m_z) + B (F^-1 d, 0).
    S' = S + low_pass m_z^2 diag(1 / fx^2, 1 / fy^2, 0) is the Gaussian widened along the film.

    Neither S' nor its inverse is formed: their small eigenvalues would cancel. Without a low-pass
    B = diag(1 / s) R^T W^-1. With one, S' = N N^T, where N (3 x 5) has the half axes and the two
    widenings in its columns; its rows are orthonormalised, N = L Q, and B = L^-1. With z last, L
    is bounded below by the low-pass except in its last element, the deviation in depth at a fixed
    place on the film, which is small only where the whole row is.
    """
    focal, z = camera.focal, affine.means[:, 2]
    if low_pass == 0:
        largest = np.max(affine.scales, axis=1, keepdims=True)
        largest = np.where(largest > 0, largest, 1.0)
        scales = np.maximum(affine.scales, MIN_RELATIVE_STD * largest)
        # W^-1, not W^T: a rotation that was rounded to single precision is orthogonal to 1e-7.
        from_camera = np.swapaxes(affine.rotations, 1, 2) @ np.linalg.inv(camera.rotation)
        whitening = from_camera / scales[:, :, None]
    else:
        widening = np.sqrt(low_pass) * z[:, None, None] * np.eye(3)[:, :2] / focal
        rows = np.concatenate([affine.axes, widening], axis=2)
        whitening = _inverse_factors(rows, smallest=MIN_RELATIVE_STD * z)
    mean_rays = affine.means / z[:, None]
    return np.concatenate([whitening[:, :, :2] / focal, whitening @ mean_rays[:, :, None]], axis=2)


def _inverse_factors(rows: np.ndarray, smallest: np.ndarray) -> np.ndarray:
    """Return L^-1 (N, 3, 3) of rows = L Q (N, 3, K), Q orthonormal rows, L lower triangular.

    Modified Gram-Schmidt. Diagonal elements of L are raised to ``smallest`` (N,).
    """
    inverse = np.tile(np.eye(3), (len(rows), 1, 1))
    rest = rows.copy()
    for i in range(3):
        for j in range(i):
            factor = np.sum(rest[:, i] * rest[:, j], axis=-1)[:, None]
            rest[:, i] -= factor * rest[:, j]
            inverse[:, i] -= factor * inverse[:, j]
        length = np.maximum(np.linalg.norm(rest[:, i], axis=-1), smallest)[:, None]
        rest[:, i] /= length
        inverse[:, i] /= length
    return inverse


# ---- A splat at a pixel ----------------------------------------------------------------------


def _peaks(splats: _Splats, points: np.ndarray, model: ImageModel) -> _Peaks:
    """Return the peaks of N splats at pixels that are evaluated at points (P, 2), px, film."""
    offsets = points[:, None] - splats.means2d
    peaks = _exact_peaks if model.projection == "exact" else _affine_peaks
    return _Peaks(*np.broadcast_arrays(*peaks(splats, offsets, model)))


def _affine_peaks(splats: _Splats, offsets: np.ndarray, model: ImageModel) -> tuple:
    """Return the peaks of Gaussians on the film: rho^2 = d^T C^-1 d, t = m_z a / D.

    With C = L L^T, e = L^-1 d and kappa = L^-1 k: rho^2 = |e|^2, a = 1 - kappa . e,
    h = w - |kappa|^2, D = a^2 + h |e|^2. Order ``"center"`` does not ask for the depth, and a
    splat then exists whatever the sign of a.
    """
    z = splats.depths
    e = _whitened_on_film(splats, offsets)
    rho_sq = np.sum(e**2, axis=-1)
    if model.order == "center":
        return rho_sq, z, z, 1.0
    kappa = _whitened_on_film(splats, splats.depth_cov)
    a = 1 - np.sum(kappa * e, axis=-1)
    h = np.maximum(splats.depth_var - np.sum(kappa**2, axis=-1), 0.0)
    t = z * a / np.where(a > 0, a**2 + h * rho_sq, 1.0)
    return rho_sq, t, t, a


def _whitened_on_film(splats: _Splats, vectors: np.ndarray) -> np.ndarray:
    """Return L^-1 v (..., N, 2) for vectors v (..., N, 2) px, C = L L^T, L triangular."""
    variance, covariance = splats.cov2d[:, 0, 0], splats.cov2d[:, 0, 1]
    first = vectors[..., 0] / np.sqrt(variance)
    rest = vectors[..., 1] - covariance / variance * vectors[..., 0]
    return np.stack([first, rest / np.sqrt(splats.dets / variance)], axis=-1)


def _exact_peaks(splats: _Splats, offsets: np.ndarray, model: ImageModel) -> tuple:
    """Return the peaks of Gaussians along rays r, at t = Br . Bm / |Br|^2.

    rho^2 = |Bm x Br|^2 / |Br|^2, where Bm x Br = Bm x B (r - m / m_z) does not cancel near the
    mean. The ray enters the ellipsoid rho = extent at sqrt(extent^2 - rho^2) / |Br| before t.
    """
    z, (x_axis, y_axis, to_mean) = splats.depths, np.moveaxis(splats.whitened, 2, 0)
    sideways = x_axis * offsets[..., :1] + y_axis * offsets[..., 1:]
    ray = to_mean + sideways
    ray_sq = np.sum(ray**2, axis=-1)
    rho_sq = z**2 * np.sum(np.cross(to_mean, sideways) ** 2, axis=-1) / ray_sq
    t = z * np.sum(ray * to_mean, axis=-1) / ray_sq
    if model.order == "center":
        return rho_sq, z, z, t / z
    if model.order == "pixel":
        return rho_sq, t, t, t / z
    entry = t - np.sqrt(np.maximum(model.extent**2 - rho_sq, 0.0) / ray_sq)
    return rho_sq, t, entry, entry / z


# ---- Which pixels a splat may reach ----------------------------------------------------------


def _boxes(
    splats: _Splats, model: ImageModel, positions: np.ndarray, threshold_width: float
) -> np.ndarray:
    """Return (N, 2, 2) [first, end) columns and rows of the image that each splat may reach.

    positions: (H, W, 2) px, film. One pixel is added for rounding.
    """
    size = np.array([positions.shape[1], positions.shape[0]])
    if not size.all():
        return np.zeros((len(splats.depths), 2, 2), dtype=int)
    low, high = _film_bounds(splats, model, threshold_width)
    indices = np.stack(np.meshgrid(np.arange(size[0]), np.arange(size[1])), axis=-1)
    shifts = positions - indices
    first = np.ceil(low - shifts.max(axis=(0, 1)) - 1)
    last = np.floor(high - shifts.min(axis=(0, 1)) + 1)
    # fmin and fmax also send a NaN to the border, so that the conversion is defined.
    first = np.fmin(np.fmax(first, 0), size)
    end = np.fmax(np.fmin(last + 1, size), first)
    return np.stack([first, end], axis=-1).astype(int)


def _film_bounds(
    splats: _Splats, model: ImageModel, threshold_width: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the lowest and highest film positions (N, 2), px, at which a splat may exist.

    rho <= d, from the extent and from o exp(-d^2 / 2) = alpha_cut, bounds a Gaussian on the film
    by d sqrt(C_xx). An exact one is bounded by the planes through the x or y axis that touch the
    ellipsoid rho = d: with l = A0^T e_x - y e_z / fx, one that passes y px beside the mean,
    (l . m)^2 = d^2 l^T S' l is

        (1 - d^2 w) y^2 + 2 d^2 k_x y - d^2 C_xx = 0

    Where d^2 w >= 1 the ellipsoid reaches the plane z = 0, and there is no bound.
    """
    reach_sq = np.full(len(splats.depths), model.extent**2 * (1 + threshold_width))
    if model.alpha_cut > 0:
        cut = model.alpha_cut * (1 - threshold_width)
        reach_sq = np.minimum(reach_sq, 2 * np.log(splats.opacities / cut))
    variances = np.diagonal(splats.cov2d, axis1=1, axis2=2)
    if model.projection != "exact":
        half_sizes = np.sqrt(reach_sq[:, None] * variances)
        return splats.means2d - half_sizes, splats.means2d + half_sizes
    finite = np.isfinite(reach_sq)
    reach_sq = np.where(finite, reach_sq, 0.0)
    bounded = finite & (reach_sq * splats.depth_var < 1 - OPEN_CONE)
    reach_sq = np.where(bounded, reach_sq, 0.0)[:, None]
    closing = 1 - reach_sq * splats.depth_var[:, None]
    middle = -reach_sq * splats.depth_cov
    half_sizes = np.sqrt(middle**2 + closing * reach_sq * variances)
    half_sizes = np.where(bounded[:, None], half_sizes, inf)
    return (
        splats.means2d + (middle - half_sizes) / closing,
        splats.means2d + (middle + half_sizes) / closing,
    )


def _blocks(
    rows: slice, columns: slice, boxes: np.ndarray, near: np.ndarray
) -> Iterator[tuple[tuple[slice, slice], np.ndarray]]:
    """Yield parts of a rectangle, and the indices of the splats whose boxes reach into each.

    It is halved across its longer side until it has at most ``MAX_PAIRS`` pairs or one pixel. near:
    the indices among which those of the rectangle are.
    """
    start, stop = np.array([columns.start, rows.start]), np.array([columns.stop, rows.stop])
    reaches = (boxes[near, :, 0] < stop) & (boxes[near, :, 1] > start)
    near = near[reaches.all(axis=1)]
    width, height = stop - start
    if len(near) * width * height <= MAX_PAIRS or width * height == 1:
        yield (rows, columns), near
    elif height > width:
        middle = (rows.start + rows.stop) // 2
        yield from _blocks(slice(rows.start, middle), columns, boxes, near)
        yield from _blocks(slice(middle, rows.stop), columns, boxes, near)
    else:
        middle = (columns.start + columns.stop) // 2
        yield from _blocks(rows, slice(columns.start, middle), boxes, near)
        yield from _blocks(rows, slice(middle, columns.stop), boxes, near)


# ---- Compositing -----------------------------------------------------------------------------


def _composite(
    splats: _Splats, peaks: _Peaks, steps: np.ndarray, model: ImageModel, threshold_width: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the weights T alpha (P, N), the transmittance (P,) and the marks (P,) of P pixels.

    steps: (P,) the model's step in the units of the keys.

    Transmittance is a cumulative product, and as it never rises, a pixel is finished exactly where
    it is below the stop. Pairs that do not exist, even in single precision, come last.
    """
    raw, far = splats.opacities * np.exp(-0.5 * peaks.rho_sq), model.extent**2
    exists = (raw >= model.alpha_cut) & (peaks.rho_sq <= far) & (peaks.ahead > 0)
    possible = (
        (raw >= model.alpha_cut * (1 - threshold_width))
        & (peaks.rho_sq <= far * (1 + threshold_width))
        & (peaks.ahead > -threshold_width)
    )
    undecided = possible & (
        _is_near(raw, model.alpha_cut, threshold_width)
        | _is_near(raw, model.alpha_max, threshold_width)
        | _is_near(peaks.rho_sq, far, threshold_width)
        | (np.abs(peaks.ahead) <= threshold_width)
    )
    keys = np.where(possible, peaks.keys, inf)
    alphas = np.where(exists, np.minimum(raw, model.alpha_max), 0.0)
    order = np.argsort(keys, axis=1, kind="stable")
    keys, alphas, near = (np.take_along_axis(m, order, axis=1) for m in (keys, alphas, undecided))

    if model.step > 0:
        alphas = np.where(_passed_over(alphas > 0, keys, steps), 0.0, alphas)
    behind = np.cumprod(1 - alphas, axis=1)
    before = np.column_stack([np.ones(len(behind)), behind])[:, :-1]
    unfinished = before >= model.transmittance_stop
    composited = unfinished if model.stop == "after" else behind >= model.transmittance_stop
    weights = np.zeros_like(alphas)
    np.put_along_axis(weights, order, np.where(composited, before * alphas, 0.0), axis=1)
    transmittance = np.min(np.where(composited, behind, 1.0), axis=1, initial=1.0)

    near |= (alphas > 0) & _is_near(behind, model.transmittance_stop, threshold_width)
    if model.order != "center":
        near |= (alphas > 0) & _follows_closely(keys, threshold_width)
    return weights, transmittance, np.any(unfinished & near, axis=1)


def _is_near(values: np.ndarray, threshold: float, width: float) -> np.ndarray:
    """Return (P, N) bool: within ``width``, relative; nothing is near a threshold of 0 or inf."""
    if threshold == 0 or not isfinite(threshold):
        return np.zeros(np.shape(values), dtype=bool)
    return np.abs(values - threshold) <= width * threshold


def _passed_over(exists: np.ndarray, keys: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Return (P, N) bool: the splat's key is within the step (P,) behind the last one entered."""
    passed, last = np.zeros_like(exists), np.full(len(keys), -inf)
    for rank in range(keys.shape[1]):
        passed[:, rank] = exists[:, rank] & (keys[:, rank] < last + steps)
        last = np.where(exists[:, rank] & ~passed[:, rank], keys[:, rank], last)
    return passed


def _follows_closely(keys: np.ndarray, width: float) -> np.ndarray:
    """Return (P, N) bool: the sort key (P, N) is that of the splat before it, within ``width``.

    A splat that does not exist may stand between two that do: it is near a threshold itself.
    """
    with np.errstate(invalid="ignore"):  # of those that do not exist
        return np.diff(keys, axis=1, prepend=-inf) <= width * np.abs(keys)


# ---- Small helpers ---------------------------------------------------------------------------


def _rows(data: Rows, chosen: np.ndarray) -> Rows:
    """Return some rows; chosen: indices, or a mask (N,)."""
    return type(data)(**{name: array[chosen] for name, array in vars(data).items()})
