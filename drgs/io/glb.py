"""Binary glTF 2.0 with ``KHR_gaussian_splatting``: Gaussians as a point primitive, in float32.

Source of the layout: "glTF 2.0 Specification" (Khronos), section 4.4, and the ratified extension
``KHR_gaussian_splatting`` with its kernel ``ellipse``. Attributes, in axes with y up:

- ``POSITION``, and ``COLOR_0`` (base colour and opacity) for programs that show points;
- ``KHR_gaussian_splatting:ROTATION``, a unit quaternion xyzw; ``:SCALE``, standard deviations,
  linear (drafts of the extension had logarithms); ``:OPACITY``, from 0 to 1, after the sigmoid;
- ``:SH_DEGREE_l_COEF_n``, the harmonics in the order and with the signs of the 3DGS reference.

Colours are in display space, ``srgb_rec709_display``. Rendering settings are in the primitive's
``extras``, which other programs ignore. Other keys of the JSON part are ignored.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from pydantic import AliasPath, BaseModel, ConfigDict, Field
from pydantic.alias_generators import to_camel
from typing_extensions import override

from drgs.config.section import parse_json, validate
from drgs.core.errors import Place, UserError, one_line
from drgs.core.files import read_bytes
from drgs.core.origin import WORLD, Origin, recenter_means
from drgs.io.formats import (
    FORMATS,
    MAX_ORIGIN,
    ORIGIN,
    Arrays,
    FileFormat,
    Scalar,
    check_range,
    pop_origin,
)
from drgs.io.ply import STATEMENT
from drgs.io.quantization import (
    MAX_LOG_SCALE,
    MIN_LOG_SCALE,
    arrays_from_activated,
    colors_from_sh0,
    normalize_quaternions,
    opacities_from_logits,
    require_scene_memory,
    round_to_uint32,
)

EXTENSION = "KHR_gaussian_splatting"
REQUIRED = ("POSITION", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")))

MAX_JSON_BYTES = 1 << 24  # limit of the JSON part, which takes up to 30 times as much memory

MAX_BYTES = (1 << 32) - 1  # largest file: its length is a number of 32 bits

HEADER = struct.Struct("<4sII")
CHUNK = struct.Struct("<I4s")
MAGIC, VERSION = b"glTF", 2
JSON, BINARY = b"JSON", b"BIN\0"

FLOAT, BYTE = 5126, 5121  # types of components that are written

ARRAY_BUFFER = 34962
POINTS = 0

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
"""Types of components that splats may have, by number."""

KINDS = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}  # types of accessors, by number of components

EXTRAS_KEY = "drgs"  # key of our values in ``extras``


@FORMATS.register("glb")
class Glb(FileFormat):
    """Binary glTF."""

    suffix = ".glb"
    description = "binary glTF with KHR_gaussian_splatting, in full precision"
    up = "y"
    metadata = None
    ranges = MappingProxyType({"log_scales": (MIN_LOG_SCALE, MAX_LOG_SCALE)})

    @override
    def read(self, path: Path) -> tuple[Arrays, Mapping[str, Scalar]]:
        """Return Gaussians, y up, and our values in ``extras``; other meshes are passed over.

        Scales, rotations and opacities may be quantised as the extension allows. A translation is
        added to the means or, where it is far away, is their origin.

        Raises :class:`UserError` also for splats that the file rotates, scales or shows several
        times, for compressed ones, and for other kernels and colour spaces than are written here.
        """
        document = _read_document(path, *_chunks(path, read_bytes(path, "file", MAX_BYTES)))
        names = document.primitive.attributes
        count = next((k for k in (16, 9, 4, 1) if set(_harmonics(k)) <= set(names)), 0)
        stray = [n for n in names if ":SH_DEGREE_" in n and n not in _harmonics(count)]
        if not count or stray:
            what = f"all those below {stray[0]}" if stray else "at least that of degree 0"
            raise UserError(
                f"{path}: {document.place}: harmonics must be complete: {what} is expected"
            )
        require_scene_memory(path, document.accessor("POSITION").count, count, turned=True)
        means = document.values("POSITION", 3)
        scales = document.values(f"{EXTENSION}:SCALE", 3, 0)
        opacities = document.values(f"{EXTENSION}:OPACITY", 1, 0, 1)
        columns = [document.values(name, 3).astype(np.float32) for name in _harmonics(count)]
        harmonics = np.stack(columns, axis=1)
        quats = np.roll(document.values(f"{EXTENSION}:ROTATION", 4), 1, axis=1)
        moved, origin = recenter_means(means + document.translation)
        settings = document.rendered_with
        if origin != WORLD:  # exactly the file's
            moved = means
            settings = settings | dict(zip(ORIGIN, document.translation, strict=True))
        return arrays_from_activated(moved, quats, scales, opacities[:, 0], harmonics), settings

    @override
    def encode(self, gaussians: Arrays, rendered_with: Mapping[str, Scalar]) -> bytes:
        """Return a file, in which the origin is the translation of the node."""
        attributes, settings = _attributes(gaussians), dict(rendered_with)
        origin = pop_origin("rendered_with", settings)
        document = _document(attributes, {EXTRAS_KEY: settings} if settings else None, origin)
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        binary = b"".join(values.tobytes() for values in attributes.values())
        length = HEADER.size + 2 * CHUNK.size + len(text) + len(binary)
        if length > MAX_BYTES:
            raise UserError(f"the format glb holds at most {MAX_BYTES:,} bytes, got {length:,}")
        start = HEADER.pack(MAGIC, VERSION, length) + CHUNK.pack(len(text), JSON)
        return b"".join([start, text, CHUNK.pack(len(binary), BINARY), binary])


def _attributes(g: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return arrays of float32 or bytes by name, each a multiple of 4 bytes long."""
    opacities = opacities_from_logits(g["logit_opacities"])
    rgba = np.column_stack([colors_from_sh0(g["sh0"]), opacities])
    scales = np.exp(np.clip(g["log_scales"].astype(np.float64), MIN_LOG_SCALE, MAX_LOG_SCALE))
    attributes = {
        "POSITION": g["means"],
        "COLOR_0": round_to_uint32(rgba * 255, 255).astype("u1"),
        f"{EXTENSION}:ROTATION": np.roll(normalize_quaternions(g["quats"]), -1, axis=1),
        f"{EXTENSION}:SCALE": scales,
        f"{EXTENSION}:OPACITY": opacities[:, None],
    }
    harmonics = np.concatenate([g["sh0"], g["shN"]], axis=1)
    attributes |= zip(_harmonics(harmonics.shape[1]), np.moveaxis(harmonics, 1, 0), strict=True)
    return {
        name: np.ascontiguousarray(values, values.dtype if values.dtype == "u1" else "<f4")
        for name, values in attributes.items()
    }


