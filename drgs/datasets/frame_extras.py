"""What a frame may have besides a photograph by a pinhole camera that stands still.

A lens, and a second pose (``drgs.datasets.transforms``); a mask, and depths. ``mask_path`` names a
picture that is black where pixels do not count. ``depth_file_path`` names a picture of 16 bits or
an ``.npy`` file; ``depth_unit_scale_factor`` is how many scene units its numbers count. But for the
pose, what stands at the top of the file is every frame's that has none of its own.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drgs.cameras.lens import Lens
from drgs.config.schema import DataConfig
from drgs.core.errors import UserError
from drgs.datasets.images import downscale_depth, downscale_mask, is_array, read_depth, read_mask
from drgs.datasets.lazy_image import Pixels, kept_mask
from drgs.datasets.transforms import CLOSE, Frame, lens_of, motion_of
from drgs.datasets.types import Motion

MASK, DEPTH = "mask_path", "depth_file_path"

PICTURE_UNIT = 1e-3
"""Scene units in a step of a depth picture, unless ``depth_unit_scale_factor`` says otherwise: as
nerfstudio has it. An ``.npy`` file then holds scene units, which it has numbers for."""


def optics_of(config: DataConfig, frame: Frame) -> dict[str, Lens | Motion | None]:
    """``lens`` and ``motion`` of a :class:`drgs.datasets.types.View`."""
    return {
        "lens": None if config.ignore_distortion else lens_of(frame),
        "motion": None if config.ignore_motion else motion_of(frame, config.shutter_samples),
    }


def extras_of(config: DataConfig, frame: Frame, size: tuple[int, int]) -> dict[str, Pixels | None]:
    """``mask`` and ``depth`` of a :class:`drgs.datasets.types.View`.

    size: of the photograph, W, H, before it is scaled.
    """
    return {
        "mask": _mask(config, frame, size) if "mask" in frame.files else None,
        "depth": _depth(config, frame, size) if "depth" in frame.files else None,
    }


def _mask(config: DataConfig, frame: Frame, size: tuple[int, int]) -> Pixels:
    """The mask of 1 and 0, at the width that is configured."""
    file = frame.files["mask"]
    mask = read_mask(file, size)
    smaller = downscale_mask(mask, config.image_size)
    if not smaller.any():  # its PSNR is the mean of nothing
        size_too_small = f" at data.image_size {config.image_size}; set a larger one,"
        raise UserError(
            f"{file}: must leave pixels that count (brighter than half), got a mask without any"
            f"{size_too_small if mask.any() else ';'} remove the view from its file, or set "
            "data.ignore_masks"
        )
    return kept_mask(smaller)


def _depth(config: DataConfig, frame: Frame, size: tuple[int, int]) -> np.ndarray:
    """(H, W), scene units, 0 where not known, at the width that is configured."""
    depth = read_depth(frame.files["depth"], _unit(frame), size)
    return downscale_depth(depth, config.image_size)


def _unit(frame: Frame) -> float:
    """Scene units that a number of the file of depths counts."""
    values = frame.values
    if values.depth_unit_scale_factor is not None:
        return values.depth_unit_scale_factor
    return 1.0 if is_array(frame.files["depth"]) else PICTURE_UNIT


def ignored(config: DataConfig, frames: Sequence[Frame]) -> tuple[str, ...]:
    """What some frame has and the configuration leaves out.

    ``distortion``, ``motion``, ``masks``, ``depth``: see ``data.ignore_*``.
    """
    found = {
        "distortion": config.ignore_distortion and any(map(lens_of, frames)),
        "motion": config.ignore_motion and any(f.moves for f in frames),
        "masks": config.ignore_masks and any(f.values.mask_path for f in frames),
        "depth": config.ignore_depth and any(f.values.depth_file_path for f in frames),
    }
    return tuple(name for name, is_ignored in found.items() if is_ignored)


def notes(config: DataConfig, frames: Sequence[Frame]) -> str:
    """What frames have of it, and what is left out, for a dataset's description."""
    left_out, text = ignored(config, frames), ""
    lenses = filter(None, map(lens_of, frames))
    if found := sorted({f"{lens.kind} ({', '.join(lens.coefficients())})" for lens in lenses}):
        text += f"; lens {' and '.join(found)}"
        text += " ignored" if "distortion" in left_out else ""
    if "masks" in left_out:
        text += f"; masks ({MASK}) ignored"
    elif count := sum("mask" in frame.files for frame in frames):
        text += f"; masks of {count:,} of {len(frames):,} photographs"
    if "depth" in left_out:
        text += f"; depth ({DEPTH}) ignored"
    elif units := sorted({_unit(f) for f in frames if "depth" in f.files}):
        text += f"; depth in units of {' and '.join(f'{unit:g}' for unit in units)}"
    if "motion" in left_out:
        text += f"; motion ({CLOSE}) ignored"
    return text
