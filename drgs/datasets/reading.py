"""How the pictures of a view are read, or left to others.

Of several processes that fit together, each reads the photographs of the views that it renders. Of
the others it knows the sizes, from the headers of their files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drgs.config.schema import DataConfig
from drgs.datasets.frame_extras import extras_of
from drgs.datasets.images import downscaled_size, kept_photograph
from drgs.datasets.lazy_image import KeptPicture, Pixels
from drgs.datasets.transforms import Frame
from drgs.datasets.types import View
from drgs.io.pictures import has_alpha, image_size, read_pixels

ViewPictures = dict[str, Pixels | None]
"""``image``, ``alpha``, ``mask`` and ``depth`` of a :class:`drgs.datasets.types.View`."""


@dataclass(frozen=True)
class Reading:
    """What becomes of a photograph's file, and of what belongs to it."""

    pixels: Callable[[Path], np.ndarray]  # (H, W, C), as it is stored
    pictures: Callable[[DataConfig, Frame, Path, np.ndarray], ViewPictures]


def _read(config: DataConfig, frame: Frame, file: Path, pixels: np.ndarray) -> ViewPictures:
    """pixels: of ``file``, upright."""
    del file
    height, width = pixels.shape[:2]
    image, alpha = kept_photograph(pixels, config.background_rgb, config.image_size)
    return {"image": image, "alpha": alpha, **extras_of(config, frame, (width, height))}


def _sized_pixels(file: Path) -> np.ndarray:
    """An array of that shape, which takes no memory and shows nothing."""
    width, height = image_size(file)
    return np.broadcast_to(np.uint8(0), (height, width, 4 if has_alpha(file) else 3))


def _sized(config: DataConfig, frame: Frame, file: Path, pixels: np.ndarray) -> ViewPictures:
    """Pictures that refuse to become numbers."""
    height, width, channels = pixels.shape
    new_width, new_height = downscaled_size(width, height, config.image_size)
    files, plane = frame.files, _unread((new_height, new_width), file)
    return {
        "image": _unread((new_height, new_width, 3), file),
        "alpha": plane if channels == 4 else None,
        "mask": plane if "mask" in files else None,
        "depth": plane if "depth" in files else None,
    }


def without_pictures(view: View) -> View:
    """The view as if others had read its pictures."""
    there = {name: getattr(view, name) for name in ("image", "alpha", "mask", "depth")}
    unread = {name: _unread(p.shape, view.name) for name, p in there.items() if p is not None}
    return replace(view, **unread)


def _unread(shape: tuple[int, ...], name: object) -> KeptPicture:
    def refuse() -> np.ndarray:
        raise RuntimeError(f"{name}: another process has its picture")

    return KeptPicture(shape, refuse, nbytes=0)


READ = Reading(read_pixels, _read)
SIZES_ALONE = Reading(_sized_pixels, _sized)
