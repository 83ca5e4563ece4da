"""Scenes before cameras with lenses, for the kernels and for the float64 reference."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cache

import drjit as dr
import numpy as np
import pytest

from drgs.cameras import equirectangular, fisheye, orthographic, thin_prism_fisheye
from drgs.cameras.camera import Aperture, Camera
from drgs.cameras.radial_tangential import RadialTangential
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.reference import effects
from drgs.reference import splatting as reference
from drgs.reference.effects import Equirectangular, Fisheye, OpenCV, Orthographic, ThinPrismFisheye
from drgs.splatting import rendering
from drgs.splatting.projection import ewa, load_rows, plain_opacity, project
from support.helpers import (
    FLOAT32,
    FLOAT64,
    Case,
    Precision,
    device_camera,
    device_gaussians,
    render_composed,
    rows,
    single,
)
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


PINHOLE = effects.Pinhole()


def kernel_lens(lens: effects.Lens) -> object:
    """The kernels' lens with the coefficients of the reference's that are not zero."""
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


def lens_camera(camera: reference.Camera, lens: effects.Lens, precision: Precision) -> Camera:
    """The kernels' camera; no number of it is a literal."""
    camera = device_camera(camera, precision)
    if not isinstance(lens, effects.Pinhole):
        camera = camera.with_lens(kernel_lens(lens))
    dr.make_opaque(camera)
    return camera


def points_at(lens: effects.Lens, camera: reference.Camera, film, distances) -> np.ndarray:
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


@dataclass(frozen=True)
class LensCase(Case):
    """A scene behind a lens, by its recipe; everything else follows from it."""

    lens: effects.Lens = PINHOLE
    recipe: object = None  # (case, rng) -> Gaussians and camera; None: :func:`scene_behind`
    defocus: effects.ThinLens | None = None

    @property
    def scene(self) -> tuple[reference.Gaussians, reference.Camera]:
        return _scene(self)

    @property
    def rendered(self) -> reference.RenderedImage:
        return _image(self)

    def reference_image(self, gaussians=None, threshold_width=0.0) -> reference.RenderedImage:
        """Render other Gaussians."""
        return effects.render(
            gaussians or self.gaussians, self.camera, self.lens, self.background, self.antialiased,
            self.defocus, self.rendered_degree, threshold_width,
        )  # fmt: skip

    def device_camera(self, precision: Precision) -> Camera:
        """With the lens, and the aperture."""
        camera = lens_camera(self.camera, self.lens, precision)
        if self.defocus is None:
            return camera
        assert self.camera.fx == self.camera.fy, "an aperture's disc is round"
        numbers = (self.defocus.aperture_radius, self.defocus.focus_distance)
        aperture = Aperture(*(dr.opaque(precision.Float, n) for n in numbers))
        return replace(camera, aperture=aperture)

    def render(self, precision: Precision, pipeline=None) -> tuple[Gaussians, rendering.Frame]:
        """The Gaussians on the device, and their frame."""
        gaussians = device_gaussians(self.gaussians, precision)
        camera = self.device_camera(precision)
        return gaussians, render_composed(gaussians, camera, pipeline or self.pipeline)


@cache
def _scene(case):
    rng = np.random.default_rng(case.seed)
    return (case.recipe or scene_behind)(case, rng)


@cache
def _image(case):
    return case.reference_image(threshold_width=case.threshold_width)


def camera_behind(case, rng) -> reference.Camera:
    """Rotated, fx != fy, off-centre; films whose corners are 50 to 65 degrees from the axis.

    With a fisheye they are up to 140 degrees, with a barrel beyond the fold.
    """
    size = np.array([case.width, case.height])
    factors = {Fisheye: 0.27, Orthographic: 0.3, Equirectangular: 0.16}
    focal = max(size) * factors.get(type(case.lens), 0.7)
    fx, fy = focal * rng.uniform(0.9, 1.1, 2)
    if case.defocus is not None:
        fy = fx
    cx, cy = size * rng.uniform(0.4, 0.6, 2)
    return reference.Camera(
        rotation=single(reference.quat_to_rotation(rng.normal(0, 1, (1, 4)))[0]),
        center=single(rng.normal(0, 1, 3)),
        fx=float(single(fx)), fy=float(single(fy)), cx=float(single(cx)), cy=float(single(cy)),
        width=case.width, height=case.height, near=0.25,
    )  # fmt: skip


