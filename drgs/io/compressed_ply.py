"""Compressed PLY files of PlayCanvas: 16 bytes per Gaussian, and 45 for harmonics of degree 3.

As SuperSplat and splat-transform write and read them ("Compressed PLY" in PlayCanvas's manual).
Gaussians stand in groups of 256 that are near each other. The element ``chunk`` has the smallest
and the largest position, logarithm of scale and base colour of each group; in the element
``vertex``, four whole numbers of 32 bits say where between them a Gaussian lies:

- ``packed_position``, ``packed_scale``: x, y, z in 11, 10 and 11 bits;
- ``packed_color``: red, green, blue and opacity in 8 bits each;
- ``packed_rotation``: which component of the quaternion wxyz is the largest in 2 bits, then the
  others in 10 bits each, from -1/sqrt(2) to 1/sqrt(2).

The element ``sh`` has the harmonics above degree 0, in the order of the 3DGS reference, in steps of
1/32 from -4 to 4; what is beyond is cut off. The header's comments are those of
:mod:`drgs.io.ply`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from drgs.core.constants import SH_C0
from drgs.core.errors import UserError
from drgs.core.memory import require_memory
from drgs.io.formats import FORMATS, FileFormat, Scalar
from drgs.io.ply import (
    NUM_REST,
    encode_elements,
    has_packed_vertices,
    properties_of,
    read_elements,
)
from drgs.io.quantization import (
    decoding_bytes,
    drop_largest_component,
    logits_from_opacities,
    morton_order,
    normalize_quaternions,
    opacities_from_logits,
    restore_largest_component,
    round_to_uint32,
)

CHUNK = 256
"""Gaussians in a group; the last one may have fewer."""

VECTOR_BITS = (11, 10, 11)
COLOR_BITS = (8, 8, 8, 8)
QUATERNION_BITS = (10, 10, 10)

QUATERNION_RANGE = 1 / np.sqrt(2)
"""No component but the largest is beyond it."""

SH_RANGE = 4.0
SH_LEVELS = 256

PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
BOUNDED = {"position": ("x", "y", "z"), "scale": ("scale_x", "scale_y", "scale_z")}
COLORS = ("r", "g", "b")
MAX_LOG_SCALE = 20.0
"""Larger ones are cut off, as PlayCanvas does: viewers compute with their exponentials."""


# ----------------------------------------------------------------------------------------------
# Writing
# ----------------------------------------------------------------------------------------------


def encode(
    gaussians: Mapping[str, np.ndarray], rendered_with: Mapping[str, Scalar] | None = None
) -> bytes:
    """A file of Gaussians, in Morton order. Equal Gaussians give equal bytes.

    gaussians: finite, by the names that :func:`drgs.io.ply.read_gaussians` gives; rendered_with:
    for the header, None: nothing is said.
    """
    order = morton_order(gaussians["means"])
    g = {name: values[order] for name, values in gaussians.items()}
    values = {
        "position": g["means"].astype(np.float64),
        "scale": np.clip(g["log_scales"].astype(np.float64), -MAX_LOG_SCALE, MAX_LOG_SCALE),
        "color": 0.5 + SH_C0 * g["sh0"][:, 0].astype(np.float64),
    }
    bounds = {name: _bounds(v) for name, v in values.items()}
    parts = {name: _parts(v, *bounds[name]) for name, v in values.items()}
    colors = np.column_stack([parts["color"], opacities_from_logits(g["logit_opacities"])])
    vertex = {
        "packed_position": _packed(parts["position"], VECTOR_BITS),
        "packed_rotation": _packed_rotations(g["quats"]),
        "packed_scale": _packed(parts["scale"], VECTOR_BITS),
        "packed_color": _packed(colors, COLOR_BITS),
    }
    chunk = np.concatenate([side for pair in bounds.values() for side in pair], axis=1)
    elements = {
        "chunk": _structured(_chunk_names(), chunk.astype("<f4")),
        "vertex": _structured(PACKED, np.column_stack([vertex[n] for n in PACKED]).astype("<u4")),
    }
    if g["shN"].shape[1]:
        elements["sh"] = _packed_harmonics(g["shN"])
    return encode_elements(elements, rendered_with)


def _packed_harmonics(sh: np.ndarray) -> np.ndarray:
    """The rows of the element; coefficient by coefficient, which takes little memory."""
    num, count, _ = sh.shape
    levels = np.empty((num, 3 * count), "u1")
    for column in range(3 * count):
        values = sh[:, column % count, column // count].astype(np.float64)
        level = np.floor((values / (2 * SH_RANGE) + 0.5) * SH_LEVELS)
        levels[:, column] = np.clip(level, 0, SH_LEVELS - 1)
    return _structured(tuple(f"f_rest_{i}" for i in range(3 * count)), levels)


def _chunk_names(colors: bool = True) -> tuple[str, ...]:
    groups = [*BOUNDED.values(), *([COLORS] if colors else [])]
    return tuple(f"{side}_{name}" for names in groups for side in ("min", "max") for name in names)


def _bounds(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smallest and largest values (C, 3) of each group of values (N, 3), as float32 has them."""
    starts = np.arange(0, len(values), CHUNK)
    sides = (limit.reduceat(values, starts, axis=0) for limit in (np.minimum, np.maximum))
    return tuple(side.astype(np.float32) for side in sides)


