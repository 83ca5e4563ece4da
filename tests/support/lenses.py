"""The reference of lenses: where splats lie, how large, and seen along what.

It imports nothing of this package but ``reference``, and is to be read after it. A lens replaces
``project`` and ``sh_colors`` of ``reference.render``.

The Jacobian of a lens is a difference quotient of its ``film_points``: no derivative is written
down here, so that the kernels, which have formulas, have an independent computation to agree with.

Sources are those of ``reference``, and:

- OpenCV: its documentation of ``calib3d`` ("Camera Calibration and 3D Reconstruction", the
  rational model) and of ``cv::fisheye``.
- Kannala, Brandt, "A Generic Camera Model and Calibration Method for Conventional, Wide-Angle,
  and Fish-Eye Lenses", IEEE TPAMI 28(8), 2006: the fisheye's polynomial.
- COLMAP: ``sensor/models.h``, the model THIN_PRISM_FISHEYE; Weng, Cohen, Herniou, "Camera
  Calibration with Distortion Models and Accuracy Evaluation", IEEE TPAMI 14(10), 1992: thin prisms.

Spaces, units and orders are those of ``reference``. A *slope* is (x/z, y/z) of a point in camera
axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from math import inf, pi, sqrt

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import root_scalar
from typing_extensions import override

from drgs.reference import splatting as reference
from drgs.reference.splatting import Camera, Gaussians, Projection, RenderedImage

FISHEYE_MAX_ANGLE = 0.95 * pi
"""rad: at pi, straight behind, a fisheye smears one point over a circle and J is infinite."""

BORDER_SAMPLES = 65
"""Points of each edge of the film, corners included, whose slopes bound an OpenCV lens's image.
Between two of 65, a border bent like a circle arc bulges 1 / 64^2 of its own bulge."""

FOLD_RADII, FOLD_STEPS = (1e-3, 1e6), 1000
"""Range in which a lens with tangential terms is searched for a fold: slopes, or angles in rad, in
steps of two percent."""

REAL_ROOT = 1e-7
"""A root with a smaller imaginary part (relative) is real: a double root is found to within the
square root of rounding, 1.5e-8."""

DIFFERENCE_STEP = 2.0**-9
"""Step of the central differences, relative to the point's distance from the camera: they are off
by the eighth power of (step / distance to the nearest pole), and by rounding / step = 1e-13."""

CENTRAL_WEIGHTS = (4 / 5, -1 / 5, 4 / 105, -1 / 280)
"""Central differences of order 8: f'(x) h = sum_j w_j (f(x + j h) - f(x - j h)), j = 1 to 4."""


