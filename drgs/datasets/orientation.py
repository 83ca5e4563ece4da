"""Photographs that a camera stored on their side, and said so in EXIF.

Programs disagree: viewers, OpenCV and Agisoft turn such a picture, COLMAP, PyTorch's readers and
the 3DGS reference do not. So the numbers of its camera decide, where they can, whether they are for
the picture as it is stored or as it is seen; a guess would fit a turned picture without a word.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from drgs.core.errors import UserError
from drgs.datasets.transforms import Frame
from drgs.io.pictures import image_orientation, upright


def as_calibrated(pixels: np.ndarray, file: Path, frame: Frame) -> np.ndarray:
    """The pixels (H, W, C) of ``file``, turned as EXIF says if that is the frame's size.

    Where both sizes are, a frame that knows what its numbers are for decides.

    Raises :class:`UserError` where the size does not tell.
    """
    orientation = image_orientation(file)
    if orientation == 1:
        return pixels
    turned = upright(pixels, orientation)
    fits, fits_turned = (_has_size(frame, image) for image in (pixels, turned))
    if fits and (frame.numbers_are_as_stored or not fits_turned):
        return pixels
    if fits_turned and not fits:
        return turned
    height, width = pixels.shape[:2]
    if not fits:
        where = frame.where("w" if frame.values.w is not None else "h")
        raise UserError(
            f"{where} must be the image's size, {width} x {height} px ({file}), or as EXIF's "
            f"orientation {orientation} turns it; scale the intrinsics or the images"
        )
    raise UserError(
        f"{file}: has the EXIF orientation {orientation}, and w and h do not tell whether the "
        "camera's numbers are for the picture as it is stored or as that turns it; save the "
        "picture as the camera's numbers have it, without the orientation"
    )


def _has_size(frame: Frame, image: np.ndarray) -> bool:
    """Whether nothing that the frame says of its picture's size contradicts."""
    height, width = image.shape[:2]
    return frame.values.w in (None, width) and frame.values.h in (None, height)
