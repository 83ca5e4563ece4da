"""Isolated splats as drawn by drgs and by Mitsuba's own ``volprim_rf_basic``.

With the right approximations the two compute the same: a Gaussian's peak along each pixel's ray and
the colour in the ray's direction, with no low-pass and no cut. volprim orders by where the ray
enters the splats' shells: in these scenes the same order. Only rounding is left.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import single
from support.views import View, image_of, pose, tensors

import drgs  # noqa: F401  (registers the plugin)
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
        "opacities": reference.sigmoid(gaussians.logit_opacities)[:, None],
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


def rounding_of(gaussians, camera) -> np.ndarray:
    """Return how far rounding may take images (H, W, 3), in single precision.

    In camera axes let u = (x/z, y/z) be the slope of a pixel's ray, u0 that of the mean, z the
    mean's depth, S the covariance, and A(u) = [I | -u], the 2x3 projection along the ray onto a
    plane parallel to the film. With d = u - u0 and C(u) = A(u) S A(u)^T / z^2, the peak along the
    ray is o exp(-d^T C(u)^-1 d / 2), since the Mahalanobis distance of a point from a line is that
    of their projections along the line.

    An image is linear in each alpha, with the slope T (color - the image behind), which is at most
    the largest color; and the weight of a color is at most its alpha. Colors are rounded as sums,
    before and after 0.5 is added.
    """
    covariance = reference.covariances(gaussians.quats, gaussians.log_scales)
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
    alphas = reference.sigmoid(gaussians.logit_opacities)[:, None, None] * np.exp(-0.5 * rho**2)
    # Positions are rounded relative to the distance from the camera. What this makes of rho is
    # largest along the smallest axis, and d alpha / d rho = -rho alpha. The exponential is
    # rounded, and the transmittance, as 1 - alpha, absolutely.
    smallest = np.sqrt(np.linalg.eigvalsh(covariance)[:, 0])
    d_rho = ROUNDING * (np.linalg.norm(means, axis=1) / smallest)[:, None, None]
    rays = np.concatenate([slopes, np.ones_like(slopes[..., :1])], axis=-1) @ camera.rotation
    alpha_rounding = rho * alphas * d_rho + ROUNDING * alphas + UNIT
    colors = _colors_along(gaussians, rays)
    d_colors = ROUNDING * (1 + colors)
    colors, weights = colors + d_colors, alphas + alpha_rounding
    terms = alpha_rounding[..., None] * colors.max(axis=0) + weights[..., None] * d_colors
    return terms.sum(axis=0)


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


SPLATS = {
    "type": "splats", "srgb_primitives": False, "projection": "exact", "order": "pixel",
    "sh_direction": "pixel", "low_pass": 0.0, "extent": 6.0, "alpha_max": 0.9999, "alpha_cut": 0.0,
    "transmittance_stop": 0.0,
}  # fmt: skip


def check_difference(splats, change=lambda gaussians, _: gaussians, **settings):
    """Check volprim's image less that of drgs, by a shape and by tensors; ``change`` is made to
    drgs's Gaussians."""
    gaussians, view = splats.gaussians, splats.view

    def by_shape(gaussians, *integrator):
        quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
        scales = np.exp(gaussians.log_scales)
        return volprim_image(gaussians, view, scales, quats[:, [1, 2, 3, 0]], *integrator)

    changed, integrator = change(gaussians, view.camera), SPLATS | settings
    sensor = view.sensor(pixel_format="rgb")
    by_tensors = mi.load_dict(
        {"type": "scene", "integrator": integrator | tensors(changed), "sensor": sensor}
    )
    allowed, expected = rounding_of(gaussians, view.camera), by_shape(gaussians)
    assert expected.max() > 1000 * allowed.max()
    for image in (by_shape(changed, integrator), image_of(by_tensors)):
        assert_within(image - expected, allowed)


@pytest.mark.parametrize("splats", SCENES.values(), ids=SCENES.keys())
def test_images_equal_those_of_volprim(splats):
    check_difference(splats)


SMALL, COLORED = Splats(angle=0.005, sizes=LONG), SCENES["degree 3"]


def shifted(gaussians, camera):
    z = (gaussians.means - camera.center) @ camera.rotation[2]
    shift = 0.1 * z[:, None] / camera.fx * camera.rotation[0]
    return replace(gaussians, means=gaussians.means + shift)


def more_opaque(gaussians, _):
    opacities = 1.005 * reference.sigmoid(gaussians.logit_opacities)
    return replace(gaussians, logit_opacities=np.log(opacities / (1 - opacities)))


def with_swapped_depths(gaussians, camera):
    """The first splat in the second's place in depth, the image of each unchanged."""
    factors = np.array([4.0, 1.0])
    means = camera.center + (gaussians.means - camera.center) * factors[:, None]
    scales = gaussians.log_scales + np.log(factors)[:, None]
    return replace(gaussians, means=means, log_scales=scales)


def in_another_order(sh):
    return sh.transpose(0, 2, 1).reshape(sh.shape)


ODD = np.repeat([-1, 1, -1], [3, 5, 7])[:, None]
"""Signs of the harmonics of degrees 1 to 3, seen from behind."""

WRONG = {
    "conjugated": (SMALL, lambda g, _: replace(g, quats=g.quats * [1, -1, -1, -1])),
    "quats read as xyzw": (SMALL, lambda g, _: replace(g, quats=g.quats[:, [3, 0, 1, 2]])),
    "axes exchanged": (SMALL, lambda g, _: replace(g, log_scales=g.log_scales[:, [1, 0, 2]])),
    "wider by two percent": (SMALL, lambda g, _: replace(g, log_scales=g.log_scales + 0.02)),
    "shifted by a tenth of a pixel": (SMALL, shifted),
    "more opaque by half a percent": (SMALL, more_opaque),
    "brighter by 0.001": (SMALL, lambda g, _: replace(g, sh0=g.sh0 + 0.001 / reference.C_00)),
    "depths swapped": (TWO, with_swapped_depths),
    "seen from behind": (COLORED, lambda g, _: replace(g, shN=g.shN * ODD)),
    "harmonics exchanged": (COLORED, lambda g, _: replace(g, shN=in_another_order(g.shN))),
}

APPROXIMATIONS = {"low-pass": {"low_pass": 0.3}, "projected at the mean": {"projection": "ewa"}}


@pytest.mark.parametrize("name", [*WRONG, *APPROXIMATIONS])
def test_wrong_splats_and_approximations_differ_from_volprim(name):
    with pytest.raises(AssertionError, match="worst at"):
        check_difference(*WRONG.get(name, (SMALL,)), **APPROXIMATIONS.get(name, {}))
