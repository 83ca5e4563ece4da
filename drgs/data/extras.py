"""What a frame may name besides its photograph: a mask, and depths.

``mask_path`` is a picture that is black where pixels do not count. ``depth_file_path`` is a picture
of 16 bits or an ``.npy`` file; ``depth_unit_scale_factor``, of the frame or of the whole file, is
how many scene units its numbers count.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drgs.config import DataConfig
from drgs.data.frames import InheritedValues, image_path, positive
from drgs.data.images import downscale_depth, downscale_mask, read_depth, read_mask

MASK, DEPTH, UNIT = "mask_path", "depth_file_path", "depth_unit_scale_factor"

PICTURE_UNIT = 1e-3
"""Scene units in a step of a depth picture, unless :data:`UNIT` says otherwise: as nerfstudio has
it. An ``.npy`` file then holds scene units, which it has numbers for."""


def mask_of(config: DataConfig, frame: InheritedValues, size: tuple[int, int]) -> np.ndarray | None:
    """(H, W) of 1 and 0, at the width that is configured; None: the frame has none.

    size: of the photograph, W, H.
    """
    if MASK not in frame or config.ignore_masks:
        return None
    mask = read_mask(image_path(config.path, frame.own, frame.where, MASK), size)
    return downscale_mask(mask, config.image_size)


def depth_of(
    config: DataConfig, frame: InheritedValues, size: tuple[int, int]
) -> np.ndarray | None:
    """(H, W), scene units, 0 where not known, at the width that is configured; None: has none.

    size: of the photograph, W, H.
    """
    if DEPTH not in frame:
        return None
    file = image_path(config.path, frame.own, frame.where, DEPTH)
    depth = read_depth(file, _unit_of(frame, file), size)
    return downscale_depth(depth, config.image_size)


def _unit_of(frame: InheritedValues, file: Path) -> float:
    """Scene units that a number of the file counts."""
    if UNIT in frame:
        return positive(*frame.at(UNIT))
    return 1.0 if file.suffix == ".npy" else PICTURE_UNIT


def notes(config: DataConfig, frames: Sequence[InheritedValues]) -> str:
    """What frames have of it, and what is left out, for a dataset's description."""
    text = ""
    if config.ignore_masks and any(MASK in frame for frame in frames):
        text += f"; masks ({MASK}) ignored"
    units = set()
    for frame in frames:
        if DEPTH in frame:
            file = image_path(config.path, frame.own, frame.where, DEPTH)
            units.add(_unit_of(frame, file))
    if units:
        text += f"; depth in units of {' and '.join(f'{unit:g}' for unit in sorted(units))}"
    return text
