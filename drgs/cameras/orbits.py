"""Cameras on a circle around the photographed object, or around Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from drgs.cameras.viewpoints import (
    FIELD_OF_VIEW,
    Viewpoint,
    focus_of,
    format_vector,
    level_axes,
    look_at,
    pinhole,
)
from drgs.config.schema import NEAR_LIMITS, REFERENCE_NEAR
from drgs.core.errors import UserError
from drgs.gaussians.parameters import Gaussians

ELEVATION, MAX_ELEVATION = math.radians(30), math.radians(80)
"""Elevation of an orbit without cameras; and of any orbit, which would spin in place beyond."""

MAX_ORBIT_SIDE_PX = 400

ELEVATIONS = (-25, 5, 35, 65)  # degrees, of rings of cameras around Gaussians

OPAQUE, SPREAD = 0.5, 0.98
"""Least opacity of Gaussians that decide where an orbit without cameras looks; and the share of
them that it keeps in the image. The rest may be outliers."""

MAX_GAP = math.radians(100)
"""Azimuth between two neighbouring cameras; a side beyond a larger gap was not photographed."""

SWAYING_ARC_SHARE = 0.8  # of the cameras' arc, through which an orbit sways that is not all round

NEAR_RANGE, NEAR_SHARE = (0.01, 0.5), 0.1
"""Shares of the median distance of Gaussians from their middle: the range of the reference's near
plane, and the near plane outside of it."""

MEAN_UP_WEIGHT = 1e-3  # of the cameras' up vectors, where their right vectors leave ``up`` open


@dataclass(frozen=True, eq=False)
class Orbit:
    """A closed path around ``focus`` at constant height, all of whose cameras look at it."""

    focus: np.ndarray  # (3,) world
    up: np.ndarray  # (3,) unit, world: the axis of rotation
    start: np.ndarray  # (3,) unit, world, perpendicular to up: from the focus to azimuth zero
    radius: float  # world units: distance of the cameras to the focus
    elevation: float  # radians above the plane through the focus
    half_arc: float | None  # radians: the azimuth sways by this; None: it runs all the way round

    def viewpoints(self, count: int, width: int, height: int, fov: float) -> list[Viewpoint]:
        """Return ``count`` cameras in equal steps of time; fov: degrees, horizontal."""
        side = np.cross(self.up, self.start)
        views = []
        for index in range(count):
            phase = 2 * math.pi * index / count
            azimuth = phase if self.half_arc is None else self.half_arc * math.sin(phase)
            level = math.cos(azimuth) * self.start + math.sin(azimuth) * side
            offset = math.cos(self.elevation) * level + math.sin(self.elevation) * self.up
            pose = look_at(self.focus + self.radius * offset, self.focus, self.up)
            views.append(pinhole(f"orbit_{index:03d}", pose, width, height, fov))
        return views


def orbit_of_views(views: Sequence[Viewpoint], gaussians: Gaussians) -> Orbit:
    """Return the orbit at the cameras' mean height and median distance around their focus.

    Where their optical axes do not meet, it is around the middle of ``gaussians``. Where they took
    the scene from one side only, it sways.
    """
    centers = np.stack([view.center for view in views])
    try:
        focus, radius = focus_of(views)
    except UserError:
        focus = _middle(gaussians)[0]
        radius = float(np.median(np.linalg.norm(centers - focus, axis=1)))
    up = up_of(views)
    start, side = level_axes(up, (centers - focus).mean(axis=0))
    offsets = centers - focus
    distances = np.maximum(np.linalg.norm(offsets, axis=1), np.finfo(np.float64).tiny)
    elevation = float(np.mean(np.arcsin(np.clip(offsets @ up / distances, -1, 1))))
    middle, half_arc = _covered_arc(np.arctan2(offsets @ side, offsets @ start))
    return Orbit(
        focus=focus,
        up=up,
        start=math.cos(middle) * start + math.sin(middle) * side,
        radius=radius,
        elevation=float(np.clip(elevation, -MAX_ELEVATION, MAX_ELEVATION)),
        half_arc=half_arc,
    )


def orbit_of_gaussians(gaussians: Gaussians, up: np.ndarray, fov: float) -> Orbit:
    """Return the orbit that shows all but outliers of the opaque Gaussians in a square image.

    up: (3,) world, any length; fov: degrees.
    """
    up = np.asarray(up, np.float64)
    with np.errstate(over="ignore"):  # becomes infinite, and is refused
        length = np.linalg.norm(up)
    if not 0 < length < np.inf:
        raise UserError(f"camera: up must not be zero or infinite, got {format_vector(up)}")
    focus, spread = _middle(gaussians)
    up = up / length
    start, _ = level_axes(up, np.array([0.0, -1.0, 0.0]))
    radius = spread / math.sin(math.radians(fov) / 2)
    return Orbit(focus, up, start, radius, ELEVATION, half_arc=None)


def rings_around(
    gaussians: Gaussians, up: np.ndarray, views_per_ring: int, side_px: int
) -> list[Viewpoint]:
    """Return square cameras on rings around the opaque Gaussians; up: (3,) unit, their axis."""
    orbit = orbit_of_gaussians(gaussians, up, FIELD_OF_VIEW)
    rings = [replace(orbit, elevation=math.radians(degrees)) for degrees in ELEVATIONS]
    return [v for r in rings for v in r.viewpoints(views_per_ring, side_px, side_px, FIELD_OF_VIEW)]


def near_plane_of(gaussians: Gaussians) -> float:
    """Return the near plane, scene units, for Gaussians without a configuration."""
    size, (low, high) = extent_of(gaussians), NEAR_RANGE
    if low * size <= REFERENCE_NEAR <= high * size:
        return REFERENCE_NEAR
    return float(np.clip(NEAR_SHARE * size, *NEAR_LIMITS))


def extent_of(gaussians: Gaussians) -> float:
    """Return the median distance of the opaque Gaussians from their middle, scene units."""
    return _middle(gaussians, share=0.5)[1]


def up_of(views: Sequence[Viewpoint]) -> np.ndarray:
    """Return the world's up direction (3,), unit, estimated from the cameras' poses.

    Minimises mean((r_i . u)^2) over unit vectors u, with r_i the cameras' right vectors, which are
    horizontal unless a camera is rolled. A small term draws u to the mean of the cameras' own up
    vectors: it decides where the right vectors are parallel, and the sign.
    """
    right = np.stack([view.camera_to_world[:3, 0] for view in views])
    mean_up = np.mean([-view.camera_to_world[:3, 1] for view in views], axis=0)
    matrix = right.T @ right / len(views) - MEAN_UP_WEIGHT * np.outer(mean_up, mean_up)
    up = np.linalg.eigh(matrix)[1][:, 0]
    return up if up @ mean_up >= 0 else -up


def orbit_size(views: Sequence[Viewpoint]) -> tuple[int, int]:
    """Return width and height, px: those of the first photograph, scaled to at most 400 px."""
    first = views[0]
    scale = min(1.0, MAX_ORBIT_SIDE_PX / max(first.width, first.height))
    return max(1, round(scale * first.width)), max(1, round(scale * first.height))


def _middle(gaussians: Gaussians, share: float = SPREAD) -> tuple[np.ndarray, float]:
    """Return the opaque Gaussians' median position (3,) and the distance of a ``share`` of them.

    Where all are at one place, the distance is the largest standard deviation.
    """
    g = gaussians.numpy()
    means = g.means.astype(np.float64)
    opaque = means[g.opacities >= OPAQUE]
    means = opaque if len(opaque) else means
    middle = np.median(means, axis=0)
    distance = float(np.quantile(np.linalg.norm(means - middle, axis=1), share))
    return middle, distance or float(np.clip(g.scales.max(), np.finfo(np.float32).tiny, 1e9))


def _covered_arc(azimuths: np.ndarray) -> tuple[float, float | None]:
    """Return the azimuth at which an orbit starts, and its ``half_arc``."""
    azimuths = np.sort(azimuths)
    gaps = np.diff(azimuths, append=azimuths[0] + 2 * math.pi)
    widest = int(np.argmax(gaps))
    if gaps[widest] <= MAX_GAP:
        return 0.0, None
    arc = 2 * math.pi - gaps[widest]
    first = azimuths[(widest + 1) % len(azimuths)]
    return float(first + arc / 2), float(SWAYING_ARC_SHARE * arc / 2)