def _harmonics(count: int) -> list[str]:
    return [
        f"{EXTENSION}:SH_DEGREE_{degree}_COEF_{index}"
        for degree in range(4)
        for index in range(2 * degree + 1)
    ][:count]


def _document(
    attributes: Mapping[str, np.ndarray], extras: Mapping[str, object] | None, origin: Origin
) -> dict[str, object]:
    node: dict[str, object] = {"mesh": 0}
    if origin != WORLD:
        node["translation"] = list(origin)
    views, accessors, start = [], [], 0
    for name, values in attributes.items():
        part = {"byteOffset": start, "byteLength": values.nbytes}
        views.append({"buffer": 0, **part, "target": ARRAY_BUFFER})
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
        "nodes": [node],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": start}],
    }


def _chunks(path: Path, content: bytes) -> tuple[bytes, bytes]:
    refused = UserError(
        f"{Place(path, 'byte', 0)}: must be a binary glTF 2.0 file of a JSON part, of at most "
        f"{MAX_JSON_BYTES:,} bytes, and a binary part; it is damaged, cut off or another file"
    )
    try:
        magic, version, length = HEADER.unpack_from(content)
        json_size, json_kind = CHUNK.unpack_from(content, HEADER.size)
        text = HEADER.size + CHUNK.size
        size, kind = CHUNK.unpack_from(content, text + min(json_size, MAX_JSON_BYTES))
    except struct.error:
        raise refused from None
    start = text + json_size + CHUNK.size
    header = magic, version, length, json_kind, kind
    if header != (MAGIC, VERSION, len(content), JSON, BINARY) or start + size > length:
        raise refused
    return content[text : text + json_size], content[start : start + size]


Index = Annotated[int, Field(ge=0, lt=2**32)]
Coordinate = Annotated[float, Field(ge=-MAX_ORIGIN, le=MAX_ORIGIN)]
IDENTITY: dict[str, list[float]] = {
    "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
    "rotation": [0, 0, 0, 1],
    "scale": [1, 1, 1],
}

Part = TypeVar("Part", bound=BaseModel)


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, alias_generator=to_camel)


class _Accessor(_Part):
    buffer_view: Index
    byte_offset: Index = 0
    component_type: Literal[5120, 5121, 5122, 5123, 5126]
    normalized: bool = False
    count: Annotated[Index, Field(ge=1)]
    type: str
    sparse: None = None


class _View(_Part):
    buffer: Literal[0]
    byte_offset: Index = 0
    byte_length: Index
    byte_stride: Annotated[int, Field(ge=4, le=252)] | None = None


def _of_extension(key: str, **settings: Any) -> Any:
    return Field(validation_alias=AliasPath("extensions", EXTENSION, key), **settings)


