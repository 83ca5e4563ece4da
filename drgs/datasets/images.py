"""Images of views: read, composited over a background, scaled, and kept in little memory.

The file's integers are kept, and floats, which take four times the memory, computed at each access.
What would not fit into memory is read from disk: from a temporary file, which
the system removes with the process, however that ends.
"""

from __future__ import annotations

import math
import os
import shutil
import tempfile
import threading
import weakref
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy import sparse
from typing_extensions import override

from drgs.core.errors import UserError, note_user, one_line
from drgs.core.files import open_regular, refusal_reason, refuse_damage
from drgs.core.memory import available_memory, format_bytes, require_memory
from drgs.datasets.types import LazyImage, Pixels, View
from drgs.io.images import (
    BITS,
    MAX_16_BITS,
    MAX_BYTES,
    as_numbers,
    image_size,
    read_header,
    read_image,
)

MAX_PIXELS_AT_ONCE = 1 << 25  # of photographs that are read at a time: 40 bytes each, at most

MAX_THREADS = 8

MAX_MEMORY_SHARE = 0.5  # of the available memory, for photographs: Gaussians need about as much

MIN_WHOLE_SHARE = 1 - 1e-4  # share of a pixel's area that counts as all of it, up to rounding

DEPTH_BYTES = 24  # memory for a depth of an ``.npy`` file while it is converted


# Stores of photographs' pixels while a fit uses them


class MemoryStore:
    """Keeps pixels in memory."""

    is_on_disk = False

    def keep(self, array: np.ndarray) -> Pixels:
        """Return the array, or a lazy image that becomes the same one."""
        return array


