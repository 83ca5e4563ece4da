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
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.gaussians.rotation import sh_rotation_generators, sh_rotation_matrices
from drgs.gaussians.sh import num_coefficients


class Part(Protocol):
    """Conversion of stored Gaussians to raw parameters in world space, and its derivatives."""

    values: Any  # PyTree with num_gaussians, sh_degree and parameters(), by name; in a gathered
    # part detached: holding it keeps its indices from being reused

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


_ROWS = {
    **{"means": (3,), "quats": (4,), "log_scales": (3,), "sh0": (1, 3)},
    **{"logit_opacities": (), "smoothing": ()},
}
"""Shapes of the rows that do not depend on the degree."""


def _joined(parts: Sequence[Gaussians], degree: int) -> Gaussians:
    """Concatenate the rows of all parts."""
    parts = [part for part in parts if part.num_gaussians > 0]
    found, rows = [_arrays(part) for part in parts], _row_shapes(degree)
    rows |= {k: v.shape[1:] for arrays in found for k, v in arrays.items() if k not in rows}
    whole = {}
    for name in dict.fromkeys(name for arrays in found for name in arrays):
        blocks = [
            _block(arrays.get(name), 0, part.num_gaussians, part.num_gaussians, rows[name])
            for arrays, part in zip(found, parts, strict=True)
        ]
        filled = [block for block in blocks if dr.width(block) > 0]  # dr.concat takes no others
        whole[name] = dr.concat(filled) if len(filled) > 1 else (filled or blocks)[0]
    return _gaussians(whole, rows, sum(part.num_gaussians for part in parts))


def _rows(gaussians: Gaussians, start: int, num: int, degree: int) -> Gaussians:
    """Return ``num`` rows from row ``start`` on, with the coefficients that ``degree`` has."""
    arrays, rows = _arrays(gaussians), _row_shapes(degree)
    rows |= {k: v.shape[1:] for k, v in arrays.items() if k not in rows}
    blocks = {
        name: _block(values, start, num, gaussians.num_gaussians, rows[name])
        for name, values in arrays.items()
    }
    return _gaussians(blocks, rows, num)


def _row_shapes(degree: int) -> dict[str, tuple[int, ...]]:
    return {**_ROWS, "shN": (num_coefficients(degree) - 1, 3)}


def _arrays(part: Gaussians) -> dict[str, Any]:
    """Return all arrays that a part has, by name."""
    named = {name: getattr(part, name) for name in (*PARAMETER_NAMES, "smoothing")}
    return {k: v for k, v in {**named, **(part.features or {})}.items() if v is not None}


def _gaussians(arrays: dict[str, Any], rows: dict[str, tuple[int, ...]], num: int) -> Gaussians:
    """Return Gaussians of flat arrays; rows: shapes of their rows."""
    shaped = {k: mi.TensorXf(v, (num, *rows[k])) if rows[k] else v for k, v in arrays.items()}
    names = [name for name in shaped if name not in (*_ROWS, "shN")]
    features = {name: shaped.pop(name) for name in names}
    return Gaussians(**shaped, features=features or None)


def _block(values: Any, start: int, num: int, total: int, row: tuple[int, ...]) -> Any:
    """Return ``num`` rows of ``total``, flat: cut to ``row``, or filled with zeros."""
    flat = mi.Float() if values is None else values.array  # an array is its own
    kept, width = math.prod(row), dr.width(flat) // total
    if width == kept and num == total:
        return flat
    if num * kept == 0 or width == 0:
        return dr.zeros(mi.Float, num * kept)
    UInt32 = types_of(type(flat)).UInt32
    index, first = dr.arange(UInt32, num * kept), dr.opaque(UInt32, start)  # in no kernel
    at = index // kept
    column = index - at * kept
    return dr.gather(type(flat), flat, (at + first) * width + column, column < width)


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
