"""Dr.Jit types of a backend and precision, and row access to flat arrays.

Every stage is written once for all array types (float32 and float64, LLVM and CUDA).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import dataclass, fields
from functools import cache
from typing import Generic, TypeVar, cast

import drjit as dr
import numpy as np
from numpy.typing import ArrayLike

from drgs.core import types
from drgs.core.private import access_all_lanes
from drgs.core.types import Bool, Float, UInt32

Array = TypeVar("Array", bound=dr.ArrayBase)


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
    """Return the companions of a flat array type such as ``drjit.llvm.ad.Float`` or ``UInt32``."""
    module = sys.modules[float_type.__module__]
    if not dr.is_float_v(float_type):
        float_type = module.Float
    suffix = "64" if is_float64(float_type) else ""
    names = [field.name for field in fields(ArrayTypes)]
    types = {n: getattr(module, n + suffix if n.endswith("f") else n) for n in names}
    return ArrayTypes(**types | {"Float": float_type})


def is_float64(float_type: type) -> bool:
    """Return whether ``float_type`` is a double precision array."""
    return dr.type_v(float_type) == dr.VarType.Float64


def reinterpret(dtype: type[Array], value: dr.ArrayBase) -> Array:
    """Return the same bits as another type of the same size."""
    return cast(Array, dr.reinterpret_array(dtype, value))


def from_host(flat_type: type[Array], values: ArrayLike) -> Array:
    """Copy numbers of the host to aligned memory.

    Dr.Jit wraps numpy's memory on the CPU, and compiles another kernel for unaligned loads.
    """
    values = np.asarray(values, dtype=_NUMPY_TYPES[dr.type_v(flat_type)])
    aligned = empty_on_host(flat_type, (values.size,))
    aligned[:] = values.ravel()
    return flat_type(aligned)


def real_numbers(where: str, name: str, value: object) -> np.ndarray:
    """Return an array that is none of Dr.Jit's; TypeError unless its numbers are real."""
    with suppress(ValueError):  # rows of different lengths
        if (values := np.asarray(value)).dtype.kind in "biuf":
            return values
    raise TypeError(f"{where}: {name} must be an array of real numbers, got {value!r:.80}")


def empty_on_host(flat_type: type, shape: tuple[int, ...]) -> np.ndarray:
    """Allocate memory of the host for numbers, not initialised, aligned as Dr.Jit's own is."""
    dtype = np.dtype(_NUMPY_TYPES[dr.type_v(flat_type)])
    size = math.prod(shape) * dtype.itemsize
    storage = np.empty(size + _ALIGNMENT, np.uint8)
    start = -storage.ctypes.data % _ALIGNMENT
    return storage[start : start + size].view(dtype).reshape(shape)


def wrap_numpy(flat_type: type[Array], values: np.ndarray) -> Array:
    """Return an array that shares, on the CPU, the memory of values from :func:`empty_on_host`."""
    return flat_type(values.reshape(-1))


_ALIGNMENT = 64  # bytes, of the widest vectors

_NUMPY_TYPES = {
    dr.VarType.Float32: np.float32,
    dr.VarType.Float64: np.float64,
    dr.VarType.UInt32: np.uint32,
}


def quotient(index: Array, divisor: int) -> Array:
    """Return index // divisor, by a divisor that is not compiled into the kernel.

    The product in double precision is off by less than 2^-52 of itself, hence by less than
    2^-20 / divisor, and (index + 1/2) / divisor is at least 1 / (2 divisor) from an integer.
    """
    Float64 = cast(type[Float], dr.float64_array_t(type(index)))
    reciprocal = dr.opaque(Float64, 1 / divisor)
    return type(index)((Float64(index) + 0.5) * reciprocal)


def divide(index: Array, divisor: int, parts: int) -> tuple[Array, Array]:
    """Return index // divisor, below ``parts``, and the rest; for one part a literal zero."""
    if parts == 1:
        return type(index)(0), index
    part = quotient(index, divisor)
    return part, index - part * dr.opaque(type(index), divisor)