class _Primitive(_Part):
    attributes: dict[str, Index]
    mode: Literal[0]
    kernel: Literal["ellipse"] = _of_extension("kernel")
    color_space: Literal["srgb_rec709_display"] = _of_extension("colorSpace")
    further: dict[str, object] = _of_extension("extensions", default={}, max_length=0)
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
    extensions_required: list[Literal["KHR_gaussian_splatting"]] = []
    nodes: list[_Node] = []
    meshes: list[_Mesh] = []
    accessors: list[object] = []
    buffer_views: list[object] = []


@dataclass(frozen=True)
class _Document:
    """The only primitive of splats in a file."""

    path: Path
    place: str  # of the primitive
    primitive: _Primitive
    file: _File
    translation: tuple[float, float, float]  # of the splats, by their node and its parents
    binary: bytes

    @property
    def rendered_with(self) -> dict[str, Scalar]:
        """Our values in the primitive's extras; none if another program wrote them."""
        extras = self.primitive.extras
        settings = extras.get(EXTRAS_KEY, {}) if isinstance(extras, dict) else {}
        if not isinstance(settings, dict) or not all(
            isinstance(value, Scalar) and STATEMENT.fullmatch(f"{EXTRAS_KEY} {name} {value}")
            for name, value in settings.items()
        ):
            raise UserError(
                f"{self.path}: {self.place}.extras.{EXTRAS_KEY}: must be an object of names and "
                f"values of one word, got {one_line(repr(settings), 60)}; correct it, or remove it"
            )
        return settings

    def accessor(self, name: str) -> _Accessor:
        index = self.primitive.attributes[name]
        return self._item("accessors", self.file.accessors, index, _Accessor)

    def values(
        self, name: str, width: int, least: float = -np.inf, most: float = np.inf
    ) -> np.ndarray:
        """Return an attribute (N, width) float64 of finite numbers from ``least`` to ``most``."""
        accessor = self.accessor(name)
        view = self._item("bufferViews", self.file.buffer_views, accessor.buffer_view, _View)
        count, kind = self.accessor("POSITION").count, KINDS[width]
        dtype = np.dtype(COMPONENTS[accessor.component_type])
        stride = view.byte_stride or width * dtype.itemsize
        first = view.byte_offset + accessor.byte_offset
        needed = accessor.byte_offset + (count - 1) * stride + width * dtype.itemsize
        is_whole = needed <= view.byte_length <= len(self.binary) - view.byte_offset
        if (accessor.count, accessor.type) != (count, kind) or not is_whole:
            raise UserError(
                f"{self.path}: {self.place}: {name}: {count:,} times {kind} in {needed:,} bytes "
                f"within the file were expected, got {accessor.count:,} times {accessor.type} in "
                f"a part of {view.byte_length:,}"
            )
        rows = np.ndarray((count, width), dtype, self.binary, first, (stride, dtype.itemsize))
        with np.errstate(invalid="ignore"):  # NaN, which is refused below
            values = rows.astype(np.float64)
        if dtype.kind != "f" and accessor.normalized:
            values = np.maximum(values / np.iinfo(dtype).max, -1)
        check_range(self.path, name, values, least, most)
        return values

    def _item(self, key: str, items: list[object], index: int, kind: type[Part]) -> Part:
        if index >= len(items):
            raise UserError(f"{self.path}: {key}[{index}] must be there, got {len(items)} of them")
        return validate(kind, items[index], f"{self.path}: {key}[{index}].")


def _read_document(path: Path, text: bytes, binary: bytes) -> _Document:
    file = validate(_File, parse_json(text, f"{path}: the JSON part: "), f"{path}: ")
    splats = [
        (mesh, index)
        for mesh, each in enumerate(file.meshes)
        for index, primitive in enumerate(each.primitives)
        if isinstance(known := primitive.get("extensions"), dict) and EXTENSION in known
    ]
    if len(splats) != 1:
        raise UserError(
            f"{path}: must have one primitive with {EXTENSION}, got {len(splats) or 'none'}"
        )
    mesh, index = splats[0]
    place = f"meshes[{mesh}].primitives[{index}]"
    primitive = validate(_Primitive, file.meshes[mesh].primitives[index], f"{path}: {place}.")
    missing = [name for name in REQUIRED if name not in primitive.attributes]
    if missing:
        raise UserError(f"{path}: {place}: attributes {', '.join(missing)} are missing")
    return _Document(path, place, primitive, file, _translation(path, file.nodes, mesh), binary)


def _translation(path: Path, nodes: list[_Node], mesh: int) -> tuple[float, float, float]:
    """Add up the translations of the node that shows the splats, and of its parents."""
    showing = [index for index, node in enumerate(nodes) if node.mesh == mesh]
    if len(showing) > 1:
        raise UserError(f"{path}: the splats must be shown once, got {len(showing)} nodes")
    parents = {child: index for index, node in enumerate(nodes) for child in node.children}
    visited, total = set(), (0.0, 0.0, 0.0)
    while showing and showing[0] not in visited:
        index = showing[0]
        visited.add(index)
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
