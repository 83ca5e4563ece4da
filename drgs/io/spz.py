"""SPZ files of Niantic: 20 bytes per Gaussian, and 45 for harmonics of degree 3, then compressed.

Source of the layout: the README of nianticlabs/spz and its reference implementation. After a
header come the numbers of all Gaussians, attribute by attribute:

- positions: x, y, z as signed whole numbers of 24 bits, in steps that the header gives as 2^-bits;
- opacities: 8 bits;
- base colours: red, green, blue, (sh0 0.15 + 0.5) 255 in 8 bits;
- scales: (log + 10) 16 in 8 bits, so from e^-10 to e^5.9 in steps of 6 %;
- rotations: of the quaternion xyzw, the index of the largest component in 2 bits, then the others
  as a sign and 9 bits, up to 1/sqrt(2); in version 2, x, y, z in 8 bits each, w being positive;
- harmonics: (value + 1) 128 in 8 bits, coefficient by coefficient, rgb; those of degree 1 are
  rounded to 6 bits, higher ones to 5, which compresses better.

Values out of range are clamped. Versions 2 and 3 are one gzip stream. Version 4 has a header in the
clear and a Zstandard stream for each attribute, which the extra ``spz`` reads. Version 3 is
written: every program reads it. The axes are right, up and back: y is up.

A flag marks Gaussians that were fitted with compensated opacities, ``antialiased``.
"""

from __future__ import annotations

import gzip
import io
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

import numpy as np
from typing_extensions import override

from drgs.core.environment import require_module
from drgs.core.errors import Place, UserError, note_user, one_line
from drgs.core.files import read_bytes
from drgs.io.formats import FORMATS, Arrays, FileFormat, Scalar
from drgs.io.quantization import (
    drop_largest_component,
    logits_from_opacities,
    normalize_quaternions,
    opacities_from_logits,
    require_scene_memory,
    restore_largest_component,
    round_to_uint32,
)

MAX_BYTES = 1 << 32  # largest file: 4.3 GB, more than 60 million Gaussians

MAGIC = b"NGSP"
GZIP_MAGIC = b"\x1f\x8b"
HEADER = struct.Struct("<4sIIBBBB")
HEADER_4 = struct.Struct("<4sIIBBBBI12x")
TABLE_ENTRY = struct.Struct("<QQ")

WRITTEN_VERSION = 3
ANTIALIASED, EXTENSIONS = 1, 2  # flags

POSITION_BITS = 24
FRACTIONAL_BITS = 12
"""Bits of the reference implementation; more where positions would have fewer than
:data:`MIN_FRACTIONAL_BITS` of their own, fewer where they would not fit."""

MIN_FRACTIONAL_BITS = 16

MAX_DEGREE = 3  # of harmonics that are kept; files have up to 4

COLOR_SCALE = 0.15
SCALE_STEPS, LOG_SCALE_LOW = 16, -10
QUATERNION_LEVELS = 511
SH_STEPS = (4, 8)
"""Steps of 256 levels that coefficients of degree 1, and higher ones, are rounded to. The reference
implementation's are twice as wide: on ``scenes/lego_mini.yml``, they save 17 % of the file and cost
0.2 dB more. No steps at all cost 44 % and save 0.1 dB."""

GZIP_LEVEL = 6  # the reference implementation's: the highest takes nine times as long for 3 % less

XYZW = np.array([1, 2, 3, 0])  # columns of a quaternion wxyz


