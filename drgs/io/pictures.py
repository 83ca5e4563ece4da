"""Pictures to files: 8-bit PNG, and animations as WebP and GIF.

Pictures are (H, W, 3) in display space, clamped to [0, 1] here; files are written whole or not at
all.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from drgs.core.files import atomic_path

FRAME_MS = 70
"""Duration of a frame: 60 frames turn once in 4.2 s. A multiple of GIF's unit of 10 ms."""

WEBP_QUALITIES = (80, 60, 40, 20)
"""The first that keeps an animation within ``WEBP_BYTES``, or else the last."""

WEBP_BYTES = 1_500_000

GIF_WIDTH = 300
"""px: a GIF needs about five times the bytes of a WebP of the same size."""

NEAR_BACKGROUND = 8
"""Levels of 255: colours of a GIF's palette that differ less become the background's."""


def to_uint8(image: np.ndarray) -> np.ndarray:
    """The picture rounded to 8 bits."""
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def write_png(path: Path, image: np.ndarray) -> None:
    """Write one picture."""
    _write(path, encode(image, "PNG"))


def encode(image: np.ndarray, file_format: str, **options: Any) -> bytes:
    """The picture as a file of Pillow's ``file_format``."""
    buffer = io.BytesIO()
    _pillow(image).save(buffer, file_format, **options)
    return buffer.getvalue()


def write_animation(path: Path, frames: Iterable[np.ndarray]) -> None:
    """Write ``path``, an animated WebP that loops, and beside it a GIF of at most 300 px width.

    Every browser shows the WebP; the GIF is for what else there is (mail, slides, old viewers).
    frames: of one size, at least one; may be a generator, only 8 bits of each are kept.
    """
    large = [_pillow(frame) for frame in frames]
    for quality in WEBP_QUALITIES:
        data = _animate(large, "WEBP", quality=quality, method=3)
        if len(data) <= WEBP_BYTES:
            break
    _write(path, data)
    small = [_shrink(frame) for frame in large]
    palette = _common_palette(small)
    indexed = [frame.quantize(palette=palette) for frame in small]
    _write(path.with_suffix(".gif"), _animate(indexed, "GIF", optimize=False))


def _shrink(frame: Image.Image) -> Image.Image:
    if frame.width <= GIF_WIDTH:
        return frame
    height = max(1, round(frame.height * GIF_WIDTH / frame.width))
    return frame.resize((GIF_WIDTH, height), Image.Resampling.BOX)


def _pillow(image: np.ndarray) -> Image.Image:
    return Image.fromarray(to_uint8(image))


def _animate(frames: Sequence[Image.Image], file_format: str, **options: Any) -> bytes:
    first, *rest = frames
    buffer = io.BytesIO()
    first.save(
        buffer,
        file_format,
        save_all=True,
        append_images=rest,
        duration=FRAME_MS,
        loop=0,
        **options,
    )
    return buffer.getvalue()


def _write(path: Path, data: bytes) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(data)


def _common_palette(frames: Sequence[Image.Image]) -> Image.Image:
    """256 colours for all frames; the commonest, which is the background, is kept exactly.

    Pillow looks colours up in cells of 4 levels, so that any palette colour near the background's
    would be taken for it: those are replaced by it.
    """
    strip = np.concatenate([np.asarray(frame) for frame in frames[:: len(frames) // 8 or 1]])
    colors, counts = np.unique(strip.reshape(-1, 3), axis=0, return_counts=True)
    background = colors[np.argmax(counts)]
    palette = Image.fromarray(strip).quantize(256, method=Image.Quantize.MEDIANCUT)
    values = np.array(palette.getpalette(), np.int64).reshape(-1, 3)
    values[np.abs(values - background).max(axis=1) <= NEAR_BACKGROUND] = background
    palette.putpalette(values.ravel().tolist())
    return palette