def repeat_array(values: Array, count: int, step: int = 0) -> Array:
    """Return ``count`` copies of an array, each by ``step`` more than the one before it."""
    if count == 1:
        return values
    UInt32, size = types_of(type(values)).UInt32, dr.width(values)
    part, index = divide(dr.arange(UInt32, count * size), size, count)
    copies = dr.gather(type(values), values, index)
    return copies + part * dr.opaque(UInt32, step) if step else copies


def existing_lanes(index_type: type[Array], count: int) -> Array:
    """Return 0 .. count - 1, and the last number again on lanes that only fill up a vector.

    count: at least 1.
    """
    return dr.minimum(dr.arange(index_type, count), dr.opaque(index_type, count - 1))


def store_in_all_lanes(array_type: type[dr.ArrayBase], num_rows: int) -> AbstractContextManager:
    """Let lanes that only fill up a vector store rows, too, behind the others: without a branch.

    A single row is stored by its lane alone: Dr.Jit takes the number of its lane for a constant.
    """
    return access_all_lanes(array_type) if num_rows > 1 else nullcontext()


def interleave(columns: Sequence[Array]) -> Array:
    """Return columns of equal length as one row-major flat array, not evaluated.

    Unevaluated loop results would run the loop once for each column.
    """
    num_rows = dr.width(columns)
    return scatter_rows(columns, dr.arange(types_of(type(columns[0])).UInt32, num_rows), num_rows)


def scatter_rows(columns: Sequence[Array], rows: UInt32, num_rows: int) -> Array:
    """Store columns as one row-major flat array of ``num_rows`` rows; lane i fills row ``rows[i]``.

    Rows that no lane fills are undefined; no two lanes may fill the same row. Loop results: see
    :func:`interleave`.
    """
    flat = dr.empty(type(columns[0]), num_rows * len(columns))
    dr.scatter(flat, _dynamic_vector(columns), rows)
    return flat


@dataclass(frozen=True)
class Rows:
    """Rows of numbers in packets of a power of two: 9 are an array of packets of 8, and one of 1.

    A packet of 8 numbers costs less than two of 4, and these less than four of 2.
    """

    blocks: tuple[types.Float, ...]  # flat, row-major: the next columns of all rows
    width: int  # numbers in a row, without padding

    @property
    def Float(self) -> type[types.Float]:  # noqa: N802 (it is a type)
        """Type of the numbers."""
        return type(self.blocks[0])

    @staticmethod
    def empty(float_type: type[types.Float], width: int, num_rows: int) -> Rows:
        """Allocate rows, not initialised."""
        blocks = tuple(dr.empty(float_type, num_rows * each) for each in block_widths(width))
        return Rows(blocks, width)

    @staticmethod
    def from_columns(columns: Sequence[types.Float]) -> Rows:
        """Return columns of equal length, not evaluated; undefined rows may follow."""
        num_rows = dr.width(columns[0])
        rows = Rows.empty(type(columns[0]), len(columns), num_rows + MAX_LANES)
        with store_in_all_lanes(rows.Float, num_rows):
            rows.store(columns, dr.arange(types_of(rows.Float).UInt32, num_rows))
        return rows

    def first(self, num_rows: int) -> Rows:
        """Return the first of these rows, which are evaluated: the same memory."""
        widths = zip(self.blocks, block_widths(self.width), strict=True)
        return Rows(tuple(first_numbers(block, num_rows * k) for block, k in widths), self.width)

    def load(self, row: UInt32, active: Bool | bool = True) -> list[types.Float]:
        """Return the numbers of a row a lane; 0 if not active."""
        numbers: list[types.Float] = []
        lanes, vector = dr.width(row), _dynamic_type(self.Float)
        for block, width in zip(self.blocks, block_widths(self.width), strict=True):
            numbers.extend(dr.gather(vector, block, row, active, shape=(width, lanes)))
        return numbers[: self.width]

    def store(
        self, numbers: Sequence[types.Float], row: UInt32, active: Bool | bool = True
    ) -> None:
        """Fill one row a lane; no two lanes may fill the same."""
        padding, start = [type(numbers[0])(0)] * 3, 0
        for block, width in zip(self.blocks, block_widths(self.width), strict=True):
            columns = [*numbers, *padding][start : start + width]
            dr.scatter(block, _dynamic_vector(columns), row, active)
            start += width