@FORMATS.register("spz")
class Spz(FileFormat):
    """Niantic's SPZ."""

    suffix = ".spz"
    description = "Niantic's SPZ, the smallest"
    up = "y"
    metadata = frozenset({"antialiased"})
    ranges = MappingProxyType({"sh0": (-0.5 / COLOR_SCALE, 0.5 / COLOR_SCALE), "shN": (-1.0, 1.0)})

    @override
    def read(self, path: Path) -> tuple[Arrays, Mapping[str, Scalar]]:
        """Return Gaussians, y up, and whether ``antialiased``.

        Extensions of vendors and harmonics of degree 4 are passed over, with a :class:`UserNote`.
        """
        content = read_bytes(path, "file", MAX_BYTES)
        if content.startswith(GZIP_MAGIC):
            header, parts = _read_gzip(path, content)
        elif content.startswith(MAGIC):
            header, parts = _read_streams(path, content)
        else:
            raise UserError(
                f"{Place(path, 'byte', 0)}: must begin as gzip does, or with {MAGIC.decode()}: "
                "not an SPZ file"
            )
        if header.degree > MAX_DEGREE:
            note_user(f"{path}: harmonics of degree {header.degree}: read to degree {MAX_DEGREE}")
        if header.flags & EXTENSIONS:
            note = "has extensions of a vendor, which are passed over; one may mean other axes"
            note_user(f"{path}: {note}")
        positions, opacities, colors, scales, rotations, harmonics = (
            np.frombuffer(part, "u1").reshape(header.num, -1) if part else np.zeros((header.num, 0))
            for part in parts
        )
        harmonics = harmonics[:, : 3 * ((MAX_DEGREE + 1) ** 2 - 1)]
        arrays = {
            "means": _unpacked_positions(positions) / 2.0**header.fractional_bits,
            "quats": _unpacked_rotations(rotations, header.version),
            "log_scales": scales / SCALE_STEPS + LOG_SCALE_LOW,
            "logit_opacities": logits_from_opacities(opacities[:, 0] / 255),
            "sh0": ((colors / 255 - 0.5) / COLOR_SCALE)[:, None, :],
            "shN": (harmonics.astype(np.float32).reshape(header.num, -1, 3) - 128) / 128,
        }
        return arrays, {"antialiased": True} if header.flags & ANTIALIASED else {}

    @override
    def encode(self, gaussians: Arrays, rendered_with: Mapping[str, Scalar]) -> bytes:
        """Return a file, version 3; UserError if most scales are out of range, else a UserNote."""
        g = gaussians
        _check_scales(g["log_scales"])
        num, degree = len(g["means"]), round(np.sqrt(g["shN"].shape[1] + 1)) - 1
        bits = _fractional_bits(g["means"])
        flags = ANTIALIASED if rendered_with.get("antialiased") else 0
        scales = (g["log_scales"].astype(np.float64) - LOG_SCALE_LOW) * SCALE_STEPS
        parts = (
            _packed_positions(g["means"], bits),
            round_to_uint32(opacities_from_logits(g["logit_opacities"]) * 255, 255),
            round_to_uint32((g["sh0"].astype(np.float64) * COLOR_SCALE + 0.5) * 255, 255),
            round_to_uint32(scales, 255),
            _packed_rotations(g["quats"]),
            _packed_harmonics(g["shN"]),
        )
        header = HEADER.pack(MAGIC, WRITTEN_VERSION, num, degree, bits, flags, 0)
        content = b"".join([header, *(part.astype("u1").tobytes() for part in parts)])
        return gzip.compress(content, GZIP_LEVEL, mtime=0)


def _check_scales(log_scales: np.ndarray) -> None:
    """Refuse scenes whose unit does not suit the format; thin Gaussians may become thicker."""
    low, high = LOG_SCALE_LOW, LOG_SCALE_LOW + 255 / SCALE_STEPS
    largest = log_scales.max(axis=1)  # of each Gaussian
    outside = int(np.count_nonzero((largest < low) | (largest > high)))
    if not outside:
        return
    what = (
        f"the format spz holds standard deviations from {np.exp(low):.2g} to {np.exp(high):.3g}, "
        f"and those of {outside:,} of {len(largest):,} Gaussians are outside"
    )
    if 2 * outside > len(largest):
        raise UserError(f"{what}; scale the scene, or choose another format")
    note_user(f"{what}: cut off")


def _fractional_bits(means: np.ndarray) -> int:
    extent = float(np.abs(means).max())
    whole = int(np.frexp(extent)[1])  # bits of what is before the point: extent < 2^whole
    if whole > POSITION_BITS - 1:
        raise UserError(
            f"the format spz holds positions of at most {2 ** (POSITION_BITS - 1):,}, got "
            f"{extent:g}; crop or scale the scene"
        )
    finest = POSITION_BITS - 1 - whole
    return min(finest, max(FRACTIONAL_BITS, MIN_FRACTIONAL_BITS - whole), POSITION_BITS)


def _packed_positions(means: np.ndarray, bits: int) -> np.ndarray:
    """(N, 3, 3) bytes, the lowest first."""
    steps = np.floor(means.astype(np.float64) * 2.0**bits + 0.5)
    limit = 2 ** (POSITION_BITS - 1)
    return np.clip(steps, -limit, limit - 1).astype("<i4").view("u1").reshape(-1, 3, 4)[:, :, :3]


def _packed_rotations(quats: np.ndarray) -> np.ndarray:
    """(N, 4) bytes, the lowest first."""
    index, others = drop_largest_component(normalize_quaternions(quats)[:, XYZW])
    sizes = round_to_uint32(np.abs(others) * np.sqrt(2) * QUATERNION_LEVELS, QUATERNION_LEVELS)
    word = index.astype(np.uint32)
    for size, negative in zip(sizes.T, (others < 0).T, strict=True):
        word = word << np.uint32(10) | negative.astype(np.uint32) << np.uint32(9) | size
    return word.astype("<u4").view("u1").reshape(-1, 4)


