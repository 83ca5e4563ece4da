"""Dr.Jit types that belong together, and row access to flat arrays.

Every stage is written once for all array types (float32 and float64, LLVM and CUDA): it asks this
module for the companions of the float type that it was given. Therefore arrays are ``Any`` in
signatures; a comment says which type it is (Float, Array3f, ...), and of what shape and unit.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar

import drjit as dr
import numpy as np

from drgs.core import types

T = TypeVar("T")


@dataclass(frozen=True)
class ArrayTypes:
    """The Dr.Jit types of one backend and one floating point precision."""

    Float: type[types.Float]
    UInt32: type[types.UInt32]
    UInt64: type[types.UInt64]
    Int32: type[types.Int32]
    Bool: type[types.Bool]
    Array2f: type[types.Array2f]
    Array3f: type[types.Array3f]
    Array4f: type[types.Array4f]
    Array2u: type[types.Array2u]
    Array4u: type[types.Array4u]
    Matrix3f: type[types.Matrix3f]
    TensorXf: type[types.TensorXf]


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


def reinterpret(dtype: type[T], value: dr.ArrayBase) -> T:
    """Return the same bits as another type of the same size."""
    return dr.reinterpret_array(dtype, value)


def from_host(flat_type: type, values: Any) -> Any:
    """A copy of numbers of the host, aligned as Dr.Jit's own memory is.

    Dr.Jit wraps numpy's memory on the CPU, and loads from memory that is not aligned are another
    kernel: whether one has to be compiled would depend on where numpy put the numbers.
    """
    values = np.asarray(values, dtype=_NUMPY_TYPES[dr.type_v(flat_type)])
    aligned = empty_on_host(flat_type, (values.size,))
    aligned[:] = values.ravel()
    return flat_type(aligned)


def empty_on_host(flat_type: type, shape: tuple[int, ...]) -> np.ndarray:
    """Memory of the host for numbers of this type, not initialised, aligned as Dr.Jit's own is."""
    dtype = np.dtype(_NUMPY_TYPES[dr.type_v(flat_type)])
    size = math.prod(shape) * dtype.itemsize
    storage = np.empty(size + _ALIGNMENT, np.uint8)
    start = -storage.ctypes.data % _ALIGNMENT
    return storage[start : start + size].view(dtype).reshape(shape)


def wrapped(flat_type: type, values: np.ndarray) -> Any:
    """An array of these numbers, which Dr.Jit does not copy on the CPU: nobody may change them.

    values: from :func:`empty_on_host`.
    """
    return flat_type(values.reshape(-1))


_ALIGNMENT = 64
"""Bytes: what the widest vectors ask for."""

_NUMPY_TYPES = {
    dr.VarType.Float32: np.float32,
    dr.VarType.Float64: np.float64,
    dr.VarType.UInt32: np.uint32,
}


def quotient(index: Any, divisor: int) -> Any:
    """index // divisor, UInt32, by a divisor that is not compiled into the kernel.

    No machine divides vectors of integers. The product in double precision is off by less than
    2^-52 of itself, hence by less than 2^-20 / divisor, and (index + 1/2) / divisor is at least
    1 / (2 divisor) from an integer.
    """
    Float64 = dr.float64_array_t(type(index))
    reciprocal = dr.opaque(Float64, 1 / divisor)
    return type(index)((Float64(index) + 0.5) * reciprocal)


def divide(index: Any, divisor: int, parts: int) -> tuple[Any, Any]:
    """index // divisor, which is below ``parts``, and the rest; literal zeros of a single part.

    Those make later products and sums vanish from the kernel.
    """
    if parts == 1:
        return type(index)(0), index
    part = quotient(index, divisor)
    return part, index - part * dr.opaque(type(index), divisor)


def repeat_array(values: Any, count: int, step: int = 0) -> Any:
    """``count`` copies of an array, each by ``step`` more than the one before it.

    Not evaluated, if there are several.
    """
    if count == 1:
        return values
    UInt32, size = types_of(type(values)).UInt32, dr.width(values)
    part, index = divide(dr.arange(UInt32, count * size), size, count)
    copies = dr.gather(type(values), values, index)
    return copies + part * dr.opaque(UInt32, step) if step else copies


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


