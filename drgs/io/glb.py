"""Binary glTF 2.0 with ``KHR_gaussian_splatting``: Gaussians as a point primitive, in float32.

Source of the layout: "glTF 2.0 Specification" (Khronos), section 4.4, and the ratified extension
``KHR_gaussian_splatting`` with its kernel ``ellipse``. Attributes of the primitive, all in axes
with y up:

- ``POSITION``, and ``COLOR_0`` (base colour and opacity) for programs that show points;
- ``KHR_gaussian_splatting:ROTATION``, a unit quaternion xyzw; ``:SCALE``, standard deviations,
  linear (drafts of the extension had logarithms); ``:OPACITY``, from 0 to 1, after the sigmoid;
- ``:SH_DEGREE_l_COEF_n``, the harmonics in the order and with the signs of the 3DGS reference.

Colours are in display space, ``srgb_rec709_display``. What Gaussians are rendered with stands in
the primitive's ``extras``, of which other programs know nothing. Keys of the JSON part that are not
named here are ignored.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.alias_generators import to_camel

from drgs.core.constants import SH_C0
from drgs.core.errors import Place, UserError, listed, one_line
from drgs.core.files import read_bytes
from drgs.core.memory import UNASKED_FILE_BYTES, readable, require_memory
from drgs.core.origin import WORLD, near_means
from drgs.io.formats import FORMATS, MAX_ORIGIN, ORIGIN, FileFormat, Scalar, pop_origin
from drgs.io.ply import STATEMENT
from drgs.io.quantization import (
    decoding_bytes,
    log_scales_from_scales,
    logits_from_opacities,
    normalize_quaternions,
    opacities_from_logits,
    round_to_uint32,
)

EXTENSION = "KHR_gaussian_splatting"
REQUIRED = ("POSITION", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")))

MAX_RATIO = 64
"""Largest ratio of a scene's memory to its file's bytes: files with a byte for each number have
10."""

MAX_JSON_BYTES = 1 << 24
"""Limit of the JSON part, which takes up to 30 times as much memory."""

MAX_BYTES = (1 << 32) - 1
"""Largest file: its length is a number of 32 bits."""

HEADER = struct.Struct("<4sII")
CHUNK = struct.Struct("<I4s")
MAGIC, VERSION = b"glTF", 2
JSON, BINARY = b"JSON", b"BIN\0"

FLOAT, BYTE = 5126, 5121
"""Types of components that are written."""

ARRAY_BUFFER = 34962
POINTS = 0

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
"""Types of components that splats may have, by number."""

NOT_NEGATIVE = "linear, so not negative (drafts of the extension had logarithms)"

KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
"""Types of accessors, by number of components."""


OURS = "drgs"
"""Key of our values in ``extras``."""


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
    """Return arrays of float32 or bytes by name, each a multiple of 4 bytes long."""
    opacities = opacities_from_logits(g["logit_opacities"])
    colors = 0.5 + SH_C0 * g["sh0"][:, 0].astype(np.float64)
    limits = np.finfo(np.float32)
    scales = np.exp(np.clip(g["log_scales"].astype(np.float64), -200, np.log(float(limits.max))))
    attributes = {
        "POSITION": g["means"],
        "COLOR_0": round_to_uint32(np.column_stack([colors, opacities]) * 255, 255).astype("u1"),
        f"{EXTENSION}:ROTATION": np.roll(normalize_quaternions(g["quats"]), -1, axis=1),
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
    document = _read_document(path, text, binary, start)
    names = document.primitive.attributes
    count = next((k for k in (16, 9, 4, 1) if set(_harmonics(k)) <= set(names)), 0)
    stray = [n for n in names if ":SH_DEGREE_" in n and n not in _harmonics(count)]
    if not count or stray:
        what = f"all those below {stray[0]}" if stray else "at least that of degree 0"
        raise UserError(f"{path}: {document.place}: harmonics must be complete: {what} is expected")
    _check_memory(path, document, count, len(text) + len(binary))
    means = document.values("POSITION", 3)
    scales = document.values(f"{EXTENSION}:SCALE", 3)
    document.check(f"{EXTENSION}:SCALE", scales, 0, np.inf, NOT_NEGATIVE)
    opacities = document.values(f"{EXTENSION}:OPACITY", 1)
    document.check(f"{EXTENSION}:OPACITY", opacities, 0, 1, "from 0 to 1")
    harmonics = np.stack(
        [document.values(name, 3).astype(np.float32) for name in _harmonics(count)], axis=1
    )
    arrays = {
        "means": means,
        "quats": np.roll(document.values(f"{EXTENSION}:ROTATION", 4), 1, axis=1),
        "log_scales": log_scales_from_scales(scales),
        "logit_opacities": logits_from_opacities(opacities[:, 0]),
        "sh0": harmonics[:, :1],
        "shN": harmonics[:, 1:],
    }
    arrays["means"], origin = near_means(means + document.translation)
    said = document.rendered_with
    if origin != WORLD:  # exactly what the file has, not what would do
        arrays["means"], said = means, said | dict(zip(ORIGIN, document.translation, strict=True))
    return {n: values.astype(np.float32) for n, values in arrays.items()}, said


def _check_memory(path: Path, document: _Document, harmonics: int, size: int) -> None:
    """Refuse what takes more memory than there is, or than a file of ``size`` bytes should.

    Attributes may lie in the same bytes.
    """
    num = document.count
    needed, what = decoding_bytes(num, harmonics, turned=True), f"a scene of {num:,} Gaussians"
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


Index = Annotated[int, Field(ge=0, lt=2**32)]
Coordinate = Annotated[float, Field(ge=-MAX_ORIGIN, le=MAX_ORIGIN)]
IDENTITY = {
    "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
    "rotation": [0, 0, 0, 1],
    "scale": [1, 1, 1],
}


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, alias_generator=to_camel)


class _Accessor(_Part):
    """Layout of numbers in a part of the buffer."""

    buffer_view: Index | None = None
    byte_offset: Index = 0
    component_type: int
    normalized: bool = False
    count: Annotated[Index, Field(ge=1)]
    type: str
    sparse: object = None


class _View(_Part):
    """A part of the buffer."""

    buffer: Index
    byte_offset: Index = 0
    byte_length: Index
    byte_stride: Annotated[int, Field(ge=4, le=252)] | None = None


class _Splatting(_Part):
    kernel: Literal["ellipse"]
    color_space: Literal["srgb_rec709_display"]
    extensions: dict[str, object] = {}


class _Extensions(_Part):
    splatting: _Splatting = Field(alias=EXTENSION)


class _Primitive(_Part):
    attributes: dict[str, Index]
    mode: Literal[0]
    extensions: _Extensions
    extras: object = None


class _Mesh(_Part):
    primitives: list[dict[str, object]]


class _Node(_Part):
    mesh: Index | None = None
    children: list[Index] = []
    matrix: list[float] = IDENTITY["matrix"]
    translation: Annotated[list[Coordinate], Field(min_length=3, max_length=3)] = [0, 0, 0]
    rotation: list[float] = IDENTITY["rotation"]
    scale: list[float] = IDENTITY["scale"]


class _File(_Part):
    extensions_required: list[str] = []
    nodes: list[_Node] = []
    meshes: list[_Mesh] = []
    accessors: list[_Accessor] = []
    buffer_views: list[_View] = []


@dataclass(frozen=True)
class _Document:
    """The only primitive of splats in a file."""

    path: Path
    place: str  # of the primitive
    primitive: _Primitive
    file: _File
    translation: tuple[float, float, float]  # of the splats, by their node and its parents
    binary: bytes
    start: int  # byte of the file at which ``binary`` begins

    @property
    def rendered_with(self) -> dict[str, Scalar]:
        """Our values in the primitive's extras; none if another program wrote them."""
        extras = self.primitive.extras
        if not isinstance(extras, dict) or OURS not in extras:
            return {}
        where, said = f"{self.path}: {self.place}.extras.{OURS}", extras[OURS]
        if not isinstance(said, dict):
            raise UserError(
                f"{where}: must be an object, got {one_line(repr(said), 60)}; remove it"
            )
        for name, value in said.items():
            if not isinstance(value, Scalar) or not STATEMENT.fullmatch(f"{OURS} {name} {value}"):
                raise UserError(
                    f"{where}: must be names and values of one word, got {one_line(name, 60)!r}: "
                    f"{one_line(repr(value), 60)}; correct it, or remove it"
                )
        return said

    @property
    def count(self) -> int:
        """Number of splats."""
        return self.accessor("POSITION")[0].count

    def accessor(self, name: str) -> tuple[_Accessor, _View]:
        """Return how an attribute's numbers lie in a part of the buffer, and that part."""
        index, file = self.primitive.attributes[name], self.file
        if index >= len(file.accessors):
            raise UserError(
                f"{self.path}: {self.place}: {name} must be one of {len(file.accessors)} "
                f"accessors, got {index}"
            )
        found = file.accessors[index]
        if found.sparse is not None or found.buffer_view is None:
            raise UserError(
                f"{self.path}: accessors[{index}] must name a bufferView, and not be sparse; write "
                "the file otherwise"
            )
        view = found.buffer_view
        if view >= len(file.buffer_views) or file.buffer_views[view].buffer != 0:
            raise UserError(
                f"{self.path}: bufferViews[{view}] must be there, and a part of buffer 0"
            )
        return found, file.buffer_views[view]

    def values(self, name: str, width: int) -> np.ndarray:
        """Return an attribute (N, width) float64, all of it finite."""
        accessor, view = self.accessor(name)
        where = f"{self.path}: {self.place}: {name}"
        expected = (self.count, KINDS[width])
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
        needed = accessor.byte_offset + (self.count - 1) * stride + row
        if needed > view.byte_length or view.byte_offset + view.byte_length > len(self.binary):
            raise UserError(
                f"{where}: {needed:,} bytes within the file were expected from byte "
                f"{self.start + first:,} on, got a part of {view.byte_length:,} of "
                f"{len(self.binary):,}"
            )
        rows = np.ndarray((self.count, width), dtype, self.binary, first, (stride, dtype.itemsize))
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
            accessor, view = self.accessor(name)
            first = self.start + view.byte_offset + accessor.byte_offset
            raise UserError(
                f"{Place(self.path, 'byte', first)}, row {bad[0][0]:,}: {name} must be {words}, "
                f"got {values[tuple(bad[0])]}"
            )