def scene_behind(case, rng) -> tuple[reference.Gaussians, reference.Camera]:
    """Splats of a fraction of a pixel to a fifth of the film, on and around the film.

    Of 20 or more the first ten are special: straight behind the camera; nearer than the near
    plane; too transparent; four large ones far beyond each side of the film; one whose parameters
    are those of a fresh Gaussian; one on the axis; one beyond what the lens model is made for.
    """
    camera, count = camera_behind(case, rng), case.count
    size = np.array([case.width, case.height])
    film = rng.uniform(-0.15, 1.15, (count, 2)) * size
    distances = rng.uniform(1.0, 4.0, count)
    sizes = np.minimum(rng.lognormal(np.log(1.5), 0.9, (count, 3)), 0.2 * max(size) + 1)
    logits = rng.normal(0.5, 1.7, count)
    if special := count >= 20:
        distances[1], logits[2] = 0.1, -6.0
        film[1:3] = size * np.array([[0.3, 0.4], [0.6, 0.3]])
        film[3:7] = size * np.array([[-0.6, 0.5], [1.6, 0.4], [0.3, -0.6], [0.6, 1.6]])
        sizes[3:7], logits[3:7] = 0.3 * max(size), 2.0
        film[7], sizes[7], logits[7] = 0.4 * size, 2.0, 0.0
        film[8] = camera.cx, camera.cy
    points = seen_points(case.lens, camera, film, distances)
    if special:
        points[0] = [0, 0, -1]
        beyond = point_beyond_lens_limit(case.lens)
        points[9] = beyond if beyond is not None else points[9]
    gaussians = gaussians_at_points(case, rng, camera, points, sizes, logits)
    if special:
        gaussians.quats[7] = [1, 0, 0, 0]
        gaussians.sh0[7] = 0
    return gaussians, camera


def gaussians_at_points(case, rng, camera, points, sizes, logits) -> reference.Gaussians:
    """At points (N, 3) in camera axes, of ``sizes`` (N, 3) px on the axis."""
    n = len(points)
    # With parallel rays, fx is px per world unit at any distance.
    far = 1 if isinstance(case.lens, Orthographic) else np.linalg.norm(points, axis=1)[:, None]
    return reference.Gaussians(
        means=single(points @ camera.rotation + camera.center),
        quats=single(rng.normal(0, 1, (n, 4)) * rng.uniform(0.2, 5.0, (n, 1))),
        log_scales=single(np.log(sizes * far / camera.fx)),
        logit_opacities=single(logits),
        sh0=single(rng.normal(0, 1.0, (n, 1, 3))),
        shN=single(rng.normal(0, 0.3, (n, (case.degree + 1) ** 2 - 1, 3))),
    )


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


def moved(gaussians: reference.Gaussians, direction, step) -> reference.Gaussians:
    """Gaussians + step * direction."""
    return reference.Gaussians(
        **{n: getattr(gaussians, n) + step * getattr(direction, n) for n in PARAMETER_NAMES}
    )


def directions(gaussians: reference.Gaussians, seed: int) -> dict[str, reference.Gaussians]:
    """Return directions by parameter: normal numbers in it, float32 values, and zeros in the
    others."""
    rng = np.random.default_rng(seed)
    zeros = {n: np.zeros_like(getattr(gaussians, n)) for n in PARAMETER_NAMES}
    return {
        n: reference.Gaussians(**{**zeros, n: single(rng.normal(size=zeros[n].shape))})
        for n in PARAMETER_NAMES
    }


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


def case_of(name, **others) -> LensCase:
    return LensCase(name, 37, 29, 1, lens=LENSES[name], **others)


def splats_of(gaussians, camera, lens, precision, shape=ewa, low_pass=0.3, degree=0):
    """DirectProjection by the kernels."""
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