@dataclass(frozen=True)
class Rows:
    """Rows of numbers such that a lane loads or stores several of them at once, in packets.

    A packet of 8 numbers costs a lane less than two of 4, and these less than four of 2; and what
    is not stored need not come from memory. Rows of 9 are therefore stored as an array of packets
    of 8 and one of single numbers, where they are read in order.
    """

    blocks: tuple[Any, ...]  # flat, row-major: the next columns of all rows
    width: int  # numbers in a row, without padding

    @property
    def Float(self) -> type:  # noqa: N802 (it is a type)
        """That of the numbers."""
        return type(self.blocks[0])

    @staticmethod
    def empty(float_type: type, width: int, num_rows: int) -> Rows:
        """Memory, not initialised."""
        blocks = tuple(dr.empty(float_type, num_rows * each) for each in block_widths(width))
        return Rows(blocks, width)

    @staticmethod
    def of(columns: Sequence[Any]) -> Rows:
        """Columns of equal length, not evaluated."""
        num_rows = dr.width(columns[0])
        rows = Rows.empty(type(columns[0]), len(columns), num_rows)
        rows.store(columns, dr.arange(types_of(rows.Float).UInt32, num_rows))
        return rows

    def load(self, row: Any, active: Any = True) -> list[Any]:
        """The numbers of a row a lane; 0 if not active."""
        numbers, lanes, vector = [], dr.width(row), _dynamic_type(self.Float)
        for block, width in zip(self.blocks, block_widths(self.width), strict=True):
            numbers.extend(dr.gather(vector, block, row, active, shape=(width, lanes)))
        return numbers[: self.width]

    def store(self, numbers: Sequence[Any], row: Any, active: Any = True) -> None:
        """Fill one row a lane; no two lanes may fill the same."""
        padding, start = [type(numbers[0])(0)] * 3, 0
        for block, width in zip(self.blocks, block_widths(self.width), strict=True):
            columns = [*numbers, *padding][start : start + width]
            dr.scatter(block, _dynamic_vector(columns), row, active)
            start += width


