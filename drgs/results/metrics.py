"""Image quality: PSNR and SSIM of (H, W, 3) images in display space, float64 numpy.

Shares no code with ``drgs.training.losses``: one checks the other. Not differentiated.
"""

from __future__ import annotations

import importlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypedDict, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy.ndimage import correlate1d
from typing_extensions import NotRequired

WINDOW = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
"""The Gaussian window of Wang et al. 2004, section III.B: 11 pixels, sigma 1.5, unit sum."""
WINDOW /= WINDOW.sum()

NUM_WAITING = 2  # images that are scored while the next one is rendered

T = TypeVar("T")


@dataclass(frozen=True)
class Quality:
    """Mean scores over views."""

    psnr: float  # dB
    ssim: float
    num_views: int


class SplitMetrics(TypedDict):
    """Means over the measured views, in ``metrics.json``."""

    psnr: float  # dB
    ssim: float
    num_views: int
    split: str


class SmallFileMetrics(SplitMetrics):
    """The quality of a small file, and its size."""

    bytes: int


class FitMetrics(TypedDict):
    """The content of a fit's ``metrics.json``."""

    iterations: int
    num_gaussians: int
    wall_s: float  # of the iterations
    test: SplitMetrics
    viewers: NotRequired[SplitMetrics]  # of the file for viewers, in their rendering
    small_file: NotRequired[SmallFileMetrics]  # of ``output.small_file``, likewise
    seed: int
    versions: dict[str, str]
    variant: str
    threads: int
    processor: str
    date: str  # of the results: ISO 8601, local time
    command: str  # command line
    config: dict[str, Any]  # YAML values


def psnr(image: ArrayLike, target: ArrayLike, mask: ArrayLike | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB, -10 log10(mean squared error).

    image, target: (H, W, 3) display space, clamped to [0, 1] (the peak is 1). mask: (H, W), 1 where
    a pixel counts. Infinite for equal images, NaN if a pixel is.
    """
    image, target = _prepare("psnr()", image, target)
    with np.errstate(divide="ignore"):
        return float(-10 * np.log10(_mean((image - target) ** 2, mask)))


def ssim(image: ArrayLike, target: ArrayLike, mask: ArrayLike | None = None) -> float:
    """Return the structural similarity, averaged over all pixels and channels.

    image, target: (H, W, 3) display space, clamped to [0, 1]. Windows reach beyond the image into
    zeros, as in the 3DGS reference's evaluation; equation 13 of Wang et al. 2004 with K1 = 0.01,
    K2 = 0.03, L = 1. mask: (H, W), 1 where a pixel counts; the others are black in both.
    """
    x, y = _prepare("ssim()", image, target)
    channels = zip(np.moveaxis(x, 2, 0), np.moveaxis(y, 2, 0), strict=True)
    # One channel at a time: temporaries take memory.
    return float(np.mean([_mean(_ssim_map(*channel, mask), mask) for channel in channels]))


def flip(image: ArrayLike, target: ArrayLike, mask: ArrayLike | None = None) -> float:
    """Return the mean of FLIP, the difference that is seen when images alternate: 0 to 1.

    Arguments as of :func:`psnr`; pixels that do not count still are surroundings of others. By
    ``flip-evaluator`` (Andersson et al. 2020), at 67 pixels per degree.
    """
    evaluate = importlib.import_module("flip_evaluator").evaluate
    x, y = (np.asarray(each, np.float32) for each in _prepare("flip()", image, target))
    differences = evaluate(y, x, "LDR", applyMagma=False, computeMeanError=False)[0]
    return _mean(differences[:, :, 0], mask)


def _ssim_map(x: np.ndarray, y: np.ndarray, mask: ArrayLike | None) -> np.ndarray:
    counts = 1.0 if mask is None else np.asarray(mask)
    x, y = x * counts, y * counts  # contiguous
    mu_x, mu_y = _filter_window(x), _filter_window(y)
    mu_xy, mu_squares = mu_x * mu_y, mu_x**2 + mu_y**2
    cov_xy = _filter_window(x * y) - mu_xy
    variances = _filter_window(x * x + y * y) - mu_squares  # their sum
    numerator = (2 * mu_xy + 0.01**2) * (2 * cov_xy + 0.03**2)
    return numerator / ((mu_squares + 0.01**2) * (variances + 0.03**2))


def mean_quality(
    pairs: Iterable[tuple[ArrayLike, ArrayLike] | tuple[ArrayLike, ArrayLike, ArrayLike | None]],
) -> Quality:
    """Return unweighted means of PSNR and SSIM over views; pairs: (image, target[, mask]) each."""

    def scores(x: ArrayLike, y: ArrayLike, *mask: ArrayLike | None) -> tuple[float, float]:
        return psnr(x, y, *mask), ssim(x, y, *mask)

    return mean_of(list(map_ahead(scores, pairs)))


def map_ahead(function: Callable[..., T], items: Iterable[tuple]) -> Iterator[T]:
    """Yield ``function(*item)`` in order, computed while the next few items are made."""
    waiting: deque[Future[T]] = deque()
    with ThreadPoolExecutor(NUM_WAITING) as pool:
        for item in items:
            waiting.append(pool.submit(function, *item))
            if len(waiting) > NUM_WAITING:
                yield waiting.popleft().result()
        while waiting:
            yield waiting.popleft().result()


def mean_of(scores: Sequence[tuple[float, float]]) -> Quality:
    """Return the means of at least one view's (PSNR, SSIM)."""
    if not scores:
        raise ValueError("mean_quality(): needs at least one view, got none")
    mean_psnr, mean_ssim = np.mean(scores, axis=0)
    return Quality(psnr=float(mean_psnr), ssim=float(mean_ssim), num_views=len(scores))


def _mean(values: np.ndarray, mask: ArrayLike | None) -> float:
    """Return the mean over the pixels that count; NaN if none does."""
    return float(np.mean(values if mask is None else values[np.asarray(mask) > 0]))


def _filter_window(values: np.ndarray) -> np.ndarray:
    for axis in (0, 1):
        values = correlate1d(values, WINDOW, axis=axis, mode="constant", cval=0.0)
    return values


def _prepare(where: str, image: ArrayLike, target: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    image, target = (np.asarray(values, dtype=np.float64) for values in (image, target))
    if image.shape != target.shape or image.ndim != 3 or image.shape[2] != 3:
        raise ValueError(
            f"{where}: image and target must both be (H, W, 3), got {image.shape} "
            f"and {target.shape}"
        )
    return np.clip(image, 0, 1), np.clip(target, 0, 1)
