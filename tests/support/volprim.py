"""Isolated splats, and their images by ``volprim_rf_basic``, with bounds of rounding."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import drjit as dr
import drjit.llvm.ad as llvm
import mitsuba as mi
import numpy as np

import drgs  # noqa: F401  (registers the plugin)
from drgs.reference import splatting as reference
from support.helpers import single
from support.views import View, image_of, pose

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

VOLPRIM = {"type": "volprim_rf_basic", "srgb_primitives": False}

STRAIGHT = pose([0, 0, 1], 0)
TURNED = pose([0.3, -1.0, 0.5], 40, (0.4, -0.7, 1.1))
ROUND = ((WIDTH, WIDTH, WIDTH),)
LONG = ((1.2 * WIDTH, 0.6 * WIDTH, 0.3 * WIDTH),)
OFF_AXIS = (0.4, -0.3)


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


def covariances(gaussians) -> np.ndarray:
    """(N, 3, 3) world. The rotations are Dr.Jit's, as in volprim."""
    w, x, y, z = (llvm.Float64(np.ascontiguousarray(column)) for column in gaussians.quats.T)
    quats = dr.normalize(llvm.Quaternion4f64(x, y, z, w))
    rotations = np.moveaxis(np.array(dr.quat_to_matrix(llvm.Matrix3f64, quats)), -1, 0)
    axes = rotations * np.exp(gaussians.log_scales)[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def volprim_image(gaussians, view, scales, quats_xyzw, integrator=VOLPRIM) -> np.ndarray:
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
    sensor = view.sensor(pixel_format="rgb") | {"sampler": sampler}
    scene = {"type": "scene", "integrator": integrator, "sensor": sensor, "shapes": shapes}
    return image_of(mi.load_dict(scene))


def opacities_of(gaussians) -> np.ndarray:
    """(N,) activated."""
    return 1 / (1 + np.exp(-gaussians.logit_opacities))


@dataclass(frozen=True)
class Footprints:
    """N splats on the film: alphas and colours along the pixels' rays, and their rounding."""

    alphas: np.ndarray  # (N, H, W)
    colors: np.ndarray  # (N, H, W, 3)
    alpha_rounding: np.ndarray  # (N, H, W), single precision

    @property
    def image_rounding(self) -> np.ndarray:
        """(H, W, 3): errors of an image from those of alphas and colours.

        An image is linear in each alpha, with the slope T (color - the image behind), which is at
        most the largest color; and the weight of a color is at most its alpha. Colors are rounded
        as sums, before and after 0.5 is added.
        """
        d_colors = ROUNDING * (1 + self.colors)
        colors, weights = self.colors + d_colors, self.alphas + self.alpha_rounding
        terms = self.alpha_rounding[..., None] * colors.max(axis=0) + weights[..., None] * d_colors
        return terms.sum(axis=0)


def footprints(gaussians, camera) -> Footprints:
    """Return the footprints of Gaussians.

    In camera axes let u = (x/z, y/z) be the slope of a pixel's ray, u0 that of the mean, z the
    mean's depth, S the covariance, and A(u) = [I | -u], the 2x3 projection along the ray onto a
    plane parallel to the film. With d = u - u0 and C(u) = A(u) S A(u)^T / z^2, the peak along the
    ray is o exp(-d^T C(u)^-1 d / 2), since the Mahalanobis distance of a point from a line is that
    of their projections along the line.
    """
    covariance = covariances(gaussians)
    means = (gaussians.means - camera.center) @ camera.rotation.T
    z = means[:, 2]
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    slopes = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy], axis=-1)
    offsets = slopes - (means[:, :2] / z[:, None])[:, None, None]
    relative = camera.rotation @ covariance @ camera.rotation.T / z[:, None, None] ** 2
    identity = np.broadcast_to(np.eye(2), (*slopes.shape[:-1], 2, 2))
    along = np.concatenate([identity, -slopes[..., None]], axis=-1)
    on_film = along @ relative[:, None, None] @ np.swapaxes(along, -1, -2)
    rho = np.sqrt(np.einsum("...i,...ij,...j", offsets, np.linalg.inv(on_film), offsets))
    alphas = opacities_of(gaussians)[:, None, None] * np.exp(-0.5 * rho**2)
    # Positions are rounded relative to the distance from the camera. What this makes of rho is
    # largest along the smallest axis, and d alpha / d rho = -rho alpha. The exponential is
    # rounded, and the transmittance, as 1 - alpha, absolutely.
    smallest = np.sqrt(np.linalg.eigvalsh(covariance)[:, 0])
    d_rho = ROUNDING * (np.linalg.norm(means, axis=1) / smallest)[:, None, None]
    rays = np.concatenate([slopes, np.ones_like(slopes[..., :1])], axis=-1) @ camera.rotation
    alpha_rounding = rho * alphas * d_rho + ROUNDING * alphas + UNIT
    return Footprints(alphas, _colors_along(gaussians, rays), alpha_rounding)


def _colors_along(gaussians, rays) -> np.ndarray:
    """(N, H, W, 3) in the directions of world vectors (H, W, 3)."""
    directions = (rays / np.linalg.norm(rays, axis=-1, keepdims=True)).reshape(-1, 3)
    basis = reference.sh_basis(directions, gaussians.sh_degree).reshape(*rays.shape[:2], -1)
    coefficients = np.concatenate([gaussians.sh0, gaussians.shN], axis=1)
    return np.maximum(np.einsum("hwk,nkc->nhwc", basis, coefficients) + 0.5, 0)


def assert_within(difference, allowed) -> None:
    """Every pixel and channel; the message tells the worst."""
    bad = ~(np.abs(difference) <= allowed)
    worst = np.unravel_index(np.argmax(np.abs(difference) / allowed), bad.shape)
    message = (
        f"{bad.sum()} of {bad.size} values, worst at (row, column, channel) "
        f"{tuple(map(int, worst))}: {difference[worst]:.3g}, allowed {allowed[worst]:.3g}"
    )
    assert bad.sum() == 0, message
