"""Single photographs that a fit is better without, and why: :func:`bad_photographs`.

Each photograph is compared with its rendering by a short fit, the differences of a camera removed,
and with how others differ from theirs: by medians and median deviations, which few bad ones do not
move.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from functools import partial
from typing import cast

import numpy as np
from scipy import ndimage

from drgs.datasets.types import View
from drgs.effects.base import Finding, ShortFit
from drgs.results.alignment import Alignment

MIN_VIEWS = 8  # that are compared with one another
NORMAL = 1.4826  # standard deviation over the median absolute one, of a normal distribution

MAX_SHOWN, MAX_SHARE = 4, 0.15  # photographs in the table; of all, or they are no single ones

MAX_DEVIATIONS, CONFIRMED = 5.0, 3.0
"""Normal deviations from the middle: photographs that differ by more are bad; without them, too."""

LEAST_DEVIATIONS = {"psnr": 0.8, "sharpness": 0.06}
"""Deviations (dB; logarithm of steps between pixels), where photographs are more alike."""

FULL, MIN_FULL_SHARE, MIN_BRIGHTER = 0.985, 0.1, 0.15
"""Overexposed: the brightness of full pixels, their share beyond others', and the gain."""

COVERED_DEVIATIONS, MIN_REGION, COVERED_SHARES = 6.0, 0.015, (0.04, 0.7)
"""Pixels that differ by so many times the median of all photographs; the share of the largest
connected region of them, which is 0.002 to 0.009 in clean ones, where things move, and where
something is before the camera: beside such photographs, floaters are 0.02 to 0.03 of good ones."""

MANY = 0.3  # of the photographs, with such regions: things move

ELSEWHERE = "of another place, or its pose is wrong"

SIDE_PX, MIN_SIMILARITY, MAX_SHARE_OF_OWN = 16, 0.6, 0.5
"""Another camera's photograph: correlation of images of this size with the other's rendering, at
least, and how far it is from 1 relative to that with its own: 0.002 to 0.45, else 1 or more."""


def look_for_bad_photographs(fit: ShortFit, among: Collection[str] | None = None) -> Finding | None:
    """Return the photographs that should be left out; None: nothing can be said, or there are none.

    among: of these alone, which the fit has left out.
    """
    found = bad_photographs(fit, MAX_DEVIATIONS if among is None else CONFIRMED)
    if among is not None:
        found = {name: found[name] for name in among if name in found}
    if not found and among is not None:
        return None
    shown = "; ".join(f"{name} is {why}" for name, why in [*found.items()][:MAX_SHOWN])
    shown += f"; {len(found) - MAX_SHOWN} more" if len(found) > MAX_SHOWN else ""
    shown = shown or "none differs from its rendering more than others do"
    is_likely = 0 < len(found) <= MAX_SHARE * (len(fit.dataset.train) + len(fit.dataset.test))
    words = "" if among is None else " ".join(f"--leave-out {name}" for name in found)
    changes, confirm = {"data.leave_out": [*found]}, partial(look_for_bad_photographs, among=found)
    return Finding("bad photographs", shown, is_likely, changes, {}, words, confirm)


def look_for_moving_things(fit: ShortFit) -> Finding:
    """Return whether many photographs have a region that no other one agrees with."""
    share = float((_regions([*fit.alignments, *fit.trained]) > MIN_REGION).mean())
    advice = "masks (mask_path); reflections that are not simulated look the same"
    text = f"{share:.0%} of photographs have a region that is in no other"
    return Finding("things that move", text, False, {}, advice=advice if share > MANY else "")


def bad_photographs(fit: ShortFit, limit: float = MAX_DEVIATIONS) -> dict[str, str]:
    """Return the reasons by name; photographs of both groups, fitted and held out, are judged.

    limit: normal deviations, beyond which they are bad.
    """
    held_out = fit.dataset.test, fit.alignments, fit.images
    trained = fit.dataset.train[: len(fit.trained)], fit.trained, fit.trained_images
    renderings, found = {}, {}
    for views, _, images in (held_out, trained):
        renderings |= {view.name: image for view, image in zip(views, images, strict=True)}
    for views, alignments, images in (held_out, trained):
        if len(views) >= MIN_VIEWS:
            found |= _outliers(views, alignments, images, renderings, limit)
    return found


