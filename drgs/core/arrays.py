"""Dr.Jit types that belong together, and row access to flat arrays.

Every stage is written once for all array types (float32 and float64, LLVM and CUDA): it asks this
module for the companions of the float type that it was given. Therefore arrays are ``Any`` in
signatures; a comment says which type it is (Float, Array3f, ...), and of what shape and unit.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import numpy as np


@dataclass(frozen=True)
class ArrayTypes:
    """The Dr.Jit types of one backend and one floating point precision."""

    Float: type
    UInt32: type
    UInt64: type
    Int32: type
    Bool: type
    Array2f: type
    Array3f: type
    Array4f: type
    Array2u: type
    Array4u: type
    Matrix3f: type
    TensorXf: type


@cache
def types_of(float_type: type) -> ArrayTypes:
    """Companions of a flat Dr.Jit array type such as ``drjit.llvm.ad.Float`` or ``UInt32``."""
    module = sys.modules[float_type.__module__]
    if not dr.is_float_v(float_type):
        float_type = module.Float
    suffix = "64" if dr.type_v(float_type) == dr.VarType.Float64 else ""
    return ArrayTypes(
        Float=float_type,
        UInt32=module.UInt32,
        UInt64=module.UInt64,
        Int32=module.Int32,
        Bool=module.Bool,
        Array2f=getattr(module, "Array2f" + suffix),
        Array3f=getattr(module, "Array3f" + suffix),
        Array4f=getattr(module, "Array4f" + suffix),
        Array2u=module.Array2u,
        Array4u=module.Array4u,
        Matrix3f=getattr(module, "Matrix3f" + suffix),
        TensorXf=getattr(module, "TensorXf" + suffix),
    )


def is_float64(float_type: type) -> bool:
    """Whether ``float_type`` is a double precision array."""
    return dr.type_v(float_type) == dr.VarType.Float64


def from_host(flat_type: type, values: Any) -> Any:
    """A copy of numbers of the host, aligned as Dr.Jit's own memory is.

    Dr.Jit wraps numpy's memory on the CPU, and loads from memory that is not aligned are another
    kernel: whether one has to be compiled would depend on where numpy put the numbers.
    """
    values = np.asarray(values, dtype=_NUMPY_TYPES[dr.type_v(flat_type)]).ravel()
    storage = np.empty(values.nbytes + _ALIGNMENT, np.uint8)
    start = -storage.ctypes.data % _ALIGNMENT
    aligned = storage[start : start + values.nbytes].view(values.dtype)
    aligned[:] = values
    return flat_type(aligned)


_ALIGNMENT = 64
"""Bytes: what the widest vectors ask for."""

_NUMPY_TYPES = {
    dr.VarType.Float32: np.float32,
    dr.VarType.Float64: np.float64,
    dr.VarType.UInt32: np.uint32,
}


def quotient(index: Any, divisor: int) -> Any:
    """index // divisor, UInt32, by a divisor below 2^19 that is not compiled into the kernel.

    No machine divides vectors of integers. The product in double precision is off by less than
    2^-52 of itself, and (index + 1/2) / divisor is at least 1 / (2 divisor) from an integer.
    """
    Float64 = dr.float64_array_t(type(index))
    reciprocal = dr.opaque(Float64, 1 / divisor)
    return type(index)((Float64(index) + 0.5) * reciprocal)


def interleave(columns: list[Any]) -> Any:
    """Columns of equal length as one row-major flat array, not evaluated.

    Loop results must be evaluated before: storing them unevaluated runs the loop once more for
    each column.
    """
    num_rows = dr.width(columns)
    return scatter_rows(columns, dr.arange(types_of(type(columns[0])).UInt32, num_rows), num_rows)


def scatter_rows(columns: list[Any], rows: Any, num_rows: int) -> Any:
    """Columns as one row-major flat array of ``num_rows`` rows; lane i fills row ``rows[i]``.

    Rows that no lane fills are undefined; no two lanes may fill the same row. The same holds
    for loop results as in :func:`interleave`.
    """
    flat = dr.empty(type(columns[0]), num_rows * len(columns))
    dr.scatter(flat, _dynamic_vector(columns), rows)
    return flat


PACKET = 4
"""Numbers that a lane loads at once: such a load costs about as much as one of a single number."""


def pack_rows(columns: Sequence[Any]) -> Any:
    """Columns of equal length as rows that fill whole packets, flat, not evaluated."""
    padding = dr.zeros(type(columns[0]), dr.width(columns[0]))
    return interleave([*columns, *[padding] * (-len(columns) % PACKET)])


def load_row(
    rows: Any, width: int, row: Any, active: Any = True, *, start: int = 0, end: int | None = None
) -> list[Any]:
    """Numbers ``start`` to ``end`` (None: all) of a row a lane of what :func:`pack_rows` made.

    width: of the rows; start: where a packet begins. 0 if not active.
    """
    end = width if end is None else end
    packet, stride = types_of(type(rows)).Array4f, -(-width // PACKET)
    packets = range(start // PACKET, -(-end // PACKET))
    loaded = [dr.gather(packet, rows, row * stride + k, active) for k in packets]
    return [number for packet in loaded for number in packet][: end - start]


def empty_rows(float_type: type, width: int, num_rows: int) -> Any:
    """Memory, not initialised, for rows of ``width`` numbers."""
    return dr.empty(float_type, num_rows * -(-width // PACKET) * PACKET)


def store_row(rows: Any, numbers: Sequence[Any], row: Any, active: Any = True) -> None:
    """Fill one row a lane of what :func:`empty_rows` made; no two lanes may fill the same."""
    t = types_of(type(rows))
    padded = [*numbers, *[t.Float(0)] * (-len(numbers) % PACKET)]
    packets = len(padded) // PACKET
    for k in range(packets):
        packet = t.Array4f(padded[PACKET * k : PACKET * (k + 1)])
        dr.scatter(rows, packet, row * packets + k, active)


def _dynamic_vector(columns: list[Any]) -> Any:
    flat_type = type(columns[0])
    module = sys.modules[flat_type.__module__]
    return getattr(module, _VECTORS[dr.type_v(flat_type)])(columns)


_VECTORS = {
    dr.VarType.Float32: "ArrayXf",
    dr.VarType.Float64: "ArrayXf64",
    dr.VarType.UInt32: "ArrayXu",
}


def planes_of(image: Any) -> list[Any]:
    """The channels of a tensor (H, W, C), each Float (H * W,), detached."""
    flat, count = dr.detach(image).array, image.shape[2]
    pixel = dr.arange(types_of(type(flat)).UInt32, image.shape[0] * image.shape[1])
    return [dr.gather(type(flat), flat, pixel * count + k) for k in range(count)]


def image_of(planes: list[Any], like: Any) -> Any:
    """The tensor (H, W, C) of these channels; like: an image of H x W pixels."""
    return type(like)(interleave(planes), (*like.shape[:2], len(planes)))
