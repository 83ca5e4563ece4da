"""All images that drgs reads from files or writes to files.

Read: 8 bits, with and without alpha, and grey of 16 bits; of colours of 16 bits, the upper 8.
Written, whole or not at all: 8-bit PNG and WebP, animations as WebP, Mitsuba's bitmaps as EXR.
Images are (H, W, C) in display space, rounded to 8 bits and clamped to [0, 1] here.
"""

from __future__ import annotations

import io
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import imageio.v3 as iio
import numpy as np
from PIL import ExifTags, Image, ImageCms, ImageFile, PngImagePlugin, UnidentifiedImageError

from drgs.core.errors import UserError, one_line
from drgs.core.files import open_regular, refuse_damage, write_bytes
from drgs.core.memory import require_memory

if TYPE_CHECKING:
    import mitsuba as mi
    from PIL.TiffImagePlugin import TiffImageFile

MAX_PIXELS = 1 << 26  # of an image, as 8192 x 8192: 0.8 GB once decoded to float32

PIXEL_BYTES = 16  # memory for a pixel while it is decoded and copied

MAX_SIDE = 2**24  # px: in a larger image, float32 does not resolve pixels

MAX_BYTES = 1 << 30  # of a file: twice what so many pixels of 64 bits take uncompressed

BITS = {"L": 8, "LA": 8, "RGB": 8, "RGBA": 8, "I;16": 16, "I;16B": 16, "I": 16}
"""Bits of a channel, by Pillow's modes that are read. ``I`` has 32, but is what some versions of
Pillow make of a grey PNG of 16."""

MAX_16_BITS = 2**16 - 1

MITSUBA_FORMATS = ("PNG", "JPEG", "MPO", "BMP", "PPM", "TGA")
"""Pillow's names of the formats that Mitsuba reads as well. MPO is a JPEG with several images."""

FIRST_TRANSPOSED_ORIENTATION = 5  # EXIF's orientations from this one exchange width and height

INVERSE_ORIENTATIONS = {6: 8, 8: 6}  # other orientations are their own inverses

PNG_LEVEL = 2  # of zlib: a tenth larger than with its 6, in half of the time

MAX_WEBP_SIDE = 16_383  # px: the largest width and height that the format can express

MAX_FRAMES_BYTES = 2 << 30  # all frames of an animation, which are held until it is written

FRAME_MS = 70  # 60 frames turn once in 4.2 s

WEBP_QUALITIES, WEBP_BYTES = (80, 60, 40, 20), 1_500_000
"""The first quality is used that keeps an animation within so many bytes, or else the last."""

MIN_BACKGROUND_SHARE, LOSSLESS_WEBP_BYTES = 0.1, 4_000_000
"""An animation is coded without loss, in so many bytes at most, if one colour has this share of all
pixels: a flat background."""

LOSSLESS_STEP = 255 / 31
"""Levels of 255 between two values of a channel without loss: a smaller error than that of lossy
coding, which halves the resolution of colours, and two thirds of the bytes."""


# Reading: by Pillow itself, which reads an image's mode and size before decoding it


@dataclass(frozen=True)
class ImageHeader:
    """Properties of an image before it is decoded."""

    size: tuple[int, int]  # width and height as stored, px
    format: str  # Pillow's name: see MITSUBA_FORMATS
    mode: str  # Pillow's: see BITS
    has_alpha: bool  # of read_pixels
    orientation: int  # EXIF's, 1 to 8; 1: upright or unknown


def read_header(path: Path) -> ImageHeader:
    """Return the header of an image; raises :class:`UserError` for one that is not read."""
    with _open_image(path) as image:
        size = image.size
        if image.format == "TIFF":  # Pillow's size is that of the upright image
            tags = cast("TiffImageFile", image).tag_v2
            size = tags[ExifTags.Base.ImageWidth], tags[ExifTags.Base.ImageLength]
        alpha, orientation = _has_alpha(image), _orientation(image)
        return ImageHeader(size, image.format or "", image.mode, alpha, orientation)


def image_size(path: Path) -> tuple[int, int]:
    """Return (width, height) as stored, px, from the file's header."""
    return read_header(path).size


def _orientation(image: Image.Image) -> int:
    if image.format == "PNG" and "exif" not in image.info:
        return 1  # Pillow would decode the image to find EXIF data after the pixels
    try:
        number = image.getexif().get(ExifTags.Base.Orientation, 1)
    except Exception:  # Pillow raises many types for broken EXIF, which is ignored
        return 1
    return number if number in range(1, 9) else 1


