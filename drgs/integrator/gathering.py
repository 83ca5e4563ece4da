"""All Gaussians of a picture, put together of those of splat objects and of shapes.

Imported when a scene has more than the Gaussians of one integrator where they are. Each
:class:`Part` converts what is stored of some Gaussians to raw parameters in world space, and
derivatives along and back. Gradients take the way back by gathers alone: nothing is added
atomically, and they are the same to the last bit in every run.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.core.arrays import from_host, interleave, tangent_of, types_of
from drgs.core.private import same_variables
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.sh import num_coefficients
from drgs.gaussians.sh_rotation import sh_rotation_generators, sh_rotation_matrices


class Values(Protocol):
    """Arrays of some Gaussians as they are stored; a PyTree."""

    @property
    def num_gaussians(self) -> int:
        """N."""

    @property
    def sh_degree(self) -> int:
        """Highest spherical-harmonics degree stored: 0 to 3."""

    def parameters(self) -> dict[str, Any]:
        """Differentiable arrays by name."""


class Part(Protocol):
    """Conversion of stored Gaussians to raw parameters in world space, and its derivatives."""

    values: Values  # in a gathered part detached: holding it keeps its indices from being reused

    @property
    def fixed(self) -> object:
        """Anything else that the conversion depends on; equal if the same."""

    def gaussians(self) -> Gaussians:
        """All parameters, detached."""

    def tangent(self, tangent: Mapping[str, Any]) -> Gaussians:
        """Derivatives of the parameters along those of ``values.parameters()``."""

    def adjoint(self, gradients: Gaussians, names: Collection[str]) -> dict[str, Any]:
        """Derivatives with respect to parameters of these names, from those of ``gaussians()``."""


@dataclass(frozen=True, eq=False)
class Gathered:
    """All Gaussians of a rendering, by part."""

    parts: list[Part]  # detached
    gaussians: Gaussians  # detached and evaluated

    def matches(self, parts: Sequence[Part]) -> bool:
        """True if gathering these would give the same Gaussians."""
        return same_variables(
            [part.values for part in self.parts], [part.values for part in parts]
        ) and [part.fixed for part in self.parts] == [part.fixed for part in parts]

    def accumulate(self, parts: Sequence[Part], gradients: Gaussians) -> None:
        """Hand the same parts, attached, their derivatives."""
        start = 0
        for part, own in zip(parts, self.parts, strict=True):
            parameters = part.values.parameters()
            attached = {k: v for k, v in parameters.items() if dr.width(v) and dr.grad_enabled(v)}
            num = own.values.num_gaussians
            if attached and num > 0:
                rows = _rows(gradients, start, num, own.values.sh_degree)
                for name, derivative in own.adjoint(rows, list(attached)).items():
                    dr.accum_grad(attached[name], derivative)
            start += num

    def tangents(self, parts: Sequence[Part]) -> Gaussians:
        """Derivatives of all Gaussians, from those set on the same parts, attached."""
        tangents = []
        for part, own in zip(parts, self.parts, strict=True):
            parameters = part.values.parameters()
            tangents.append(own.tangent({k: tangent_of(v) for k, v in parameters.items()}))
        return _joined(tangents, self.gaussians.sh_degree)


def gather(parts: Sequence[Part], last: Gathered | None) -> Gathered:
    """The Gaussians of all parts in their order, of the highest degree that any has.

    last: the result of the last call, which is returned again while nothing has changed. Features
    and coefficients that a part lacks are zeros, and so is a smoothing filter.
    """
    parts = [replace(part, values=dr.detach(part.values)) for part in parts]
    if last is not None and last.matches(parts):
        return last
    converted = [part.gaussians() for part in parts]
    gaussians = _joined(converted, max(part.sh_degree for part in converted))
    dr.eval(gaussians)
    return Gathered(parts, gaussians)


def _joined(parts: Sequence[Gaussians], degree: int) -> Gaussians:
    """The rows of all parts; coefficients and features that a part lacks are zeros."""
    parts = [part for part in parts if part.num_gaussians > 0]
    num = sum(part.num_gaussians for part in parts)
    rows = {**_ROWS, "shN": (num_coefficients(degree) - 1, 3)}
    tensors = {
        name: mi.TensorXf(
            _concatenated([_widened(getattr(part, name), row) for part in parts]), (num, *row)
        )
        for name, row in rows.items()
    }
    widths = {k: v.shape[1] for part in parts for k, v in (part.features or {}).items()}
    features = {
        name: mi.TensorXf(
            _concatenated(
                [_array_or_zeros((part.features or {}).get(name), part, width) for part in parts]
            ),
            (num, width),
        )
        for name, width in widths.items()
    }
    smoothing = None
    if any(part.smoothing is not None for part in parts):
        smoothing = _concatenated([_array_or_zeros(part.smoothing, part, 1) for part in parts])
    logits = _concatenated([part.logit_opacities for part in parts])
    return Gaussians(
        **tensors, logit_opacities=logits, smoothing=smoothing, features=features or None
    )


_ROWS = {"means": (3,), "quats": (4,), "log_scales": (3,), "sh0": (1, 3)}
"""Shapes of the rows that do not depend on the degree."""


def _rows(gaussians: Gaussians, start: int, num: int, degree: int) -> Gaussians:
    """``num`` rows from row ``start`` on, with the coefficients that ``degree`` has."""
    rows = {**_ROWS, "shN": (num_coefficients(degree) - 1, 3)}
    tensors = {
        name: _block(getattr(gaussians, name), start, num, row) for name, row in rows.items()
    }
    features = {
        name: _block(value, start, num, value.shape[1:])
        for name, value in (gaussians.features or {}).items()
    }
    logits, smoothing = (
        None if flat is None else _block(mi.TensorXf(flat, (dr.width(flat), 1)), start, num, (1,))
        for flat in (gaussians.logit_opacities, gaussians.smoothing)
    )
    return Gaussians(
        **tensors,
        logit_opacities=logits.array,
        smoothing=None if smoothing is None else smoothing.array,
        features=features or None,
    )


def columns(flat: Any, width: int) -> list[Any]:
    """The columns of rows of ``width`` numbers; see :func:`interleaved`."""
    if width == 0:
        return []
    UInt32 = types_of(type(flat)).UInt32
    row = dr.arange(UInt32, dr.width(flat) // width) * width
    return [dr.gather(type(flat), flat, row + k) for k in range(width)]


def interleaved(values: list[Any]) -> Any:
    """Columns as rows again, flat; of no columns, an empty array."""
    return interleave(values) if values else mi.Float()


def _block(tensor: Any, start: int, num: int, row: tuple[int, ...]) -> Any:
    """Rows from ``start`` on, of each the first numbers, as many as ``row`` has."""
    flat, width, kept = tensor.array, math.prod(tensor.shape[1:]), math.prod(row)
    if num * kept == 0:
        return dr.zeros(mi.TensorXf, (num, *row))
    UInt32 = types_of(type(flat)).UInt32
    index, first = dr.arange(UInt32, num * kept), dr.opaque(UInt32, start)  # in no kernel
    at = index // kept
    cells = (at + first) * width + (index - at * kept)
    return mi.TensorXf(dr.gather(type(flat), flat, cells), (num, *row))


def _widened(tensor: Any, row: tuple[int, ...]) -> Any:
    """Flat rows of more numbers, zeros behind those that there are."""
    flat, width, wider = tensor.array, math.prod(tensor.shape[1:]), math.prod(row)
    if width == wider:
        return flat
    if width == 0:
        return dr.zeros(type(flat), tensor.shape[0] * wider)
    index = dr.arange(types_of(type(flat)).UInt32, tensor.shape[0] * wider)
    at = index // wider
    column = index - at * wider
    return dr.gather(type(flat), flat, at * width + column, column < width)


def _array_or_zeros(values: Any, part: Gaussians, width: int) -> Any:
    """A flat array; rows of ``width`` zeros where a part has none."""
    if values is None:
        return dr.zeros(type(part.logit_opacities), part.num_gaussians * width)
    return values.array if dr.is_tensor_v(values) else values


def _concatenated(arrays: list[Any]) -> Any:
    filled = [array for array in arrays if dr.width(array) > 0]  # dr.concat takes no others
    return dr.concat(filled) if len(filled) > 1 else (filled or arrays)[0]


# ----------------------------------------------------------------------------------------------
# Spherical harmonics
# ----------------------------------------------------------------------------------------------

PER_DEGREE = {num_coefficients(degree): degree for degree in range(4)}


@dataclass(frozen=True, eq=False)
class Turn:
    """A linear map of the coefficients of degree 1 to 3 by one matrix per degree."""

    matrices: Any  # Float (9 + 25 + 49,)

    @staticmethod
    def by(rotation: np.ndarray) -> Turn:
        """The rotation of spherical harmonics; rotation: (3, 3), x' = R x."""
        return Turn._from(sh_rotation_matrices(rotation, 3))

    @staticmethod
    def generators() -> list[Turn]:
        """Derivatives of turned coefficients along rotations about x, y and z."""
        return [Turn._from(matrices) for matrices in sh_rotation_generators(3)]

    @staticmethod
    def _from(matrices: Sequence[np.ndarray]) -> Turn:
        return Turn(from_host(mi.Float, np.concatenate([matrix.ravel() for matrix in matrices])))

    def of(self, columns: list[Any], transposed: bool = False) -> list[Any]:
        """Columns of the coefficients of degree 1 and above, three a coefficient; turned."""
        turned, start = [], 0
        for degree in range(1, PER_DEGREE[len(columns) // 3 + 1] + 1):
            size = 2 * degree + 1
            band = columns[3 * (degree**2 - 1) :][: 3 * size]
            for k in range(size):
                cells = [j * size + k if transposed else k * size + j for j in range(size)]
                row = [number_of(self.matrices, start + cell) for cell in cells]
                for c in range(3):
                    terms = [a * x for a, x in zip(row, band[c::3], strict=True)]
                    turned.append(sum(terms[1:], terms[0]))
            start += size * size
        return turned


def number_of(flat: Any, index: int) -> Any:
    """One entry of an array, in no kernel: other numbers need no other one."""
    return dr.gather(type(flat), flat, types_of(type(flat)).UInt32(index))
