"""Vignetting and responses as photographs have them, by the brightness of points in several.

The logarithm of the brightness of point i in photograph j, taken by camera k, is

    log b_ij = c_i + <d_i, v_ij> + g_j + a_k s_ij + p_k m_i,

with the colour c_i of the point, whose mean is m_i, and, to first order, its change d_i with the
direction v_ij to the camera, the gain g_j, the falloff a_k with s_ij, the squared distance from the
principal point (1 in corners), and the response p_k, relative to the first camera's. They are found
by robust least squares (compare Goldman and Chen 2005). Reflections whose second order in the
direction moves as s does, those of a thing that stays in the middle of all photographs, cannot be
told from a falloff.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy import ndimage
from scipy.spatial import KDTree

from drgs.datasets.film import is_projectable, shown_points
from drgs.gaussians.parameters import Gaussians

if TYPE_CHECKING:
    from drgs.datasets.types import View

MIN_OPACITY, MIN_OBSERVATIONS = 0.3, 8  # of a point that counts; photographs that show it
BLUR_PX, MIN_OPAQUE_PX = 1.0, 5  # of photographs; around an observation
DARKEST, BRIGHTEST = 0.02, 0.98  # channels of an observation, display space
NUM_REWEIGHTINGS, NUM_SWEEPS, RIDGE = 4, 8, 1e-3
MIN_OBSERVATIONS_OF_ALL = 500
MIN_SPREAD = 0.01  # of s beyond reflections: 0.03 of photographs around a room, 0.002 of a thing


@dataclass(frozen=True)
class Tones:
    """Logarithms, by camera, and their standard errors, by photographs; None: cannot be told."""

    falloff: tuple[np.ndarray, np.ndarray] | None  # (K,) of corners' brightness over the middle's
    response: tuple[np.ndarray, np.ndarray] | None  # (K,) of exponents, relative to the first


def find_tones(views: Sequence[View], cameras: Sequence[int], gaussians: Gaussians) -> Tones:
    """Return vignetting and responses of cameras 0 to K - 1, each of which has taken some views.

    cameras: of the views. gaussians: numpy arrays, of a fit to them: where points are, and what
    they hide.
    """
    opacities = 1 / (1 + np.exp(-np.asarray(gaussians.logit_opacities)))
    points = np.asarray(gaussians.means, np.float64)[opacities > MIN_OPACITY]
    if len(points) < MIN_OBSERVATIONS or not all(map(is_projectable, views)):
        return Tones(None, None)
    spacing = KDTree(points).query(points, k=4)[0][:, 1:].mean(axis=1)
    seen = [_observe(view, points, spacing) for view in views]
    point, s, brightness, direction = (np.concatenate(each) for each in zip(*seen, strict=True))
    photograph = np.repeat(np.arange(len(seen)), [len(each[0]) for each in seen])
    counts, order = np.bincount(point, minlength=1), np.argsort(point, kind="stable")
    order = order[counts[point[order]] >= MIN_OBSERVATIONS]
    if len(order) < MIN_OBSERVATIONS_OF_ALL:
        return Tones(None, None)
    point, s, brightness, photograph = (v[order] for v in (point, s, brightness, photograph))
    x, y, z = direction[order].T
    first = np.stack([np.ones_like(x), x, y, z])
    second = np.stack([*first, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1])
    starts = np.flatnonzero(np.diff(point, prepend=-1))
    sizes = np.diff(starts, append=len(point))
    row, by = np.repeat(np.arange(len(starts)), sizes), np.array(cameras)[photograph]
    mean = (np.add.reduceat(brightness, starts) / sizes)[row]
    count = max(cameras) + 1
    is_turn = any(view.lens is not None and view.lens.whole_turn for view in views)
    spread = _remover(second, np.ones_like(s), starts, row, photograph)(s)
    has_falloff = not is_turn and np.sqrt(np.square(spread).mean()) > MIN_SPREAD
    columns = [s * (by == k) for k in range(count if has_falloff else 0)]
    columns += [(mean - mean.mean()) * (by == k) for k in range(1, count)]
    if not columns:
        return Tones(None, None)
    values, errors = _regress(np.stack(columns), brightness, first, starts, row, photograph)
    first_response = count if has_falloff else 0
    falloff = values[:count], errors[:count]
    response = np.append(0, values[first_response:]), np.append(0, errors[first_response:])
    return Tones(falloff if has_falloff else None, response if count > 1 else None)


def _observe(view: View, points: np.ndarray, spacing: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return indices, s, logarithms of brightness and directions of points that a view shows."""
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
    seen = index, s, np.log(np.maximum(image.mean(axis=1), DARKEST)), to_camera
    return tuple(each[counts] for each in seen)


def _regress(
    columns: np.ndarray,
    brightness: np.ndarray,
    basis: np.ndarray,
    starts: np.ndarray,
    row: np.ndarray,
    photograph: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the numbers of columns (C, N), beside points and photographs, and their errors."""
    weights, values, errors = np.ones_like(brightness), np.zeros(0), np.zeros(0)
    for _ in range(NUM_REWEIGHTINGS):
        remove = _remover(basis, weights, starts, row, photograph)
        moved, left = np.stack([remove(column) for column in columns]), remove(brightness)
        inverse = np.linalg.inv(np.einsum("an,bn->ab", weights * moved, moved))
        values = inverse @ (weights * moved * left).sum(axis=1)
        left = left - values @ moved
        scores = np.stack([np.bincount(photograph, weights * each * left) for each in moved])
        errors = np.sqrt(np.square(inverse @ scores).sum(axis=1))
        deviation = 1.4826 * float(np.median(np.abs(left)))
        weights = 1 / (1 + np.square(left / (2 * deviation + 1e-6)))
    return values, errors


def _remover(
    basis: np.ndarray,
    weights: np.ndarray,
    starts: np.ndarray,
    row: np.ndarray,
    photograph: np.ndarray,
) -> Callable[[np.ndarray], np.ndarray]:
    """Return a function that removes what points explain by a basis (K, N), and photographs.

    starts: of each point's observations, which follow each other; row: the points of observations.
    """
    weighted = weights * basis
    normal = np.stack([np.add.reduceat(weighted * other, starts, axis=1) for other in basis])
    normal = normal.transpose(2, 0, 1)
    ridge = RIDGE * np.diag(np.arange(len(basis)) > 0) + 1e-9 * np.eye(len(basis))
    inverse = np.linalg.inv(normal + normal[:, :1, :1] * ridge)
    by_photograph = np.bincount(photograph, weights) + 1e-12

    def remove_points(values: np.ndarray) -> np.ndarray:
        sums = np.add.reduceat(weighted * values, starts, axis=1)
        return values - (basis * np.einsum("pij,jp->ip", inverse, sums)[:, row]).sum(axis=0)

    def remove(values: np.ndarray) -> np.ndarray:
        values = remove_points(values)
        for _ in range(NUM_SWEEPS):
            means = np.bincount(photograph, weights * values) / by_photograph
            values = remove_points(values - means[photograph])
        return values

    return remove