def _has_alpha(image: Image.Image) -> bool:
    has_clear_color = image.mode in ("P", "L", "RGB", "1") and "transparency" in image.info
    return image.mode in ("LA", "RGBA") or has_clear_color


def upright(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """Return pixels (H, W, C) turned by EXIF's ``orientation``, a view."""
    if orientation >= FIRST_TRANSPOSED_ORIENTATION:
        pixels = pixels.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        pixels = np.flipud(pixels)
    return np.fliplr(pixels) if orientation in (2, 3, 6, 7) else pixels


def colour_profile(path: Path) -> str:
    """Return the name of the colour profile, which is not applied; "": sRGB's, or none."""
    with _open_image(path) as image:
        profile = image.info.get("icc_profile")
    if not profile:
        return ""
    try:
        name = one_line(ImageCms.getProfileDescription(io.BytesIO(profile)), 60)
    except Exception:  # Pillow raises many types for a broken profile, which is ignored
        return ""
    return "" if "srgb" in name.lower() else name


def read_image(path: Path) -> np.ndarray:
    """Return (H, W, C) float32 in 0..1: see :func:`read_pixels`."""
    return as_numbers(read_pixels(path))


def as_numbers(pixels: np.ndarray) -> np.ndarray:
    """Return float32 in 0..1 for pixels of :func:`read_pixels`."""
    numbers = pixels.astype(np.float32)
    numbers /= np.float32(255 if pixels.dtype == np.uint8 else MAX_16_BITS)
    return numbers


def read_pixels(path: Path) -> np.ndarray:
    """Return (H, W, C) as stored (EXIF orientation is not applied), uint8 or 16 bits in an integer.

    C is 3, or 4 with straight (not premultiplied) alpha; grey images become RGB.
    """
    with _open_image(path) as image:
        needed = image.width * image.height * PIXEL_BYTES
        require_memory(path, needed, f"an image of {image.width} x {image.height} px")
        # Pillow turns TIFFs, and no others.
        turn, decoded = _orientation(image) if image.format == "TIFF" else 1, image
        if image.mode not in ("RGBA", "LA") and _has_alpha(image):
            decoded = image.convert("RGBA")
        elif image.mode == "P":
            decoded = image.convert("RGB")
        elif image.mode == "1":
            decoded = image.convert("L")
        pixels = upright(np.asarray(decoded), INVERSE_ORIENTATIONS.get(turn, turn))
        if image.mode == "I" and not 0 <= pixels.min() <= pixels.max() <= MAX_16_BITS:
            raise UserError(
                f"{path}: must have values of 16 bits, 0 to {MAX_16_BITS}, got {pixels.min()} to "
                f"{pixels.max()}; convert it"
            )
    if pixels.ndim == 2:
        pixels = pixels[:, :, None]
    if pixels.shape[2] < 3:
        pixels = np.concatenate([pixels[:, :, :1]] * 3 + [pixels[:, :, 1:]], axis=2)
    return pixels


@contextmanager
def _open_image(path: Path) -> Iterator[ImageFile.ImageFile]:
    """Open an image without decoding it; errors within the block become the user's."""
    where = f"{path}: cannot read the image"
    with open_regular(path, "image", MAX_BYTES) as file, refuse_damage(where):
        try:
            image = Image.open(file)
        except UnidentifiedImageError:
            raise UserError(
                f"{where}: it is of no format that is read, such as PNG, JPEG, TIFF or WebP; "
                "convert it"
            ) from None
        with image:
            if image.width * image.height > MAX_PIXELS:
                raise UserError(
                    f"{path}: must have at most {MAX_PIXELS:,} pixels, got {image.width} x "
                    f"{image.height}; scale the images down"
                )
            if image.mode not in (*BITS, "P", "1"):
                raise UserError(
                    f"{path}: must be a grey, RGB or RGBA image of 8 or 16 bits, got one of "
                    f"Pillow's mode {image.mode}; convert it"
                )
            yield image


# Writing: by imageio


def to_uint8(image: np.ndarray) -> np.ndarray:
    """Return the image, 0..1 or already uint8, rounded to 8 bits."""
    if image.dtype == np.uint8:
        return image
    return np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)


