"""Image files -> opaque display-space images of the wanted size."""

from __future__ import annotations

from pathlib import Path

import imageio.v3 as iio
import numpy as np

from drgs.checks import UserError


def read_image(path: Path) -> np.ndarray:
    """(H, W, C) float32 in 0..1, as stored (EXIF orientation is not applied).

    C is 3, or 4 with straight (not premultiplied) alpha; grey images become RGB.
    """
    try:
        pixels = iio.imread(path, plugin="pillow")
    except Exception as error:  # Pillow raises many types for a broken file
        raise UserError(f"{path}: cannot read the image: {error}") from None
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if (
        pixels.ndim != 3
        or pixels.shape[2] > 4
        or not np.issubdtype(pixels.dtype, np.unsignedinteger)
    ):
        raise UserError(
            f"{path}: must be a grey, RGB or RGBA image of 8 or 16 bits, got an array of shape "
            f"{pixels.shape} and type {pixels.dtype}"
        )
    if pixels.shape[2] < 3:
        pixels = np.concatenate([pixels[:, :, :1]] * 3 + [pixels[:, :, 1:]], axis=2)
    return pixels.astype(np.float32) / np.float32(np.iinfo(pixels.dtype).max)


def composite(image: np.ndarray, background: tuple[float, float, float]) -> np.ndarray:
    """(H, W, 3): rgb * a + background * (1 - a), in display space; RGB images pass unchanged."""
    if image.shape[2] == 3:
        return image
    rgb, alpha = image[:, :, :3], image[:, :, 3:]
    return rgb * alpha + np.asarray(background, np.float32) * (1 - alpha)


def downscale(image: np.ndarray, max_width: int | None) -> np.ndarray:
    """The image at width ``max_width`` if it is wider, else as it is; the height in proportion.

    Each new pixel is the exact average over its area: a mean of whole pixels where the factor is
    an integer, with partly covered pixels weighted by their coverage where it is not. Applied
    after compositing, which gives what scaling premultiplied colours and alpha would.
    """
    height, width = image.shape[:2]
    if max_width is None or width <= max_width:
        return image
    new_height = max(1, round(height * max_width / width))
    rows = _average_rows(image, new_height)
    return np.ascontiguousarray(_average_rows(rows.swapaxes(0, 1), max_width).swapaxes(0, 1))


def _average_rows(image: np.ndarray, count: int) -> np.ndarray:
    """(count, ...) float32: area average along the first axis."""
    length = image.shape[0]
    if length % count == 0:
        return image.reshape(count, length // count, *image.shape[1:]).mean(axis=1)
    edges = np.arange(count + 1) * (length / count)
    pixel = np.arange(length)
    upper = np.minimum(edges[1:, None], pixel[None, :] + 1)
    lower = np.maximum(edges[:-1, None], pixel[None, :])
    weights = np.maximum(upper - lower, 0) * (count / length)
    return np.tensordot(weights.astype(np.float32), image, axes=1)