# ---- Lenses ----------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lens:
    """The mapping of points to the film. Methods that a lens does not define are a pinhole's.

    ``points`` are (M, 3) in camera axes (x right, y down, z forward), world units.
    """

    def film_points(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        """Return (M, 2), px, film; meaningless for points that are not seen."""
        raise NotImplementedError

    def depths(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        """Return (M,), world units: the order of splats, compared with the near plane.

        Here: z.
        """
        return points[:, 2]

    def is_seen(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        """Return (M,) bool: the lens maps the point, onto the film or beside it.

        Here: depth >= near.
        """
        return self.depths(camera, points) >= camera.near

    def view_directions(self, camera: Camera, means: np.ndarray) -> np.ndarray:
        """Return (N, 3), unit, world: directions to the means (N, 3), world.

        Here: from the camera's centre to the mean.
        """
        directions, _ = reference._normalize(means - camera.center, fallback=(0.0, 0.0, 1.0))
        return directions

    def slope_bounds(self, camera: Camera) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the lowest and highest slopes (2,), (2,) of the film's border.

        Within these bounds, widened by ``reference.FRUSTUM_MARGIN``, J is evaluated. None: at the
        mean itself, wherever it is.
        """
        return None

    def period(self, camera: Camera) -> float | None:
        """Return after how many px along x the film shows the same again; None: it does not."""
        return None

    def derivative_steps(self, points: np.ndarray) -> np.ndarray:
        """Return (M,), world units: lengths within which ``film_points`` is smooth at points."""
        return np.linalg.norm(points, axis=1)


@dataclass(frozen=True)
class Pinhole(Lens):
    """film = (fx x/z + cx, fy y/z + cy)."""

    @override
    def film_points(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        return camera.film_points(points)

    @override
    def slope_bounds(self, camera: Camera) -> tuple[np.ndarray, np.ndarray]:
        """Return the slopes (2,), (2,) of the film's corners (0, 0) and (W, H)."""
        lower, upper = (0 - camera.principal), (camera.size - camera.principal)
        return lower / camera.focal, upper / camera.focal


@dataclass(frozen=True)
class OpenCV(Lens):
    """Radial and tangential distortion: OpenCV's rational model, without thin prism and tilt.

    With (x, y) the slope, r^2 = x^2 + y^2, the distorted slope is

        x'' = x q + 2 p1 x y + p2 (r^2 + 2 x^2)
        y'' = y q + p1 (r^2 + 2 y^2) + 2 p2 x y
        q = (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)

    and film = (fx x'' + cx, fy y'' + cy). OpenCV's own vector of coefficients has another order:
    k1, k2, p1, p2, k3, k4, k5, k6.
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    k5: float = 0.0
    k6: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @override
    def film_points(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        slopes = points[:, :2] / points[:, 2:]
        return camera.focal * self.distort(slopes) + camera.principal

    @override
    def is_seen(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        """Return (M,) bool: z >= near, and the slope's length is below ``valid_radius``.

        Slopes beyond would fold back into the image.
        """
        in_front = points[:, 2] >= camera.near
        z = np.where(in_front, points[:, 2], 1.0)
        radii = np.linalg.norm(points[:, :2], axis=1) / z
        return in_front & (radii < self.valid_radius)

    @override
    def slope_bounds(self, camera: Camera) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the bounding box of the undistorted slopes of the film's border.

        None if one of the border's points is the image of no slope within ``valid_radius``: the
        slopes of the others need not hold all that the film shows.
        """
        border = (_film_border(camera) - camera.principal) / camera.focal
        slopes = self.undistort(border)
        return (slopes.min(axis=0), slopes.max(axis=0)) if np.isfinite(slopes).all() else None

    def distort(self, slopes: np.ndarray) -> np.ndarray:
        """Return (..., 2) distorted slopes of slopes (..., 2), which may be complex."""
        x, y = slopes[..., 0], slopes[..., 1]
        r2 = x * x + y * y
        numerator = 1 + self.k1 * r2 + self.k2 * r2**2 + self.k3 * r2**3
        denominator = 1 + self.k4 * r2 + self.k5 * r2**2 + self.k6 * r2**3
        ratio = numerator / denominator
        return np.stack(
            [
                x * ratio + 2 * self.p1 * x * y + self.p2 * (r2 + 2 * x * x),
                y * ratio + self.p1 * (r2 + 2 * y * y) + 2 * self.p2 * x * y,
            ],
            axis=-1,
        )

    @property
    def valid_radius(self) -> float:
        """The radius within which no two slopes are distorted to the same; it may be infinite.

        Without tangential terms, the smallest r > 0 at which the derivative of r -> r q(r)
        vanishes, or q has a pole. With u = r^2, q = n(u) / d(u) and ' for d/du, the derivative is
        (d n + 2 u (d n' - n d')) / d^2.

        With them: where ``least_eigenvalue`` first vanishes, if that comes before. A symmetric
        Jacobian that is positive definite all over a disc is that of a one-to-one map.
        """
        n = np.polynomial.Polynomial([1.0, self.k1, self.k2, self.k3])
        d = np.polynomial.Polynomial([1.0, self.k4, self.k5, self.k6])
        u = np.polynomial.Polynomial([0.0, 1.0])
        slope = d * n + 2 * u * (d * n.deriv() - n * d.deriv())
        radius = sqrt(min(_first_positive_root(slope.coef), _first_positive_root(d.coef)))
        return _first_fold(self, radius) if self.p1 or self.p2 else radius

    def least_eigenvalue(self, radii: np.ndarray) -> np.ndarray:
        """Return (M,): no eigenvalue of the Jacobian, in any direction at radii (M,), is smaller.

        The least one of the radial part and the least one of the tangential part, in the direction
        where that is least, added (Weyl's inequality).
        """
        radial, tangential = replace(self, p1=0.0, p2=0.0), OpenCV(p1=self.p1, p2=self.p2)
        slopes = radii[:, None] * -_unit(np.array([self.p2, self.p1]))
        return _least_eigenvalues(radial, slopes) + _least_eigenvalues(tangential, slopes) - 1

    def undistort(self, slopes: np.ndarray) -> np.ndarray:
        """Return the slopes (M, 2) within ``valid_radius`` that are distorted to ``slopes`` (M, 2).

        NaN where there is none.
        """
        return _undistort(self, slopes, self.valid_radius)


@dataclass(frozen=True)
class Fisheye(Lens):
    """OpenCV's fisheye (Kannala, Brandt), also beyond 90 degrees from the axis.

    With rho = sqrt(x^2 + y^2) and theta = atan2(rho, z), the angle from the axis,

        theta_d = theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8)
        film = (fx, fy) theta_d / rho (x, y) + (cx, cy)
    """

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    @override
    def film_points(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        rho = np.linalg.norm(points[:, :2], axis=1)
        # On the axis (x, y) = 0, whatever it is multiplied by.
        theta_by_rho = np.arctan2(rho, points[:, 2]) / np.where(rho == 0, 1.0, rho)
        distorted = self.distort(theta_by_rho[:, None] * points[:, :2])
        return camera.focal * distorted + camera.principal

    def distort(self, places: np.ndarray) -> np.ndarray:
        """Return (..., 2) places theta_d / theta (u, v) of places (u, v) = theta / rho (x, y).

        They may be complex.
        """
        r2 = np.sum(places**2, axis=-1, keepdims=True)
        return places * (1 + self.k1 * r2 + self.k2 * r2**2 + self.k3 * r2**3 + self.k4 * r2**4)

    @override
    def depths(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        """Return (M,): distances from the camera's centre, world units."""
        return np.linalg.norm(points, axis=1)

    @override
    def is_seen(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        """Return (M,) bool: the distance is >= near, the angle from the axis < ``valid_angle``."""
        angles = np.arctan2(np.linalg.norm(points[:, :2], axis=1), points[:, 2])
        return (self.depths(camera, points) >= camera.near) & (angles < self.valid_angle)

    @property
    def valid_angle(self) -> float:
        """rad: the first theta at which d theta_d / d theta vanishes, FISHEYE_MAX_ANGLE at most."""
        slope = [1.0, 3 * self.k1, 5 * self.k2, 7 * self.k3, 9 * self.k4]
        return min(sqrt(_first_positive_root(slope)), FISHEYE_MAX_ANGLE)


@dataclass(frozen=True)
class ThinPrismFisheye(Fisheye):
    """COLMAP's fisheye with tangential and thin prism terms, also beyond 90 degrees from the axis.

    With (u, v) = theta / rho (x, y), where a fisheye without coefficients shows a point, and
    r^2 = u^2 + v^2 = theta^2,

        u' = u q + 2 p1 u v + p2 (r^2 + 2 u^2) + sx1 r^2
        v' = v q + p1 (r^2 + 2 v^2) + 2 p2 u v + sy1 r^2
        q = 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8

    and film = (fx u' + cx, fy v' + cy). COLMAP's own vector of coefficients has another order: k1,
    k2, p1, p2, k3, k4, sx1, sy1.
    """

    p1: float = 0.0
    p2: float = 0.0
    sx1: float = 0.0
    sy1: float = 0.0

    @override
    def distort(self, places: np.ndarray) -> np.ndarray:
        u, v = places[..., 0], places[..., 1]
        r2 = u * u + v * v
        tangential_and_prism = [
            2 * self.p1 * u * v + self.p2 * (r2 + 2 * u * u) + self.sx1 * r2,
            self.p1 * (r2 + 2 * v * v) + 2 * self.p2 * u * v + self.sy1 * r2,
        ]
        return super().distort(places) + np.stack(tangential_and_prism, axis=-1)

    @property
    @override
    def valid_angle(self) -> float:
        """rad: an angle within which no two places are distorted to the same.

        That of the radial terms, or where ``least_eigenvalue`` first vanishes, if that comes
        before. A map is one-to-one in a disc if the symmetric part of its Jacobian is positive
        definite all over it: on the line between two places, what it adds never turns back.
        """
        angle = super().valid_angle
        is_radial = not (self.p1 or self.p2 or self.sx1 or self.sy1)
        return angle if is_radial else _first_fold(self, angle)

    def least_eigenvalue(self, radii: np.ndarray) -> np.ndarray:
        """Return (M,): no eigenvalue of the Jacobian's symmetric part at radii (M,) is smaller.

        The least one of the radial terms and the least one of the others, in the direction where
        that is least, added (Weyl's inequality). At w = (u, v), with p = (p2, p1) and
        s = (sx1, sy1), the others are |w|^2 (p + s) + 2 (p . w) w, and the least eigenvalue of
        their symmetric part is (4 p + s) . w - |w| |2 p + s|.
        """
        p, s = np.array([self.p2, self.p1]), np.array([self.sx1, self.sy1])
        others = ThinPrismFisheye(p1=self.p1, p2=self.p2, sx1=self.sx1, sy1=self.sy1)
        radial = replace(self, p1=0.0, p2=0.0, sx1=0.0, sy1=0.0)
        places = radii[:, None] * -_unit(4 * p + s)
        return _least_eigenvalues(radial, places) + _least_eigenvalues(others, places) - 1

    def undistort(self, places: np.ndarray) -> np.ndarray:
        """Return the places (M, 2) within ``valid_angle`` that are distorted to ``places`` (M, 2).

        NaN where there is none.
        """
        return _undistort(self, places, self.valid_angle)


@dataclass(frozen=True)
class Orthographic(Lens):
    """film = (fx x + cx, fy y + cy), with fx and fy in px per world unit."""

    @override
    def film_points(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        return camera.focal * points[:, :2] + camera.principal

    @override
    def view_directions(self, camera: Camera, means: np.ndarray) -> np.ndarray:
        """Return (N, 3), unit, world: the camera's forward axis for all."""
        forward = camera.rotation[2] / np.linalg.norm(camera.rotation[2])
        return np.tile(forward, (len(means), 1))


@dataclass(frozen=True)
class Equirectangular(Lens):
    """All directions on one film: x is the longitude, y the latitude.

    With theta = atan2(x, z) and phi = atan2(y, sqrt(x^2 + z^2)), film =
    (W (theta / (2 pi) + 1/2), H (phi / pi + 1/2)). W and H are those of the film, px: focal
    lengths and principal point are not used.
    """

    @override
    def film_points(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        x, y, z = points.T
        angles = np.column_stack([np.arctan2(x, z) / 2, np.arctan2(y, np.hypot(x, z))])
        return camera.size * (angles / np.pi + 0.5)

    @override
    def depths(self, camera: Camera, points: np.ndarray) -> np.ndarray:
        """Return (M,): distances from the camera's centre, world units."""
        return np.linalg.norm(points, axis=1)

    @override
    def period(self, camera: Camera) -> float:
        return float(camera.width)

    @override
    def derivative_steps(self, points: np.ndarray) -> np.ndarray:
        """Return (M,): distances from the vertical axis."""
        return np.hypot(points[:, 0], points[:, 2])


def _jacobians(lens: OpenCV | ThinPrismFisheye, places: np.ndarray) -> np.ndarray:
    """Return (M, 2, 2): derivatives of ``lens.distort`` at places (M, 2), by complex steps."""
    columns = [np.imag(lens.distort(places + 1e-30j * axis)) / 1e-30 for axis in np.eye(2)]
    return np.stack(columns, axis=-1)


def _least_eigenvalues(lens: OpenCV | ThinPrismFisheye, places: np.ndarray) -> np.ndarray:
    """Return (M,): of the symmetric part of the Jacobian at places (M, 2)."""
    jacobians = _jacobians(lens, places)
    return np.linalg.eigvalsh((jacobians + np.swapaxes(jacobians, 1, 2)) / 2)[:, 0]


def _unit(vector: np.ndarray) -> np.ndarray:
    """Return the direction (2,) of a vector; any, if it has none."""
    length = np.hypot(*vector)
    return vector / length if length > 0 else np.array([1.0, 0.0])


def _undistort(lens: OpenCV | ThinPrismFisheye, targets: np.ndarray, radius: float) -> np.ndarray:
    """Return the places (M, 2) within ``radius`` that are distorted to targets (M, 2), or NaN.

    Newton's method from the target; its step is halved until it stays within the radius and lessens
    the error. Derivatives are complex steps.
    """
    lengths = np.linalg.norm(targets, axis=1, keepdims=True)
    guesses = targets * np.minimum(1.0, 0.9 * radius / np.maximum(lengths, 1e-300))
    fractions = 0.5 ** np.arange(40.0)[:, None, None]
    for _ in range(100):
        errors = targets - lens.distort(guesses)
        steps = np.linalg.solve(_jacobians(lens, guesses), errors[..., None])[..., 0]
        candidates = guesses + fractions * steps
        left = np.linalg.norm(targets - lens.distort(candidates), axis=-1)
        better = (np.linalg.norm(candidates, axis=-1) < radius) & (
            left < np.linalg.norm(errors, axis=-1)
        )
        first = np.argmax(better, axis=0)
        moved = candidates[first, np.arange(len(targets))]
        guesses = np.where(better.any(axis=0)[:, None], moved, guesses)
        if not better.any():
            break
    errors = np.linalg.norm(targets - lens.distort(guesses), axis=1)
    return np.where((errors <= 1e-12 * (1 + lengths[:, 0]))[:, None], guesses, np.nan)


@cache
def _first_fold(lens: OpenCV | ThinPrismFisheye, radius: float) -> float:
    """Return the smallest r below ``radius`` with ``least_eigenvalue`` 0; ``radius``: none is."""
    radii = np.array([0.0, *np.geomspace(*FOLD_RADII, FOLD_STEPS)])
    radii = np.append(radii[radii < radius], radius * (1 - 1e-12)) if radius < inf else radii
    folded = np.flatnonzero(lens.least_eigenvalue(radii) <= 0)
    if len(folded) == 0:
        return radius

    def least_eigenvalue(r: float) -> float:
        return lens.least_eigenvalue(np.array([r]))[0]

    between = radii[folded[0] - 1], radii[folded[0]]
    return float(root_scalar(least_eigenvalue, bracket=between, xtol=1e-15).root)


def _film_border(camera: Camera) -> np.ndarray:
    """Return (4 BORDER_SAMPLES, 2), px: evenly spaced points of the film's edges."""
    x = np.linspace(0, camera.width, BORDER_SAMPLES)
    y = np.linspace(0, camera.height, BORDER_SAMPLES)
    edges = [(x, 0 * x), (x, 0 * x + camera.height), (0 * y, y), (0 * y + camera.width, y)]
    return np.concatenate([np.column_stack(edge) for edge in edges])


def _first_positive_root(coefficients: ArrayLike) -> float:
    """Return the smallest u > 0 with 1 + c1 u + ... + cn u^n = 0, or inf; coefficients[0] is 1.

    It is 1 / v for the largest v with v^n + c1 v^(n - 1) + ... + cn = 0, which divides by no cn.
    """
    roots = np.roots(coefficients)
    real = roots.real[np.abs(roots.imag) <= REAL_ROOT * np.abs(roots)]
    return 1 / real.max() if (real > 0).any() else inf


# ---- Projection ------------------------------------------------------------------------------


def project(
    gaussians: Gaussians,
    camera: Camera,
    lens: Lens = Pinhole(),
    antialiased: bool = False,
    low_pass: ArrayLike = reference.LOW_PASS,
) -> Projection:
    """Return the splats that Gaussians leave on the film behind a lens.

    cov2d = J W Sigma W^T J^T + diag(low_pass)    (EWA, section 4)

    J is the derivative of ``film_points`` at the mean, its slope clamped where the lens has
    ``slope_bounds``. low_pass: px^2, one number or (N, 2); antialiased: opacities are multiplied by
    sqrt(det(J W Sigma W^T J^T) / det(cov2d)), as in ``reference.project``. ``Projection.depths``
    are the lens's.

    Splats with a singular cov2d, which low_pass = 0 permits, are not visible.
    """
    points = (gaussians.means - camera.center) @ camera.rotation.T
    depths = lens.depths(camera, points)
    seen = lens.is_seen(camera, points)
    points = np.where(seen[:, None], points, (0.0, 0.0, 1.0))

    scales = np.exp(gaussians.log_scales)
    axes = camera.rotation @ reference.quat_to_rotation(gaussians.quats) * scales[:, None, :]
    axes2d = jacobians(lens, camera, _points_of_jacobian(lens, camera, points)) @ axes
    cov2d, dets, areas = reference.widened_covariances(axes2d, low_pass)
    singular = dets == 0
    opacities = reference.sigmoid(gaussians.logit_opacities)
    if antialiased:
        opacities = opacities * areas / np.sqrt(np.where(singular, 1.0, dets))
    return Projection(
        means2d=lens.film_points(camera, points),
        cov2d=cov2d,
        conics=reference._inverses(cov2d, np.where(singular, 1.0, dets)),
        depths=depths,
        opacities=opacities,
        visible=seen & ~singular & (opacities > reference.ALPHA_CUT),
    )


def jacobians(lens: Lens, camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return (M, 2, 3), px per world unit: derivatives of ``film_points`` at points (M, 3).

    Points are in camera axes. Central differences of order 8: see DIFFERENCE_STEP.
    """
    steps = DIFFERENCE_STEP * lens.derivative_steps(points)[:, None]
    columns = []
    for axis in np.eye(3):
        differences = [
            lens.film_points(camera, points + j * steps * axis)
            - lens.film_points(camera, points - j * steps * axis)
            for j in range(1, len(CENTRAL_WEIGHTS) + 1)
        ]
        differences = [_nearest(each, lens.period(camera)) for each in differences]
        columns.append(np.tensordot(CENTRAL_WEIGHTS, differences, axes=1) / steps)
    return np.stack(columns, axis=-1)


def _nearest(differences: np.ndarray, period: float | None) -> np.ndarray:
    """Return differences (M, 2) of points on the film, px, across its border where that is less."""
    if period is None:
        return differences
    turns = np.round(differences[:, :1] / period)
    return differences - period * np.hstack([turns, 0 * turns])


def _points_of_jacobian(lens: Lens, camera: Camera, points: np.ndarray) -> np.ndarray:
    """Return the points (M, 3), camera, with slopes clamped to the widened bounds of the lens."""
    bounds = lens.slope_bounds(camera)
    if bounds is None:
        return points
    lower, upper = bounds
    margin = reference.FRUSTUM_MARGIN * (upper - lower) / 2
    z = points[:, 2:]
    return np.hstack([np.clip(points[:, :2] / z, lower - margin, upper + margin) * z, z])


# ---- Images ----------------------------------------------------------------------------------


def sh_colors(
    gaussians: Gaussians, camera: Camera, lens: Lens = Pinhole(), degree: int | None = None
) -> np.ndarray:
    """Return the colours (N, 3), display space, >= 0, seen along the lens's directions.

    degree: None for all that is stored.
    """
    directions = lens.view_directions(camera, gaussians.means)
    return np.maximum(reference.unclamped_colors(gaussians, directions, degree), 0.0)


def render(
    gaussians: Gaussians,
    camera: Camera,
    lens: Lens = Pinhole(),
    background: ArrayLike = (0.0, 0.0, 0.0),
    antialiased: bool = False,
    degree: int | None = None,
    threshold_width: float = reference.THRESHOLD_WIDTH,
) -> RenderedImage:
    """Return the image of Gaussians behind a lens; its depth sums the lens's ``depths``.

    background: (3,) display space; antialiased: see ``project``; degree: see ``sh_colors``;
    threshold_width: see ``reference.composite``.
    """
    splats = project(gaussians, camera, lens, antialiased)
    colors = sh_colors(gaussians, camera, lens, degree)
    size = camera.width, camera.height
    return reference.composite(
        splats, colors, background, *size, threshold_width, lens.period(camera)
    )