def _read_document(path: Path, text: bytes, binary: bytes, start: int) -> _Document:
    """Check the JSON part of a file, and find its splats.

    Raises :class:`UserError` naming the file, the key, what was expected and what was got.
    """
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: the JSON part is not valid: {one_line(error)}") from None
    file = _validated(path, "", _File, content)
    unknown = [name for name in file.extensions_required if name != EXTENSION]
    if unknown:
        raise UserError(f"{path}: needs {listed(unknown)}, which drgs does not read")
    found = [
        (mesh, index)
        for mesh, each in enumerate(file.meshes)
        for index, primitive in enumerate(each.primitives)
        if _has_splats(primitive)
    ]
    if len(found) != 1:
        raise UserError(
            f"{path}: must have one primitive with {EXTENSION}, got {len(found) or 'none'}"
        )
    mesh, index = found[0]
    place = f"meshes[{mesh}].primitives[{index}]"
    primitive = _validated(path, f"{place}.", _Primitive, file.meshes[mesh].primitives[index])
    if primitive.extensions.splatting.extensions:
        names = listed(list(primitive.extensions.splatting.extensions))
        raise UserError(f"{path}: {place}: {names} is not read; write the splats without it")
    missing = [name for name in REQUIRED if name not in primitive.attributes]
    if missing:
        raise UserError(f"{path}: {place}: attributes {', '.join(missing)} are missing")
    translation = _translation(path, file.nodes, mesh)
    return _Document(path, place, primitive, file, translation, binary, start)


