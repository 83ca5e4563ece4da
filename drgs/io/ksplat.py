"""``.ksplat`` files of mkkellogg's GaussianSplats3D: read, not written.

Source of the layout: ``SplatBuffer.js`` of that viewer. A header, headers of sections, and the
sections: the lengths of partly filled buckets, the centres of all buckets, and a row for each
Gaussian of position, scales, quaternion wxyz, red, green, blue and opacity in 8 bits, and
harmonics, degree by degree and in each channel by channel. Numbers are float32 at compression level
0; at 1 and 2, positions are 16 bits relative to the centre of a bucket, harmonics of level 2 are 8
bits between bounds, and other numbers are float16.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np
from typing_extensions import override

from drgs.core.errors import Place, UserError
from drgs.core.files import read_bytes
from drgs.io.formats import FORMATS, Arrays, FileFormat, Scalar
from drgs.io.quantization import (
    log_scales_from_scales,
    logits_from_opacities,
    require_scene_memory,
    sh0_from_colors,
)

MAX_BYTES = 1 << 33  # largest file: 8.6 GB

HEADER = struct.Struct("<BB2xI4xIIH14xff")
SECTION = struct.Struct("<IIIIfH2xI4xIIH")
HEADER_BYTES, SECTION_BYTES = 4096, 1024

POSITION_RANGES = (1, 32767, 32767)  # by level, where a section has 0
HARMONICS_BOUNDS = (-1.5, 1.5)  # where the header has 0


@FORMATS.register("ksplat")
class Ksplat(FileFormat):
    """GaussianSplats3D's format."""

    suffix = ".ksplat"
    description = "GaussianSplats3D's .ksplat, read only"

    @override
    def read(self, path: Path) -> tuple[Arrays, Mapping[str, Scalar]]:
        with np.errstate(invalid="ignore", over="ignore"):  # of what is refused later
            return _read(path), {}


def _read(path: Path) -> Arrays:
    content = read_bytes(path, "file", MAX_BYTES)
    if len(content) < HEADER_BYTES:
        _refuse(path, 0, f"a header of {HEADER_BYTES:,} bytes", f"{len(content):,}")
    major, minor, num_sections, _, num, level, low, high = HEADER.unpack_from(content)
    if (major, minor >= 1) != (0, True):
        _refuse(path, 0, "version 0.1 of .ksplat", f"{major}.{minor}")
    if level > 2:
        _refuse(path, 20, "a compression level from 0 to 2", level)
    bounds = low or HARMONICS_BOUNDS[0], high or HARMONICS_BOUNDS[1]
    sections = list(_read_sections(path, content, num_sections, level))
    if not num or sum(len(rows) for rows, _ in sections) != num:
        found = sum(len(rows) for rows, _ in sections)
        _refuse(path, 16, f"the number of Gaussians in sections, {found:,}, at least 1", num)
    width = max(rows["sh"].shape[1] for rows, _ in sections)
    require_scene_memory(path, num, 1 + width // 3)
    names = ("scale", "quat", "rgba")
    scale, quat, rgba = (np.concatenate([rows[name] for rows, _ in sections]) for name in names)
    return {
        "means": np.concatenate([means for _, means in sections]),
        "quats": quat.astype(np.float32),
        "log_scales": log_scales_from_scales(np.abs(scale.astype(np.float32))),
        "logit_opacities": logits_from_opacities(rgba[:, 3] / 255),
        "sh0": sh0_from_colors(rgba[:, :3] / 255),
        "shN": np.concatenate([_harmonics(r["sh"], level, bounds, width) for r, _ in sections]),
    }


def _refuse(path: Path, byte: int, expected: str, got: object) -> None:
    raise UserError(
        f"{Place(path, 'byte', byte)}: {expected} was expected, got {got}; the file is damaged, "
        "cut off or another one"
    )


def _row(level: int, degree: int) -> np.dtype:
    center, other, sh = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))[level]
    count = 3 * ((degree + 1) ** 2 - 1)
    fields = [("center", center, 3), ("scale", other, 3), ("quat", other, 4), ("rgba", "u1", 4)]
    return np.dtype([*fields, ("sh", sh, (count,))])


def _read_sections(
    path: Path, content: bytes, num_sections: int, level: int
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield rows and means (N, 3) of each section that has any."""
    start = HEADER_BYTES + num_sections * SECTION_BYTES
    if start > len(content):
        _refuse(path, 4, f"{num_sections:,} headers of sections", f"{len(content):,} bytes")
    for index in range(num_sections):
        at = HEADER_BYTES + index * SECTION_BYTES
        header = SECTION.unpack_from(content, at)
        count, room, size, num_buckets, block, stride, span, full, partial, degree = header
        if degree > 3:
            _refuse(path, at + 40, "a degree of harmonics from 0 to 3", degree)
        row, centers = _row(level, degree), start + 4 * partial
        first = centers + stride * num_buckets
        end = first + room * row.itemsize
        if count > room or end > len(content):
            expected = f"a section of {max(count, room):,} Gaussians in {end - start:,} bytes"
            _refuse(path, start, expected, f"{len(content) - start:,} bytes for {room:,}")
        rows = np.frombuffer(content, row, count, first)
        means = rows["center"].astype(np.float32)
        if level and count:
            if stride != 12 or full + partial > num_buckets:
                expected = f"buckets of 12 bytes, of which {full:,} are full and {partial:,} not"
                _refuse(path, at + 8, expected, f"{num_buckets:,} of {stride}")
            lengths = np.frombuffer(content, "<u4", partial, start).astype(np.int64)
            ends = np.cumsum(np.append(np.full(full, size, np.int64), lengths))
            if not len(ends) or ends[-1] < count:
                got = f"{ends[-1] if len(ends) else 0:,}"
                _refuse(path, start, f"room for {count:,} Gaussians in buckets", got)
            bucket = np.searchsorted(ends, np.arange(count), side="right")
            span = span or POSITION_RANGES[level]
            middles = np.frombuffer(content, "<f4", 3 * num_buckets, centers).reshape(-1, 3)
            offsets = (rows["center"].astype(np.float64) - span) * (block / 2 / span)
            means = middles[bucket] + offsets
        if count:
            yield rows, means
        start = end


def _harmonics(sh: np.ndarray, level: int, bounds: tuple[float, float], width: int) -> np.ndarray:
    """Return coefficients (N, width / 3, 3); zeros are those that a section lacks."""
    values = sh.astype(np.float32)
    if level == 2:
        values = bounds[0] + values / 255 * (bounds[1] - bounds[0])
    found, first = np.zeros((len(sh), width // 3, 3), np.float32), 0
    for degree in range(1, 4):
        count = 2 * degree + 1
        if 3 * first < sh.shape[1]:
            part = values[:, 3 * first : 3 * (first + count)].reshape(-1, 3, count)
            found[:, first : first + count] = part.transpose(0, 2, 1)
        first += count
    return found
