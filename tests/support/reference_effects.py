"""The reference of effects: defocus, moving cameras, the smoothing filter, surfaces between splats.

Naive float64 numpy, to be read after ``drgs.reference``, whose spaces, units and orders these are.
So are its sources, with Shoemake, "Animating Rotation with Quaternion Curves", SIGGRAPH 1985.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import inf, pi, sqrt

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from drgs.reference import splatting as reference
from drgs.reference.splatting import Camera, Gaussians, Projection, RenderedImage
from support import lenses
from support.lenses import Lens, Pinhole, render

PINHOLE = Pinhole()

MIN_CUT = 2.0**-60
"""An alpha that changes no sum: the cut of splats however dim they are out of focus."""

SMOOTHING_VARIANCE = 0.2
"""px^2: variance of the 3D smoothing filter at the largest sampling rate (Mip-Splatting's s)."""

VIEW_MARGIN = 0.15
"""A camera samples what lies within its film, widened by this part of its size (Mip-Splatting)."""


# ---- Defocus ---------------------------------------------------------------------------------


@dataclass(frozen=True)
class ThinLens:
    """An aperture, a disc about the camera's centre, and the plane that is in focus."""

    aperture_radius: float  # world units, >= 0
    focus_distance: float  # world units, > 0: camera z of what is in focus

    def blur_radii(self, camera: Camera, depths: np.ndarray) -> np.ndarray:
        """Return (N, 2), px: half axes of the ellipse over which a point at depth (N,) is spread.

        Seen from the aperture's point a, the point (x, z) is at f (x - a) / z on the film, moved
        by f a / focus_distance so that the plane in focus stays where it is: together it moves by
        f a (1 / focus_distance - 1 / z).
        """
        spread = self.aperture_radius * np.abs(1 / self.focus_distance - 1 / depths)
        return camera.focal * spread[:, None]


def project_defocused(
    gaussians: Gaussians,
    camera: Camera,
    defocus: ThinLens,
    lens: Lens = PINHOLE,
    antialiased: bool = False,
    low_pass: float = reference.LOW_PASS,
) -> Projection:
    """Return the splats that Gaussians leave on the film behind a lens with an aperture.

        cov2d = cov2d in focus + diag(r^2 / 4)

    r (N, 2) px are the ``blur_radii``; the variance of a uniform disc of radius r along an axis is
    r^2 / 4. Opacities are multiplied by sqrt(det(cov2d in focus) / det(cov2d)), so that the
    integral over the film of a splat stays. So are ``Projection.cuts``: a splat that is seen in
    focus is seen out of focus, and ends at as many standard deviations. Both may be small, but not
    below MIN_CUT.

    Not defined behind an orthographic lens, whose rays meet in no aperture.
    """
    focused = lenses.project(gaussians, camera, lens, antialiased, low_pass)
    radii = defocus.blur_radii(camera, np.where(focused.visible, focused.depths, 1.0))
    blurred = lenses.project(gaussians, camera, lens, low_pass=low_pass + radii**2 / 4)
    dimming = np.sqrt(_determinants(focused) / _determinants(blurred))
    opacities = focused.opacities * dimming
    return replace(
        blurred,
        opacities=opacities,
        visible=focused.visible & (opacities > MIN_CUT),
        cuts=np.maximum(focused.all_cuts * dimming, MIN_CUT),
    )


def _determinants(splats: Projection) -> np.ndarray:
    """Return the determinants (N,) of cov2d, which do not cancel in the conics."""
    return splats.cov2d[:, 0, 0] / np.where(splats.visible, splats.conics[:, 1, 1], 1.0)


def render_defocused(
    gaussians: Gaussians,
    camera: Camera,
    defocus: ThinLens,
    lens: Lens = PINHOLE,
    antialiased: bool = False,
    degree: int | None = None,
    threshold_width: float = reference.THRESHOLD_WIDTH,
) -> RenderedImage:
    """Return the image over black, as ``lenses.render``."""
    splats = project_defocused(gaussians, camera, defocus, lens, antialiased)
    colors = lenses.sh_colors(gaussians, camera, lens, degree)
    size, period = (camera.width, camera.height), lens.period(camera)
    return reference.composite(splats, colors, np.zeros(3), *size, threshold_width, period)


def lens_cameras(camera: Camera, defocus: ThinLens, num_samples: int) -> list[Camera]:
    """Return pinhole cameras at points of the aperture that agree on the plane in focus.

    The camera's centre moves by (a_x, a_y) to the right and down, its principal point by
    f a / focus_distance.
    """
    right, down, _ = camera.rotation
    return [
        replace(
            camera,
            center=camera.center + a_x * right + a_y * down,
            cx=camera.cx + camera.fx * a_x / defocus.focus_distance,
            cy=camera.cy + camera.fy * a_y / defocus.focus_distance,
        )
        for a_x, a_y in defocus.aperture_radius * _disc_points(num_samples)
    ]


def _disc_points(count: int) -> np.ndarray:
    """Return (count, 2): a sunflower, each seed with an equal share of the unit disc's area."""
    k = np.arange(count)
    radii = np.sqrt((k + 0.5) / count)
    angles = k * pi * (3 - sqrt(5))
    return radii[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])


