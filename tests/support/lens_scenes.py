"""Scenes before cameras with lenses, for the kernels and for the float64 reference."""

from __future__ import annotations

from dataclasses import asdict, replace
from unittest import mock

import drjit as dr
import numpy as np
import pytest
from scipy.optimize import brentq

from drgs.cameras import equirectangular, fisheye, orthographic, thin_prism_fisheye
from drgs.cameras import lens as camera_lens
from drgs.cameras.camera import Camera
from drgs.cameras.radial_tangential import RadialTangential
from drgs.reference import splatting as reference
from drgs.splatting.projection import ewa, load_rows, plain_opacity, project
from support import lenses
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Precision,
    device_camera,
    device_gaussians,
    gaussians_before,
    rows,
    single,
)
from support.lenses import Equirectangular, Fisheye, OpenCV, Orthographic, ThinPrismFisheye
from support.reference_lenses import FISHEYE, THIN_PRISM

# ----------------------------------------------------------------------------------------------
# Lenses
# ----------------------------------------------------------------------------------------------

# Exact in single precision: both precisions then start from equal numbers.
LENSES = {
    "radial": OpenCV(k1=-0.25, k2=0.0625, k3=0.03125),
    "tangential": OpenCV(p1=0.0078125, p2=-0.015625),
    "rational": OpenCV(-0.25, 0.0625, 0.03125, 0.125, -0.0625, 0.015625, 0.0078125, -0.015625),
    "fox": OpenCV(
        k1=float(single(0.0578421)),
        k2=float(single(-0.0805099)),
        p1=float(single(-0.000980296)),
        p2=float(single(0.00015575)),
    ),
    "barrel": OpenCV(k1=-0.3125),
    "plain fisheye": Fisheye(),
    "fisheye": FISHEYE,
    "thin prism": THIN_PRISM,
    "orthographic": Orthographic(),
    "panorama": Equirectangular(),
}


PINHOLE = lenses.Pinhole()


def kernel_lens(lens: lenses.Lens) -> object:
    """The kernels' lens with the coefficients of the reference's that are not zero."""
    if isinstance(lens, lenses.Pinhole):
        return camera_lens.PINHOLE
    given = {name: value for name, value in asdict(lens).items() if value != 0}
    if isinstance(lens, OpenCV):
        return RadialTangential.from_coefficients(**given)
    if isinstance(lens, ThinPrismFisheye):
        return thin_prism_fisheye.ThinPrismFisheye.from_coefficients(**given)
    if isinstance(lens, Equirectangular):
        return equirectangular.Equirectangular()
    return (
        fisheye.Fisheye.from_coefficients(**given)
        if isinstance(lens, Fisheye)
        else orthographic.Orthographic()
    )


def lens_camera(camera: reference.Camera, lens: lenses.Lens, precision: Precision) -> Camera:
    """The kernels' camera; no number of it is a literal."""
    camera = device_camera(camera, precision).with_lens(kernel_lens(lens))
    dr.make_opaque(camera)
    return camera