def _has_splats(primitive: dict[str, object]) -> bool:
    extensions = primitive.get("extensions")
    return isinstance(extensions, dict) and EXTENSION in extensions


def _validated(path: Path, place: str, kind: type[BaseModel], content: object) -> BaseModel:
    try:
        return kind.model_validate(content)
    except ValidationError as failed:
        error = failed.errors(include_url=False)[0]
        keys = ".".join(str(key) for key in error["loc"]) or "the JSON part"
        raise UserError(
            f"{path}: {one_line(place + keys, 200)}: {one_line(error['msg'], 200)}, got "
            f"{one_line(repr(error['input']), 60)}"
        ) from None


def _translation(path: Path, nodes: list[_Node], mesh: int) -> tuple[float, float, float]:
    """Add up the translations of the node that shows the splats, and of its parents.

    Raises :class:`UserError` for nodes that rotate or scale them.
    """
    showing = [index for index, node in enumerate(nodes) if node.mesh == mesh]
    if len(showing) > 1:
        raise UserError(f"{path}: the splats must be shown once, got {len(showing)} nodes")
    parents = {child: index for index, node in enumerate(nodes) for child in node.children}
    seen, total = set(), (0.0, 0.0, 0.0)
    while showing and showing[0] not in seen:
        index = showing[0]
        seen.add(index)
        moved = [n for n, same in IDENTITY.items() if getattr(nodes[index], n) != same]
        if moved:
            raise UserError(
                f"{path}: nodes[{index}].{moved[0]}: splats that a node rotates or scales are not "
                "read; apply it to them in the program that wrote the file"
            )
        x, y, z = (a + b for a, b in zip(total, nodes[index].translation, strict=True))
        total = x, y, z
        showing = [parents[index]] if index in parents else []
    return total


@FORMATS.register("glb")
class Glb(FileFormat):
    """Binary glTF."""

    suffix = ".glb"
    description = "binary glTF with KHR_gaussian_splatting, in full precision"
    up = "y"
    metadata = None
    read = staticmethod(read_gaussians)
    encode = staticmethod(encode)
