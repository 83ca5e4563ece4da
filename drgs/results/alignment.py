"""Differences between a photograph and a rendering that a camera explains: by registration.

A rendering r of a camera that is slightly off, for a photograph of another exposure, differs from
it to first order by

    g_c r_c + (u + z x - w y) dr/dx + (v + z y + w x) dr/dy

with gains g of the channels c, a shift (u, v), a zoom z and a rotation w about the middle of the
image. :func:`align` finds the seven numbers by least squares, again after moving the rendering by
them (Lucas and Kanade 1981), with weights by which pixels with other differences count little
(Cauchy's, Holland and Welsch 1977). What is left, it regresses on

    b (x s dr/dx + y s dr/dy) + y (m dr/dx + n dr/dy), s = x^2 + y^2,

with the distortion b and the skews m, n of rows that are read one after the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from drgs.datasets.types import View

SIGMA_PX = 1.0  # of the blur before the derivatives, so that they hold for shifts of a pixel
NUM_MOVES, NUM_REWEIGHTINGS = 4, 4  # at most; and of each regression
MIN_MOVE_PX = 0.03  # of the corners; smaller moves are the last
MEDIAN_STRIDE = 7  # one in so many differences is among those whose median is taken
MIN_SIDE_PX = 8  # of an image; smaller ones are not aligned
MIN_COVERED = 0.5  # share of the image; a rendering that is moved farther is not aligned
MAX_MOVE = 0.25  # of corners, half diagonals: farther ones are found where nothing is alike
MIN_DEVIATION = 1e-6  # of the remaining differences, display space


@dataclass(frozen=True, eq=False)
class Alignment:
    """A rendering's differences from its photograph."""

    gains: np.ndarray  # (3,): the photograph's brightness relative to the rendering's, minus 1
    shift: np.ndarray  # (2,) px: from the rendering's content to the photograph's
    psnr: float  # dB, of the rendering without these differences
    zoom: float  # px at half the diagonal
    distortion: float  # px at half the diagonal, beyond the zoom
    skew: np.ndarray  # (2,) px at half the diagonal: shift of lower rows
    sharpness: float  # logarithm of the photograph's steps between pixels over the rendering's
    left: np.ndarray  # (H, W) float32: RMS difference of each pixel that remains
    """Pixels that are masked, or show the background alone, have 0."""


def align(
    view: View, rendering: np.ndarray, background: tuple[float, float, float] = (1.0, 1.0, 1.0)
) -> Alignment:
    """Compare a rendering (H, W, 3), display space, with the view's photograph.

    Masked pixels do not count, nor do those that the moved rendering does not cover. The background
    behind a transparent photograph, display space, has no gain. Where the numbers do not make the
    images more alike, there are gains alone, by least squares, and in images below 8 px nothing.
    """
    photograph = np.asarray(view.image, np.float32)
    height, width, _ = photograph.shape
    counts = np.asarray(1.0 if view.mask is None else view.mask, np.float32)
    counts = np.broadcast_to(counts, (height, width))
    behind, is_opaque = np.zeros(3, np.float32), True
    if view.alpha is not None:
        alpha = np.asarray(view.alpha, np.float32)
        is_opaque = alpha > 0
        behind = np.asarray(background, np.float32) * (1 - alpha[..., None])
    blur = SIGMA_PX, SIGMA_PX, 0
    blurred = ndimage.gaussian_filter(photograph, blur)
    image, moved, gains = np.asarray(rendering, np.float32), np.zeros(4), np.zeros(3)
    before = _mean_error(photograph - image, counts)
    for _ in range(NUM_MOVES if min(height, width) >= MIN_SIDE_PX else 0):
        at, _ = _move(image, moved)
        smooth = ndimage.gaussian_filter(at, blur)
        base = ndimage.gaussian_filter(at - behind, blur)
        directions = [np.eye(3, dtype=np.float32)[:, None, None] * base, _directions(smooth)[:4]]
        numbers = _fit_numbers(np.concatenate(directions), blurred - smooth, counts)
        gains, moved = numbers[:3].astype(np.float32), moved + numbers[3:]
        if np.abs(numbers[3:]).max() < MIN_MOVE_PX:
            break
    at, is_covered = _move(image, moved)
    seen, left, others = counts * is_covered, photograph - at - gains * (at - behind), np.zeros(5)
    error = _mean_error(left, seen)
    if min(height, width) >= MIN_SIDE_PX:
        directions = _directions(ndimage.gaussian_filter(at, blur))[2:]
        others = _fit_numbers(directions, ndimage.gaussian_filter(left, blur), seen)
    farthest = max(np.abs(moved).max(), np.abs(others).max()) / (np.hypot(width, height) / 2)
    if is_covered.mean() < MIN_COVERED or farthest > MAX_MOVE or not error < before:
        moved, others = np.zeros(4), np.zeros(5)
        at, seen, base = image, counts, image - behind
        weights = counts[..., None] * base * (min(height, width) >= MIN_SIDE_PX)
        gains = (weights * (photograph - image)).sum((0, 1)) / ((weights * base).sum((0, 1)) + 1e-9)
        left = photograph - image - gains * base
        error = _mean_error(left, seen)
    return Alignment(
        gains=gains,
        shift=moved[:2],
        psnr=-10 * float(np.log10(max(min(error, before), 1e-10))),
        zoom=float(moved[2] + others[0]),
        distortion=float(others[2]),
        skew=others[3:],
        sharpness=float(np.log(_mean_step(photograph, seen) / _mean_step(at, seen))),
        left=(np.sqrt(np.square(left).mean(axis=2)) * seen * is_opaque).astype(np.float32),
    )


