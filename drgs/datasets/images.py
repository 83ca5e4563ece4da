"""Photographs, masks and depths of a dataset: read, composited, and scaled to the wanted size."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from drgs.core.errors import UserError, one_line
from drgs.core.files import open_regular
from drgs.core.memory import available_memory, readable, require_memory
from drgs.datasets.lazy_image import KeptPicture, Pixels
from drgs.datasets.types import View
from drgs.io.pictures import (
    BITS,
    MAX_16_BITS,
    MAX_BYTES,
    as_numbers,
    image_mode,
    image_size,
    read_image,
    stored_shape,
)

NUMBERS_AT_ONCE, MOST_THREADS = 1 << 25, 8
"""Pixels of photographs that are being read: of 40 bytes each, at most."""

NEITHER, MOST_EDGES = 0.8, 0.1
"""Middle part of brightness that is neither black nor white; and how many of a mask's pixels
may be so, at the edges of what it leaves out."""

ALL = 1 - 1e-4
"""Of an area, up to rounding."""


def read_mask(path: Path, size: tuple[int, int]) -> np.ndarray:
    """(H, W) float32: 1 where the picture is brighter than half, 0 elsewhere; size: W, H.

    A mask for a larger photograph of the same shape will do: a pixel counts where all that it
    covers does.
    """
    width, height = image_size(path)
    is_larger = width > size[0] and is_scaled(size, (width, height))
    if not is_larger:
        _check_size(path, (width, height), size)  # before memory is taken for it
    mask = pixels_that_count(path).astype(np.float32)
    return _counting(_resized(mask, *size)) if is_larger else mask


def pixels_that_count(path: Path) -> np.ndarray:
    """(H, W) bool: where a mask is opaque, and its brightest channel is above half.

    A photograph that is cut out, not black and white, is a mask by its alpha channel alone.
    """
    image = read_image(path)
    brightness = image[:, :, :3].max(axis=2)
    if image.shape[2] == 3 or (image[:, :, 3] > 0.5).all():
        return brightness > 0.5
    opaque = image[:, :, 3] > 0.5
    is_photograph = np.mean(np.abs(brightness[opaque] - 0.5) < NEITHER / 2) > MOST_EDGES
    return opaque if is_photograph else opaque & (brightness > 0.5)


def is_scaled(size: tuple[int, int], original: tuple[int, int]) -> bool:
    """Whether a picture of ``size`` may be one of the size ``original``, scaled; each W, H, px.

    Sides are whole numbers: each is less than 1 px away from the product of the factor and the
    original's. A picture with one side of the original and another one beside is cropped, not
    scaled.
    """
    (width, height), (full_width, full_height) = size, original
    if width == full_width or height == full_height:
        return size == original
    ratio = full_height / full_width
    return abs(width * ratio - height) < 1 + ratio


def read_depth(path: Path, unit: float, size: tuple[int, int]) -> np.ndarray:
    """(H, W) float32, scene units, 0 where not known.

    unit: scene units that a number of the ``.npy`` file, or a step of the 16 bit picture, counts;
    size: W, H. What is not finite or not positive is not known.
    """
    if is_array(path):
        depth = _stored_depth(path)
        _check_size(path, depth.shape[::-1], size)  # before memory is taken for it
        require_memory(path, DEPTH_BYTES * depth.size, "the depth")
        with np.errstate(over="ignore"):  # becomes infinite, and so is not known
            depth = (depth.astype(np.float64) * unit).astype(np.float32)
    else:
        mode = image_mode(path)
        if BITS.get(mode) != 16:  # of 8 bits, all depths would be 257 times as large
            raise UserError(
                f"{path}: must be a grey picture of 16 bits or an .npy file, got one of Pillow's "
                f"mode {mode}; convert it"
            )
        _check_size(path, image_size(path), size)
        depth = read_image(path)[:, :, 0] * np.float32(MAX_16_BITS * unit)
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


DEPTH_BYTES = 24
"""About what a depth of an ``.npy`` file takes while it is converted."""


def is_array(path: Path) -> bool:
    """Return whether depths are stored as an array, not as a picture; by the name."""
    return path.suffix.lower() == ".npy"


def _stored_depth(path: Path) -> np.ndarray:
    """(H, W) of an ``.npy`` file, mapped into memory."""
    open_regular(path, "depth", MAX_BYTES).close()
    try:
        with np.errstate(over="ignore"):  # of the size that a header claims
            depth = np.load(path, mmap_mode="r", allow_pickle=False)
    except MemoryError:
        raise
    except Exception as error:  # numpy raises many types for a broken header
        reason = one_line(error) or type(error).__name__
        raise UserError(f"{path}: cannot read the depth: {reason}") from None
    if not isinstance(depth, np.ndarray) or depth.dtype.kind not in "fiu":
        kind = depth.dtype if isinstance(depth, np.ndarray) else "several arrays"
        raise UserError(f"{path}: depth must be one array of real numbers, got {one_line(kind)}")
    depth = depth.squeeze(-1) if depth.ndim == 3 and depth.shape[2] == 1 else depth
    if depth.ndim != 2:
        raise UserError(f"{path}: depth must be (height, width), got shape {depth.shape}")
    return depth


def _check_size(path: Path, got: tuple[int, int], size: tuple[int, int]) -> None:
    if got != size:
        raise UserError(
            f"{path}: must be {size[0]} x {size[1]} px, as the photograph is, got {got[0]} x "
            f"{got[1]}; resize it, or leave it out of the frame"
        )


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
    new_width, new_height = downscaled_size(width, height, max_width)
    if new_width == width:
        return image
    return _resized(image, new_width, new_height)


def downscaled_size(width: int, height: int, max_width: int | None) -> tuple[int, int]:
    """Width and height of what :func:`downscale` makes of a picture of ``width`` x ``height``."""
    if max_width is None or width <= max_width:
        return width, height
    return max_width, max(1, round(height * max_width / width))


def kept_photograph(
    pixels: np.ndarray, background: tuple[float, float, float], max_width: int | None
) -> tuple[Pixels, Pixels | None]:
    """``image`` and ``alpha`` of a :class:`View`, kept in a form that takes little memory.

    As the file has it; where that is scaled down to less than half, as numbers, which take less;
    and where it is scaled by no whole factor, which takes long, as numbers rounded to 16 bits.

    pixels: what :func:`drgs.io.pictures.read_pixels` gave; background: behind transparent pixels,
    display space; max_width: see :func:`downscale`.
    """
    height, width, channels = pixels.shape
    new_width, new_height = downscaled_size(width, height, max_width)

    def image() -> np.ndarray:
        return downscale(composite(as_numbers(pixels), background), max_width)

    def alpha() -> np.ndarray:
        return downscale(as_numbers(pixels[:, :, 3]), max_width)

    if 4 * new_width * new_height * channels < pixels.nbytes:
        return image(), alpha() if channels == 4 else None
    if width % new_width or height % new_height:
        return kept_rounded(image()), kept_rounded(alpha()) if channels == 4 else None
    shape = (new_height, new_width)
    opaqueness = KeptPicture(shape, alpha, 0) if channels == 4 else None
    return KeptPicture((*shape, 3), image, pixels.nbytes), opaqueness


def kept_rounded(numbers: np.ndarray) -> KeptPicture:
    """Numbers in 0..1, kept in 16 bits each."""
    kept = np.round(numbers * np.float32(MAX_16_BITS)).astype(np.uint16)
    return KeptPicture(kept.shape, lambda: as_numbers(kept), kept.nbytes)


def check_room(files: Sequence[Path], max_width: int | None) -> None:
    """Raise :class:`UserError` where photographs do not fit into memory as they would be kept.

    Before any is decoded, from the files' headers; max_width: see :func:`downscale`.
    """
    needed = numbers = 0
    for file in files:
        width, height, channels, depth = stored_shape(file)
        new_width, new_height = downscaled_size(width, height, max_width)
        new_size, size = channels * new_width * new_height, channels * depth * width * height
        is_scaled = width % new_width or height % new_height
        needed += min(4 * new_size, 2 * new_size if is_scaled else size)
        numbers += 4 * new_size
    if needed <= (available := available_memory()):
        return
    widest = max(downscaled_size(*image_size(file), max_width)[0] for file in files)
    fitting = max(1, int(widest * (0.5 * available / numbers) ** 0.5))
    raise UserError(
        f"{files[0].parent}: {len(files):,} photographs take {readable(needed)} of memory as they "
        f"are kept, and {readable(available)} are available; set data.image_size={fitting}, or use "
        "fewer of them"
    )


def threads_for(files: Sequence[Path]) -> int:
    """How many photographs to read at once, so that numbers of all of them do not fill memory."""
    width, height = image_size(files[0])
    return max(1, min(MOST_THREADS, NUMBERS_AT_ONCE // (width * height)))


def smaller_view(view: View, factor: int) -> View:
    """The same camera with pixels ``factor`` times as large, each the average over its area."""
    new_width = max(1, round(view.width / factor))
    width, height = downscaled_size(view.width, view.height, new_width)
    x, y = width / view.width, height / view.height

    def smaller(picture: Pixels | None, scaled: Callable = downscale) -> KeptPicture | None:
        if picture is None:
            return None
        shape = (height, width, *picture.shape[2:])
        return KeptPicture(shape, lambda: scaled(np.asarray(picture), new_width), 0)

    return replace(
        view,
        image=smaller(view.image),
        fx=view.fx * x,
        fy=view.fy * y,
        cx=view.cx * x,
        cy=view.cy * y,
        width=width,
        height=height,
        alpha=smaller(view.alpha),
        mask=smaller(view.mask, downscale_mask),
        depth=smaller(view.depth, downscale_depth),
    )


def downscale_mask(mask: np.ndarray, max_width: int | None) -> np.ndarray:
    """(H, W) of 1 and 0: a pixel counts where all that it covers does."""
    return _counting(downscale(mask, max_width))


def _counting(share: np.ndarray) -> np.ndarray:
    """1 where all of a pixel's area counts, 0 elsewhere."""
    return (share > ALL).astype(np.float32)


def downscale_depth(depth: np.ndarray, max_width: int | None) -> np.ndarray:
    """(H, W): the mean depth where all that a pixel covers has one, else 0."""
    known = downscale((depth > 0).astype(np.float32), max_width)
    return np.where(known > ALL, downscale(depth, max_width), 0).astype(np.float32)


def _resized(image: np.ndarray, width: int, height: int) -> np.ndarray:
    """Averages over the areas of (height, width) pixels."""
    rows = _average_rows(image, height)
    return np.ascontiguousarray(_average_rows(rows.swapaxes(0, 1), width).swapaxes(0, 1))


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
