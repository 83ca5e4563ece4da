"""Gaussians of Mitsuba's ``ellipsoids`` and ``ellipsoidsmesh`` shapes, as the kernels want them.

Imported when a scene has such shapes. A shape keeps, of N Gaussians, ``data`` (10 N: per row
centre, standard deviations, quaternion xyzw), ``opacities`` (N) in 0..1 and ``sh_coeffs`` (3 K N:
per row K coefficients of red, green, blue). :func:`gather` puts them behind Gaussians of the
integrator's own::

    log_scales = ln |scales|    logit_opacities = ln(o / (1 - o))    shN = D sh_coeffs

with D the rotation by which a shape was turned (:mod:`drgs.gaussians.sh_rotation`), as Mitsuba
turns centres and quaternions but no coefficients. Derivatives take the way back by gathers alone:
nothing is added atomically, and they are the same to the last bit in every run.

o is clamped to :data:`OPACITIES`. The derivative at o = 1 is that of the inside; outside of 0..1
it is zero. What has no positive opacity, or a standard deviation of zero, is not visible, and its
derivatives are zero. The sign of a standard deviation means nothing, as for ``volprim_rf_basic``
(Mitsuba makes them negative where a ``to_world`` mirrors).

Numbers that are written in place, through a view of a shape's memory, are not noticed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.core.arrays import from_host, interleave, types_of
from drgs.core.errors import PluginError
from drgs.core.private import same_variables
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.sh import num_coefficients
from drgs.gaussians.sh_rotation import sh_rotation_matrices

DATA = 10
"""Numbers of a row of ``data``: centre, standard deviations, quaternion xyzw."""

OPACITIES = (2.0**-64, 1 - 2.0**-24)
"""The largest float32 below 1, whose logit is 16.6; and an opacity that no picture shows, so far
from zero that neither it nor its reciprocal leaves float32."""

HIDDEN = -1e4
"""A logit whose sigmoid is exactly zero."""

PER_DEGREE = {num_coefficients(degree): degree for degree in range(4)}


@dataclass(frozen=True)
class Ellipsoids:
    """What a shape holds of its Gaussians; or derivatives with respect to it."""

    data: Any  # Float (10 N,)
    opacities: Any  # Float (N,)
    sh_coeffs: Any  # Float (3 K N,)

    @property
    def num_gaussians(self) -> int:
        """N."""
        return dr.width(self.opacities)

    @property
    def sh_degree(self) -> int:
        """0 to 3."""
        return PER_DEGREE[dr.width(self.sh_coeffs) // (3 * self.num_gaussians)]


@dataclass(frozen=True, eq=False)
class Turn:
    """The rotation of spherical harmonics by one matrix per degree."""

    matrices: Any  # Float (9 + 25 + 49,)

    @staticmethod
    def by(rotation: np.ndarray) -> Turn:
        """rotation: (3, 3), x' = R x."""
        matrices = [matrix.ravel() for matrix in sh_rotation_matrices(rotation, 3)]
        return Turn(from_host(mi.Float, np.concatenate(matrices)))

    def of(self, columns: list[Any], transposed: bool = False) -> list[Any]:
        """Columns of all coefficients, degree 0 first, three a coefficient; turned."""
        turned, start = columns[:3], 0
        for degree in range(1, PER_DEGREE[len(columns) // 3] + 1):
            size = 2 * degree + 1
            band = columns[3 * degree**2 :][: 3 * size]
            for k in range(size):
                cells = [j * size + k if transposed else k * size + j for j in range(size)]
                row = [self._number(start + cell) for cell in cells]
                for c in range(3):
                    terms = [a * x for a, x in zip(row, band[c::3], strict=True)]
                    turned.append(sum(terms[1:], terms[0]))
            start += size * size
        return turned

    def _number(self, index: int) -> Any:
        """Of one entry: in no kernel, so that another rotation needs no other one."""
        return dr.gather(type(self.matrices), self.matrices, types_of(mi.Float).UInt32(index))


# ----------------------------------------------------------------------------------------------
# Reading
# ----------------------------------------------------------------------------------------------


def read(shape: mi.Shape) -> Ellipsoids:
    """What the shape holds now, attached. Raises PluginError that names what does not fit."""
    values = mi.traverse(shape)
    where = f"splats: the {_name(shape)}"
    missing = [name for name in ("opacities", "sh_coeffs") if name not in values]
    if missing:
        others = [name for name in values.keys() if not name.startswith("extent")]  # noqa: SIM118
        raise PluginError(
            f"{where} must have the attributes opacities and sh_coeffs; missing: "
            f"{', '.join(missing)}; it has: {', '.join(others)}"
        )
    num = dr.width(values["data"]) // DATA
    allowed = {"opacities": [1], "sh_coeffs": [3 * k for k in PER_DEGREE]}
    for name, widths in allowed.items():
        got = dr.width(values[name])
        if num == 0 or got not in [num * width for width in widths]:
            words = " or ".join(f"({num}, {width})" for width in widths)
            raise PluginError(f"{where} must have {name} of shape {words}, got {got} numbers")
    return Ellipsoids(values["data"], values["opacities"], values["sh_coeffs"])


def _name(shape: mi.Shape) -> str:
    kind = "ellipsoidsmesh" if shape.is_mesh() else "ellipsoids"
    return f"shape '{shape.id()}' ({kind})" if shape.id() else f"shape without an id ({kind})"


# ----------------------------------------------------------------------------------------------
# Converting
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Conversion:
    """From what a shape holds to raw parameters of its Gaussians, and derivatives of that."""

    shape: Ellipsoids  # detached: holding it keeps its variable indices from being reused
    turn: Turn | None

    def gaussians(self) -> Gaussians:
        """All parameters, detached."""
        scales, opacities = self._scales, self._opacities
        logits = dr.log(opacities / (1 - opacities))
        return self._assembled(
            self._data[:3],
            self._data[6:],
            [dr.log(dr.select(self._is_visible, dr.abs(scale), 1)) for scale in scales],
            dr.select(self._is_visible, logits, HIDDEN),
            _columns(self.shape.sh_coeffs, self._num_sh),
        )

    def tangent(self, tangent: Ellipsoids) -> Gaussians:
        """Derivatives of the parameters along ``tangent``."""
        data = _columns(tangent.data, DATA)
        return self._assembled(
            data[:3],
            data[6:],
            [d * slope for d, slope in zip(data[3:6], self._scale_slopes, strict=True)],
            tangent.opacities * self._opacity_slope,
            _columns(tangent.sh_coeffs, self._num_sh),
        )

    def adjoint(self, gradients: Gaussians) -> Ellipsoids:
        """Derivatives with respect to what the shape holds, from those of the parameters."""
        w, x, y, z = _columns(gradients.quats.array, 4)
        d_scales = [
            d * slope
            for d, slope in zip(
                _columns(gradients.log_scales.array, 3), self._scale_slopes, strict=True
            )
        ]
        sh = _columns(gradients.sh0.array, 3)
        sh += _columns(gradients.shN.array, self._num_sh - 3)
        if self.turn is not None:
            sh = self.turn.of(sh, transposed=True)
        return Ellipsoids(
            data=interleave([*_columns(gradients.means.array, 3), *d_scales, x, y, z, w]),
            opacities=gradients.logit_opacities * self._opacity_slope,
            sh_coeffs=interleave(sh),
        )

    def _assembled(
        self, means: list, xyzw: list, log_scales: list, logits: Any, sh: list[Any]
    ) -> Gaussians:
        if self.turn is not None:
            sh = self.turn.of(sh)
        num, (x, y, z, w) = self.shape.num_gaussians, xyzw
        higher = interleave(sh[3:]) if len(sh) > 3 else dr.zeros(type(logits), 0)
        return Gaussians(
            means=mi.TensorXf(interleave(means), (num, 3)),
            quats=mi.TensorXf(interleave([w, x, y, z]), (num, 4)),
            log_scales=mi.TensorXf(interleave(log_scales), (num, 3)),
            logit_opacities=logits,
            sh0=mi.TensorXf(interleave(sh[:3]), (num, 1, 3)),
            shN=mi.TensorXf(higher, (num, len(sh) // 3 - 1, 3)),
        )

    @property
    def _num_sh(self) -> int:
        return 3 * num_coefficients(self.shape.sh_degree)

    @cached_property
    def _data(self) -> list[Any]:
        return _columns(self.shape.data, DATA)

    @property
    def _scales(self) -> list[Any]:
        return self._data[3:6]

    @property
    def _is_visible(self) -> Any:
        """Written such that a NaN is not."""
        x, y, z = self._scales
        return (dr.abs(x) > 0) & (dr.abs(y) > 0) & (dr.abs(z) > 0)

    @property
    def _opacities(self) -> Any:
        lowest, highest = OPACITIES
        value = self.shape.opacities  # a NaN stays: projection then drops the Gaussian
        value = dr.select(value < lowest, lowest, value)
        return dr.select(value > highest, highest, value)

    @property
    def _scale_slopes(self) -> list[Any]:
        return [
            dr.select(self._is_visible, 1 / dr.select(self._is_visible, scale, 1), 0)
            for scale in self._scales
        ]

    @property
    def _opacity_slope(self) -> Any:
        value, clamped = self.shape.opacities, self._opacities
        inside = (value >= 0) & (value <= 1) & self._is_visible
        return dr.select(inside, 1 / (clamped * (1 - clamped)), 0)


# ----------------------------------------------------------------------------------------------
# Gathering
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Gathered:
    """All Gaussians of a rendering: the integrator's own, then those of each shape."""

    own: Gaussians  # detached, perhaps none
    conversions: list[Conversion]
    gaussians: Gaussians  # detached and evaluated

    def matches(self, own: Gaussians, shapes: list[Ellipsoids], turns: list[Turn | None]) -> bool:
        """Whether gathering these would give the same Gaussians."""
        return (
            same_variables([self.own, [c.shape for c in self.conversions]], [own, shapes])
            and [c.turn for c in self.conversions] == turns
        )

    def accumulate(self, shapes: Sequence[mi.Shape], gradients: Gaussians) -> Gaussians:
        """Hand the shapes their derivatives; the part of the integrator's own is returned."""
        start = self.own.num_gaussians
        for shape, conversion in zip(shapes, self.conversions, strict=True):
            held = read(shape)
            if any(dr.grad_enabled(value) for value in vars(held).values()):
                degree, num = conversion.shape.sh_degree, conversion.shape.num_gaussians
                derivatives = conversion.adjoint(_part(gradients, start, num, degree))
                for name, value in vars(held).items():
                    if dr.grad_enabled(value):
                        dr.accum_grad(value, getattr(derivatives, name))
            start += conversion.shape.num_gaussians
        return _part(gradients, 0, self.own.num_gaussians, self.own.sh_degree)

    def tangents(self, shapes: Sequence[mi.Shape], own: Gaussians) -> Gaussians:
        """Derivatives of all Gaussians, from those of the own and those set on the shapes."""
        parts = []
        for shape, conversion in zip(shapes, self.conversions, strict=True):
            held = read(shape)
            tangent = Ellipsoids(**{name: dr.grad(value) for name, value in vars(held).items()})
            parts.append(conversion.tangent(tangent))
        return _joined([own, *parts], self.gaussians.sh_degree)


def gather(
    own: Gaussians,
    shapes: Sequence[mi.Shape],
    turns: Mapping[str, Turn],
    last: Gathered | None,
) -> Gathered:
    """The Gaussians of all shapes behind ``own``, of the highest degree that any has.

    turns: by the ids of shapes, and under "" of all others; last: what the last call returned,
    which is returned again while nothing has changed. Of features the shapes' Gaussians have zeros,
    and no smoothing filter.

    Raises PluginError for shapes that cannot be rendered, and for turns of shapes that there are
    not.
    """
    unknown = set(turns) - {shape.id() for shape in shapes} - {""}
    if unknown:
        found = ", ".join(f"'{shape.id()}'" for shape in shapes if shape.id()) or "none"
        raise PluginError(
            f"splats: shapes_to_world_{min(unknown)} must end with the id of a shape of type "
            f"ellipsoids or ellipsoidsmesh, ids are: {found}"
        )
    own, held = dr.detach(own), [dr.detach(read(shape)) for shape in shapes]
    turned = [turns.get(shape.id(), turns.get("")) for shape in shapes]
    if last is not None and last.matches(own, held, turned):
        return last
    conversions = [Conversion(*pair) for pair in zip(held, turned, strict=True)]
    parts = [own, *(conversion.gaussians() for conversion in conversions)]
    gaussians = _joined(parts, max(part.sh_degree for part in parts))
    dr.eval(gaussians)
    return Gathered(own, conversions, gaussians)


def _joined(parts: Sequence[Gaussians], degree: int) -> Gaussians:
    """The rows of all parts; coefficients and features that a part lacks are zeros."""
    parts = [part for part in parts if part.num_gaussians > 0]
    num, first = sum(part.num_gaussians for part in parts), parts[0]
    rows = {**_ROWS, "shN": (num_coefficients(degree) - 1, 3)}
    tensors = {
        name: mi.TensorXf(
            _concatenated([_widened(getattr(part, name), row) for part in parts]), (num, *row)
        )
        for name, row in rows.items()
    }
    features = {
        name: mi.TensorXf(
            _concatenated([value.array, *(_zeros(part, value.shape[1]) for part in parts[1:])]),
            (num, value.shape[1]),
        )
        for name, value in (first.features or {}).items()
    }
    smoothing = first.smoothing
    if smoothing is not None:
        smoothing = _concatenated([smoothing, *(_zeros(part, 1) for part in parts[1:])])
    logits = _concatenated([part.logit_opacities for part in parts])
    return Gaussians(
        **tensors, logit_opacities=logits, smoothing=smoothing, features=features or None
    )


_ROWS = {"means": (3,), "quats": (4,), "log_scales": (3,), "sh0": (1, 3)}
"""Shapes of the rows that do not depend on the degree."""


def _part(gaussians: Gaussians, start: int, num: int, degree: int) -> Gaussians:
    """``num`` rows from row ``start`` on, with the coefficients that ``degree`` has."""
    rows = {**_ROWS, "shN": (num_coefficients(degree) - 1, 3)}
    tensors = {
        name: _block(getattr(gaussians, name), start, num, row) for name, row in rows.items()
    }
    features = {
        name: _block(value, start, num, value.shape[1:])
        for name, value in (gaussians.features or {}).items()
    }
    logits = gaussians.logit_opacities
    column = _block(mi.TensorXf(logits, (dr.width(logits), 1)), start, num, (1,))
    return Gaussians(**tensors, logit_opacities=column.array, features=features or None)


def _columns(flat: Any, width: int) -> list[Any]:
    """The columns of rows of ``width`` numbers."""
    if width == 0:
        return []
    UInt32 = types_of(type(flat)).UInt32
    row = dr.arange(UInt32, dr.width(flat) // width) * width
    return [dr.gather(type(flat), flat, row + k) for k in range(width)]


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


def _zeros(part: Gaussians, width: int) -> Any:
    return dr.zeros(type(part.logit_opacities), part.num_gaussians * width)


def _concatenated(arrays: list[Any]) -> Any:
    filled = [array for array in arrays if dr.width(array) > 0]  # dr.concat takes no others
    return dr.concat(filled) if len(filled) > 1 else (filled or arrays)[0]
