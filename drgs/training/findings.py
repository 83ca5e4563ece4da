"""Findings about a dataset: what a short fit shows of an effect that it does not simulate."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image

from drgs.config.schema import FitConfig
from drgs.datasets.types import Dataset
from drgs.gaussians.parameters import Gaussians
from drgs.results.alignment import Alignment


@dataclass(frozen=True, eq=False)
class ShortFit:
    """A fit of few iterations to small photographs, some of which were held out."""

    config: FitConfig
    dataset: Dataset  # ``test``: the held-out training photographs
    gaussians: Gaussians  # numpy arrays
    images: Sequence[np.ndarray]  # (H, W, 3) display space: renderings of the held-out views
    alignments: Sequence[Alignment]  # of these
    factor: int  # px of the dataset's photographs in one of the fit's
    wall_s: float  # of its iterations

    @property
    def psnr(self) -> np.ndarray:
        """The held-out views' PSNR, (V,) dB, with the differences of a camera removed."""
        return np.array([alignment.psnr for alignment in self.alignments])


@dataclass(frozen=True)
class Finding:
    """The evidence for an effect, or against it."""

    effect: str  # a name for the table
    evidence: str  # in a few words, with numbers
    is_likely: bool  # whether it is worth a short fit with the effect
    changes: Mapping[str, object]  # values of the configuration that simulate it, by key
    in_short_fits: Mapping[str, object] = field(default_factory=dict)  # further ones, such as rates


def exposure_spread(paths: Sequence[Path]) -> float | None:
    """Return the standard deviation of the exposures that EXIF gives, in stops.

    An exposure is time x sensitivity / aperture^2; None if a photograph does not give all three.
    """
    exposures = [_exposure_of(path) for path in paths]
    known = [exposure for exposure in exposures if exposure is not None]
    return float(np.std(np.log2(known))) if known and len(known) == len(exposures) else None


def _exposure_of(path: Path) -> float | None:
    tags = ExifTags.Base
    try:
        with warnings.catch_warnings(), Image.open(path) as image:
            warnings.simplefilter("ignore")
            details = image.getexif().get_ifd(ExifTags.IFD.Exif)
        time, aperture = float(details[tags.ExposureTime]), float(details[tags.FNumber])
        product = time * float(details[tags.ISOSpeedRatings]) / aperture**2
    except Exception:  # Pillow raises many types for broken EXIF, which is ignored
        return None
    return product if 0 < product < float("inf") else None
