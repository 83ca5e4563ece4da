"""Vignetting and responses as photographs have them, by the brightness of points in several.

The logarithm of the brightness of point i in photograph j, taken by camera k, is

    log b_ij = c_i + <d_i, v_ij> + g_j + a_k s_ij + p_k m_i,

with the colour c_i of the point, whose mean is m_i, and, to first order, its change d_i with the
direction v_ij to the camera, the gain g_j, the falloff a_k with s_ij, the squared distance from the
principal point (1 in corners), and the response p_k, relative to the first camera's. They are found
by robust least squares (compare Goldman and Chen 2005). Reflections whose second order in the
direction moves as s does, those of a thing in the middle of all photographs, look like a falloff.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from drgs.datasets.film import is_projectable, shown_points

if TYPE_CHECKING:
    from drgs.datasets.types import View
    from drgs.gaussians.parameters import Gaussians

MIN_OPACITY, MIN_OBSERVATIONS = 0.3, 8  # of a point that counts; photographs that show it
BLUR_PX, MIN_OPAQUE_PX = 1.0, 5  # of photographs; around an observation
DARKEST, BRIGHTEST = 0.02, 0.98  # channels of an observation, display space
NUM_REWEIGHTINGS, NUM_SWEEPS, RIDGE = 4, 8, 1e-3
MIN_OBSERVATIONS_OF_ALL = 500
MIN_SPREAD = 0.01  # of s beyond reflections: 0.03 of photographs around a room, 0.002 of a thing


class Tones(NamedTuple):
    """Logarithms, (K,) by camera, and their standard errors, (K,); None: cannot be told."""

    falloff: tuple[np.ndarray, np.ndarray] | None = None  # of corners' brightness over the middle's
    response: tuple[np.ndarray, np.ndarray] | None = None  # of exponents over the first camera's


def find_tones(views: Sequence[View], cameras: Sequence[int], gaussians: Gaussians) -> Tones:
    """Return vignetting and responses of cameras 0 to K - 1, each of which has taken some views.

    cameras: of views. gaussians: numpy, of a fit to them: where points are, and what they hide.
    """
    points = np.asarray(gaussians.means, np.float64)
    points = points[1 / (1 + np.exp(-np.asarray(gaussians.logit_opacities))) > MIN_OPACITY]
    if len(points) < MIN_OBSERVATIONS or not all(map(is_projectable, views)):
        return Tones()
    spacing = KDTree(points).query(points, k=4)[0][:, 1:].mean(axis=1)
    rows = np.concatenate([_observe(k, v, points, spacing) for k, v in enumerate(views)], axis=1)
    counts = np.bincount(rows[0].astype(int), minlength=1)[rows[0].astype(int)]
    rows = rows[:, counts >= MIN_OBSERVATIONS]
    if rows.shape[1] < MIN_OBSERVATIONS_OF_ALL:
        return Tones()
    point, photograph, s, brightness, x, y, z = rows[:, np.argsort(rows[0], kind="stable")]
    seen = _Observations(np.flatnonzero(np.diff(point, prepend=-1)), photograph.astype(int))
    first, camera, count = [np.ones_like(x), x, y, z], np.array(cameras), max(cameras) + 1
    second = [*first, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1]
    spread = seen.remover(np.stack(second), np.ones_like(s))(s)
    num_falloffs = count if np.sqrt(np.square(spread).mean()) > MIN_SPREAD else 0
    if any(view.lens is not None and view.lens.whole_turn for view in views):
        num_falloffs = 0
    mean = brightness - seen.remover(np.stack(first[:1]), first[0], sweeps=0)(brightness)
    is_by = camera[seen.photograph]
    columns = [s * (is_by == k) for k in range(num_falloffs)]
    columns += [(mean - mean.mean()) * (is_by == k) for k in range(1, count)]
    if not columns:
        return Tones()
    values, errors = seen.regress(np.stack(columns), brightness, np.stack(first))
    response = np.append(0, values[num_falloffs:]), np.append(0, errors[num_falloffs:])
    falloff = (values[:count], errors[:count]) if num_falloffs else None
    return Tones(falloff, response if count > 1 else None)


def _observe(number: int, view: View, points: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Return points, photograph, s, logarithms of brightness and directions, (7, N)."""
    index, (row, column), _ = shown_points(view, list(points.T), spacing)
    image = ndimage.gaussian_filter(np.asarray(view.image), (BLUR_PX, BLUR_PX, 0))[row, column]
    counts = (image.min(axis=1) > DARKEST) & (image.max(axis=1) < BRIGHTEST)
    for opaque in (view.alpha, view.mask):
        if opaque is not None:
            counts &= ndimage.minimum_filter(np.asarray(opaque), MIN_OPAQUE_PX)[row, column] > 0.99
    squares = np.square(column + 0.5 - view.cx) + np.square(row + 0.5 - view.cy)
    s = squares * 4 / (view.width**2 + view.height**2)
    to_camera = view.center - points[index]
    to_camera /= np.linalg.norm(to_camera, axis=1, keepdims=True)
    brightness = np.log(np.maximum(image.mean(axis=1), DARKEST))
    return np.stack([index, np.full(len(index), number), s, brightness, *to_camera.T])[:, counts]


