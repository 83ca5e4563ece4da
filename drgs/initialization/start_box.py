"""Where a fit starts: random points in a box that the cameras look into, or in what they see.

Points that the cameras do not look at are refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from drgs.config.schema import InitConfig
from drgs.core.errors import UserError
from drgs.datasets.focus import focus_of
from drgs.datasets.types import Dataset, Viewpoint

KEEP_OUT = 0.25
"""Of the distance to what the cameras look at: no starting point is nearer to a camera."""

FAR_SHARE, FARTHEST = 0.5, 10.0
"""Of starting points, those behind what is looked at, and how far they go, in distances to it."""

MAX_BATCHES = 200
"""Batches of points to draw: enough where half a percent of the box is in view."""

REFERENCE_FILL = 0.9
"""Of half of a picture's width: what the reference's box takes up where NeRF-synthetic's cameras
look, 1.3 / (4.03 tan(0.69 / 2))."""

FILL_RANGE = (0.5, 2.0)
"""Of half of a picture's width: where that box is taken as it is."""

LEAST_LOOKING = 0.5
"""Of the cameras, those that must look at where a fit starts."""

MIDDLE = 0.5
"""Of a picture's width and height: what a camera looks at is in there."""

LEAST_COVERED = 0.005
"""Of a picture (the median): what a box must cover, or what is around it starts without points."""

LEAST_NEAR_FOCUS = 0.01
"""Of a box, what must be no farther from what the cameras look at than they are: of 100,000 points,
a thousand for all that matters."""

SAMPLES = 2000
"""Points that stand for a box."""

MOST_POINTS = 20_000
"""Points of a cloud that stand for all of it."""

RAYS = 32
"""In each direction, through a picture whose covered part is measured."""


@dataclass(frozen=True, eq=False)
class Box:
    """A cube along the world's axes."""

    center: np.ndarray  # (3,) world
    half_extent: float  # world units

    def points(self, count: int, rng: np.random.Generator) -> np.ndarray:
        """(count, 3) float64: uniform."""
        return self.center + rng.uniform(-self.half_extent, self.half_extent, (count, 3))

    def __str__(self) -> str:
        """As messages name it."""
        if not self.center.any():
            return f"[-{self.half_extent:g}, {self.half_extent:g}]^3"
        center = shown(self.center, self.half_extent)
        return f"the cube of half width {self.half_extent:.3g} around {center}"


def box_to_start_in(init: InitConfig, dataset: Dataset) -> Box | None:
    """The box of the random points that a fit starts from; None: :func:`points_in_view`.

    Raises :class:`UserError` for a given one (``init.half_extent``) that the cameras do not see.
    """
    if init.half_extent is not None:
        box = Box(-np.array(dataset.origin), init.half_extent)
        check_box(box, dataset)
        return box
    if dataset.start_half_extent is None:
        return None
    if is_of_the_reference(dataset):
        return Box(-np.array(dataset.origin), dataset.start_half_extent)
    return box_looked_at(dataset.train)


def box_looked_at(views: Sequence[Viewpoint]) -> Box:
    """As the reference's box is to its cameras: nearly as wide as what they see at their focus."""
    focus, distance = focus_of(views)
    return Box(focus, REFERENCE_FILL * distance * _half_width(views))


def is_of_the_reference(dataset: Dataset) -> bool:
    """Whether the layout has a start box, and the cameras are about as far away as it expects."""
    half_extent = dataset.start_half_extent
    if half_extent is None or not dataset.train:
        return half_extent is not None
    try:
        focus, distance = focus_of(dataset.train)
    except UserError:  # nothing is known that would be better
        return True
    fill = half_extent / (distance * _half_width(dataset.train))
    off = np.abs(focus + dataset.origin).max()
    return bool(FILL_RANGE[0] <= fill <= FILL_RANGE[1] and off <= half_extent)


def _half_width(views: Sequence[Viewpoint]) -> float:
    """Of what is seen at distance 1; the median."""
    return float(np.median([0.5 * view.width / view.fx for view in views]))


def points_in_view(views: Sequence[Viewpoint], count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) float64: what is seen of a cube around the cameras' focus, and of what is behind.

    The cube's half extent is the distance D to the focus: it holds what is looked at and as much
    again behind it. Half of the points are uniform in it. The others are for walls and skies: in
    any direction uniform in one over the distance, out to 10 D, as Mip-NeRF 360 (Barron et al.
    2022) contracts space. Points that no camera sees would never be moved or removed, and one close
    to a camera covers its picture, so only points are kept that lie in a picture and nowhere nearer
    than D / 4 to a camera.
    """
    focus, distance = focus_of(views)
    kept = np.empty((0, 3))
    for _ in range(MAX_BATCHES):
        points = focus + distance * _near_and_far(count, rng)
        seen = in_view(points, views) & _clear_of(points, views, KEEP_OUT * distance)
        kept = np.concatenate([kept, points[seen]])
        if len(kept) >= count:
            return kept[:count]
    raise UserError(
        "init.half_extent: no start box can be derived from the cameras, which see too little of "
        f"what is around {np.round(focus, 3).tolist()}; set it, or give init.point_cloud"
    )


def _near_and_far(count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3): in and around the cube [-1, 1]^3."""
    points = rng.uniform(-1, 1, (count, 3))
    is_far = rng.random(count) < FAR_SHARE
    size = np.abs(points[is_far]).max(axis=1, keepdims=True)  # 1: on the cube's surface
    points[is_far] /= size * rng.uniform(1 / FARTHEST, 1, size.shape)
    return points


