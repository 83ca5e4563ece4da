"""Binary glTF 2.0 with ``KHR_gaussian_splatting``: Gaussians as a point primitive, in float32.

Source of the layout: "glTF 2.0 Specification" (Khronos), section 4.4, and the ratified extension
``KHR_gaussian_splatting`` with its kernel ``ellipse``. Attributes of the primitive, all in axes
with y up:

- ``POSITION``, and ``COLOR_0`` (base colour and opacity) for programs that show points;
- ``KHR_gaussian_splatting:ROTATION``, a unit quaternion xyzw; ``:SCALE``, standard deviations,
  linear (drafts of the extension had logarithms); ``:OPACITY``, from 0 to 1, after the sigmoid;
- ``:SH_DEGREE_l_COEF_n``, the harmonics in the order and with the signs of the 3DGS reference.

Colours are in display space, ``srgb_rec709_display``. What Gaussians are rendered with stands in
the primitive's ``extras``, of which other programs know nothing. :mod:`drgs.io.glb_document` has
what is read of the JSON part.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from drgs.core.constants import SH_C0
from drgs.core.errors import Place, UserError
from drgs.core.files import read_bytes
from drgs.core.memory import UNASKED_FILE_BYTES, readable, require_memory
from drgs.core.origin import WORLD, near_means
from drgs.io.formats import FORMATS, ORIGIN, FileFormat, Scalar, pop_origin
from drgs.io.glb_document import EXTENSION, OURS, Document, read_document
from drgs.io.quantized import (
    gaussians_bytes,
    log_scales_of,
    logits_of,
    opacities_of,
    rounded,
    unit_quaternions,
)

MAX_RATIO = 64
"""How many times more memory a scene may take than its file has bytes: those with a byte for each
number take 10 times."""

MAX_JSON_BYTES = 1 << 24
"""Limit of the JSON part, which takes up to 30 times as much memory."""

MAX_BYTES = (1 << 32) - 1
"""Of a file: its length is a number of 32 bits."""

HEADER = struct.Struct("<4sII")
CHUNK = struct.Struct("<I4s")
MAGIC, VERSION = b"glTF", 2
JSON, BINARY = b"JSON", b"BIN\0"

FLOAT, BYTE = 5126, 5121
"""Types of components that are written."""

ARRAY_BUFFER = 34962
POINTS = 0

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
"""By number, the types of components that splats may have."""

NOT_NEGATIVE = "linear, so not negative (drafts of the extension had logarithms)"

KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
"""By number of components."""


def encode(
    gaussians: Mapping[str, np.ndarray], rendered_with: Mapping[str, Scalar] | None = None
) -> bytes:
    """A file of Gaussians. Equal Gaussians give equal bytes.

    gaussians: finite, by the names that :func:`drgs.io.ply.read_gaussians` gives, in axes with y
    up; rendered_with: for ``extras``, None: nothing is said; the origin becomes the translation of
    the node.
    """
    attributes, said = _attributes(gaussians), dict(rendered_with or {})
    origin = pop_origin("rendered_with", said)
    document = _document(attributes, {OURS: said} if said else None)
    if origin != WORLD:
        document["nodes"][0]["translation"] = list(origin)
    text = json.dumps(document, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    binary = b"".join(values.tobytes() for values in attributes.values())
    length = HEADER.size + 2 * CHUNK.size + len(text) + len(binary)
    if length > MAX_BYTES:
        raise UserError(f"the format glb holds at most {MAX_BYTES:,} bytes, got {length:,}")
    return b"".join(
        [
            HEADER.pack(MAGIC, VERSION, length),
            CHUNK.pack(len(text), JSON),
            text,
            CHUNK.pack(len(binary), BINARY),
            binary,
        ]
    )


def _attributes(g: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """By name, arrays of float32 or bytes, each a multiple of 4 bytes long."""
    opacities = opacities_of(g["logit_opacities"])
    colors = 0.5 + SH_C0 * g["sh0"][:, 0].astype(np.float64)
    limits = np.finfo(np.float32)
    scales = np.exp(np.clip(g["log_scales"].astype(np.float64), -200, np.log(float(limits.max))))
    attributes = {
        "POSITION": g["means"],
        "COLOR_0": rounded(np.column_stack([colors, opacities]) * 255, 255).astype("u1"),
        f"{EXTENSION}:ROTATION": np.roll(unit_quaternions(g["quats"]), -1, axis=1),
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": opacities[:, None],
    }
    harmonics = np.concatenate([g["sh0"], g["shN"]], axis=1)
    for index, name in enumerate(_harmonics(harmonics.shape[1])):
        attributes[name] = harmonics[:, index]
    return {
        name: np.ascontiguousarray(values, values.dtype if values.dtype == "u1" else "<f4")
        for name, values in attributes.items()
    }


def _harmonics(count: int) -> list[str]:
    """Names of ``count`` coefficients, in their order."""
    return [
        f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index}"
        for degree in range(4)
        for index in range(2 * degree + 1)
    ][:count]


def _document(
    attributes: Mapping[str, np.ndarray], extras: Mapping[str, object] | None
) -> dict[str, object]:
    """The JSON part."""
    views, accessors, start = [], [], 0
    for name, values in attributes.items():
        views.append(
            {"buffer": 0, "byteOffset": start, "byteLength": values.nbytes, "target": ARRAY_BUFFER}
        )
        accessor = {
            "bufferView": len(accessors),
            "componentType": BYTE if values.dtype == "u1" else FLOAT,
            "count": len(values),
            "type": KINDS[values.shape[1]],
        }
        if values.dtype == "u1":
            accessor["normalized"] = True
        if name == "POSITION":  # required, as the numbers that the file holds
            accessor |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
        accessors.append(accessor)
        start += values.nbytes
    primitive = {
        "attributes": {name: index for index, name in enumerate(attributes)},
        "mode": POINTS,
        "extensions": {EXTENSION: {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}},
    }
    if extras is not None:
        primitive["extras"] = extras
    return {
        "asset": {"version": "2.0", "generator": "drgs"},
        "extensionsUsed": [EXTENSION],
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }


# ----------------------------------------------------------------------------------------------
# Reading
# ----------------------------------------------------------------------------------------------


def read_gaussians(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Scalar]]:
    """Gaussians as numpy float32 arrays with y up, and what ``extras`` says they are rendered with.

    As :func:`drgs.io.ply.read_gaussians` gives them; opacities of 0 and 1, and scales of 0, are the
    next ones that their logits and logarithms tell apart. Scales, rotations and opacities may be
    quantised as the extension allows. Other meshes of the file are passed over.

    Raises :class:`UserError` naming the file, the place, what was expected and what was got: also
    for splats that the file rotates, scales or shows several times, for compressed ones and for
    kernels and colour spaces other than those that are written here. A translation is added to the
    means or, where it is far away, is their origin.
    """
    path = Path(path)
    text, binary, start = _chunks(path, read_bytes(path, "file", MAX_BYTES))
    document = read_document(path, text)
    names = document.primitive.attributes
    count = next((k for k in (16, 9, 4, 1) if set(_harmonics(k)) <= set(names)), 0)
    stray = [n for n in names if ":SH_DEGREE_" in n and n not in _harmonics(count)]
    if not count or stray:
        what = f"all those below {stray[0]}" if stray else "at least that of degree 0"
        raise UserError(f"{path}: {document.place}: harmonics must be complete: {what} is expected")
    _check_memory(path, document, count, len(text) + len(binary))
    reader = _Attributes(path, document, binary, start)
    means = reader.values("POSITION", 3)
    scales = reader.values(f"{EXTENSION}:SCALE", 3)
    reader.check(f"{EXTENSION}:SCALE", scales, 0, np.inf, NOT_NEGATIVE)
    opacities = reader.values(f"{EXTENSION}:OPACITY", 1)
    reader.check(f"{EXTENSION}:OPACITY", opacities, 0, 1, "from 0 to 1")
    harmonics = np.stack(
        [reader.values(name, 3).astype(np.float32) for name in _harmonics(count)], axis=1
    )
    arrays = {
        "means": means,
        "quats": np.roll(reader.values(f"{EXTENSION}:ROTATION", 4), 1, axis=1),
        "log_scales": log_scales_of(scales),
        "logit_opacities": logits_of(opacities[:, 0]),
        "sh0": harmonics[:, :1],
        "shN": harmonics[:, 1:],
    }
    arrays["means"], origin = near_means(means + document.translation)
    said = document.rendered_with
    if origin != WORLD:  # exactly what the file has, not what would do
        arrays["means"], said = means, said | dict(zip(ORIGIN, document.translation, strict=True))
    return {n: values.astype(np.float32) for n, values in arrays.items()}, said


def _check_memory(path: Path, document: Document, harmonics: int, size: int) -> None:
    """Refuse what takes more memory than there is, or than a file of ``size`` bytes should.

    Attributes may lie in the same bytes.
    """
    num = document.accessor("POSITION").count
    needed, what = gaussians_bytes(num, harmonics, turned=True), f"a scene of {num:,} Gaussians"
    if needed > MAX_RATIO * size and needed > UNASKED_FILE_BYTES:
        raise UserError(
            f"{path}: {document.place}: {what} takes about {readable(needed)} of memory, and a "
            f"file of {size:,} bytes must take at most {MAX_RATIO} times as many; its attributes "
            "lie in the same bytes: write each in bytes of its own"
        )
    require_memory(path, needed, what)


def _chunks(path: Path, content: bytes) -> tuple[bytes, bytes, int]:
    """The JSON part, the binary part, and the byte at which that begins."""
    if len(content) < HEADER.size or not content.startswith(MAGIC):
        raise UserError(f"{Place(path, 'byte', 0)}: must begin with glTF: not a binary glTF file")
    _, version, length = HEADER.unpack_from(content)
    if version != VERSION or length != len(content):
        raise UserError(
            f"{Place(path, 'byte', 4)}: version {VERSION} and the file's length, {len(content):,}, "
            f"were expected, got {version} and {length:,}; the file is damaged, or was cut off"
        )
    chunks, at = [], HEADER.size
    for kind in (JSON, BINARY):
        size, found = CHUNK.unpack_from(content, at) if at + CHUNK.size <= length else (0, b"")
        if kind == JSON and size > MAX_JSON_BYTES:
            raise UserError(
                f"{Place(path, 'byte', at)}: the JSON part must have at most {MAX_JSON_BYTES:,} "
                f"bytes, got {size:,}; write the splats into a file of their own"
            )
        if found != kind or size > length - at - CHUNK.size:
            raise UserError(
                f"{Place(path, 'byte', at)}: a chunk {kind.decode().strip(chr(0))} within the file "
                f"was expected, got {found!r} of {size:,} bytes"
            )
        at += CHUNK.size
        chunks.append(content[at : at + size])
        at += size
    return *chunks, at - len(chunks[1])


class _Attributes:
    """The numbers of the primitive's attributes."""

    def __init__(self, path: Path, document: Document, binary: bytes, start: int) -> None:
        self._path, self._document = path, document
        self._binary, self._start = binary, start
        self._count = document.accessor("POSITION").count

    def values(self, name: str, width: int) -> np.ndarray:
        """(N, width) float64, all of them finite."""
        accessor = self._document.accessor(name)
        view = self._document.view(name)
        where = f"{self._path}: {self._document.place}: {name}"
        expected = (self._count, KINDS[width])
        if (accessor.count, accessor.type) != expected or accessor.component_type not in COMPONENTS:
            raise UserError(
                f"{where}: {expected[0]:,} times {expected[1]} of floats, bytes or shorts were "
                f"expected, got {accessor.count:,} times {accessor.type} of the component type "
                f"{accessor.component_type}"
            )
        dtype = np.dtype(COMPONENTS[accessor.component_type])
        row = width * dtype.itemsize
        stride = view.byte_stride or row
        first = view.byte_offset + accessor.byte_offset
        needed = accessor.byte_offset + (self._count - 1) * stride + row
        if needed > view.byte_length or view.byte_offset + view.byte_length > len(self._binary):
            raise UserError(
                f"{where}: {needed:,} bytes within the file were expected from byte "
                f"{self._start + first:,} on, got a part of {view.byte_length:,} of "
                f"{len(self._binary):,}"
            )
        rows = np.ndarray(
            (self._count, width), dtype, self._binary, first, (stride, dtype.itemsize)
        )
        with np.errstate(invalid="ignore"):  # NaN, which is refused below
            values = rows.astype(np.float64)
        if dtype.kind != "f" and accessor.normalized:
            values = np.maximum(values / np.iinfo(dtype).max, -1)
        self._refuse(name, values, ~np.isfinite(values), "finite")
        return values

    def check(self, name: str, values: np.ndarray, least: float, most: float, words: str) -> None:
        """Refuse values outside of a range."""
        self._refuse(name, values, ~((values >= least) & (values <= most)), words)

    def _refuse(self, name: str, values: np.ndarray, wrong: np.ndarray, words: str) -> None:
        bad = np.argwhere(wrong)
        if len(bad):
            view = self._document.view(name)
            first = self._start + view.byte_offset + self._document.accessor(name).byte_offset
            raise UserError(
                f"{Place(self._path, 'byte', first)}, row {bad[0][0]:,}: {name} must be {words}, "
                f"got {values[tuple(bad[0])]}"
            )


@FORMATS.register("glb")
class Glb(FileFormat):
    """Binary glTF."""

    suffix = ".glb"
    description = "binary glTF with KHR_gaussian_splatting, in full precision"
    up = "y"
    metadata = None
    read = staticmethod(read_gaussians)
    encode = staticmethod(encode)