# ---- Cameras that move while they expose -----------------------------------------------------

Pose = tuple[np.ndarray, np.ndarray]  # rotation (3, 3) world to camera, center (3,) world


def interpolate_pose(open: Pose, close: Pose, t: float) -> Pose:
    """Return the pose at time t: ``open`` at 0, ``close`` at 1.

    The centre moves along a line. The rotation moves along the shortest arc at constant speed
    (Shoemake's slerp): it is exp(t log(R_close R_open^T)) R_open. Between rotations that are half
    a turn apart there are two shortest arcs; which one is taken is not defined.
    """
    (rotation_open, center_open), (rotation_close, center_close) = open, close
    turn = Rotation.from_matrix(rotation_close @ rotation_open.T).as_rotvec()
    rotation = Rotation.from_rotvec(t * turn).as_matrix() @ rotation_open
    return rotation, (1 - t) * center_open + t * center_close


def camera_at(camera_open: Camera, camera_close: Camera, t: float) -> Camera:
    """Return the camera at time t, 0 to 1, of the exposure; see ``interpolate_pose``.

    The two differ in nothing but their pose.
    """
    rotation, center = interpolate_pose(
        (camera_open.rotation, camera_open.center), (camera_close.rotation, camera_close.center), t
    )
    return replace(camera_open, rotation=rotation, center=center)


def render_motion_blur(
    gaussians: Gaussians,
    camera_open: Camera,
    camera_close: Camera,
    num_samples: int,
    background: ArrayLike = (0.0, 0.0, 0.0),
    lens: Lens = PINHOLE,
    threshold_width: float = reference.THRESHOLD_WIDTH,
) -> RenderedImage:
    """Return the mean of n = num_samples images, at the times (k + 0.5) / n of the exposure.

    A pixel that any of them marks as near a threshold is marked.
    """
    images = [
        render(
            gaussians,
            camera_at(camera_open, camera_close, (k + 0.5) / num_samples),
            lens,
            background,
            threshold_width=threshold_width,
        )
        for k in range(num_samples)
    ]
    means = {
        name: np.mean([getattr(rendered, name) for rendered in images], axis=0)
        for name in ("image", "alpha", "depth", "transmittance")
    }
    marked = np.any([rendered.near_threshold for rendered in images], axis=0)
    return RenderedImage(**means, near_threshold=marked)


def render_rolling_shutter(
    gaussians: Gaussians,
    camera_open: Camera,
    camera_close: Camera,
    background: ArrayLike = (0.0, 0.0, 0.0),
    lens: Lens = PINHOLE,
) -> RenderedImage:
    """Return the image whose row j is row j of the image at time (j + 0.5) / H."""
    height = camera_open.height
    images = [
        render(
            gaussians, camera_at(camera_open, camera_close, (j + 0.5) / height), lens, background
        )
        for j in range(height)
    ]
    rows = ([field[j] for field in vars(rendered).values()] for j, rendered in enumerate(images))
    return RenderedImage(*map(np.stack, zip(*rows, strict=True)))


# ---- The 3D smoothing filter -----------------------------------------------------------------


