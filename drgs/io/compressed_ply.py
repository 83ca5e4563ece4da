"""Compressed PLY files of PlayCanvas: 16 bytes per Gaussian, and 45 for harmonics of degree 3.

As SuperSplat and splat-transform write and read them ("Compressed PLY" in PlayCanvas's manual).
Gaussians stand in groups of 256 that are near each other. The element ``chunk`` has the smallest
and the largest position, logarithm of scale and base colour of each group; in the element
``vertex``, four whole numbers of 32 bits specify where between them a Gaussian lies:

- ``packed_position``, ``packed_scale``: x, y, z in 11, 10 and 11 bits;
- ``packed_color``: red, green, blue and opacity in 8 bits each;
- ``packed_rotation``: the index of the quaternion's largest component, of wxyz, in 2 bits, then the
  others in 10 bits each, from -1/sqrt(2) to 1/sqrt(2).

The element ``sh`` has the harmonics above degree 0, in the order of the 3DGS reference, in steps of
1/32 from -4 to 4; others are clamped. Comments are those of :mod:`drgs.io.ply`.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from typing_extensions import override

from drgs.core.errors import UserError
from drgs.io.formats import FORMATS, PLAYCANVAS, Arrays, FileFormat, Scalar
from drgs.io.ply import NUM_REST, encode_elements, has_packed_vertices, read_elements
from drgs.io.quantization import (
    colors_from_sh0,
    drop_largest_component,
    logits_from_opacities,
    morton_order,
    normalize_quaternions,
    opacities_from_logits,
    require_scene_memory,
    restore_largest_component,
    round_to_uint32,
    sh0_from_colors,
)

CHUNK = 256  # gaussians in a group; the last one may have fewer

BITS = {
    "packed_position": (11, 10, 11),
    "packed_rotation": (2, 10, 10, 10),
    "packed_scale": (11, 10, 11),
    "packed_color": (8, 8, 8, 8),
}
"""Bits of the numbers in each word, the first in the highest."""

BOUNDED = {
    "packed_position": ("x", "y", "z"),
    "packed_scale": ("scale_x", "scale_y", "scale_z"),
    "packed_color": ("r", "g", "b"),
}
"""Names with bounds in ``chunk``, by word."""

QUATERNION_RANGE = 1 / np.sqrt(2)  # no component but the largest is beyond it
SH_RANGE = 4.0
SH_LEVELS = 256

MAX_LOG_SCALE = 20.0  # PlayCanvas's limit: viewers compute with its exponential


@FORMATS.register("compressed-ply")
class CompressedPly(FileFormat):
    """PlayCanvas's compressed PLY."""

    suffix = ".compressed.ply"
    description = "PlayCanvas's compressed PLY, for SuperSplat and PlayCanvas"
    metadata = None
    shown_with = PLAYCANVAS
    ranges = MappingProxyType(
        {"shN": (-SH_RANGE, SH_RANGE), "log_scales": (-MAX_LOG_SCALE, MAX_LOG_SCALE)}
    )

    @override
    def read(self, path: Path) -> tuple[Arrays, Mapping[str, Scalar]]:
        """Return Gaussians and header values, also of older files without bounds of colours."""
        rows, statements = read_elements(path, ["chunk", "vertex", "sh"])
        vertex, chunk, sh = rows["vertex"], rows["chunk"], rows.get("sh")
        harmonics = 1 if sh is None else 1 + len(sh.dtype.names or ()) // 3
        require_scene_memory(path, len(vertex), harmonics)
        _require(path, "vertex", vertex, BITS, "u4")
        if len(chunk) != (expected := -(-len(vertex) // CHUNK)):
            raise UserError(
                f"{path}: element chunk must have a row for each {CHUNK} of the {len(vertex):,} "
                f"vertices, {expected:,}, got {len(chunk):,}"
            )
        rotation = _unpack_words(vertex, "packed_rotation")
        largest = np.round(3 * rotation[:, 0]).astype(np.intp)
        others = (rotation[:, 1:] - 0.5) * (2 * QUATERNION_RANGE)
        arrays = {
            "means": _dequantize(path, rows, "packed_position"),
            "quats": restore_largest_component(largest, others).astype(np.float32),
            "log_scales": _dequantize(path, rows, "packed_scale"),
            "logit_opacities": logits_from_opacities(_unpack_words(vertex, "packed_color")[:, 3]),
            "sh0": sh0_from_colors(_dequantize(path, rows, "packed_color")),
            "shN": _harmonics(path, sh, len(vertex)),
        }
        return arrays, statements

    @override
    def encode(self, gaussians: Arrays, rendered_with: Mapping[str, Scalar]) -> bytes:
        """Return a file of the Gaussians in Morton order."""
        order = morton_order(gaussians["means"])
        g = {name: values[order] for name, values in gaussians.items()}
        log_scales = g["log_scales"].astype(np.float64)
        values = {
            "packed_position": g["means"].astype(np.float64),
            "packed_scale": np.clip(log_scales, -MAX_LOG_SCALE, MAX_LOG_SCALE),
            "packed_color": colors_from_sh0(g["sh0"]),
        }
        starts = np.arange(0, len(order), CHUNK)  # of groups; their bounds are (C, 3) float32
        ends = np.minimum.reduceat, np.maximum.reduceat
        bounds = {k: [end(v, starts).astype("<f4") for end in ends] for k, v in values.items()}
        parts = {name: _parts(v, *bounds[name]) for name, v in values.items()}
        opacities = opacities_from_logits(g["logit_opacities"])
        parts["packed_color"] = np.column_stack([parts["packed_color"], opacities])
        index, others = drop_largest_component(normalize_quaternions(g["quats"]))
        others = others / (2 * QUATERNION_RANGE) + 0.5
        parts["packed_rotation"] = np.column_stack([index / 3, others])
        words = np.column_stack([_pack_words(parts[name], bits) for name, bits in BITS.items()])
        chunk = np.concatenate([side for pair in bounds.values() for side in pair], axis=1)
        names = [f"{s}_{n}" for names in BOUNDED.values() for s in ("min", "max") for n in names]
        elements = {
            "chunk": _structured_array(names, chunk),
            "vertex": _structured_array(list(BITS), words),
        }
        if g["shN"].shape[1]:
            elements["sh"] = _packed_harmonics(g["shN"])
        return encode_elements(elements, rendered_with)

    @override
    def recognizes(self, path: Path) -> bool:
        return has_packed_vertices(path)


def _packed_harmonics(sh: np.ndarray) -> np.ndarray:
    """Return the rows of the element; coefficient by coefficient, which takes little memory."""
    num, count, _ = sh.shape
    levels = np.empty((num, 3 * count), "u1")
    for column in range(3 * count):
        values = sh[:, column % count, column // count].astype(np.float64)
        level = np.floor((values / (2 * SH_RANGE) + 0.5) * SH_LEVELS)
        levels[:, column] = np.clip(level, 0, SH_LEVELS - 1)
    return _structured_array([f"f_rest_{i}" for i in range(3 * count)], levels)


def _parts(values: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Return each value relative to the bounds of its group, from 0 to 1; (N, 3)."""
    low, high = (np.repeat(side.astype(np.float64), CHUNK, axis=0) for side in (low, high))
    low, high = low[: len(values)], high[: len(values)]
    return np.clip((values - low) / np.where(high > low, high - low, 1), 0, 1)


def _pack_words(parts: np.ndarray, bits: tuple[int, ...]) -> np.ndarray:
    """Return words (N,) of numbers from 0 to 1 (N, len(bits))."""
    word = np.zeros(len(parts), "<u4")
    for column, count in enumerate(bits):
        largest = 2**count - 1
        word = word << np.uint32(count) | round_to_uint32(parts[:, column] * largest, largest)
    return word


def _structured_array(names: list[str], rows: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(rows).view([(name, rows.dtype) for name in names])[:, 0]


def _require(
    path: str | Path, element: str, rows: np.ndarray, names: Mapping | list[str], kind: str
) -> None:
    types = {name: rows.dtype[name].newbyteorder("<").str[1:] for name in rows.dtype.names or ()}
    if wrong := [name for name in names if types.get(name) != kind]:
        raise UserError(
            f"{path}: element {element}: properties {', '.join(wrong)} must be there, in the type "
            f"{np.dtype(kind).name}"
        )


def _dequantize(path: str | Path, rows: Mapping[str, np.ndarray], word: str) -> np.ndarray:
    """Return the values (N, 3) of a word, between the bounds of their groups."""
    names, chunk = BOUNDED[word], rows["chunk"]
    parts = _unpack_words(rows["vertex"], word)[:, :3]
    if word == "packed_color" and "min_r" not in (chunk.dtype.names or ()):
        return parts
    _require(path, "chunk", chunk, [f"{s}_{n}" for s in ("min", "max") for n in names], "f4")
    low = np.column_stack([chunk[f"min_{name}"] for name in names]).astype(np.float64)
    high = np.column_stack([chunk[f"max_{name}"] for name in names]).astype(np.float64)
    bad = np.argwhere(~(low <= high))
    if len(bad):
        row, axis = bad[0]
        raise UserError(
            f"{path}: element chunk, row {row}: max_{names[axis]} must not be below "
            f"min_{names[axis]}, got {high[row, axis]} and {low[row, axis]}"
        )
    group = np.arange(len(parts)) // CHUNK
    with np.errstate(invalid="ignore"):  # of infinite bounds, which are refused later
        return low[group] * (1 - parts) + high[group] * parts


def _unpack_words(vertex: np.ndarray, word: str) -> np.ndarray:
    """Return the numbers from 0 to 1 (N, len(bits)) of a word: see :func:`_pack_words`."""
    words, bits = vertex[word].astype(np.uint32), BITS[word]
    shifts = [sum(bits[column + 1 :]) for column in range(len(bits))]
    columns = [
        (words >> np.uint32(shift) & np.uint32(2**count - 1)) / (2**count - 1)
        for shift, count in zip(shifts, bits, strict=True)
    ]
    return np.column_stack(columns)


def _harmonics(path: str | Path, sh: np.ndarray | None, num: int) -> np.ndarray:
    """Return coefficients (N, K - 1, 3); sh: the rows of the element, None: there is none."""
    if sh is None:
        return np.zeros((num, 0, 3))
    names = [f"f_rest_{i}" for i in range(len(sh.dtype.names or ()))]
    if len(names) not in NUM_REST or len(sh) != num:
        raise UserError(
            f"{path}: element sh must have a row of {list(NUM_REST[1:])} harmonics for each of "
            f"the {num:,} vertices, got {len(sh):,} rows of {len(names)}"
        )
    _require(path, "sh", sh, names, "u1")
    parts = (np.arange(SH_LEVELS) + 0.5) / SH_LEVELS
    parts[[0, -1]] = 0, 1
    values = ((parts - 0.5) * (2 * SH_RANGE)).astype(np.float32)
    rest = values[np.column_stack([sh[name] for name in names])]
    return rest.reshape(num, 3, -1).transpose(0, 2, 1)
