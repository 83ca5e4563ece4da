"""Random points of a start, in a box that the cameras look into, or in all that they see."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from typing_extensions import override

from drgs.cameras.viewpoints import Viewpoint, focus_of, is_panorama
from drgs.config.schema import InitConfig
from drgs.core.errors import UserError
from drgs.datasets.types import Dataset

MIN_DISTANCE = 0.25  # of starting points to cameras, in distances to the focus

FAR_SHARE, FARTHEST = 0.5, 10.0
"""Share of starting points behind the focus, and their largest distance, in distances to it."""

MAX_BATCHES = 200  # batches of points to draw: enough where half a percent of the box is in view

REFERENCE_FILL = 0.9
"""Share of half of an image's width that the reference's box fills: 1.3 / (4.03 tan(0.69 / 2))."""

FILL_RANGE = (0.5, 2.0)  # shares of half of an image's width at which that box is taken as it is

MIN_FACING_SHARE = 0.5  # of the cameras, which must look at the points of a start

CENTRAL_SHARE = 0.5  # of an image's width and height: its middle, at which a camera looks

NUM_SAMPLES = 2000  # points that stand for a box

MAX_CLOUD_POINTS = 20_000  # points of a cloud that stand for all of it, which would take long


@dataclass(frozen=True, eq=False)
class Box:
    """A cube along the world's axes."""

    center: np.ndarray  # (3,) world
    half_extent: float  # world units

    def points(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """Return uniform random points (count, 3) float64."""
        return self.center + rng.uniform(-self.half_extent, self.half_extent, (count, 3))

    @override
    def __str__(self) -> str:
        if not self.center.any():
            return f"[-{self.half_extent:g}, {self.half_extent:g}]^3"
        center = format_point(self.center, self.half_extent)
        return f"the cube of half width {self.half_extent:.3g} around {center}"


def start_box_of(init: InitConfig, dataset: Dataset) -> Box | None:
    """Return the box of the random points of a start; None: :func:`points_in_view`.

    It is the layout's where the cameras are about as far from it as those of the reference.

    Raises :class:`UserError` for a given one (``init.half_extent``) that the cameras do not see.
    """
    if init.half_extent is not None:
        box = Box(-np.array(dataset.origin), init.half_extent)
        check_box(box, dataset)
        return box
    if dataset.start_half_extent is None:
        return None
    reference = Box(-np.array(dataset.origin), dataset.start_half_extent)
    if not dataset.train:
        return reference
    try:
        focus, distance = focus_of(dataset.train)
    except UserError:
        return reference
    visible_width = distance * _half_width(dataset.train)
    is_near = np.abs(focus - reference.center).max() <= reference.half_extent
    if is_near and FILL_RANGE[0] <= reference.half_extent / visible_width <= FILL_RANGE[1]:
        return reference
    return focus_box(dataset.train)


def focus_box(views: Sequence[Viewpoint]) -> Box:
    """Return a box nearly as wide as the views at the cameras' focus, as the reference's is."""
    focus, distance = focus_of(views)
    return Box(focus, REFERENCE_FILL * distance * _half_width(views))


def _half_width(views: Sequence[Viewpoint]) -> float:
    """Return the median half width of the views at distance 1."""
    return float(np.median([0.5 * view.width / view.fx for view in views]))


def points_in_view(views: Sequence[Viewpoint], count: int, rng: np.random.Generator) -> np.ndarray:
    """Return random points (count, 3) float64 in the cameras' views, around and behind their focus.

    Half of the points are uniform in a cube around the focus; its half extent is the distance D to
    the cameras. The others, for walls and skies, are uniform in one over the distance, out to 10 D,
    as Mip-NeRF 360 (Barron et al. 2022) contracts space. Points that no camera sees would never be
    moved or removed, and one close to a camera covers its image, so only points are kept that are
    in an image and at least D / 4 from every camera.
    """
    focus, distance = focus_of(views)
    kept = np.empty((0, 3))
    for _ in range(MAX_BATCHES):
        points = rng.uniform(-1, 1, (count, 3))
        is_far = rng.random(count) < FAR_SHARE
        size = np.abs(points[is_far]).max(axis=1, keepdims=True)  # 1: on the cube's surface
        points[is_far] /= size * rng.uniform(1 / FARTHEST, 1, size.shape)
        points = focus + distance * points
        visible, clear = np.zeros(count, bool), np.ones(count, bool)
        for view in views:
            offsets = points - view.center
            visible |= _in_image(points, view)
            clear &= np.einsum("ni,ni->n", offsets, offsets) >= (MIN_DISTANCE * distance) ** 2
        kept = np.concatenate([kept, points[visible & clear]])
        if len(kept) >= count:
            return kept[:count]
    raise UserError(
        "init.half_extent: no start box can be derived from the cameras, which see too little of "
        f"what is around {np.round(focus, 3).tolist()}; set it, or give init.point_cloud"
    )


def _in_image(points: np.ndarray, view: Viewpoint, part: float = 1.0) -> np.ndarray:
    """Return whether (N,) points are in the middle ``part`` of the image's width and height."""
    if is_panorama(view):
        return np.full(len(points), True)
    x, y, z = ((points - view.center) @ view.camera_to_world[:3, :3]).T
    # In pixels times z, so that nothing is divided by a depth near zero.
    u, v = view.fx * x + view.cx * z, view.fy * y + view.cy * z
    left, right = 0.5 * (1 - part), 0.5 * (1 + part)
    inside = (u >= left * view.width * z) & (u <= right * view.width * z)
    return inside & (z > 0) & (v >= left * view.height * z) & (v <= right * view.height * z)


# Checks of given boxes and point clouds


def num_views_facing(points: np.ndarray, views: Sequence[Viewpoint]) -> int:
    """Return the number of cameras with one of the points (N, 3) in the middle of their images."""
    points = points[:: max(1, len(points) // MAX_CLOUD_POINTS)]
    return sum(bool(_in_image(points, view, CENTRAL_SHARE).any()) for view in views)


def focus_text(dataset: Dataset) -> str:
    """Return the place that the cameras look at, world, for a message; "" where there is none."""
    try:
        focus, distance = focus_of(dataset.train)
    except UserError:
        return ""
    return f" (around {format_point(focus + dataset.origin, distance)}, from {distance:.3g} away)"


def check_box(box: Box, dataset: Dataset) -> None:
    """Raise :class:`UserError` for a box that most cameras do not look into."""
    points, views = box.points(NUM_SAMPLES, np.random.default_rng(0)), dataset.train
    looking = num_views_facing(points, views)
    if looking >= MIN_FACING_SHARE * len(views):
        return
    in_world = Box(box.center + dataset.origin, box.half_extent)
    raise UserError(
        f"init.half_extent: the start box {in_world} must be what the cameras look at"
        f"{focus_text(dataset)}, but only {looking} of {len(views)} have it in the middle of their "
        "images; set init.half_extent=null, and it follows from them"
    )


def format_point(point: np.ndarray, scale: float) -> str:
    """Return a point as messages write it; scale: of distances, which decides the digits."""
    rounded = np.where(np.abs(point) < 1e-6 * scale, 0, point)
    digits = max(3, math.ceil(math.log10(max(np.abs(point).max() / scale, 1))) + 2)
    return f"({', '.join(f'{v:.{digits}g}' for v in rounded)})"