@dataclass(frozen=True, eq=False)
class _Observations:
    """N observations of points, which follow each other, in photographs."""

    starts: np.ndarray  # of each point's
    photograph: np.ndarray  # (N,)

    def regress(
        self, columns: np.ndarray, brightness: np.ndarray, basis: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the numbers of columns (C, N), beside points and photographs, and their errors."""
        weights, values, errors = np.ones_like(brightness), np.zeros(0), np.zeros(0)
        for _ in range(NUM_REWEIGHTINGS):
            remove = self.remover(basis, weights)
            moved, left = np.stack([remove(column) for column in columns]), remove(brightness)
            inverse = np.linalg.inv(np.einsum("an,bn->ab", weights * moved, moved))
            values = inverse @ (weights * moved * left).sum(axis=1)
            left = left - values @ moved
            scores = [np.bincount(self.photograph, weights * each * left) for each in moved]
            errors = np.sqrt(np.square(inverse @ np.stack(scores)).sum(axis=1))
            deviation = 1.4826 * float(np.median(np.abs(left)))
            weights = 1 / (1 + np.square(left / (2 * deviation + 1e-6)))
        return values, errors

    def remover(
        self, basis: np.ndarray, weights: np.ndarray, sweeps: int = NUM_SWEEPS
    ) -> Callable[[np.ndarray], np.ndarray]:
        """Return a function that removes what points explain by a basis (K, N), and photographs."""
        sizes = np.diff(self.starts, append=basis.shape[1])
        row, weighted = np.repeat(np.arange(len(sizes)), sizes), weights * basis
        normal = [np.add.reduceat(weighted * other, self.starts, axis=1) for other in basis]
        normal = np.stack(normal).transpose(2, 0, 1)
        ridge = RIDGE * np.diag(np.arange(len(basis)) > 0) + 1e-9 * np.eye(len(basis))
        inverse = np.linalg.inv(normal + normal[:, :1, :1] * ridge)
        by_photograph = np.bincount(self.photograph, weights) + 1e-12

        def remove_points(values: np.ndarray) -> np.ndarray:
            sums = np.add.reduceat(weighted * values, self.starts, axis=1)
            return values - (basis * np.einsum("pij,jp->ip", inverse, sums)[:, row]).sum(axis=0)

        def remove(values: np.ndarray) -> np.ndarray:
            values = remove_points(values)
            for _ in range(sweeps):
                means = np.bincount(self.photograph, weights * values) / by_photograph
                values = remove_points(values - means[self.photograph])
            return values

        return remove
