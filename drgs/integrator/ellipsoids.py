"""Gaussians of Mitsuba's ``ellipsoids`` and ``ellipsoidsmesh`` shapes, as the kernels want them.

Imported when a scene has such shapes. A shape keeps, of N Gaussians, ``data`` (10 N: per row
centre, standard deviations, quaternion xyzw), ``opacities`` (N) in 0..1 and ``sh_coeffs`` (3 K N:
per row K coefficients of red, green, blue). :class:`Conversion` makes raw parameters of these::

    log_scales = ln |scales|    logit_opacities = ln(o / (1 - o))    shN = D sh_coeffs

with D the rotation by which a shape was turned (:mod:`drgs.gaussians.rotation`), as Mitsuba
turns centres and quaternions but no coefficients.

o is clamped to :data:`OPACITIES`. The derivative at o = 1 is that of the inside; outside of 0..1
it is zero. What has no positive opacity, or a standard deviation of zero, is not visible, and its
derivatives are zero. The sign of a standard deviation means nothing, as for ``volprim_rf_basic``
(Mitsuba makes them negative where a ``to_world`` mirrors).

Numbers that are written in place, through a view of a shape's memory, are not noticed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from drgs.core.arrays import interleave
from drgs.core.errors import PluginError
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.gathering import PER_DEGREE, Turn, columns, interleaved

DATA = 10
"""Numbers of a row of ``data``: centre, standard deviations, quaternion xyzw."""

OPACITIES = (2.0**-64, 1 - 2.0**-24)
"""The largest float32 below 1, whose logit is 16.6; and an opacity that no picture shows, so far
from zero that neither it nor its reciprocal leaves float32."""

HIDDEN = -1e4
"""A logit whose sigmoid is exactly zero."""


# ----------------------------------------------------------------------------------------------
# Reading
# ----------------------------------------------------------------------------------------------


def read(shape: mi.Shape) -> dict[str, Any]:
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
    return {name: values[name] for name in ("data", *allowed)}


def _name(shape: mi.Shape) -> str:
    kind = "ellipsoidsmesh" if shape.is_mesh() else "ellipsoids"
    return f"shape '{shape.id()}' ({kind})" if shape.id() else f"shape without an id ({kind})"


# ----------------------------------------------------------------------------------------------
# Converting
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Conversion:
    """The conversion of a shape's arrays to raw parameters; see ``gathering.Part``."""

    values: dict[str, Any]  # data (10 N,), opacities (N,), sh_coeffs (3 K N,)
    fixed: Turn | None  # of the harmonics, which is not differentiated

    def gaussians(self) -> Gaussians:
        num = dr.width(self.values["opacities"])
        data = columns(self.values["data"], DATA)
        sh = columns(self.values["sh_coeffs"], dr.width(self.values["sh_coeffs"]) // num)
        scales, (x, y, z, w) = [dr.abs(scale) for scale in data[3:6]], data[6:]
        # Written such that a NaN is not visible.
        is_visible = (scales[0] > 0) & (scales[1] > 0) & (scales[2] > 0)
        higher = sh[3:] if self.fixed is None else self.fixed.of(sh[3:])
        opacity = self._opacity(is_visible)
        logits = dr.log(opacity / (1 - opacity))
        log_scales = [dr.log(dr.select(is_visible, scale, 1)) for scale in scales]
        return Gaussians(
            means=mi.TensorXf(interleave(data[:3]), (num, 3)),
            quats=mi.TensorXf(interleave([w, x, y, z]), (num, 4)),
            log_scales=mi.TensorXf(interleave(log_scales), (num, 3)),
            logit_opacities=dr.select(is_visible, logits, HIDDEN),
            sh0=mi.TensorXf(interleave(sh[:3]), (num, 1, 3)),
            shN=mi.TensorXf(interleaved(higher), (num, len(sh) // 3 - 1, 3)),
        )

    def _opacity(self, is_visible: mi.Bool) -> mi.Float:
        """Return opacities between bounds, attached where they were within 0..1.

        A NaN stays: projection then drops the Gaussian.
        """
        (lowest, highest), value = OPACITIES, self.values["opacities"]
        clamped = dr.detach(dr.select(value < lowest, lowest, value))
        clamped = dr.select(clamped > highest, highest, clamped)
        inside = (value >= 0) & (value <= 1) & is_visible
        return dr.select(inside, dr.replace_grad(clamped, value), clamped)


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
