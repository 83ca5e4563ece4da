"""Training photographs ranked by how badly a fit matches them, with a hint at the cause."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from drgs.datasets.images import downscale, smaller_view, with_arrays
from drgs.datasets.types import LazyImage, View
from drgs.results.alignment import Alignment, align
from drgs.results.metrics import map_ahead, psnr

WIDTH_PX = 135  # about: of photographs and renderings that are registered and shown
NUM_HINTS = 6  # the worst photographs, which get a hint

Render = Callable[[tuple[View, ...]], Iterable[np.ndarray]]
"""Yields images (H, W, 3) of views as fitted, display space."""

MIN_GAIN, MIN_SHIFT_PX = 0.1, 0.5
"""Differences of brightness, and shifts of small images, that are worth a hint."""

MAX_SHARPNESS = 0.85  # of a blurred photograph: its mean step, relative to the rendering's
OUTLIER_DEVIATIONS = 3.0  # below the median, in normal deviations by the median one
NORMAL = 1.4826  # standard deviation over the median absolute one, of a normal distribution


@dataclass(frozen=True, eq=False)
class RankedPhotograph:
    """A training photograph beside the rendering of its view."""

    name: str
    psnr: float  # dB
    hint: str = ""  # at the cause of the difference
    images: np.ndarray | None = None  # (H, 2 W, 3) display space, small: photograph, rendering


def rank_photographs(
    views: Sequence[View], render: Render, background: tuple[float, float, float]
) -> list[RankedPhotograph]:
    """Return the training photographs, worst first; the first few have hints and images.

    Photographs of other processes are left out. render: without photographs' own, such as colours.
    """
    views = [v for v in views if not (isinstance(v.image, LazyImage) and v.image.is_elsewhere)]
    if not views:
        return []
    pairs = zip(views, render(tuple(views)), strict=True)
    scores = list(map_ahead(lambda v, image: psnr(image, np.asarray(v.image), v.mask), pairs))
    order = sorted(range(len(views)), key=lambda index: scores[index])
    ranked = [RankedPhotograph(views[index].name, scores[index]) for index in order]
    worst, middle = tuple(views[index] for index in order[:NUM_HINTS]), np.median(scores)
    limit = middle - OUTLIER_DEVIATIONS * NORMAL * np.median(np.abs(np.array(scores) - middle))
    for place, (view, image) in enumerate(zip(worst, render(worst), strict=True)):
        factor = max(1, round(view.width / WIDTH_PX))
        small = with_arrays(smaller_view(view, factor))
        image = downscale(image, small.width)
        is_outlier = bool(ranked[place].psnr < limit)
        hint = _hint_at(align(small, image, background), factor, is_outlier)
        images = np.concatenate([np.asarray(small.image), image], axis=1)
        ranked[place] = replace(ranked[place], hint=hint, images=images)
    return ranked


def _hint_at(found: Alignment, factor: int, is_outlier: bool) -> str:
    """Return how a photograph differs from its rendering; "": as others do."""
    hints = []
    if np.abs(found.gains).max() > MIN_GAIN:
        gains = ", ".join(f"{gain:+.0%}" for gain in found.gains)
        hints.append(f"exposure or white balance (red, green, blue {gains})")
    if (shift := float(np.hypot(*found.shift))) > MIN_SHIFT_PX:
        hints.append(f"pose (off by {shift * factor:.1f} px)")
    if found.sharpness < np.log(MAX_SHARPNESS):
        hints.append("blurred")
    if not hints and is_outlier:
        hints.append("something moved, or is seen here alone")
    return "; ".join(hints)
