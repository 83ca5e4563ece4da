"""The JSON part of a glTF file, as far as splats need it: what it must say, and what it says.

Keys that are not named here are ignored. "glTF 2.0 Specification" (Khronos), section 5, and
``KHR_gaussian_splatting``.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.alias_generators import to_camel

from drgs.core.errors import UserError, listed, one_line
from drgs.io.formats import MAX_ORIGIN, Scalar
from drgs.io.ply import STATEMENT

EXTENSION = "KHR_gaussian_splatting"

REQUIRED = ("POSITION", *(f"{EXTENSION}:{name}" for name in ("ROTATION", "SCALE", "OPACITY")))

Index = Annotated[int, Field(ge=0, lt=2**32)]
Coordinate = Annotated[float, Field(ge=-MAX_ORIGIN, le=MAX_ORIGIN)]
OURS = "drgs"
"""The key of extras that are ours."""

IDENTITY = {
    "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
    "rotation": [0, 0, 0, 1],
    "scale": [1, 1, 1],
}


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True, alias_generator=to_camel)


class Accessor(_Part):
    """How numbers lie in a part of the buffer."""

    buffer_view: Index | None = None
    byte_offset: Index = 0
    component_type: int
    normalized: bool = False
    count: Annotated[Index, Field(ge=1)]
    type: str
    sparse: object = None


class View(_Part):
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
    accessors: list[Accessor] = []
    buffer_views: list[View] = []


@dataclass(frozen=True)
class Document:
    """What a file says of its only primitive of splats."""

    path: Path
    place: str  # of the primitive
    primitive: _Primitive
    accessors: list[Accessor]
    views: list[View]
    translation: tuple[float, float, float]  # of the splats, by their node and its parents

    @property
    def rendered_with(self) -> dict[str, Scalar]:
        """What the primitive's extras say of it; nothing, where they are somebody else's."""
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

    def accessor(self, name: str) -> Accessor:
        """Of an attribute."""
        index = self.primitive.attributes[name]
        if index >= len(self.accessors):
            raise UserError(
                f"{self.path}: {self.place}: {name} must be one of {len(self.accessors)} "
                f"accessors, got {index}"
            )
        found = self.accessors[index]
        if found.sparse is not None or found.buffer_view is None:
            raise UserError(
                f"{self.path}: accessors[{index}] must name a bufferView, and not be sparse; write "
                "the file otherwise"
            )
        return found

    def view(self, name: str) -> View:
        """The part of the file's own buffer that an attribute lies in."""
        index = self.accessor(name).buffer_view
        if index >= len(self.views) or self.views[index].buffer != 0:
            raise UserError(
                f"{self.path}: bufferViews[{index}] must be there, and a part of buffer 0"
            )
        return self.views[index]


def read_document(path: Path, text: bytes) -> Document:
    """Check the JSON part of a file as a whole, and find its splats.

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
    return Document(path, place, primitive, file.accessors, file.buffer_views, translation)


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