def write_png(path: Path, image: np.ndarray, text: Mapping[str, str] | None = None) -> None:
    """Write one image: (H, W, 3) or, with straight alpha, (H, W, 4), in 0..1 or uint8.

    text: to be stored with it, by name.
    """
    chunks = PngImagePlugin.PngInfo()
    for name, words in (text or {}).items():
        chunks.add_text(name, words)
    write_bytes(path, encode(image, "png", pnginfo=chunks))


def write_exr(path: Path, bitmap: mi.Bitmap) -> None:
    """Write all channels of a bitmap, in its own precision."""
    import mitsuba as mi

    from drgs.io.scenes import openexr_threads

    stream = mi.MemoryStream()  # an error of the disk is then Python's, and names the file
    with openexr_threads():
        bitmap.write(stream, mi.Bitmap.FileFormat.OpenEXR)
    write_bytes(path, stream.raw_buffer())


def encode(image: np.ndarray, suffix: str, **options: Any) -> bytes:
    """Return a PNG or WebP file of an image or the frames of an animation, by Pillow's options."""
    if suffix == "png":
        options = {"compress_level": PNG_LEVEL, **options}
    return iio.imwrite(
        "<bytes>", to_uint8(image), extension=f".{suffix}", plugin="pillow", **options
    )


def check_animation(frames: int, width: int, height: int) -> None:
    """Raise :class:`UserError` where :func:`write_animation` cannot write so many, or so large."""
    if max(width, height) > MAX_WEBP_SIDE:
        raise UserError(
            f"an animation (WebP) must be at most {MAX_WEBP_SIDE:,} px wide and high, got "
            f"{width} x {height}; choose a smaller size"
        )
    if frames * width * height * 3 > MAX_FRAMES_BYTES:
        raise UserError(
            f"the frames of an animation must take at most {MAX_FRAMES_BYTES / 1e9:.1f} GB, got "
            f"{frames:,} of {width} x {height} px: {frames * width * height * 3 / 1e9:.1f} GB; "
            "choose fewer, or a smaller size"
        )


def write_animation(path: Path, frames: Iterable[np.ndarray]) -> None:
    """Write an animated WebP that loops; frames: at least one, of one size, in 0..1 or uint8."""
    stack = np.stack([to_uint8(frame) for frame in frames])
    data = _encode_lossless(stack)
    for quality in WEBP_QUALITIES if data is None else ():
        data = encode(stack, "webp", quality=quality, method=3, duration=FRAME_MS, loop=0)
        if len(data) <= WEBP_BYTES:
            break
    assert data is not None, "there is at least one quality"
    write_bytes(path, data)


def _encode_lossless(frames: np.ndarray) -> bytes | None:
    """Return a WebP without loss; None without a flat background, or where it is too large.

    Lossy coding leaves a haze around objects in front of such a background.
    """
    background, share = _commonest_color(frames[:: len(frames) // 8 or 1])
    if share < MIN_BACKGROUND_SHARE:
        return None
    options = {"lossless": True, "quality": 20, "method": 1}
    first = _quantize_colors(frames[0], background)
    if len(frames) * len(encode(first, "webp", **options)) > 1.5 * LOSSLESS_WEBP_BYTES:
        return None
    coarse = np.stack([_quantize_colors(frame, background) for frame in frames])
    data = encode(coarse, "webp", duration=FRAME_MS, loop=0, **options)
    return data if len(data) <= LOSSLESS_WEBP_BYTES else None


def _quantize_colors(frame: np.ndarray, background: np.ndarray) -> np.ndarray:
    """Return uint8 in steps of :data:`LOSSLESS_STEP`, but for the background."""
    levels = np.arange(256)
    is_near = np.abs(levels[:, None] - background) <= LOSSLESS_STEP / 2  # (256, 3)
    coarse = np.round(np.round(levels / LOSSLESS_STEP) * LOSSLESS_STEP).astype(np.uint8)[frame]
    coarse[np.logical_and.reduce([is_near[frame[..., k], k] for k in range(3)])] = background
    return coarse


def _commonest_color(pixels: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the colour (3,) uint8, and its share of all pixels (..., 3)."""
    r, g, b = np.moveaxis(pixels.astype(np.uint32), -1, 0)
    numbers, counts = np.unique(r << 16 | g << 8 | b, return_counts=True)
    most = numbers[np.argmax(counts)]
    color = np.array([most >> 16, most >> 8 & 255, most & 255], np.uint8)
    return color, float(counts.max() / counts.sum())