def _mean_error(difference: np.ndarray, counts: np.ndarray) -> float:
    """Return the mean square of differences (H, W, 3); counts: weights (H, W)."""
    squares = np.square(difference).mean(axis=2, dtype=np.float64)
    return float((squares * counts).sum() / max(counts.sum(), 1e-10))


def _mean_step(image: np.ndarray, counts: np.ndarray) -> float:
    """Return the mean absolute difference of neighbouring pixels (H, W, 3) that count."""
    steps = [np.diff(image, axis=axis) for axis in (0, 1)]
    both = [np.minimum(counts[1:], counts[:-1]), np.minimum(counts[:, 1:], counts[:, :-1])]
    pairs = zip(steps, both, strict=True)
    sums = [(np.abs(step).mean(axis=2) * each).sum() for step, each in pairs]
    return float(sum(sums) / max(counts.sum(), 1) + MIN_DEVIATION)


def _coordinates(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y from the middle, (H, W) float32, in units of half the diagonal."""
    y, x = np.mgrid[:height, :width].astype(np.float32)
    size = float(np.hypot(width, height)) / 2
    return (x + 0.5 - width / 2) / size, (y + 0.5 - height / 2) / size


def _move(image: np.ndarray, moved: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the image (H, W, 3) at places moved by u, v, z and w, px, and whether it has them."""
    height, width, _ = image.shape
    rows, columns = np.indices((height, width))
    if not moved.any():
        return image, np.ones((height, width), bool)
    x, y = _coordinates(height, width)
    u, v, zoom, turn = moved
    down, across = rows + v + zoom * y + turn * x, columns + u + zoom * x - turn * y
    planes = [
        ndimage.map_coordinates(plane, [down, across], order=3, mode="nearest")
        for plane in np.moveaxis(image, 2, 0)
    ]
    is_there = np.abs(down - (height - 1) / 2) < height / 2
    return np.stack(planes, axis=2), is_there & (np.abs(across - (width - 1) / 2) < width / 2)


def _directions(image: np.ndarray) -> np.ndarray:
    """Return the derivatives of an image (H, W, 3) along the numbers, (7, H, W, 3).

    They are along shift, zoom, rotation, distortion and skews, part of which the rotation explains.
    """
    x, y = (each[..., None] for each in _coordinates(*image.shape[:2]))
    dy, dx = np.gradient(image, axis=(0, 1))
    outward = x * dx + y * dy
    lens = (x * x + y * y) * outward, y * dx, y * dy
    return np.stack([dx, dy, outward, x * dy - y * dx, *lens])


def _fit_numbers(directions: np.ndarray, difference: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the numbers (K,) of the robust regression.

    directions: (K, H, W, 3); difference: (H, W, 3); counts: weights (H, W).
    """
    # Row by row, products are too small for BLAS's threads, of which each caller has its own.
    a = directions.reshape(*directions.shape[:2], -1).transpose(1, 0, 2)  # (H, K, 3 W)
    b, given = difference.reshape(len(a), -1), np.repeat(counts, difference.shape[-1], axis=1)
    weights, is_counted = given, given.ravel()[::MEDIAN_STRIDE] > 0
    numbers = np.zeros(a.shape[1])
    for _ in range(NUM_REWEIGHTINGS):
        weighted = a * weights[:, None]
        normal = (weighted @ a.transpose(0, 2, 1)).sum(0, np.float64) + 1e-9 * np.eye(a.shape[1])
        numbers = np.linalg.solve(normal, (weighted @ b[..., None]).sum(0, np.float64)[:, 0])
        left = np.abs(b - numbers.astype(np.float32) @ a)
        some = left.ravel()[::MEDIAN_STRIDE][is_counted]
        deviation = 1.4826 * float(np.median(some)) if some.size else 0.0
        weights = given / (1 + np.square(left / (2 * deviation + MIN_DEVIATION)))
    return numbers