def in_view(points: np.ndarray, views: Sequence[Viewpoint]) -> np.ndarray:
    """(N,) bool: which of the points (N, 3) are inside at least one picture."""
    seen = np.zeros(len(points), bool)
    for view in views:
        seen |= _in_picture(points, view)
    return seen


def _in_picture(points: np.ndarray, view: Viewpoint, part: float = 1.0) -> np.ndarray:
    """(N,) bool: which are in the middle ``part`` of the picture's width and height."""
    x, y, z = ((points - view.center) @ view.camera_to_world[:3, :3]).T
    # In pixels times z, so that nothing is divided by a depth near zero.
    u, v = view.fx * x + view.cx * z, view.fy * y + view.cy * z
    left, right = 0.5 * (1 - part), 0.5 * (1 + part)
    inside = (u >= left * view.width * z) & (u <= right * view.width * z)
    return inside & (z > 0) & (v >= left * view.height * z) & (v <= right * view.height * z)


def _clear_of(points: np.ndarray, views: Sequence[Viewpoint], keep_out: float) -> np.ndarray:
    """(N,) bool: which are at least ``keep_out`` from every camera."""
    clear = np.ones(len(points), bool)
    for view in views:
        offsets = points - view.center
        clear &= np.einsum("ni,ni->n", offsets, offsets) >= keep_out**2
    return clear


# Where a configuration or a point cloud says that a fit starts


def num_looking(points: np.ndarray, views: Sequence[Viewpoint]) -> int:
    """How many cameras have one of the points (N, 3) in the middle of their picture.

    Of very many points, which would take long, every n-th is looked at.
    """
    points = points[:: max(1, len(points) // MOST_POINTS)]
    return sum(bool(_in_picture(points, view, MIDDLE).any()) for view in views)


def where_they_look(dataset: Dataset) -> str:
    """Place of what the cameras look at, world, for a message; "" where they look nowhere."""
    try:
        focus, distance = focus_of(dataset.train)
    except UserError:
        return ""
    return f" (around {shown(focus + dataset.origin, distance)}, from {distance:.3g} away)"


def check_box(box: Box, dataset: Dataset) -> None:
    """Raise :class:`UserError` for a box that most cameras do not look into, or hardly see.

    And for one that is so large that next to nothing of it is what they look at.
    """
    points, views = box.points(SAMPLES, np.random.default_rng(0)), dataset.train
    looking = num_looking(points, views)
    covered = float(np.median([_covered(box, view) for view in views]))
    if looking < LEAST_LOOKING * len(views):
        what = f"only {looking} of {len(views)} have it in the middle of their pictures"
    elif covered < LEAST_COVERED:
        what = f"it covers only {100 * covered:.2g} % of a picture (the median)"
    elif _far_from_focus(points, views):
        what = f"less than {100 * LEAST_NEAR_FOCUS:g} % of it is as near to that as they are"
    else:
        return
    in_world = Box(box.center + dataset.origin, box.half_extent)
    raise UserError(
        f"init.half_extent: the start box {in_world} must be what the cameras look at"
        f"{where_they_look(dataset)}, but {what}; set init.half_extent=null, and it follows "
        "from them"
    )


def _far_from_focus(points: np.ndarray, views: Sequence[Viewpoint]) -> bool:
    try:
        focus, distance = focus_of(views)
    except UserError:
        return False
    return bool(np.mean(np.linalg.norm(points - focus, axis=1) <= distance) < LEAST_NEAR_FOCUS)


def _covered(box: Box, view: Viewpoint) -> float:
    """Which part of a picture shows the box, by rays through it; lenses are taken for pinholes."""
    u, v = np.meshgrid(
        *((np.arange(RAYS) + 0.5) / RAYS * size for size in (view.width, view.height))
    )
    rays = np.stack([(u - view.cx) / view.fx, (v - view.cy) / view.fy, np.ones_like(u)], axis=-1)
    # A zero component, of a ray along a face's plane, meets that face nowhere: at infinity.
    with np.errstate(divide="ignore", invalid="ignore"):
        directions = rays.reshape(-1, 3) @ view.camera_to_world[:3, :3].T
        low, high = (
            (box.center + sign * box.half_extent - view.center) / directions for sign in (-1, 1)
        )
        first = np.nanmax(np.minimum(low, high), axis=1)
        last = np.nanmin(np.maximum(low, high), axis=1)
    by_rays = float(np.mean((last > 0) & (first <= last)))
    # One that is smaller than what lies between two rays.
    return max(by_rays, 0.5 / RAYS**2 if in_view(box.center[None], [view])[0] else 0.0)


def shown(point: np.ndarray, scale: float) -> str:
    """A point as messages write it; scale: what is around it, beside which rounding is nothing."""
    rounded = np.where(np.abs(point) < 1e-6 * scale, 0, point)
    digits = max(3, math.ceil(math.log10(max(np.abs(point).max() / scale, 1))) + 2)
    return f"({', '.join(f'{v:.{digits}g}' for v in rounded)})"