def _parts(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Where between the bounds of its group each value lies, from 0 to 1; (N, 3)."""
    low, high = (np.repeat(side.astype(np.float64), CHUNK, axis=0) for side in (low, high))
    low, high = low[: len(values)], high[: len(values)]
    return np.clip((values - low) / np.where(high > low, high - low, 1), 0, 1)


def _packed(parts: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Numbers from 0 to 1 (N, len(bits)) in as many bits each, the first in the highest."""
    word = np.zeros(len(parts), np.uint32)
    for column, count in enumerate(bits):
        word = word << np.uint32(count) | round_to_uint32(
            parts[:, column] * (2**count - 1), 2**count - 1
        )
    return word


def _packed_rotations(quats: np.ndarray) -> np.ndarray:
    index, others = drop_largest_component(normalize_quaternions(quats))
    parts = others / (2 * QUATERNION_RANGE) + 0.5
    return index.astype(np.uint32) << np.uint32(30) | _packed(parts, QUATERNION_BITS)


def _structured(names: tuple[str, ...], rows: np.ndarray) -> np.ndarray:
    """The columns of an array by name."""
    return np.ascontiguousarray(rows).view([(name, rows.dtype) for name in names])[:, 0]


# ----------------------------------------------------------------------------------------------
# Reading
# ----------------------------------------------------------------------------------------------


def read_gaussians(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Scalar]]:
    """Gaussians as numpy float32 arrays, and by name what its header says they are rendered with.

    As :func:`drgs.io.ply.read_gaussians` gives them; opacities of 0 and 1 are the next ones that
    sigmoids tell apart. Files without bounds of colours, as older programs write them, are read as
    well.

    Raises :class:`UserError` naming the file, the element and what it lacks.
    """
    there = properties_of(path)
    rows, statements = read_elements(path, [n for n in ("chunk", "vertex", "sh") if n in there])
    vertex = rows["vertex"]
    harmonics = 1 + len(rows["sh"].dtype.names) // 3 if "sh" in rows else 1
    needed = decoding_bytes(len(vertex), harmonics)
    require_memory(path, needed, f"a scene of {len(vertex):,} Gaussians")
    bounds = _checked_bounds(path, rows, colors="min_r" in there["chunk"])
    _check_unsigned(path, "vertex", vertex, PACKED, 4)
    group = np.arange(len(vertex)) // CHUNK
    position, scale, color = (
        _between(bounds, names, group, _unpacked(vertex[f"packed_{word}"], bits))
        for word, names, bits in (
            ("position", BOUNDED["position"], VECTOR_BITS),
            ("scale", BOUNDED["scale"], VECTOR_BITS),
            ("color", COLORS, COLOR_BITS),
        )
    )
    arrays = {
        "means": position,
        "quats": _unpacked_rotations(vertex["packed_rotation"]),
        "log_scales": scale,
        "logit_opacities": logits_from_opacities(
            _unpacked(vertex["packed_color"], COLOR_BITS)[:, 3]
        ),
        "sh0": ((color - 0.5) / SH_C0)[:, None, :],
        "shN": _harmonics(path, rows.get("sh"), len(vertex)),
    }
    with np.errstate(over="ignore"):  # harmonics are 3.5 times as large as colours
        return {n: np.ascontiguousarray(v, np.float32) for n, v in arrays.items()}, statements