def points_at(lens: lenses.Lens, camera: reference.Camera, film, distances) -> np.ndarray:
    """Points (N, 3), camera axes, that are seen at ``film`` (N, 2), px; NaN where nothing is.

    distances (N,): z, or from the centre where that is the depth. By the inverse of the reference:
    Newton's method with halved steps, or from a table of the angle.
    """
    if isinstance(lens, Equirectangular):
        theta, phi = np.pi * (film / [camera.width, camera.height] - 0.5).T * [[2], [1]]
        directions = [np.sin(theta) * np.cos(phi), np.sin(phi), np.cos(theta) * np.cos(phi)]
        return np.column_stack(directions) * distances[:, None]
    plane = (film - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if isinstance(lens, Orthographic):
        return np.column_stack([plane, distances])
    if isinstance(lens, ThinPrismFisheye):
        places = lens.undistort(plane)
        angles = np.linalg.norm(places, axis=1)
        directions = np.column_stack([np.sinc(angles / np.pi)[:, None] * places, np.cos(angles)])
    elif isinstance(lens, Fisheye):
        directions = _fisheye_directions(lens, plane)
    else:
        slopes = lens.undistort(plane) if isinstance(lens, OpenCV) else plane
        directions = np.column_stack([slopes, np.ones(len(plane))])
    return directions * distances[:, None]


def _fisheye_directions(lens, plane) -> np.ndarray:
    """(N, 3), unit. Newton's method from an interpolated table."""
    powers = np.array([1, 3, 5, 7, 9])
    coefficients = np.array([1, lens.k1, lens.k2, lens.k3, lens.k4])
    table = np.linspace(0, lens.valid_angle, 10001)
    radii = np.linalg.norm(plane, axis=1)
    distorted = coefficients @ table ** powers[:, None]
    angles = np.interp(radii, distorted, table)
    for _ in range(4):
        slope = (powers * coefficients) @ angles ** (powers - 1)[:, None]
        angles = angles - (coefficients @ angles ** powers[:, None] - radii) / slope
    angles = np.where(radii < distorted[-1], angles, np.nan)
    toward = plane / np.where(radii == 0, 1, radii)[:, None]
    return np.column_stack([np.sin(angles)[:, None] * toward, np.cos(angles)])


# ----------------------------------------------------------------------------------------------
# Scenes
# ----------------------------------------------------------------------------------------------


# px, of a film 37 px wide: those of fisheyes reach beyond 90 degrees from the axis; that of
# parallel rays is 3 units.
FOCAL = {Fisheye: 10.0, ThinPrismFisheye: 10.0, Orthographic: 12.0, Equirectangular: 6.0}


def camera_behind(lens: lenses.Lens, seed=0, width=37, height=29) -> reference.Camera:
    """Rotated, fx != fy, off-centre; films whose corners are 50 to 65 degrees from the axis.

    With a fisheye they are up to 140 degrees, with a barrel beyond the fold.
    """
    rng = np.random.default_rng(seed)
    fx, fy = FOCAL.get(type(lens), 26.0) * width / 37 * rng.uniform(0.9, 1.1, 2)
    cx, cy = [width, height] * rng.uniform(0.4, 0.6, 2)
    return reference.Camera(
        rotation=single(reference.quat_to_rotation(rng.normal(0, 1, (1, 4)))[0]),
        center=single(rng.normal(0, 1, 3)),
        fx=float(single(fx)), fy=float(single(fy)), cx=float(single(cx)), cy=float(single(cy)),
        width=width, height=height, near=0.25,
    )  # fmt: skip


def gaussians_at_points(lens, rng, camera, points, sizes, logits, degree) -> reference.Gaussians:
    """At points (N, 3) in camera axes, of ``sizes`` (N, 3) px on the axis."""
    # With parallel rays, fx is px per world unit at any distance.
    far = 1 if isinstance(lens, Orthographic) else np.linalg.norm(points, axis=1)[:, None]
    return gaussians_before(rng, camera, points, sizes * far / camera.fx, logits, degree)


def seen_points(lens, camera, film, distances) -> np.ndarray:
    """Points (N, 3) seen at ``film``, or close to where the lens model ends before it."""
    points = points_at(lens, camera, film, distances)
    near_the_end = points_near_lens_limit(lens, camera, film, distances)
    return np.where(np.isnan(points), near_the_end, points)


def points_near_lens_limit(lens, camera, film, distances) -> np.ndarray:
    """Points (N, 3) seen in the direction of ``film``, close to where the lens model ends."""
    plane = (film - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    radii = np.linalg.norm(plane, axis=1, keepdims=True)
    toward = plane / np.where(radii == 0, 1, radii)
    if isinstance(lens, Fisheye):
        angle = 0.97 * lens.valid_angle
        points = np.column_stack([np.sin(angle) * toward, np.full(len(film), np.cos(angle))])
    else:
        radius = 0.9 * lens.valid_radius if isinstance(lens, OpenCV) else 1.0
        points = np.column_stack([min(radius, 2) * toward, np.ones(len(film))])
    return points * distances[:, None]


def point_beyond_lens_limit(lens) -> np.ndarray | None:
    """A point (3,) that the lens model is not made for; None: it is made for all in front."""
    if isinstance(lens, Fisheye):
        angle = 1.01 * lens.valid_angle
        return 2 * np.array([0.6 * np.sin(angle), 0.8 * np.sin(angle), np.cos(angle)])
    if isinstance(lens, OpenCV) and np.isfinite(lens.valid_radius):
        return 2 * np.array([*(1.1 * lens.valid_radius * np.array([0.6, 0.8])), 1])
    return None


# ----------------------------------------------------------------------------------------------
# Checks
# ----------------------------------------------------------------------------------------------


every_lens = pytest.mark.parametrize("name", LENSES)


FORMS = ("rational", "barrel", "fisheye", "thin prism", "orthographic")
"""One of each form; of a barrel, pixels that show nothing. Where Dr.Jit differentiates, or kernels
take long to compile, the others, which are these without some terms, tell no more."""


# Relative to the largest value of each array. float64: the reference's J, by differences, is off
# by 1e-13 of itself. Measured 4e-13. float32: as in test_rendering, and a few roundings more on
# the way to the film.
IMAGE = {FLOAT64: 1e-11, FLOAT32: 2e-5}


def splats_of(gaussians, camera, lens, precision, shape=ewa, low_pass=0.3, degree=0):
    """Projection by the kernels."""
    parameter_rows = load_rows(device_gaussians(gaussians, precision), degree)
    camera = lens_camera(camera, lens, precision)
    return project(parameter_rows, camera, degree, plain_opacity, shape, low_pass=low_pass)


def covariances(splats) -> np.ndarray:
    """(N, 2, 2), px^2."""
    p, r, s = rows(splats.conic_factor).T
    factors = np.moveaxis(np.array([[p, r], [np.zeros_like(s), s]]), -1, 0)
    return np.linalg.inv(np.swapaxes(factors, 1, 2) @ factors)


def planes_of(frame) -> np.ndarray:
    """(4, H W): transmittance and colour."""
    return np.array([rows(plane) for plane in frame.planes()])


# ----------------------------------------------------------------------------------------------
# A rolling shutter
# ----------------------------------------------------------------------------------------------


ROW_MARGIN, MAX_ROW_RATE = 0.5, 0.5
"""The motion goes on before and after the film's rows; faster points are taken as still."""


def row_time(camera_at, lens, mean) -> tuple[float, bool]:
    """Return when the row that shows a mean is read, the root of row less time, and if it is."""

    def behind(time) -> float:
        camera = camera_at(time)
        point = (mean - camera.center) @ camera.rotation.T
        return lens.film_points(camera, point[None])[0, 1] / camera.height - time

    first, last = -ROW_MARGIN, 1 + ROW_MARGIN
    if behind(first) <= 0:
        return first, False
    if behind(last) >= 0:
        return last, False
    return brentq(behind, first, last, xtol=1e-15, rtol=1e-14), True


def as_read(splat, gaussian, camera_at, lens, time) -> reference.Projection:
    """The projection of one Gaussian at its time, sheared: rows below are read later.

    With the velocity v on the film, px, by differences: A = (I - v e_y^T / height)^-1.
    """
    step, weights = 2.0**-7, lenses.CENTRAL_WEIGHTS
    steps = step * np.arange(1, len(weights) + 1)

    def point(at) -> np.ndarray:
        return (gaussian.means - camera_at(at).center) @ camera_at(at).rotation.T

    moves = [point(time + each) - point(time - each) for each in steps]
    place = lenses._points_of_jacobian(lens, camera_at(time), point(time))
    velocity = lenses.jacobians(lens, camera_at(time), place)[0] @ (
        np.tensordot(weights, moves, axes=1)[0] / step
    )
    height = camera_at(time).height
    if velocity[1] >= MAX_ROW_RATE * height:
        return splat
    shear = np.linalg.inv(np.eye(2) - np.outer(velocity, [0, 1]) / height)
    cov2d = shear @ splat.cov2d @ shear.T
    return replace(splat, cov2d=cov2d, conics=np.linalg.inv(cov2d))


def rolling_image(gaussians, camera_at, lens, degree, threshold_width) -> reference.RenderedImage:
    """Each splat at the time of its mean, sheared, on black; camera_at: the camera at a time."""
    times = [row_time(camera_at, lens, mean) for mean in gaussians.means]
    cameras = [camera_at(time) for time, _ in times]
    pairs = [
        (reference.Gaussians(*(values[k : k + 1] for values in vars(gaussians).values())), camera)
        for k, camera in enumerate(cameras)
    ]
    bounds = lens.slope_bounds(cameras[0])  # wherever the camera is, and slow to compute
    with mock.patch.object(type(lens), "slope_bounds", lambda *_: bounds):
        splats = [lenses.project(*pair, lens) for pair in pairs]
        splats = [
            as_read(splat, pair[0], camera_at, lens, time) if is_read and splat.visible else splat
            for splat, pair, (time, is_read) in zip(splats, pairs, times, strict=True)
        ]
    colors = np.concatenate([lenses.sh_colors(*pair, lens, degree) for pair in pairs])
    arrays = ("means2d", "cov2d", "conics", "depths", "opacities", "visible")
    splats = reference.Projection(
        *(np.concatenate([getattr(each, name) for each in splats]) for name in arrays)
    )
    size = cameras[0].width, cameras[0].height
    return reference.composite(splats, colors, np.zeros(3), *size, threshold_width)