def block_widths(width: int) -> tuple[int, ...]:
    """How many numbers of a row each block of :class:`Rows` has: whole packets, of 8 if possible.

    Three numbers are a packet of 4.
    """
    rest = width % 8 + (width % 8 in (3, 7))
    widths = (width // 8 * 8, *(rest & packet for packet in (8, 4, 2, 1)))
    return tuple(each for each in widths if each)


PACKET = 4
"""Numbers in a packet of rows that are back to back."""


def load_columns(flat: Any, row: Any, num_rows: Any, stride: int, width: int) -> list[Any]:
    """The first ``width`` numbers of a row a lane, of rows of ``stride`` numbers back to back.

    row: UInt32; num_rows: UInt32 (1,), evaluated, how many rows ``flat`` has.

    Such rows begin anywhere in a packet: all packets that a row has part in are loaded, and its
    numbers are moved to their places. That takes less than half the time of single loads.
    """
    whole = (dr.width(flat) - 1) // PACKET
    if whole == 0 or width < PACKET:
        return [dr.gather(type(flat), flat, row * stride + k) for k in range(width)]
    if stride % PACKET == 0:
        return _load_packets(flat, row * (stride // PACKET), width)
    packets = _Packets(flat, first_numbers(flat, whole * PACKET), num_rows * stride)
    begin, shift = row * stride // PACKET, row * stride % PACKET
    always_whole = (stride - 1) // PACKET  # so many packets of a row, wherever it begins
    numbers: list[Any] = []
    for k in range(-(-(width + PACKET - 1) // PACKET)):
        numbers.extend((packets.load if k < always_whole else packets.load_last)(begin + k))
    for step in (1, 2):
        moves = (shift & step) != 0
        numbers = [dr.select(moves, b, a) for a, b in zip(numbers, numbers[step:], strict=False)]
    return numbers[:width]


def store_columns(columns: Sequence[Any]) -> Any:
    """The same as :func:`interleave`, in a third of the time where there are many columns.

    Packets that a row fills alone are stored as such, what is left at its ends number by number.
    The array may have up to three numbers more, undefined, for its last packet to be whole:
    :func:`first_numbers` leaves them out once it is evaluated.
    """
    columns, flat_type = list(columns), type(columns[0])
    width, num_rows = len(columns), dr.width(columns)
    if width % PACKET == 0 or width < 2 * PACKET:
        return interleave(columns)
    size = num_rows * width
    flat = dr.empty(flat_type, -(-size // PACKET) * PACKET)
    _store_shifted(flat, columns)
    return flat


def first_numbers(flat: Any, size: int) -> Any:
    """The first ``size`` numbers of an evaluated array: the same memory."""
    return dr.reshape(type(flat), flat, size, shrink=True)


def _store_shifted(flat: Any, columns: list[Any]) -> None:
    """Store a row a lane, each of which begins where the last one ends."""
    t, width = types_of(type(flat)), len(columns)
    first = dr.arange(t.UInt32, dr.width(columns)) * width
    begin, shift = first // PACKET, first % PACKET
    zero = t.Float(0)
    # Else each of several scatters into one array runs the kernel once more.
    alone = dr.ReduceMode.NoConflicts
    numbers = [*columns, *[zero] * PACKET]  # from the begin of the first packet on
    for step in (1, 2):
        moves = (shift & step) != 0
        shifted = [*[zero] * step, *numbers]
        numbers = [dr.select(moves, a, b) for a, b in zip(shifted, numbers, strict=False)]
    end = shift + width
    for k in range(len(numbers) // PACKET):
        is_own = (end >= PACKET * (k + 1)) & ((shift == 0) | (k > 0))
        packet = t.Array4f(numbers[PACKET * k : PACKET * (k + 1)])
        dr.scatter(flat, packet, begin + k, is_own, mode=alone)
    for k in range(1, PACKET):
        is_own = (shift != 0) & (shift <= k)
        dr.scatter(flat, numbers[k], begin * PACKET + k, is_own, mode=alone)
    last = end // PACKET * PACKET  # where the packet begins that the next row fills up
    for k in range(width - PACKET + 1, width + PACKET - 1):
        is_own = (last <= k) & (k < end)
        dr.scatter(flat, numbers[k], begin * PACKET + k, is_own, mode=alone)


def _load_packets(flat: Any, index: Any, width: int) -> list[Any]:
    """``width`` numbers a lane of rows that are whole packets."""
    packet = types_of(type(flat)).Array4f
    packets = [dr.gather(packet, flat, index + k) for k in range(-(-width // PACKET))]
    return [number for each in packets for number in each][:width]


@dataclass(frozen=True)
class _Packets:
    """An array of any size as packets, the last of which may be a part of one.

    Dr.Jit loads packets from arrays alone that are whole packets. The last one is loaded number by
    number at any size, which is no literal: neither the size nor its remainder is in a kernel.
    """

    flat: Any
    others: Any  # the same memory without the last packet
    size: Any  # UInt32 (1,), of ``flat``

    def load(self, index: Any) -> list[Any]:
        """A whole packet a lane."""
        return list(dr.gather(types_of(type(self.flat)).Array4f, self.others, index))

    def load_last(self, index: Any) -> list[Any]:
        """Any packet a lane; numbers beyond the array are not defined."""
        last = (self.size - 1) // PACKET
        packet = dr.gather(types_of(type(self.flat)).Array4f, self.others, index, index < last)
        for k in range(PACKET):
            number = index * PACKET + k
            is_there = (index == last) & (number < self.size)
            single = dr.gather(type(self.flat), self.flat, number, is_there)
            packet[k] = dr.select(is_there, single, packet[k])
        return list(packet)


def with_aligned_stack(value: Any) -> Any:
    """``value``, evaluated nowhere; kernels that need it keep what registers do not hold aligned.

    LLVM aligns a function's stack as its variables ask for, but not for vectors that it puts there
    when it runs out of registers: such a vector lies in two cache lines. Here the value goes by way
    of a variable on the stack: written and read at places that are the same, which only we know.
    """
    UInt32 = types_of(type(value)).UInt32
    variable = dr.alloc_local(type(value), 2)
    variable[dr.opaque(UInt32, 0)] = value
    return variable[dr.opaque(UInt32, 0)]


def _dynamic_vector(columns: list[Any]) -> Any:
    return _dynamic_type(type(columns[0]))(columns)


def _dynamic_type(flat_type: type) -> type:
    return getattr(sys.modules[flat_type.__module__], _VECTORS[dr.type_v(flat_type)])


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


def tangent_of(parameter: Any) -> Any:
    """Return the gradient set on a parameter; an empty one's own, as dr.grad drops its shape."""
    return dr.grad(parameter) if dr.width(parameter) > 0 else parameter