def _checked_bounds(path: str | Path, rows: Mapping[str, np.ndarray], colors: bool) -> np.ndarray:
    """The rows of element ``chunk``, whose bounds are finite and in order."""
    chunk, names = rows["chunk"], _chunk_names(colors)
    expected = -(-len(rows["vertex"]) // CHUNK)
    if len(chunk) != expected:
        raise UserError(
            f"{path}: element chunk must have a row for each {CHUNK} of the "
            f"{len(rows['vertex']):,} vertices, {expected:,}, got {len(chunk):,}"
        )
    missing = [name for name in names if name not in chunk.dtype.names]
    if missing:
        raise UserError(f"{path}: element chunk: properties {', '.join(missing)} are missing")
    for name in names:
        with np.errstate(over="ignore"):  # a float64 beyond float32 becomes inf
            bad = np.flatnonzero(~np.isfinite(chunk[name].astype(np.float32)))
        if len(bad):
            raise UserError(
                f"{path}: element chunk, row {bad[0]}: {name} must be a finite float32 number, got "
                f"{chunk[name][bad[0]]}"
            )
    for high in (name for name in names if name.startswith("max_")):
        low = high.replace("max_", "min_")
        bad = np.flatnonzero(chunk[high] < chunk[low])
        if len(bad):
            raise UserError(
                f"{path}: element chunk, row {bad[0]}: {high} must not be below {low}, got "
                f"{chunk[high][bad[0]]} and {chunk[low][bad[0]]}"
            )
    return chunk


def _check_unsigned(
    path: str | Path, element: str, rows: np.ndarray, names: tuple[str, ...], width: int
) -> None:
    missing = [name for name in names if name not in rows.dtype.names]
    if missing:
        raise UserError(f"{path}: element {element}: properties {', '.join(missing)} are missing")
    for name in names:
        if (rows.dtype[name].kind, rows.dtype[name].itemsize) != ("u", width):
            raise UserError(
                f"{path}: element {element}: {name} must be an unsigned integer of {8 * width} "
                f"bits, got {rows.dtype[name].name}"
            )


def _between(
    bounds: np.ndarray, names: tuple[str, ...], group: np.ndarray, parts: np.ndarray
) -> np.ndarray:
    """Values (N, 3) float64 that lie where ``parts`` say between the bounds of their groups."""
    if f"min_{names[0]}" not in bounds.dtype.names:  # no bounds of colours: they are 0 and 1
        return parts[:, : len(names)]
    low, high = (
        np.column_stack([bounds[f"{side}_{name}"] for name in names]).astype(np.float64)[group]
        for side in ("min", "max")
    )
    parts = parts[:, : len(names)]
    return low * (1 - parts) + high * parts


def _unpacked(words: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Numbers from 0 to 1 (N, len(bits)) of words (N,): see :func:`_packed`."""
    shifts = [sum(bits[column + 1 :]) for column in range(len(bits))]
    columns = [
        (words.astype(np.uint32) >> np.uint32(shift) & np.uint32(2**count - 1)) / (2**count - 1)
        for shift, count in zip(shifts, bits, strict=True)
    ]
    return np.column_stack(columns)


def _unpacked_rotations(words: np.ndarray) -> np.ndarray:
    others = (_unpacked(words, QUATERNION_BITS) - 0.5) * (2 * QUATERNION_RANGE)
    return restore_largest_component((words >> np.uint32(30)).astype(np.intp), others)


def _harmonics(path: str | Path, sh: np.ndarray | None, num: int) -> np.ndarray:
    """Coefficients (N, K - 1, 3); sh: the rows of the element, None: there is none."""
    if sh is None:
        return np.zeros((num, 0, 3))
    names = tuple(f"f_rest_{i}" for i in range(len(sh.dtype.names)))
    if len(names) not in NUM_REST or len(sh) != num:
        raise UserError(
            f"{path}: element sh must have a row of {sorted(NUM_REST)[1:]} harmonics for each of "
            f"the {num:,} vertices, got {len(sh):,} rows of {len(names)}"
        )
    _check_unsigned(path, "sh", sh, names, 1)
    parts = (np.arange(SH_LEVELS) + 0.5) / SH_LEVELS
    parts[[0, -1]] = 0, 1
    values = ((parts - 0.5) * (2 * SH_RANGE)).astype(np.float32)
    rest = values[np.column_stack([sh[name] for name in names])]
    return rest.reshape(num, 3, -1).transpose(0, 2, 1)


@FORMATS.register("compressed-ply")
class CompressedPly(FileFormat):
    """PlayCanvas's compressed PLY."""

    suffix = ".compressed.ply"
    description = "PlayCanvas's compressed PLY, for SuperSplat and PlayCanvas"
    metadata = None
    read = staticmethod(read_gaussians)
    encode = staticmethod(encode)

    def recognizes(self, path: Path) -> bool:
        """Return whether the vertices are packed."""
        return has_packed_vertices(path)