def smoothing_filter(
    log_scales: np.ndarray, logit_opacities: np.ndarray, rates: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return scales (N, 3), world units, and opacities (N,) of Gaussians without finer detail.

    Each Gaussian is convolved with an isotropic one of variance v = 0.2 / rate^2 (Mip-Splatting,
    section 4.1, equations 8 and 9):

        scales = sqrt(s^2 + v),  opacities = o prod_k s_k / sqrt(s_k^2 + v)

    log_scales (N, 3); logit_opacities (N,); rates (N,) px per world unit: see ``sampling_rates``.
    """
    scales = np.exp(log_scales)
    smoothed = np.sqrt(scales**2 + (SMOOTHING_VARIANCE / rates**2)[:, None])
    return smoothed, reference.sigmoid(logit_opacities) * np.prod(scales / smoothed, axis=1)


def sampling_rates(means: np.ndarray, cameras: Sequence[Camera]) -> np.ndarray:
    """Return the largest rate (N,), px per world unit, at which pinhole cameras sample means.

    means (N, 3) world. A camera samples a mean at max(fx, fy) / z (Mip-Splatting, equation 7) if
    z >= near and the mean lies on its film, widened by 15 percent of its width and height on each
    side. A mean that no camera samples gets the smallest rate of all that are sampled, and so is
    smoothed most, as in Mip-Splatting's code, which gives it the largest distance.
    """
    rates = np.zeros(len(means))
    for camera in cameras:
        points = (means - camera.center) @ camera.rotation.T
        in_front = points[:, 2] >= camera.near
        points = np.where(in_front[:, None], points, (0.0, 0.0, 1.0))
        film, size = camera.film_points(points), camera.size
        on_film = (film >= -VIEW_MARGIN * size) & (film <= (1 + VIEW_MARGIN) * size)
        rate = max(camera.fx, camera.fy) / points[:, 2]
        rates = np.where(in_front & on_film.all(axis=1), np.maximum(rates, rate), rates)
    return np.where(rates > 0, rates, rates[rates > 0].min(initial=inf))


# ---- Surfaces between the splats -------------------------------------------------------------


@dataclass(frozen=True)
class SurfaceImage:
    """The view of splats, and of surfaces between them, from one camera."""

    color: np.ndarray  # (H, W, 3) display space, of the splats: premultiplied
    coverage: np.ndarray  # (H, W) sum of the weights that ``color`` was premultiplied with
    depth: np.ndarray  # (H, W) sum of weights times depths of the splats, world units
    before: np.ndarray  # (K, H, W) transmittance of the splats in front of each surface
    transmittance: np.ndarray  # (H, W) share of the background that is seen past all


def render_with_surfaces(
    gaussians: Gaussians, camera: Camera, surfaces: Sequence[tuple[np.ndarray, np.ndarray]]
) -> SurfaceImage:
    """Composite splats and K surfaces front to back, a surface as one more layer.

    surfaces: nearest first, depth (H, W) camera z, world units, and alpha (H, W) in [0, 1]. A splat
    is behind a surface where its mean's depth is larger. Which splat is the last that a pixel
    composites is decided as without surfaces.
    """
    splats = reference.project(gaussians, camera)
    order = reference.depth_order(splats.depths, splats.visible)
    colors, depths = reference.sh_colors(gaussians, camera)[order], splats.depths[order]
    centers = reference.pixel_centers(camera.width, camera.height)
    offsets = centers - splats.means2d[order, None, None]
    exponents = -0.5 * np.einsum("nhwa,nab,nhwb->nhw", offsets, splats.conics[order], offsets)
    alphas = splats.opacities[order, None, None] * np.exp(exponents)
    alphas = np.minimum(np.where(alphas < reference.ALPHA_CUT, 0, alphas), reference.ALPHA_MAX)
    unfinished = np.cumprod(1 - alphas, axis=0) >= reference.TRANSMITTANCE_STOP
    alphas = np.where(unfinished, alphas, 0)

    through = np.cumprod(1 - alphas, axis=0) / (1 - alphas)  # the splats in front of each
    before = []
    for z, alpha in surfaces:
        is_behind = depths[:, None, None] > z
        before.append(np.prod(np.where(is_behind, 1, 1 - alphas), axis=0))
        through = np.where(is_behind, through * (1 - alpha), through)
    weights = through * alphas
    return SurfaceImage(
        color=np.einsum("nhw,nc->hwc", weights, colors),
        coverage=np.sum(weights, axis=0),
        depth=np.einsum("nhw,n->hw", weights, depths),
        before=np.array(before),
        transmittance=np.prod(1 - alphas, axis=0) * np.prod([1 - a for _, a in surfaces], axis=0),
    )