class DiskStore(MemoryStore):
    """Writes pixels to a temporary file in ``TMPDIR`` or else ``/var/tmp``."""

    is_on_disk = True

    def __init__(self, num_bytes: int, num_photographs: int) -> None:
        """num_bytes: to be written.

        Raises :class:`UserError` unless a disk has room for them.
        """
        # Many systems have /tmp in memory.
        self._folder = Path(os.environ.get("TMPDIR", "/var/tmp"))
        self._lock = threading.Lock()
        try:
            free = shutil.disk_usage(self._folder).free
            if num_bytes > free:
                raise UserError(
                    f"{self._folder}: {num_photographs:,} photographs take "
                    f"{format_bytes(num_bytes)} there during the fit, and {format_bytes(free)} are "
                    "free; set TMPDIR to a folder of a larger disk or a smaller data.image_size, "
                    "or use fewer of them"
                )
            self._file = tempfile.TemporaryFile(dir=self._folder, prefix="drgs")  # noqa: SIM115
        except OSError as error:
            raise self._error("cannot write photographs", error) from None
        weakref.finalize(self, self._file.close)

    def _error(self, what: str, error: OSError) -> UserError:
        return UserError(f"{self._folder}: {what} (data.in_memory): {refusal_reason(error)}")

    @override
    def keep(self, array: np.ndarray) -> LazyImage:
        """Write the array; several threads may."""
        try:
            with self._lock:
                position = self._file.seek(0, os.SEEK_END)
                self._file.write(np.ascontiguousarray(array).data)
                self._file.flush()
        except OSError as error:
            raise self._error("cannot write photographs", error) from None
        read = partial(self._read, position, array.shape, array.dtype)
        return LazyImage(array.shape, read, 0, is_on_disk=True)

    def _read(self, position: int, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        try:
            content = os.pread(self._file.fileno(), math.prod(shape) * dtype.itemsize, position)
        except OSError as error:
            raise self._error("cannot read photographs again", error) from None
        return np.frombuffer(bytearray(content), dtype).reshape(shape)


MEMORY = MemoryStore()


def is_on_disk(view: View) -> bool:
    """Return whether images of the view are read from disk at each use."""
    return any(isinstance(each, LazyImage) and each.is_on_disk for each in view.planes().values())


# Masks and depths


def read_mask(path: Path, size: tuple[int, int]) -> np.ndarray:
    """Return a mask (H, W) float32: 1 where opaque and brighter than half, else 0; size: W, H.

    With a mask for a larger photograph, a pixel is valid if its whole area is.
    """
    stored = image_size(path)
    is_larger = stored[0] > size[0] and is_scaled(size, stored)
    if not is_larger:
        _check_size(path, stored, size)  # before memory is taken for it
    image = read_image(path)
    counts = image[:, :, :3].max(axis=2) > 0.5
    if image.shape[2] == 4:
        counts &= image[:, :, 3] > 0.5
    mask = counts.astype(np.float32)
    return (_resize(mask, *size) > MIN_WHOLE_SHARE).astype(np.float32) if is_larger else mask


def is_scaled(size: tuple[int, int], original: tuple[int, int]) -> bool:
    """Return whether an image of ``size`` may be one of ``original``, scaled; each W, H, px.

    Rounded sides are less than 1 px from the scaled ones. An image that shares one side only with
    the original is cropped.
    """
    (width, height), (full_width, full_height) = size, original
    if width == full_width or height == full_height:
        return size == original
    ratio = full_height / full_width
    return abs(width * ratio - height) < 1 + ratio


def read_depth(path: Path, unit: float, size: tuple[int, int]) -> np.ndarray:
    """Return depths (H, W) float32, scene units; 0 where not known: not finite or not positive.

    unit: scene units of a number in the file; size: W, H.
    """
    if is_array(path):
        depth = _stored_depth(path)
        _check_size(path, depth.shape[::-1], size)  # before memory is taken for it
        require_memory(path, DEPTH_BYTES * depth.size, "the depth")
        with np.errstate(over="ignore"):  # becomes infinite, and so is not known
            depth = (depth.astype(np.float64) * unit).astype(np.float32)
    else:
        mode = read_header(path).mode
        if BITS.get(mode) != 16:  # of 8 bits, all depths would be 257 times as large
            raise UserError(
                f"{path}: must be a grey image of 16 bits or an .npy file, got one of Pillow's "
                f"mode {mode}; convert it"
            )
        _check_size(path, image_size(path), size)
        depth = read_image(path)[:, :, 0] * np.float32(MAX_16_BITS * unit)
    return np.where(np.isfinite(depth) & (depth > 0), depth, 0).astype(np.float32)


def is_array(path: Path) -> bool:
    """Return whether depths are stored as an array, not as an image; by the name."""
    return path.suffix.lower() == ".npy"


def _stored_depth(path: Path) -> np.ndarray:
    """Return the array (H, W) of an ``.npy`` file, mapped into memory."""
    open_regular(path, "depth", MAX_BYTES).close()
    with refuse_damage(f"{path}: cannot read the depth"), np.errstate(over="ignore"):
        depth = np.load(path, mmap_mode="r", allow_pickle=False)
    is_real = isinstance(depth, np.ndarray) and depth.dtype.kind in "fiu"
    shape = depth.shape if is_real else ()
    if len(shape) == 2 or (len(shape) == 3 and shape[2] == 1):
        return depth.reshape(shape[:2])
    got = f"shape {shape}" if is_real else one_line(getattr(depth, "dtype", "several arrays"))
    raise UserError(f"{path}: depth must be (height, width) real numbers, got {got}")


def _check_size(path: Path, got: tuple[int, int], size: tuple[int, int]) -> None:
    if got != size:
        raise UserError(
            f"{path}: must be {size[0]} x {size[1]} px, as the photograph is, got {got[0]} x "
            f"{got[1]}; resize it, or leave it out of the frame"
        )


# Scaling


def composite(image: np.ndarray, background: tuple[float, float, float]) -> np.ndarray:
    """Return rgb * a + background * (1 - a), (H, W, 3), display space; RGB passes unchanged."""
    if image.shape[2] == 3:
        return image
    *rgb, alpha = np.ascontiguousarray(np.moveaxis(image, 2, 0))  # faster than pixel by pixel
    mixed = [c * alpha + np.float32(b) * (1 - alpha) for c, b in zip(rgb, background, strict=True)]
    return np.stack(mixed).transpose(1, 2, 0)


def downscale(image: np.ndarray, max_width: int | None) -> np.ndarray:
    """Return the image at width ``max_width`` if it is wider; the height in proportion.

    Each new pixel is the exact average over its area. After compositing, the result is that of
    scaling premultiplied colours and alpha.
    """
    height, width = image.shape[:2]
    new_width, new_height = downscaled_size(width, height, max_width)
    return image if new_width == width else _resize(image, new_width, new_height)


def downscaled_size(width: int, height: int, max_width: int | None) -> tuple[int, int]:
    """Return the width and height of a downscaled image."""
    if max_width is None or width <= max_width:
        return width, height
    return max_width, max(1, round(height * max_width / width))


def downscale_mask(mask: np.ndarray, max_width: int | None) -> np.ndarray:
    """Return a mask (H, W) of 1 and 0: 1 where all covered pixels are valid."""
    return (downscale(mask, max_width) > MIN_WHOLE_SHARE).astype(np.float32)


def downscale_depth(depth: np.ndarray, max_width: int | None) -> np.ndarray:
    """Return mean depths (H, W) over the covered pixels; 0 where one of them has none."""
    known = downscale((depth > 0).astype(np.float32), max_width)
    return np.where(known > MIN_WHOLE_SHARE, downscale(depth, max_width), 0).astype(np.float32)


def _resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    rows = _average_rows(image, height)
    return np.ascontiguousarray(_average_rows(rows.swapaxes(0, 1), width).swapaxes(0, 1))


def _average_rows(image: np.ndarray, count: int) -> np.ndarray:
    """Return the area average (count, ...) float32 along the first axis."""
    length = image.shape[0]
    if length % count == 0:
        factor = length // count
        total = image[::factor]
        for i in range(1, factor):
            total = total + image[i::factor]
        return total / np.float32(factor)
    edges = np.union1d(np.arange(length + 1), np.arange(1, count) * (length / count))
    middles = (edges[1:] + edges[:-1]) / 2  # of parts that are in one old and in one new pixel
    cells = (middles * count / length).astype(np.int64), middles.astype(np.int64)
    shares = np.diff(edges) * (count / length)
    weights = sparse.csr_array((shares.astype(np.float32), cells), (count, length))
    return (weights @ image.reshape(length, -1)).reshape(count, *image.shape[1:])


def smaller_view(view: View, factor: int) -> View:
    """Return the same camera with pixels ``factor`` times as large, each an average."""
    new_width = max(1, round(view.width / factor))
    width, height = downscaled_size(view.width, view.height, new_width)
    x, y = width / view.width, height / view.height

    def smaller(name: str, image: Pixels) -> LazyImage:
        scale = {"mask": downscale_mask, "depth": downscale_depth}.get(name, downscale)
        shape = (height, width, *image.shape[2:])
        on_disk = isinstance(image, LazyImage) and image.is_on_disk
        return LazyImage(shape, lambda: scale(np.asarray(image), new_width), 0, None, on_disk)

    return replace(
        view,
        fx=view.fx * x,
        fy=view.fy * y,
        cx=view.cx * x,
        cy=view.cy * y,
        width=width,
        height=height,
        **{name: smaller(name, image) for name, image in view.planes().items()},
    )


def with_arrays(view: View) -> View:
    """Return the view with arrays for its lazy images, which are then computed once."""
    return replace(view, **{name: np.asarray(each) for name, each in view.planes().items()})


def shift_pixels(view: View) -> tuple[View, ...]:
    """Return the view, and if its images can be shifted three more, whose pixels are elsewhere.

    These are half a pixel to the right, below, or both. Trained on in turns, they show a fit all
    pixels of the file, not means of the same four alone.
    """
    planes = view.planes()
    shifted = {n: p.shifted for n, p in planes.items() if isinstance(p, LazyImage) and p.shifted}
    if len(shifted) < len(planes):  # masks and depths never can be
        return (view,)
    views, on_disk = [view], is_on_disk(view)
    for x, y in ((1, 0), (0, 1), (1, 1)):
        images = {
            name: LazyImage(planes[name].shape, partial(compute, x, y), 0, None, on_disk)
            for name, compute in shifted.items()
        }
        views.append(replace(view, cx=view.cx - x / 2, cy=view.cy - y / 2, **images))
    return tuple(views)


# Keeping


def compact_photograph(
    pixels: np.ndarray,
    background: tuple[float, float, float],
    max_width: int | None,
    store: MemoryStore = MEMORY,
) -> tuple[Pixels, Pixels | None]:
    """Return ``image`` and ``alpha`` of a :class:`View` in a form that takes little memory.

    That is the file's pixels, or floats where they take less; numbers of 16 bits where scaling is
    by no whole factor, which takes long. Pixels with alpha that are halved can be shifted; those of
    photographs, which a lens has blurred, were measured to gain nothing. pixels: of
    :func:`drgs.io.images.read_pixels`.
    """
    height, width, channels = pixels.shape
    new_width, new_height = downscaled_size(width, height, max_width)

    def image(pixels: Pixels, x: int = 0, y: int = 0) -> np.ndarray:
        shifted = as_numbers(_shift(np.asarray(pixels), x, y))
        return downscale(composite(shifted, background), max_width)

    def alpha(pixels: Pixels, x: int = 0, y: int = 0) -> np.ndarray:
        return downscale(as_numbers(_shift(np.asarray(pixels), x, y)[:, :, 3]), max_width)

    if 4 * new_width * new_height * channels < pixels.nbytes:
        return store.keep(image(pixels)), store.keep(alpha(pixels)) if channels == 4 else None
    if width % new_width or height % new_height:
        quantized_alpha = _quantize(alpha(pixels), store) if channels == 4 else None
        return _quantize(image(pixels), store), quantized_alpha
    kept = store.keep(pixels)
    shape, on_disk = (new_height, new_width), store.is_on_disk
    if channels == 3:
        return LazyImage((*shape, 3), partial(image, kept), kept.nbytes, None, on_disk), None
    shifted = None, None
    if can_shift(pixels, (new_width, new_height)):
        shifted = partial(image, kept), partial(alpha, kept)
    return (
        LazyImage((*shape, 3), partial(image, kept), kept.nbytes, shifted[0], on_disk),
        LazyImage(shape, partial(alpha, kept), 0, shifted[1], on_disk),
    )


def can_shift(pixels: np.ndarray, size: tuple[int, int]) -> bool:
    """Return whether pixels have alpha, and twice the width and height of ``size``.

    Files with alpha have 8 bits: :func:`compact_photograph` keeps their pixels.
    """
    return pixels.shape == (2 * size[1], 2 * size[0], 4)


def _shift(pixels: np.ndarray, x: int, y: int) -> np.ndarray:
    """Return as many pixels, from x, y on; beyond the image, its edge is repeated."""
    return np.pad(pixels[y:, x:], ((0, y), (0, x), (0, 0)), "edge") if x or y else pixels


def _quantize(numbers: np.ndarray, store: MemoryStore) -> LazyImage:
    """Return numbers in 0..1 that are kept in 16 bits each."""
    kept = store.keep(np.round(numbers * np.float32(MAX_16_BITS)).astype(np.uint16))
    return _convert_lazily(kept, as_numbers, store)


def compact_mask(mask: np.ndarray, store: MemoryStore = MEMORY) -> LazyImage:
    """Return a mask (H, W) of 1 and 0 that is kept in a byte each."""
    kept = store.keep(mask.astype(np.uint8))
    return _convert_lazily(kept, lambda kept: kept.astype(np.float32), store)


def _convert_lazily(
    kept: Pixels, convert: Callable[[np.ndarray], np.ndarray], store: MemoryStore
) -> LazyImage:
    on_disk = store.is_on_disk
    return LazyImage(kept.shape, lambda: convert(np.asarray(kept)), kept.nbytes, None, on_disk)


def choose_store(
    files: Sequence[Path], max_width: int | None, in_memory: bool | None
) -> MemoryStore:
    """Return the store for photographs: memory, or a disk where they do not fit.

    in_memory: None: if they take less than half of what is available.
    """
    needed = 0  # bytes
    for file in files:
        header = read_header(file)
        (width, height), channels = header.size, 4 if header.has_alpha else 3
        new_width, new_height = downscaled_size(width, height, max_width)
        new_size = channels * new_width * new_height
        size = channels * width * height * BITS.get(header.mode, 8) // 8
        is_fractional = width % new_width or height % new_height
        needed += min(4 * new_size, 2 * new_size if is_fractional else size)
    available = available_memory()
    if in_memory is False:
        return DiskStore(needed, len(files))
    if in_memory is None and needed > MAX_MEMORY_SHARE * available:
        try:
            store = DiskStore(needed, len(files))
        except UserError:
            if needed > available:
                raise
        else:
            note_user(
                f"{files[0].parent}: {len(files):,} photographs take {format_bytes(needed)}, and "
                f"{format_bytes(available)} of memory are available: they are read from disk"
            )
            return store
    if needed > available:
        raise UserError(
            f"{files[0].parent}: {len(files):,} photographs take {format_bytes(needed)} of memory "
            f"as they are kept, and {format_bytes(available)} are available; set "
            "data.in_memory=false or a smaller data.image_size, or use fewer of them"
        )
    return MEMORY


def num_threads(files: Sequence[Path]) -> int:
    """Return the number of photographs to read at a time, for memory."""
    width, height = image_size(files[0])
    return max(1, min(MAX_THREADS, MAX_PIXELS_AT_ONCE // (width * height)))


# Images of views that other processes render


def placeholder_pixels(file: Path) -> np.ndarray:
    """Return an array of an image's shape, from its header, that takes no memory."""
    header = read_header(file)
    return np.broadcast_to(np.uint8(0), (*header.size[::-1], 4 if header.has_alpha else 3))


def unread_image(shape: tuple[int, ...], name: object, is_shifted: bool = False) -> LazyImage:
    """Return an image that raises if its numbers are read.

    is_shifted: whether the process that has it shifts its pixels: cameras are the same on all.
    """

    def refuse(*_: int) -> np.ndarray:
        raise RuntimeError(f"{name}: another process has its image")

    return LazyImage(shape, refuse, 0, refuse if is_shifted else None, is_elsewhere=True)


def without_images(view: View) -> View:
    """Return the view as if another process had read its images."""
    unread = {}
    for name, plane in view.planes().items():
        is_shifted = isinstance(plane, LazyImage) and plane.shifted is not None
        unread[name] = unread_image(plane.shape, view.name, is_shifted)
    return replace(view, **unread)