def _packed_harmonics(sh: np.ndarray) -> np.ndarray:
    """(N, K - 1, 3) bytes; coefficient by coefficient, which takes little memory."""
    rounded_levels = np.empty(sh.shape, "u1")
    for index in range(sh.shape[1]):
        step = SH_STEPS[0] if index < 3 else SH_STEPS[1]
        levels = np.floor(sh[:, index].astype(np.float64) * 128 + 0.5) + 128
        rounded_levels[:, index] = np.clip(np.floor((levels + step // 2) / step) * step, 0, 255)
    return rounded_levels


@dataclass(frozen=True)
class _Header:
    version: int
    num: int
    degree: int
    fractional_bits: int
    flags: int

    @property
    def sizes(self) -> tuple[int, ...]:
        """Bytes of each attribute."""
        rotation = 4 if self.version >= 3 else 3
        harmonics = 3 * ((self.degree + 1) ** 2 - 1)
        return tuple(self.num * size for size in (9, 1, 3, 3, rotation, harmonics))


def _unpacked_positions(rows: np.ndarray) -> np.ndarray:
    """(N, 3) whole numbers of (N, 9) bytes."""
    words = np.zeros((len(rows), 3, 4), "u1")
    words[:, :, 1:] = rows.reshape(-1, 3, 3)  # in the upper bytes: the sign comes along
    return words.view("<i4")[:, :, 0] >> 8


def _unpacked_rotations(rows: np.ndarray, version: int) -> np.ndarray:
    """(N, 4) wxyz of (N, 4) bytes, or of version 2's (N, 3)."""
    if version < 3:
        xyz = rows / 127.5 - 1
        return np.column_stack([np.sqrt(np.maximum(0, 1 - np.square(xyz).sum(axis=1))), xyz])
    words = np.ascontiguousarray(rows).view("<u4")[:, 0]
    fields = words[:, None] >> np.array([20, 10, 0], np.uint32)
    sizes = (fields & np.uint32(QUATERNION_LEVELS)) / (QUATERNION_LEVELS * np.sqrt(2))
    others = np.where(fields & np.uint32(512), -sizes, sizes)
    xyzw = restore_largest_component((words >> np.uint32(30)).astype(np.intp), others)
    return xyzw[:, np.argsort(XYZW)]


def _checked_header(path: Path, fields: tuple, versions: tuple[int, ...]) -> _Header:
    """Check the header's numbers, and that there is memory for the Gaussians."""
    magic, version, num, degree, bits, flags = fields
    place = Place(path, "byte", 0)
    if magic != MAGIC:
        raise UserError(f"{place}: the header must begin with {MAGIC.decode()}, got {magic!r}")
    for name, value, least, most in (
        ("the version", version, versions[0], versions[-1]),
        ("the number of Gaussians", num, 1, 2**32 - 1),
        ("the degree of harmonics", degree, 0, 4),
        ("the number of fractional bits of positions", bits, 0, POSITION_BITS),
    ):
        if not least <= value <= most:
            raise UserError(f"{place}: {name} must be from {least} to {most}, got {value}")
    require_scene_memory(path, num, (degree + 1) ** 2, turned=True)
    return _Header(version, num, degree, bits, flags)


def _read_gzip(path: Path, content: bytes) -> tuple[_Header, list[bytes]]:
    with gzip.open(io.BytesIO(content)) as stream:

        def take(size: int, least: int) -> bytes:
            place = f"{Place(path, 'byte', stream.tell())} of the unpacked stream"
            try:
                data = stream.read(size)
            except (OSError, EOFError, zlib.error) as error:
                raise UserError(f"{place}: the gzip stream is damaged: {one_line(error)}") from None
            return _checked_size(place, data, least)

        header = _checked_header(path, HEADER.unpack(take(HEADER.size, HEADER.size))[:6], (2, 3))
        parts = [take(size, size) for size in header.sizes]
        while take(1 << 16, 0):  # to the end, where the checksum is
            if not header.flags & EXTENSIONS:
                raise UserError(f"{path}: the end was expected after {header.num:,} Gaussians")
    return header, parts


def _checked_size(place: object, data: bytes, expected: int) -> bytes:
    if len(data) < expected:
        raise UserError(
            f"{place}: {expected:,} bytes were expected, got {len(data):,}; the file is damaged, "
            "or was cut off"
        )
    return data


def _read_streams(path: Path, content: bytes) -> tuple[_Header, list[bytes]]:
    _checked_size(Place(path, "byte", 0), content, HEADER_4.size)
    *fields, num_streams, table = HEADER_4.unpack_from(content)
    header = _checked_header(path, tuple(fields), (4,))
    sizes = [size for size in header.sizes if size]
    start = table + num_streams * TABLE_ENTRY.size
    if num_streams != len(sizes) or not HEADER_4.size <= table <= start <= len(content):
        raise UserError(
            f"{Place(path, 'byte', 15)}: a table of {len(sizes)} streams within the file was "
            f"expected, got {num_streams} at byte {table:,}; the file is damaged, or was cut off"
        )
    zstandard, parts = require_module("zstandard", "spz", f"{path}: an SPZ file of version 4"), []
    for index, size in enumerate(sizes):
        packed, _ = TABLE_ENTRY.unpack_from(content, table + index * TABLE_ENTRY.size)
        place = Place(path, "byte", start)
        part = _checked_size(place, content[start : start + packed], packed)
        try:
            stream = zstandard.ZstdDecompressor().stream_reader(part)
            parts.append(_checked_size(place, stream.read(size), size))
        except zstandard.ZstdError as error:
            raise UserError(f"{place}: the Zstandard stream is damaged: {error}") from None
        start += packed
    return header, parts + [b""] * (len(header.sizes) - len(parts))
