"""Isolated splats as drawn by drgs and by Mitsuba's own ``volprim_rf_basic``.

The two do not compute the same. drgs projects a Gaussian with the affine approximation at its mean
(EWA) and adds a low-pass; volprim takes the Gaussian's peak along each pixel's ray. How far this
sets the pictures apart is derived here, and nothing else may.

**Opacity.** In camera axes let u = (x/z, y/z) be the slope of a pixel's ray, u0 that of the mean,
d = u - u0, z the mean's depth, S the covariance, and A(u) = [I | -u], the 2x3 projection along the
ray onto a plane parallel to the film. With C(u) = A(u) S A(u)^T / z^2,

    volprim: alpha = o exp(-d^T C(u)^-1 d / 2)        EWA: alpha = o exp(-d^T C(u0)^-1 d / 2)

since the Mahalanobis distance of a point from a line is that of their projections along the line.
A(u) = A(u0) - d e_z^T, so with k = A(u0) S e_z / z^2 and w = S_zz / z^2, the squared ratio of the
splat's depth to its distance,

    C(u) = C(u0) - d k^T - k d^T + w d d^T

Let e, kappa be d, k in coordinates where C(u0) is the identity, and rho = |e|: the distance from
the mean on the film, in standard deviations. Inverting the 2x2 matrix,

    d^T C(u)^-1 d = rho^2 / D,    D = 1 - 2 e.kappa + rho^2 w - (rho^2 |kappa|^2 - (e.kappa)^2)

S is positive, hence |kappa|^2 <= w, the last bracket lies between 0 and rho^2 w, and

    1 - 2 rho |kappa| <= D <= 1 + 2 rho |kappa| + rho^2 w

kappa is what a splat's depth has to do with its place on the film. It vanishes for a round splat
on the axis: there the models differ by the square of the splat's angular size. For a round splat
at the angle theta from the axis |kappa| = sin(theta) sigma / z, and a tilted one has some, too:
the models then differ by the first power.

**Low-pass.** It is undone by giving volprim the Gaussian widened in the directions parallel to
the film: C(u0) then is drgs's covariance on the film, and k, w are unchanged.

**Colour.** drgs takes the colour in the direction of the mean, volprim in that of the ray. The
angle between them is at most |d|. By the addition theorem, in the tangent plane,
sum_m grad Y_lm grad Y_lm^T = l (l + 1) (2 l + 1) / (8 pi) I, so that a colour sum_lm c_lm Y_lm
changes per radian by at most sum_l |c_l| sqrt(l (l + 1) (2 l + 1) / (8 pi)).

**Order.** drgs orders by the depth of the means, volprim by where a ray enters the splats' shells.
In these scenes both are the same order.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import drjit.llvm.ad as llvm
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import NEAR_THRESHOLD, single
from support.views import View, image_of, pose, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.core.constants import ALPHA_CUT, LOW_PASS
from drgs.reference import splatting as reference

FILM = 64
"""Width and height of the film, px."""

WIDTH = 7.0
"""Standard deviation of an ordinary splat on the film, px: the film shows 4.5 to each side."""

DISTANCE = 8.0
"""From the camera to the nearest splat, scene units. volprim goes on 1e-4 behind the point where
a ray entered a splat's shell. Where single precision is coarser than that (at a distance of 512),
or the shell narrow as seen from the camera, such a point may lie before the shell, and the splat
is then counted twice."""

REACH = 6.0
"""volprim's shells are at least so many standard deviations wide: at their rim, where a grazing
ray may count a splat twice, alpha is at most exp(-6^2 / 2) = 1.5e-8 and less than UNIT."""

UNIT = 2.0**-24
"""Half a unit in the last place of single precision, relative."""

ROUNDING = 16 * UNIT
"""Relative. Each side takes a mean or a ray through about 8 operations (offset, rotation,
division, focal length, principal point, distance in the splat's axes), each rounded by UNIT."""

STRAIGHT = pose([0, 0, 1], 0)
TURNED = pose([0.3, -1.0, 0.5], 40, (0.4, -0.7, 1.1))

ROUND = ((WIDTH, WIDTH, WIDTH),)
LONG = ((1.2 * WIDTH, 0.6 * WIDTH, 0.3 * WIDTH),)
OFF_AXIS = (0.4, -0.3)


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


# ----------------------------------------------------------------------------------------------
# Scenes
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Splats:
    """N splats around the middle of a film, by their recipe."""

    angle: float = 0.02  # of a standard deviation of WIDTH px, rad
    slope: tuple[float, float] = (0.0, 0.0)  # x/z and y/z of the film's middle
    to_world: tuple = field(default=TURNED, repr=False)
    sizes: tuple = ROUND  # (N, 3) standard deviations, px
    places: tuple = ((0.0, 0.0),)  # (N, 2) from the film's middle, px
    distances: tuple = (1.0,)  # (N,) in DISTANCE, no two closer than a factor of 2
    opacities: tuple = (0.9,)  # (N,)
    degree: int = 0
    film: int = FILM  # width and height, px

    @property
    def view(self) -> View:
        """The sensor. Off the axis, it is the principal point that is moved."""
        focal = WIDTH / self.angle
        return View(
            "isolated splats",
            self.film,
            self.film,
            fov=float(np.degrees(2 * np.arctan(self.film / 2 / focal))),
            offset=tuple(slope * focal / self.film for slope in self.slope),
            to_world=self.to_world,
        )

    @property
    def gaussians(self) -> reference.Gaussians:
        """Random orientations and colours; float32 values."""
        rng = np.random.default_rng(5)
        camera = self.view.camera
        n = len(self.sizes)
        z = DISTANCE * np.array(self.distances)
        slopes = np.array(self.slope) + np.array(self.places) / camera.fx
        points = np.column_stack([slopes * z[:, None], z])
        opacities = np.array(self.opacities)
        return reference.Gaussians(
            means=single(points @ camera.rotation + camera.center),
            quats=single(rng.normal(0, 1, (n, 4))),
            log_scales=single(np.log(np.array(self.sizes) * z[:, None] / camera.fx)),
            logit_opacities=single(np.log(opacities / (1 - opacities))),
            sh0=single(rng.uniform(-0.5, 1.5, (n, 1, 3))),
            shN=single(rng.normal(0, 0.2, (n, (self.degree + 1) ** 2 - 1, 3))),
        )


TWO = Splats(
    sizes=ROUND + LONG,
    places=((-3.0, 2.0), (4.0, -1.0)),
    distances=(1.0, 2.0),
    opacities=(0.8, 0.95),
)
THREE = Splats(
    slope=OFF_AXIS,
    sizes=LONG + ROUND + LONG,
    places=((-3.0, 2.0), (4.0, -1.0), (0.0, 5.0)),
    distances=(4.0, 1.0, 2.0),
    opacities=(0.9, 0.5, 0.7),
)

SCENES = {
    "round, on the axis": Splats(to_world=STRAIGHT),
    "round, the camera turned": Splats(),
    "round, off the axis": Splats(slope=OFF_AXIS),
    "tilted": Splats(sizes=LONG),
    "tilted, off the axis": Splats(sizes=LONG, slope=OFF_AXIS),
    "tilted, large": Splats(sizes=LONG, angle=0.1),
    "faint": Splats(opacities=(0.05,), sizes=LONG),
    "almost clamped": Splats(opacities=(0.989,), sizes=LONG),
    "two": TWO,
    "three, off the axis": THREE,
    "degree 1": Splats(angle=0.005, degree=1),
    "degree 2": Splats(angle=0.005, degree=2),
    "degree 3": Splats(angle=0.005, degree=3),
    "two of degree 3": replace(TWO, angle=0.005, degree=3),
}

all_scenes = pytest.mark.parametrize("splats", SCENES.values(), ids=SCENES.keys())


# ----------------------------------------------------------------------------------------------
# Pictures
# ----------------------------------------------------------------------------------------------


def covariances(gaussians) -> np.ndarray:
    """(N, 3, 3) world. The rotations are Dr.Jit's, as in volprim."""
    w, x, y, z = (llvm.Float64(np.ascontiguousarray(column)) for column in gaussians.quats.T)
    quats = dr.normalize(llvm.Quaternion4f64(x, y, z, w))
    rotations = np.moveaxis(np.array(dr.quat_to_matrix(llvm.Matrix3f64, quats)), -1, 0)
    axes = rotations * np.exp(gaussians.log_scales)[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def widened(gaussians, camera) -> np.ndarray:
    """Covariances (N, 3, 3) world that contain drgs's low-pass."""
    forward = camera.rotation[2]
    pixel = (gaussians.means - camera.center) @ forward / camera.fx  # world units at the mean
    parallel = np.eye(3) - np.outer(forward, forward)
    return covariances(gaussians) + LOW_PASS * pixel[:, None, None] ** 2 * parallel


def axes_of(covariance) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations (N, 3) and quaternions xyzw (N, 4) of covariances (N, 3, 3)."""
    variances, axes = np.linalg.eigh(covariance)
    axes = axes * np.sign(np.linalg.det(axes))[:, None, None]
    entries = [
        [llvm.Float64(np.ascontiguousarray(axes[:, i, j])) for j in range(3)] for i in range(3)
    ]
    return np.sqrt(variances), np.array(dr.matrix_to_quat(llvm.Matrix3f64(entries))).T


def volprim_image(gaussians, view, scales, quats_xyzw) -> np.ndarray:
    """(H, W, 3) by volprim: the Gaussians with other standard deviations and orientations."""
    distances = np.linalg.norm(gaussians.means - view.camera.center, axis=1)
    # The wider its shells, the more precisely volprim intersects them. But one that contains the
    # ray's origin is invisible, and at half the distance they do not spoil the order.
    nearest = np.min(distances / scales.max(axis=1))
    extent = max(REACH, 0.5 * nearest)
    assert extent < 0.95 * nearest, "a splat is too large"
    sh = np.concatenate([gaussians.sh0, gaussians.shN], axis=1)
    attributes = {
        "data": np.concatenate([gaussians.means, scales, quats_xyzw], axis=1),
        "opacities": opacities_of(gaussians)[:, None],
        "sh_coeffs": sh.reshape(len(sh), -1),
    }
    shapes = {
        "type": "ellipsoids",
        "extent": float(extent),
        "extent_adaptive_clamping": False,
        **{name: mi.TensorXf(values.astype(np.float32)) for name, values in attributes.items()},
    }
    # One sample in the middle of each pixel, where drgs evaluates.
    sampler = {"type": "stratified", "sample_count": 1, "jitter": False}
    return image_of(
        mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "volprim_rf_basic", "srgb_primitives": False},
                "sensor": view.sensor(pixel_format="rgb") | {"sampler": sampler},
                "shapes": shapes,
            }
        )
    )


def drgs_image(gaussians, view) -> np.ndarray:
    """(H, W, 3) by drgs."""
    return image_of(
        mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": "splats", "srgb_primitives": False} | tensors(gaussians),
                "sensor": view.sensor(pixel_format="rgb"),
            }
        )
    )


def difference_of(gaussians, view) -> np.ndarray:
    """volprim's picture, the low-pass undone, less drgs's: (H, W, 3)."""
    axes = axes_of(widened(gaussians, view.camera))
    return volprim_image(gaussians, view, *axes) - drgs_image(gaussians, view)


def opacities_of(gaussians) -> np.ndarray:
    """(N,) activated."""
    return 1 / (1 + np.exp(-gaussians.logit_opacities))


# ----------------------------------------------------------------------------------------------
# How far the models are apart
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Footprints:
    """N splats on the film, and the two models of their alphas and colours."""

    angles: np.ndarray  # (N, H, W) |d|
    distances: np.ndarray  # (N, H, W) rho
    coupling: np.ndarray  # (N, 1, 1) |kappa|
    depth: np.ndarray  # (N, 1, 1) w
    alpha_by_mean: np.ndarray  # (N, H, W)
    alpha_by_ray: np.ndarray  # (N, H, W)
    color_by_mean: np.ndarray  # (N, 1, 1, 3)
    color_by_ray: np.ndarray  # (N, H, W, 3)
    alpha_rounding: np.ndarray  # (N, H, W), single precision

    @property
    def color_rounding(self) -> np.ndarray:
        """(N, 1, 1, 3), single precision: of the sum, before and after 0.5 is added."""
        return ROUNDING * (1 + self.color_by_mean)

    @property
    def near_cut(self) -> np.ndarray:
        """(N, H, W): single precision may decide otherwise."""
        return np.abs(self.alpha_by_mean - ALPHA_CUT) < ALPHA_CUT * NEAR_THRESHOLD


def footprints(gaussians, camera, covariance) -> Footprints:
    """Of Gaussians with other covariances (N, 3, 3) world."""
    means = (gaussians.means - camera.center) @ camera.rotation.T
    z = means[:, 2]
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    slopes = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy], axis=-1)
    offsets = slopes - (means[:, :2] / z[:, None])[:, None, None]

    relative = camera.rotation @ covariance @ camera.rotation.T / z[:, None, None] ** 2
    at_mean = _projection(means[:, :2] / z[:, None])
    at_pixels = _projection(slopes)
    by_mean = at_mean @ relative @ at_mean.transpose(0, 2, 1)
    by_ray = at_pixels @ relative[:, None, None] @ np.swapaxes(at_pixels, -1, -2)
    rho = np.sqrt(_mahalanobis(offsets, by_mean[:, None, None]))
    rho_by_ray = np.sqrt(_mahalanobis(offsets, by_ray))
    opacities = opacities_of(gaussians)[:, None, None]
    alpha = opacities * np.exp(-0.5 * rho**2)
    alpha_by_ray = opacities * np.exp(-0.5 * rho_by_ray**2)

    # Positions are rounded relative to the distance from the camera. What this makes of rho is
    # largest along the smallest axis, and d alpha / d rho = -rho alpha. The exponential is
    # rounded, and the transmittance, as 1 - alpha, absolutely.
    smallest = np.sqrt(np.linalg.eigvalsh(covariance)[:, 0])
    d_rho = ROUNDING * (np.linalg.norm(means, axis=1) / smallest)[:, None, None]
    alpha_rounding = (
        np.maximum(rho * alpha, rho_by_ray * alpha_by_ray) * d_rho
        + ROUNDING * np.maximum(alpha, alpha_by_ray)
        + UNIT
    )

    rays = np.concatenate([slopes, np.ones_like(slopes[..., :1])], axis=-1) @ camera.rotation
    return Footprints(
        angles=np.linalg.norm(offsets, axis=-1),
        distances=rho,
        coupling=np.sqrt(_mahalanobis((at_mean @ relative)[..., 2], by_mean))[:, None, None],
        depth=relative[:, 2, 2, None, None],
        alpha_by_mean=alpha,
        alpha_by_ray=alpha_by_ray,
        color_by_mean=reference.sh_colors(gaussians, camera, gaussians.sh_degree)[:, None, None],
        color_by_ray=_colors_along(gaussians, rays),
        alpha_rounding=alpha_rounding,
    )


def _projection(slopes) -> np.ndarray:
    """A(u) (..., 2, 3) for slopes u (..., 2)."""
    identity = np.broadcast_to(np.eye(2), (*slopes.shape[:-1], 2, 2))
    return np.concatenate([identity, -slopes[..., None]], axis=-1)


def _mahalanobis(vectors, covariance) -> np.ndarray:
    """v^T C^-1 v for v (..., 2) and C (..., 2, 2)."""
    return np.einsum("...i,...ij,...j", vectors, np.linalg.inv(covariance), vectors)


def _colors_along(gaussians, rays) -> np.ndarray:
    """(N, H, W, 3) in the directions of world vectors (H, W, 3)."""
    directions = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3)
    basis = reference.sh_basis(directions, gaussians.sh_degree).reshape(*rays.shape[:2], -1)
    coefficients = np.concatenate([gaussians.sh0, gaussians.shN], axis=1)
    return np.maximum(np.einsum("hwk,nkc->nhwc", basis, coefficients) + 0.5, 0)


def bound(gaussians, camera, covariance, excess=0.0) -> np.ndarray:
    """(H, W, 3): how far the pictures may be apart.

    covariance: (N, 3, 3) world, volprim's. excess: drgs's variances on the film are larger than
    the projections of ``covariance`` by at most this factor, less 1.
    """
    on_film = footprints(gaussians, camera, covariance)
    rho, alpha = on_film.distances, on_film.alpha_by_mean

    # D lies between 1 - nearer and 1 + farther.
    nearer = np.minimum(2 * rho * on_film.coupling, 1)
    farther = 2 * rho * on_film.coupling + rho**2 * on_film.depth
    with np.errstate(divide="ignore"):
        d_alpha = alpha * np.maximum(
            np.expm1(rho**2 / 2 * farther / (1 + farther)),
            -np.expm1(-(rho**2) / 2 * nearer / (1 - nearer)),
        )
    # drgs's exponent lies between rho^2 / 2 and rho^2 / 2 / (1 + excess).
    d_alpha += alpha * np.expm1(rho**2 / 2 * excess)
    # Below the cut drgs draws nothing.
    d_alpha += np.where((alpha < ALPHA_CUT) | on_film.near_cut, alpha, 0)

    d_colors = color_slopes(gaussians)[:, None, None] * on_film.angles[..., None]
    return propagated(on_film, d_alpha + on_film.alpha_rounding, d_colors + on_film.color_rounding)


def propagated(on_film, d_alpha, d_colors) -> np.ndarray:
    """(H, W, 3): what errors of alphas (N, H, W) and colours (N, H, W, 3) make of a picture.

    A picture is linear in each alpha, with the slope T (color - the picture behind), which is at
    most the largest color; and the weight of a color is at most its alpha.
    """
    colors = np.maximum(on_film.color_by_mean, on_film.color_by_ray) + d_colors
    weights = np.maximum(on_film.alpha_by_mean, on_film.alpha_by_ray) + d_alpha
    return (d_alpha[..., None] * colors.max(axis=0) + weights[..., None] * d_colors).sum(axis=0)


def color_slopes(gaussians) -> np.ndarray:
    """(N, 3): by how much the colours may change per radian."""
    slopes = np.zeros((len(gaussians.means), 3))
    for degree in range(1, gaussians.sh_degree + 1):
        band = gaussians.shN[:, degree**2 - 1 : (degree + 1) ** 2 - 1]
        gradient = np.sqrt(degree * (degree + 1) * (2 * degree + 1) / (8 * np.pi))
        slopes += np.linalg.norm(band, axis=1) * gradient
    return slopes


def assert_within(difference, allowed) -> None:
    """Every pixel and channel; the message tells the worst."""
    bad = ~(np.abs(difference) <= allowed)
    worst = np.unravel_index(np.argmax(np.abs(difference) / allowed), bad.shape)
    message = (
        f"{bad.sum()} of {bad.size} values, worst at (row, column, channel) "
        f"{tuple(map(int, worst))}: {difference[worst]:.3g}, allowed {allowed[worst]:.3g}"
    )
    assert bad.sum() == 0, message


# ----------------------------------------------------------------------------------------------
# Agreement
# ----------------------------------------------------------------------------------------------


@all_scenes
def test_isolated_splats_agree_with_volprim(splats):
    gaussians, view = splats.gaussians, splats.view
    allowed = bound(gaussians, view.camera, widened(gaussians, view.camera))
    assert_within(difference_of(gaussians, view), allowed)


def test_the_same_numbers_agree_where_the_low_pass_is_small():
    """Nothing is undone: drgs's variances on the film, at least 18^2 px^2, are larger by 0.3."""
    splats = Splats(angle=0.005, sizes=((27.0, 22.0, 18.0),), film=128)
    gaussians, view = splats.gaussians, splats.view
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    expected = volprim_image(gaussians, view, np.exp(gaussians.log_scales), quats[:, [1, 2, 3, 0]])
    allowed = bound(gaussians, view.camera, covariances(gaussians), excess=LOW_PASS / 18.0**2)
    assert_within(expected - drgs_image(gaussians, view), allowed)


@all_scenes
def test_nothing_but_the_derived_difference_sets_them_apart(splats):
    """What is left when it is taken off is rounding."""
    gaussians, view = splats.gaussians, splats.view
    on_film = footprints(gaussians, view.camera, widened(gaussians, view.camera))
    depths = (gaussians.means - view.camera.center) @ view.camera.rotation[2]
    drawn = np.where(on_film.alpha_by_mean >= ALPHA_CUT, on_film.alpha_by_mean, 0)
    colors = np.broadcast_to(on_film.color_by_mean, on_film.color_by_ray.shape)
    derived = composite(on_film.alpha_by_ray, on_film.color_by_ray, depths)
    derived -= composite(drawn, colors, depths)

    d_alpha = on_film.alpha_rounding + np.where(on_film.near_cut, on_film.alpha_by_mean, 0)
    assert_within(
        difference_of(gaussians, view) - derived,
        propagated(on_film, d_alpha, on_film.color_rounding),
    )


def composite(alphas, colors, depths) -> np.ndarray:
    """(H, W, 3) from alphas (N, H, W) and colours (N, H, W, 3), front to back."""
    image, transmittance = np.zeros(colors.shape[1:]), np.ones(alphas.shape[1:])
    for i in np.argsort(depths):
        image += (transmittance * alphas[i])[..., None] * colors[i]
        transmittance *= 1 - alphas[i]
    return image


# ----------------------------------------------------------------------------------------------
# Convergence
# ----------------------------------------------------------------------------------------------


class Sheared(Splats):
    """Splats sheared along their rays until kappa = 0.

    Thus ellipsoids that are turned, and off the axis, whose depth has nothing to do with their
    place on the film.
    """

    @property
    def gaussians(self) -> reference.Gaussians:
        gaussians, camera = super().gaussians, self.view.camera
        means = (gaussians.means - camera.center) @ camera.rotation.T
        slopes = means[:, :2] / means[:, 2:]
        covariance = camera.rotation @ covariances(gaussians) @ camera.rotation.T
        at_mean = _projection(slopes)
        uncoupled = np.zeros_like(covariance)
        uncoupled[:, :2, :2] = at_mean @ covariance @ at_mean.transpose(0, 2, 1)
        uncoupled[:, 2, 2] = covariance[:, 2, 2]
        shear = np.broadcast_to(np.eye(3), covariance.shape).copy()
        shear[:, :2, 2] = slopes
        to_world = camera.rotation.T @ shear
        scales, quats_xyzw = axes_of(to_world @ uncoupled @ to_world.transpose(0, 2, 1))
        quats = single(quats_xyzw[:, [3, 0, 1, 2]])
        return replace(gaussians, quats=quats, log_scales=single(np.log(scales)))


FIRST_ORDER = {
    "round, off the axis": Splats(slope=OFF_AXIS),
    "tilted": Splats(sizes=LONG),
    "tilted, off the axis": Splats(sizes=LONG, slope=OFF_AXIS),
}

SECOND_ORDER = {
    "round, on the axis": Splats(to_world=STRAIGHT),
    "round, the camera turned": Splats(),
    "sheared": Sheared(sizes=LONG),
    "sheared, off the axis": Sheared(sizes=LONG, slope=OFF_AXIS),
}


def observed_orders(splats, angles) -> np.ndarray:
    """Exponents of the angular size in the largest difference, for angles that are halved."""
    largest = []
    for angle in angles:
        smaller = replace(splats, angle=angle)
        gaussians, view = smaller.gaussians, smaller.view
        alpha = footprints(gaussians, view.camera, widened(gaussians, view.camera)).alpha_by_mean
        both_draw = alpha[0] > 2 * ALPHA_CUT
        largest.append(np.abs(difference_of(gaussians, view)[both_draw]).max())
    return -np.diff(np.log2(largest))


@pytest.mark.parametrize("splats", FIRST_ORDER.values(), ids=FIRST_ORDER.keys())
def test_the_difference_is_of_first_order_where_depth_goes_with_place(splats):
    """In alpha it is rho^2 exp(-rho^2 / 2) e.kappa, at most 1.16 |kappa|.

    It is followed by at most (w rho^4 / 2 + 2 kappa^2 rho^4 + kappa^2 rho^6 / 2) exp(-rho^2 / 2),
    which is 1.08 w + 9.7 kappa^2: here, relative to the first, at most 8 times the angle. Single
    precision adds 0.05 of the last, smallest difference. -log2((1 - 0.32) / (1 - 0.16) (1 - 0.05))
    = 0.38. Measured 0.06.
    """
    assert np.all(np.abs(observed_orders(splats, (0.04, 0.02, 0.01)) - 1) < 0.38)


@pytest.mark.parametrize("splats", SECOND_ORDER.values(), ids=SECOND_ORDER.keys())
def test_the_difference_is_of_second_order_where_it_does_not(splats):
    """In alpha it is w rho^4 / 2 exp(-rho^2 / 2), largest at rho = 2.

    The next term is that times w (rho^4 / 4 - rho^2), which vanishes there: less than w = 0.02.
    Single precision adds 0.06 of the last, smallest difference. -log2((1 - 0.02) (1 - 0.06)) =
    0.12. Measured 0.001.
    """
    assert np.all(np.abs(observed_orders(splats, (0.12, 0.06, 0.03)) - 2) < 0.12)


# ----------------------------------------------------------------------------------------------
# What the bound refuses
# ----------------------------------------------------------------------------------------------

SMALL = Splats(angle=0.005, sizes=LONG)
COLORED = SCENES["degree 3"]


def conjugated(gaussians, camera):
    return replace(gaussians, quats=gaussians.quats * [1, -1, -1, -1])


def with_quats_read_as_xyzw(gaussians, camera):
    return replace(gaussians, quats=gaussians.quats[:, [3, 0, 1, 2]])


def with_axes_exchanged(gaussians, camera):
    return replace(gaussians, log_scales=gaussians.log_scales[:, [1, 0, 2]])


def two_percent_wider(gaussians, camera):
    return replace(gaussians, log_scales=gaussians.log_scales + 0.02)


def a_tenth_of_a_pixel_to_the_right(gaussians, camera):
    z = (gaussians.means - camera.center) @ camera.rotation[2]
    shift = 0.1 * z[:, None] / camera.fx * camera.rotation[0]
    return replace(gaussians, means=gaussians.means + shift)


def half_a_percent_more_opaque(gaussians, camera):
    opacities = 1.005 * opacities_of(gaussians)
    return replace(gaussians, logit_opacities=np.log(opacities / (1 - opacities)))


def a_thousandth_brighter(gaussians, camera):
    return replace(gaussians, sh0=gaussians.sh0 + 0.001 / reference.C_00)


def in_another_order(gaussians, camera):
    """The first splat in the second's place in depth, the picture of each unchanged."""
    factors = np.array([4.0, 1.0])
    means = camera.center + (gaussians.means - camera.center) * factors[:, None]
    scales = gaussians.log_scales + np.log(factors)[:, None]
    return replace(gaussians, means=means, log_scales=scales)


def seen_from_behind(gaussians, camera):
    odd = np.repeat([-1, 1, -1], [3, 5, 7])[:, None]
    return replace(gaussians, shN=gaussians.shN * odd)


def with_coefficients_in_another_order(gaussians, camera):
    return replace(gaussians, shN=gaussians.shN.transpose(0, 2, 1).reshape(gaussians.shN.shape))


WRONG = (
    (SMALL, conjugated),
    (SMALL, with_quats_read_as_xyzw),
    (SMALL, with_axes_exchanged),
    (SMALL, two_percent_wider),
    (SMALL, a_tenth_of_a_pixel_to_the_right),
    (SMALL, half_a_percent_more_opaque),
    (SMALL, a_thousandth_brighter),
    (TWO, in_another_order),
    (COLORED, seen_from_behind),
    (COLORED, with_coefficients_in_another_order),
)


@pytest.mark.parametrize("splats, wrong", WRONG, ids=[wrong.__name__ for _, wrong in WRONG])
def test_the_bound_refuses_splats(splats, wrong):
    gaussians, view = splats.gaussians, splats.view
    covariance = widened(gaussians, view.camera)
    expected = volprim_image(gaussians, view, *axes_of(covariance))
    difference = expected - drgs_image(wrong(gaussians, view.camera), view)
    with pytest.raises(AssertionError, match="worst at"):
        assert_within(difference, bound(gaussians, view.camera, covariance))


def test_the_bound_refuses_splats_without_the_low_pass():
    gaussians, view = SMALL.gaussians, SMALL.view
    covariance = covariances(gaussians)
    difference = volprim_image(gaussians, view, *axes_of(covariance)) - drgs_image(gaussians, view)
    with pytest.raises(AssertionError, match="worst at"):
        assert_within(difference, bound(gaussians, view.camera, covariance))