def block_widths(width: int) -> tuple[int, ...]:
    """Return the numbers of a row in each block of :class:`Rows`; three are a packet of 4."""
    rest = width % 8 + (width % 8 in (3, 7))
    widths = (width // 8 * 8, *(rest & packet for packet in (8, 4, 2, 1)))
    return tuple(each for each in widths if each)


PACKET = 4  # numbers in a packet of rows that are back to back


def load_columns(
    flat: Array, row: UInt32, num_rows: UInt32, stride: int, width: int
) -> list[Array]:
    """Load the first ``width`` numbers of a row a lane, of rows of ``stride`` back to back.

    num_rows: (1,), evaluated, the number of rows of ``flat``.

    A row may begin anywhere in a packet: all its packets are loaded, and the numbers are shifted.
    That takes less than half the time of single loads.
    """
    row = dr.minimum(row, num_rows - 1)  # on lanes that only fill up a vector
    with access_all_lanes(type(flat)):
        return _load_columns(flat, row, num_rows, stride, width)


def _load_columns(
    flat: Array, row: UInt32, num_rows: UInt32, stride: int, width: int
) -> list[Array]:
    whole = (dr.width(flat) - 1) // PACKET
    if whole == 0 or width < PACKET:
        return [dr.gather(type(flat), flat, row * stride + k) for k in range(width)]
    if stride % PACKET == 0:
        packet, first = types_of(type(flat)).Array4f, row * (stride // PACKET)
        loaded = [dr.gather(packet, flat, first + k) for k in range(-(-width // PACKET))]
        return [number for each in loaded for number in each][:width]
    packets = _Packets(flat, first_numbers(flat, whole * PACKET), num_rows * stride)
    begin, shift = row * stride // PACKET, row * stride % PACKET
    always_whole = (stride - 1) // PACKET  # so many packets of a row, wherever it begins
    numbers: list[Array] = []
    for k in range(-(-(width + PACKET - 1) // PACKET)):
        numbers.extend((packets.load if k < always_whole else packets.load_last)(begin + k))
    for step in (1, 2):
        moves = (shift & step) != 0
        numbers = [dr.select(moves, b, a) for a, b in zip(numbers, numbers[step:], strict=False)]
    return numbers[:width]


def store_columns(columns: Sequence[Array]) -> Array:
    """Return the same as :func:`interleave`, in a third of the time where there are many columns.

    Packets that a row fills alone are stored whole, the numbers at its ends one by one. Undefined
    numbers follow the last row; :func:`first_numbers` removes them after evaluation.
    """
    columns, flat_type = list(columns), type(columns[0])
    width, num_rows = len(columns), dr.width(columns)
    size, are_whole = (num_rows + MAX_LANES) * width, width % PACKET == 0 or width < 2 * PACKET
    padding = 0 if are_whole else -size % PACKET + _SPARE_NUMBERS
    flat = dr.empty(flat_type, size + padding)
    with store_in_all_lanes(flat_type, num_rows):
        if are_whole:
            row = dr.arange(types_of(flat_type).UInt32, num_rows)
            dr.scatter(flat, _dynamic_vector(columns), row)
        else:
            _store_shifted(flat, columns)
    return flat


MAX_LANES = 16
"""Lanes of a vector at most: so many rows follow those that all lanes store."""

_SPARE_NUMBERS = 64 * 16  # in as many cache lines as that factor


def first_numbers(flat: Array, size: int) -> Array:
    """Return the first ``size`` numbers of an evaluated array: the same memory."""
    return dr.reshape(type(flat), flat, size, shrink=True)


def _store_shifted(flat: Array, columns: list[Array]) -> None:
    t, width = types_of(type(flat)), len(columns)
    row = dr.arange(t.UInt32, dr.width(columns))
    first = row * width
    begin, shift = first // PACKET, first % PACKET
    zero = t.Float(0)
    numbers = [*columns, *[zero] * PACKET]  # from the begin of the first packet on
    for step in (1, 2):
        moves = (shift & step) != 0
        shifted = [*[zero] * step, *numbers]
        numbers = [dr.select(moves, a, b) for a, b in zip(shifted, numbers, strict=False)]
    end = shift + width
    # Threads, which have other rows, do not share cache lines.
    spare = dr.opaque(t.UInt32, dr.width(flat) - _SPARE_NUMBERS) + row // 64 % 64 * 16

    def store(place: UInt32, numbers: dr.ArrayBase, is_own: Bool, size: int) -> None:
        """Store a packet, or else it goes where nobody reads: a mask would be a branch a lane."""
        place = dr.select(is_own, place, spare) // size
        # Else each of several scatters into one array runs the kernel once more.
        dr.scatter(flat, numbers, place, mode=dr.ReduceMode.NoConflicts)

    for k in range(len(numbers) // PACKET):
        is_own = (end >= PACKET * (k + 1)) & ((shift == 0) | (k > 0))
        packet = t.Array4f(numbers[PACKET * k : PACKET * (k + 1)])
        store((begin + k) * PACKET, packet, is_own, PACKET)
    for k in range(1, PACKET):
        is_own = (shift != 0) & (shift <= k)
        store(begin * PACKET + k, numbers[k], is_own, 1)
    last = end // PACKET * PACKET  # where the packet begins that the next row fills up
    for k in range(width - PACKET + 1, width + PACKET - 1):
        is_own = (last <= k) & (k < end)
        store(begin * PACKET + k, numbers[k], is_own, 1)


@dataclass(frozen=True)
class _Packets(Generic[Array]):
    """Packets of an array of any size; Dr.Jit loads packets only from arrays of whole packets.

    The last packet is loaded number by number, for any size: no kernel contains the size.
    """

    flat: Array
    others: Array  # the same memory without the last packet
    size: UInt32  # (1,), of ``flat``

    def load(self, index: UInt32) -> list[Array]:
        """Return a whole packet a lane."""
        return list(dr.gather(types_of(type(self.flat)).Array4f, self.others, index))

    def load_last(self, index: UInt32) -> list[Array]:
        """Return any packet a lane; numbers beyond the array are not defined."""
        last = (self.size - 1) // PACKET
        is_last = index >= last
        packet = self.load(dr.minimum(index, last - 1))
        for k in range(PACKET):
            number = dr.minimum(index * PACKET + k, self.size - 1)
            packet[k] = dr.select(is_last, dr.gather(type(self.flat), self.flat, number), packet[k])
        return packet


def with_aligned_stack(value: Array) -> Array:
    """Return ``value``, not evaluated, by way of a stack variable, written and read at one index.

    LLVM aligns the stack for variables, but not for spilled vectors, which then cross cache lines.
    """
    UInt32 = types_of(type(value)).UInt32
    variable = dr.alloc_local(type(value), 2)
    variable[dr.opaque(UInt32, 0)] = value
    return variable[dr.opaque(UInt32, 0)]


def _dynamic_vector(columns: Sequence[Array]) -> dr.ArrayBase:
    return _dynamic_type(type(columns[0]))(columns)


def _dynamic_type(flat_type: type) -> type:
    return getattr(sys.modules[flat_type.__module__], _VECTORS[dr.type_v(flat_type)])


_VECTORS = {
    dr.VarType.Float32: "ArrayXf",
    dr.VarType.Float64: "ArrayXf64",
    dr.VarType.UInt32: "ArrayXu",
}


def planes_of(image: dr.ArrayBase) -> list[Float]:
    """Return the channels of an image (H, W, C), each (H * W,), detached."""
    flat, count = dr.detach(image).array, image.shape[2]
    pixel = existing_lanes(types_of(type(flat)).UInt32, image.shape[0] * image.shape[1])
    with access_all_lanes(type(flat)):
        return [dr.gather(type(flat), flat, pixel * count + k) for k in range(count)]


def image_of(planes: Sequence[dr.ArrayBase], like: Array) -> Array:
    """Return the image (H, W, C) of these channels; like: an image of H x W pixels."""
    return type(like)(interleave(planes), (*like.shape[:2], len(planes)))


def tangent_of(parameter: Array) -> Array:
    """Return the gradient set on a parameter; an empty one's own, as dr.grad drops its shape."""
    return dr.grad(parameter) if dr.width(parameter) > 0 else parameter