def _outliers(
    views: Sequence[View],
    alignments: Sequence[Alignment],
    images: Sequence[np.ndarray],
    renderings: dict[str, np.ndarray],
    limit: float,
) -> dict[str, str]:
    worse = -_deviations([a.psnr for a in alignments], LEAST_DEVIATIONS["psnr"])
    softer = -_deviations([a.sharpness for a in alignments], LEAST_DEVIATIONS["sharpness"])
    full = np.array([(np.asarray(v.image).min(axis=2) > FULL).mean() for v in views])
    full -= [(image.min(axis=2) > FULL).mean() for image in images]
    covered = _regions(alignments, is_of_border=True)
    found = {}
    for index, (view, one) in enumerate(zip(views, alignments, strict=True)):
        is_bright = one.gains.mean() > MIN_BRIGHTER
        if is_bright and full[index] - np.median(full) > MIN_FULL_SHARE:
            found[view.name] = f"overexposed ({full[index]:.0%} of it is white)"
        elif worse[index] > limit:
            found[view.name] = _why_worse(view, renderings, covered[index])
        if softer[index] > limit and found.get(view.name, "") in ("", ELSEWHERE):
            found[view.name] = f"blurred (steps x {np.exp(one.sharpness):.2f})"
    return {name: why for name, why in found.items() if why}


def _deviations(values: Sequence[float], least: float) -> np.ndarray:
    """Return differences from the median in normal deviations, which are at least ``least``."""
    off = np.array(values) - np.median(values)
    return off / max(NORMAL * float(np.median(np.abs(off))), least)


def _why_worse(view: View, renderings: dict[str, np.ndarray], covered: float) -> str:
    """Return the reason; empty if a part differs that does not reach the border: a reflection."""
    photograph = _thumbnail(np.asarray(view.image))
    alike = {name: float(np.mean(photograph * _thumbnail(r))) for name, r in renderings.items()}
    best = max(alike, key=alike.__getitem__)
    least = 1 - MAX_SHARE_OF_OWN * (1 - alike[view.name])
    if alike[best] > max(MIN_SIMILARITY, least):
        return f"swapped (resembles the view of {best})"
    if alike[view.name] <= MIN_SIMILARITY:
        return ELSEWHERE
    is_covered = COVERED_SHARES[0] < covered < COVERED_SHARES[1]
    return f"something before the camera ({covered:.0%} of it)" if is_covered else ""


def _regions(alignments: Sequence[Alignment], is_of_border: bool = False) -> np.ndarray:
    """Return the share of the largest connected region of pixels that differ, of each.

    is_of_border: of regions that reach the border, in a width of the root of their area.
    """
    medians = [np.median(one.left[one.left > 0]) for one in alignments if one.left.any()]
    least, shares = COVERED_DEVIATIONS * np.median(medians or [1.0]), []
    for one in alignments:
        differs = ndimage.uniform_filter(one.left, 3) > least
        labels, count = cast("tuple[np.ndarray, int]", ndimage.label(differs))
        areas = np.bincount(labels.ravel())[1:]
        if is_of_border:
            border = np.concatenate([labels[[1, -2]].ravel(), labels[:, [1, -2]].ravel()])
            areas = areas[np.bincount(border, minlength=count + 1)[1:] > np.sqrt(areas)]
        shares.append(max(areas, default=0) / labels.size)
    return np.array(shares)


def _thumbnail(image: np.ndarray) -> np.ndarray:
    """Return a small image of mean 0 and deviation 1."""
    factors = SIDE_PX / image.shape[0], SIDE_PX / image.shape[1], 1
    blur = 0.5 / factors[0], 0.5 / factors[1], 0
    small = np.asarray(ndimage.zoom(ndimage.gaussian_filter(image, blur), factors, order=1))
    return (small - small.mean()) / max(float(small.std()), 1e-6)
