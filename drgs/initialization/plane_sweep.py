"""Points on surfaces, by a plane sweep between photographs: a start without structure from motion.

For each pixel of some photographs, made small, a point moves along its ray. Where it is on a
surface, neighbouring photographs show the same there: the cost of a distance is

    c = mean over windows and channels of min(|I(p) - I'(p')|, MAX_COST)

for colours and their gradients, p' the place of the point in a neighbour (Collins 1996, "A
space-sweep approach to true multi-image matching"). Of six neighbours, near and far, the better
half counts, since the others may not see the surface. A point is kept if its cost is low, far below
that of other distances, and two more photographs have found it as well.

Distances are sampled evenly in their inverse, which is evenly on the film.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import drjit as dr
import drjit.llvm.ad
import numpy as np
from scipy.ndimage import uniform_filter

from drgs.cameras.camera import Camera
from drgs.core.types import Array2f, Array3f, Bool, Float, UInt32
from drgs.datasets.film import is_projectable
from drgs.datasets.types import View, evenly_spaced

LLVM: Any = drjit.llvm.ad  # whatever the fit's backend is

MAX_PHOTOGRAPHS, MAX_PIXELS = 32, 18_000
"""Photographs whose pixels become points, and the number of these in each."""

NUM_DISTANCES = 96
NEAREST, FARTHEST = 0.8, 60.0
"""Distances, in the median distance of cameras from their third neighbour in NEIGHBOURS: as far
apart as they are, up to where the farthest neighbours see a difference of a pixel."""

NEIGHBOURS = (2, 4, 6, 9, 12, 16)
"""Ranks by distance of the cameras that a photograph is compared with."""

MIN_COSINE = 0.5  # between the axes of cameras that are compared

WINDOW = 5  # px
CHANNELS = 5  # red, green, blue, and twice the gradient of their mean
MAX_COST, GOOD_COST = 0.12, 0.05

MAX_RATIO = 0.6  # of a point's cost to the median one along its ray
NUM_CHECKED, MIN_VOTES = 6, 2  # near photographs that may have found a point as well, and that must


@dataclass(frozen=True, eq=False)
class _Photograph:
    """A photograph made small, and its camera."""

    view: View
    factor: int  # px of the view in one of the small photograph
    features: np.ndarray  # (H, W, CHANNELS) float32

    @staticmethod
    def shrink(view: View) -> _Photograph:
        factor = math.ceil(math.sqrt(view.width * view.height / MAX_PIXELS))
        rows, columns = (side // factor * factor for side in (view.height, view.width))
        blocks = np.asarray(view.image)[:rows, :columns]
        blocks = blocks.reshape(rows // factor, factor, columns // factor, factor, 3)
        colors = blocks.mean((1, 3))
        gradient = [2 * each[:, :, None] for each in np.gradient(colors.mean(axis=2))]
        return _Photograph(view, factor, np.concatenate([colors, *gradient], 2, dtype=np.float32))

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, px."""
        return self.features.shape[0], self.features.shape[1]

    @cached_property
    def camera(self) -> Camera:
        """The camera at the origin: points are relative to it, and few digits are lost."""
        view = self.view
        lens = {} if view.lens is None else {"lens": view.lens}
        size = view.width, view.height, float(np.finfo(np.float32).tiny)
        axes = view.camera_to_world[:3, :3].T
        camera = Camera.create(LLVM.Float, axes, np.zeros(3), view.K, *size, **lens)
        dr.make_opaque(camera)
        return camera

    @cached_property
    def device_features(self) -> Float:
        """The features, flat."""
        return LLVM.Float(self.features.ravel())

    def rays(self, pixel: UInt32) -> tuple[Array3f, Array3f]:
        """Return origins and directions of length 1, world, of pixels of the small photograph."""
        width = self.shape[1]
        x, y = (LLVM.Float(each) + 0.5 for each in (pixel % width, pixel // width))
        origin, ray, _ = self.camera.look_through(x * self.factor, y * self.factor)
        turn = self.camera.rotation.T
        return turn @ origin, turn @ dr.normalize(ray)

    def place(self, point: Array3f) -> tuple[Array2f, Bool]:
        """Return the place of points, world, relative to the camera: px, and whether it shows."""
        seen, position, _ = self.camera.lens.visibility(self.camera, self.camera.rotation @ point)
        place = self.camera.lens.project_point(self.camera, position) / self.factor
        height, width = self.shape
        return place, seen & dr.all((place >= 0) & (place < LLVM.Array2f(width, height)))


def swept_points(views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """Return points (N, 3) world and their colours (N, 3) display space; maybe none.

    Cameras that move while the shutter is open are left out; equal photographs give equal bytes.
    """
    views = [view for view in views if is_projectable(view)]
    neighbours = [_neighbours(views, index) for index in range(len(views))]
    found = [each for each in neighbours if each]
    if not found:
        return np.zeros((0, 3)), np.zeros((0, 3), np.float32)
    centers = np.stack([view.center for view in views])
    thirds = [
        np.linalg.norm(centers[each[min(2, len(each) - 1)]] - centers[index])
        for index, each in enumerate(neighbours)
        if each
    ]
    unit = float(np.median(thirds))
    inverse = np.linspace(1 / (NEAREST * unit), 1 / (FARTHEST * unit), NUM_DISTANCES)
    photographs = {}
    swept = [i for i in evenly_spaced(range(len(views)), MAX_PHOTOGRAPHS) if neighbours[i]]
    for index in {*swept, *(other for i in swept for other in neighbours[i])}:
        photographs[index] = _Photograph.shrink(views[index])
    beside = {i: [photographs[j] for j in neighbours[i]] for i in swept}
    maps = {i: _sweep(photographs[i], beside[i], inverse) for i in swept}
    points, colors = [], []
    step = inverse[0] - inverse[1]
    for index in swept:
        others = [j for j in _by_distance(views, index) if j in maps][:NUM_CHECKED]
        pairs = [(photographs[j], maps[j]) for j in others]
        where, positions = _find_confirmed(photographs[index], maps[index], pairs, step)
        points.append(positions)
        colors.append(photographs[index].features.reshape(-1, CHANNELS)[where, :3])
    return np.concatenate(points), np.concatenate(colors)


def _by_distance(views: Sequence[View], index: int) -> list[int]:
    """Return the other cameras that look about the same way, nearest first."""
    center, axis = views[index].center, views[index].camera_to_world[:3, 2]
    distances = [float(np.linalg.norm(view.center - center)) for view in views]
    cosines = [float(np.sum(view.camera_to_world[:3, 2] * axis)) for view in views]
    order = np.argsort(distances, kind="stable").tolist()
    return [i for i in order if distances[i] > 0 and cosines[i] > MIN_COSINE]


def _neighbours(views: Sequence[View], index: int) -> list[int]:
    order = _by_distance(views, index)
    return list(dict.fromkeys(order[min(rank, len(order)) - 1] for rank in NEIGHBOURS if order))


def _relative(a: View, b: View) -> Array3f:
    """Return the centre of a relative to that of b, world, opaque."""
    return dr.opaque(LLVM.Array3f, [float(each) for each in a.center - b.center])


def _sweep(
    photograph: _Photograph, others: Sequence[_Photograph], inverse: np.ndarray
) -> np.ndarray:
    """Return the inverse distance of each pixel (H, W); NaN where it is not clear."""
    (height, width), planes = photograph.shape, len(inverse)
    index = dr.arange(LLVM.UInt32, planes * height * width)
    pixel = index % (height * width)
    origin, ray = photograph.rays(pixel)
    distance = 1 / dr.gather(LLVM.Float, LLVM.Float(inverse), index // (height * width))
    point = origin + distance * ray
    own = _features(photograph, pixel, True)
    costs = []
    for other in others:
        place, shows = other.place(point + _relative(photograph.view, other.view))
        pairs = zip(_interpolate(other, place, shows), own, strict=True)
        differences: Any = sum(dr.abs(a - b) for a, b in pairs)
        cost = dr.minimum(differences / CHANNELS, MAX_COST)
        costs.append(dr.select(shows, cost, MAX_COST))
        dr.eval(costs[-1])
    windows = np.stack([np.array(cost).reshape(planes, height, width) for cost in costs])
    windows = uniform_filter(windows, cast("Any", (0, 0, WINDOW, WINDOW)), mode="nearest")
    half = (len(others) + 1) // 2
    cost = np.partition(windows, half - 1, axis=0)[:half].mean(axis=0)
    best = cost.argmin(axis=0)
    inner = best.clip(1, planes - 2)
    before, at, after = (np.take_along_axis(cost, (inner + k)[None], axis=0)[0] for k in (-1, 0, 1))
    curvature = before - 2 * at + after
    is_bent = curvature > 0
    shift = np.where(is_bent, (before - after) / (2 * np.where(is_bent, curvature, 1)), 0)
    is_clear = (at < GOOD_COST) & (at < MAX_RATIO * np.median(cost, axis=0)) & (best == inner)
    if photograph.view.mask is not None:
        f, mask = photograph.factor, np.asarray(photograph.view.mask)
        is_clear &= mask[f // 2 :: f, f // 2 :: f][:height, :width] > 0
    step = inverse[1] - inverse[0]
    return np.where(is_clear, inverse[0] + step * (inner + shift.clip(-0.5, 0.5)), np.nan)


def _features(photograph: _Photograph, pixel: UInt32, active: Bool | bool) -> list[Float]:
    first, table = pixel * CHANNELS, photograph.device_features
    return [dr.gather(LLVM.Float, table, first + k, active) for k in range(CHANNELS)]


def _interpolate(photograph: _Photograph, place: Array2f, active: Bool) -> list[Float]:
    """Return the features at places (px), bilinearly."""
    height, width = photograph.shape
    x, y = place.x - 0.5, place.y - 0.5
    column = dr.clip(dr.floor(x), 0, width - 2)
    row = dr.clip(dr.floor(y), 0, height - 2)
    a, b = dr.clip(x - column, 0, 1), dr.clip(y - row, 0, 1)
    first = LLVM.UInt32(row) * width + LLVM.UInt32(column)
    corners = [_features(photograph, first + offset, active) for offset in (0, 1, width, width + 1)]
    return [
        dr.lerp(dr.lerp(p, q, a), dr.lerp(r, s, a), b) for p, q, r, s in zip(*corners, strict=True)
    ]


def _find_confirmed(
    photograph: _Photograph,
    inverse: np.ndarray,
    others: Sequence[tuple[_Photograph, np.ndarray]],
    step: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (M,) whose points others have found as well, and the points (M, 3), world."""
    pixels = np.flatnonzero(np.isfinite(inverse.ravel()))
    if not len(pixels):
        return pixels, np.zeros((0, 3))
    origin, ray = photograph.rays(LLVM.UInt32(pixels))
    point = origin + ray / LLVM.Float(inverse.ravel()[pixels])
    votes = np.zeros(len(pixels), np.int64)
    for other, found in others:
        relative = point + _relative(photograph.view, other.view)
        place, shows = other.place(relative)
        column, row = (np.array(each).astype(np.int64) for each in (place.x, place.y))
        height, width = other.shape
        there = found[row.clip(0, height - 1), column.clip(0, width - 1)]
        with np.errstate(invalid="ignore"):  # NaN agrees with nothing
            votes += np.array(shows) & (np.abs(there - 1 / np.array(dr.norm(relative))) < step)
    kept = votes >= MIN_VOTES
    positions = np.array(point, np.float64).T[kept] + photograph.view.center
    return pixels[kept], positions
