"""Gaussians of Mitsuba's ``ellipsoids`` and ``ellipsoidsmesh`` shapes, as the kernels want them.

Imported when a scene has such shapes. A shape keeps, of N Gaussians, ``data`` (10 N: per row
centre, standard deviations, quaternion xyzw), ``opacities`` (N) in 0..1 and ``sh_coeffs`` (3 K N:
per row K coefficients of red, green, blue). :class:`Conversion` makes raw parameters of these::

    log_scales = ln |scales|    logit_opacities = ln(o / (1 - o))    shN = D sh_coeffs

with D the rotation by which a shape was turned (:mod:`drgs.gaussians.rotation`), as Mitsuba
turns centres and quaternions but no coefficients. Derivatives take the way back by gathers alone:
nothing is added atomically, and they are the same to the last bit in every run.

o is clamped to :data:`OPACITIES`. The derivative at o = 1 is that of the inside; outside of 0..1
it is zero. What has no positive opacity, or a standard deviation of zero, is not visible, and its
derivatives are zero. The sign of a standard deviation means nothing, as for ``volprim_rf_basic``
(Mitsuba makes them negative where a ``to_world`` mirrors).

Numbers that are written in place, through a view of a shape's memory, are not noticed.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi

from drgs.core.arrays import interleave
from drgs.core.errors import PluginError
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.sh import num_coefficients
from drgs.integrator.gathering import PER_DEGREE, Turn, columns, interleaved

DATA = 10
"""Numbers of a row of ``data``: centre, standard deviations, quaternion xyzw."""

OPACITIES = (2.0**-64, 1 - 2.0**-24)
"""The largest float32 below 1, whose logit is 16.6; and an opacity that no picture shows, so far
from zero that neither it nor its reciprocal leaves float32."""

HIDDEN = -1e4
"""A logit whose sigmoid is exactly zero."""


@dataclass(frozen=True)
class Ellipsoids:
    """The arrays in which a shape keeps its Gaussians."""

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

    def parameters(self) -> dict[str, Any]:
        """Differentiable arrays by name."""
        return vars(self)


# ----------------------------------------------------------------------------------------------
# Reading
# ----------------------------------------------------------------------------------------------


def read(shape: mi.Shape) -> Ellipsoids:
    """Read the shape's arrays, attached. Raises PluginError that names what does not fit."""
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


@dataclass(frozen=True, eq=False)
class Conversion:
    """The conversion of a shape's arrays to raw parameters of Gaussians, and its derivatives.

    See :class:`drgs.integrator.gathering.Part`.
    """

    values: Ellipsoids
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
            columns(self.values.sh_coeffs, self._num_sh),
        )

    def tangent(self, tangent: Mapping[str, Any]) -> Gaussians:
        """Derivatives of the parameters along those of ``values.parameters()``."""
        data = columns(tangent["data"], DATA)
        return self._assembled(
            data[:3],
            data[6:],
            [d * slope for d, slope in zip(data[3:6], self._scale_slopes, strict=True)],
            tangent["opacities"] * self._opacity_slope,
            columns(tangent["sh_coeffs"], self._num_sh),
        )

    def adjoint(self, gradients: Gaussians, names: Collection[str]) -> dict[str, Any]:
        """Derivatives with respect to parameters of these names, from those of ``gaussians()``."""
        w, x, y, z = columns(gradients.quats.array, 4)
        d_scales = [
            d * slope
            for d, slope in zip(
                columns(gradients.log_scales.array, 3), self._scale_slopes, strict=True
            )
        ]
        higher = columns(gradients.shN.array, self._num_sh - 3)
        if self.turn is not None:
            higher = self.turn.of(higher, transposed=True)
        found = {
            "data": interleave([*columns(gradients.means.array, 3), *d_scales, x, y, z, w]),
            "opacities": gradients.logit_opacities * self._opacity_slope,
            "sh_coeffs": interleave(columns(gradients.sh0.array, 3) + higher),
        }
        return {name: found[name] for name in names}

    def _assembled(
        self, means: list, xyzw: list, log_scales: list, logits: Any, sh: list[Any]
    ) -> Gaussians:
        higher = sh[3:] if self.turn is None else self.turn.of(sh[3:])
        num, (x, y, z, w) = self.values.num_gaussians, xyzw
        return Gaussians(
            means=mi.TensorXf(interleave(means), (num, 3)),
            quats=mi.TensorXf(interleave([w, x, y, z]), (num, 4)),
            log_scales=mi.TensorXf(interleave(log_scales), (num, 3)),
            logit_opacities=logits,
            sh0=mi.TensorXf(interleave(sh[:3]), (num, 1, 3)),
            shN=mi.TensorXf(interleaved(higher), (num, len(sh) // 3 - 1, 3)),
        )

    @property
    def fixed(self) -> Turn | None:
        """The rotation of the harmonics, which is not differentiated."""
        return self.turn

    @property
    def _num_sh(self) -> int:
        return 3 * num_coefficients(self.values.sh_degree)

    @cached_property
    def _data(self) -> list[Any]:
        return columns(self.values.data, DATA)

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
        value = self.values.opacities  # a NaN stays: projection then drops the Gaussian
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
        value, clamped = self.values.opacities, self._opacities
        inside = (value >= 0) & (value <= 1) & self._is_visible
        return dr.select(inside, 1 / (clamped * (1 - clamped)), 0)


def conversions_of(shapes: Sequence[mi.Shape], turns: Mapping[str, Turn]) -> list[Conversion]:
    """Read the current values of shapes, attached.

    turns: by the ids of shapes, and under "" of all others.

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
    return [Conversion(read(shape), turns.get(shape.id(), turns.get(""))) for shape in shapes]
