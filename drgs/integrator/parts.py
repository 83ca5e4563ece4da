"""Gaussians of an image from several parts: splat objects and shapes.

Imported when a scene has more than one integrator's unmoved Gaussians. Each :data:`Part` converts
stored Gaussians to raw parameters in world space; Dr.Jit differentiates the conversions. Columns
are gathered and interleaved as permutations, without atomic additions: results are reproducible.

A :class:`Placement` moves the Gaussians of an object by a ``to_world`` x' = k R x + t:

    mean' = k R mean + t    quat' = q_R quat    log_scale' = log_scale + ln k
    smoothing' = k smoothing    shN' = D(R) shN

with D the rotation of spherical harmonics (:mod:`drgs.gaussians.rotation`). k and R are those of
the similarity that is nearest to the matrix, so that each of its twelve numbers has a derivative:
a change dA of its upper 3 x 3 block A rotates by w and scales by 1 + l, where

    dA A^-1 = l I + [w]x + S

and S, symmetric and without trace, changes nothing. Along l and w, means change by l r + w x r with
r = mean' - t, quaternions by (0, w) quat' / 2, and harmonics by sum_a w_a G_a shN' with G_a the
generators of D.

A :class:`Conversion` reads Mitsuba's shapes ``ellipsoids`` and ``ellipsoidsmesh``, which keep, of N
Gaussians, ``data`` (10 N: per row centre, standard deviations, quaternion xyzw), ``opacities`` (N)
in 0..1 and ``sh_coeffs`` (3 K N: per row K coefficients of red, green, blue)::

    log_scales = ln |scales|    logit_opacities = ln(o / (1 - o))    shN = D sh_coeffs

with D the rotation by which a shape was turned, as Mitsuba turns centres and quaternions but no
coefficients. o is clamped to :data:`OPACITY_RANGE`: the derivative at o = 1 is that of the inside;
outside of 0..1 it is zero. Gaussians without a positive opacity, or with a standard deviation of
zero, are not visible, and their derivatives are zero. Signs of standard deviations are ignored, as
by ``volprim_rf_basic``. Changes in place through a view of a shape's memory are not noticed.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.core.arrays import from_host, interleave, tangent_of, types_of
from drgs.core.errors import PluginError
from drgs.core.private import same_variables
from drgs.core.types import Float, Matrix4f
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.rotation import (
    left_multiplication_matrix,
    sh_rotation_generators,
    sh_rotation_matrices,
)
from drgs.gaussians.sh import num_coefficients
from drgs.gaussians.similarity import Similarity

ParameterArrays = dict[str, Any]  # TensorXf or Float by name; a Matrix4f for ``to_world``
ParameterColumns = dict[str, list[Float]]  # columns of parameters by name

TO_WORLD = "to_world"

PER_DEGREE = {num_coefficients(degree): degree for degree in range(4)}


@dataclass(frozen=True, eq=False)
class CombinedParts:
    """Parts, and the Gaussians of all."""

    parts: list[Part]  # detached
    sizes: list[tuple[int, int]]  # by part: number of Gaussians, degree
    gaussians: Gaussians  # detached and evaluated

    def matches(self, parts: Sequence[Part]) -> bool:
        """Return whether ``parts`` would give the same Gaussians."""
        own, other = ([part.values for part in each] for each in (self.parts, parts))
        inputs = [[part.fixed_inputs for part in each] for each in (self.parts, parts)]
        return same_variables(own, other) and inputs[0] == inputs[1]

    def accumulate(self, parts: Sequence[Part], gradients: Gaussians) -> None:
        """Accumulate derivatives into the same parts, attached."""
        start = 0
        for part, own, (num, degree) in zip(parts, self.parts, self.sizes, strict=True):
            attached = {k: v for k, v in part.values.items() if dr.width(v) and dr.grad_enabled(v)}
            if attached and num > 0:
                copy = own.detach()
                dr.enable_grad([copy.values[name] for name in attached])
                rows = _rows(gradients, start, num, degree).arrays
                found = copy.gaussians().arrays
                outputs = {k: v for k, v in found.items() if k in rows and dr.grad_enabled(v)}
                for name, values in outputs.items():
                    dr.accum_grad(values, rows[name])
                dr.enqueue(dr.ADMode.Backward, list(outputs.values()))
                dr.traverse(dr.ADMode.Backward)
                for name, values in attached.items():
                    dr.accum_grad(values, dr.grad(copy.values[name]))
            start += num

    def tangents(self, parts: Sequence[Part]) -> Gaussians:
        """Return derivatives of all Gaussians along those set on the same parts, attached."""
        found = []
        for part, own in zip(parts, self.parts, strict=True):
            copy = own.detach()
            dr.enable_grad(copy.values)
            for name, values in part.values.items():
                dr.set_grad(copy.values[name], tangent_of(values))
            moved = copy.gaussians()
            dr.forward_to(moved)
            found.append(Gaussians.from_arrays({k: tangent_of(v) for k, v in moved.arrays.items()}))
        return _concatenate(found, self.gaussians.sh_degree)


def combine(parts: Sequence[Part], last: CombinedParts | None) -> CombinedParts:
    """Return the Gaussians of all parts, in order and of the highest degree.

    last: the last result, returned again while nothing has changed. Features, coefficients and
    smoothing filters that a part lacks are zeros.
    """
    parts = [part.detach() for part in parts]
    if last is not None and last.matches(parts):
        return last
    converted = [part.gaussians() for part in parts]
    sizes = [(part.num_gaussians, part.sh_degree) for part in converted]
    gaussians = _concatenate(converted, max(degree for _, degree in sizes))
    dr.eval(gaussians)
    return CombinedParts(parts, sizes, gaussians)


def _concatenate(parts: Sequence[Gaussians], degree: int) -> Gaussians:
    found = [(part.num_gaussians, part.arrays) for part in parts if part.num_gaussians > 0]
    shapes = {k: v.shape[1:] for _, arrays in found for k, v in arrays.items()}
    shapes["shN"] = _sh_shape(degree)
    whole = {}
    for name, row in shapes.items():
        blocks = [_block(arrays.get(name), 0, num, num, row) for num, arrays in found]
        filled = [block for block in blocks if dr.width(block) > 0]  # dr.concat takes no others
        flat = dr.concat(filled) if len(filled) > 1 else (filled or blocks)[0]
        whole[name] = _reshape(flat, sum(num for num, _ in found), row)
    return Gaussians.from_arrays(whole)


def _rows(gaussians: Gaussians, start: int, num: int, degree: int) -> Gaussians:
    """Return ``num`` rows from row ``start`` on, with the coefficients of ``degree``."""
    arrays = gaussians.arrays
    shapes = {k: v.shape[1:] for k, v in arrays.items()} | {"shN": _sh_shape(degree)}
    total = gaussians.num_gaussians
    blocks = {k: _block(v, start, num, total, shapes[k]) for k, v in arrays.items()}
    return Gaussians.from_arrays({k: _reshape(v, num, shapes[k]) for k, v in blocks.items()})


def _sh_shape(degree: int) -> tuple[int, int]:
    return num_coefficients(degree) - 1, 3


def _reshape(flat: Float, num: int, row: tuple[int, ...]) -> mi.TensorXf | Float:
    return mi.TensorXf(flat, (num, *row)) if row else flat


def _block(
    values: mi.TensorXf | Float | None, start: int, num: int, total: int, row: tuple[int, ...]
) -> Float:
    """Return ``num`` of ``total`` rows, flat: cut to the shape ``row``, or filled with zeros."""
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


def columns(flat: Float, width: int) -> list[Float]:
    """Return the columns of rows of ``width`` numbers; see :func:`interleave_columns`."""
    if width == 0:
        return []
    row = dr.arange(types_of(type(flat)).UInt32, dr.width(flat) // width) * width
    return [dr.gather(type(flat), flat, row + k, mode=dr.ReduceMode.Permute) for k in range(width)]


def interleave_columns(values: list[Float]) -> Float:
    """Interleave columns to flat rows; without columns, return an empty array."""
    return interleave(values) if values else mi.Float()


def entry(flat: Float, index: int) -> Float:
    """Return one entry of an array, which is no literal of kernels."""
    return dr.gather(type(flat), flat, types_of(type(flat)).UInt32(index))


def product(matrix: Float, vector: list[Float], start: int = 0) -> list[Float]:
    """Multiply by a square matrix, flat from ``start`` on."""
    size = len(vector)
    rows = [[entry(matrix, start + j * size + k) for k in range(size)] for j in range(size)]
    terms = [[a * x for a, x in zip(row, vector, strict=True)] for row in rows]
    return [reduce(operator.add, of_row) for of_row in terms]


@dataclass(frozen=True, eq=False)
class ShRotation:
    """A linear map of the coefficients of degree 1 to 3 by one matrix per degree."""

    matrices: Float  # (9 + 25 + 49,)

    @staticmethod
    def from_rotation(rotation: np.ndarray) -> ShRotation:
        """Return the rotation of spherical harmonics; rotation: (3, 3), x' = R x."""
        return ShRotation.from_matrices(sh_rotation_matrices(rotation, 3))

    @staticmethod
    def from_matrices(matrices: Sequence[np.ndarray]) -> ShRotation:
        """Return the map by matrices of degree 1, 2 and 3."""
        return ShRotation(_device(np.concatenate([matrix.ravel() for matrix in matrices])))

    def rotate_columns(self, columns: list[Float]) -> list[Float]:
        """Turn columns of the coefficients of degree 1 and above, three a coefficient."""
        turned, start = [], 0
        for degree in range(1, PER_DEGREE[len(columns) // 3 + 1] + 1):
            size = 2 * degree + 1
            band = columns[3 * (degree**2 - 1) :][: 3 * size]
            channels = [product(self.matrices, band[c::3], start) for c in range(3)]
            turned += [value for values in zip(*channels, strict=True) for value in values]
            start += size * size
        return turned


@dataclass(frozen=True, eq=False)
class Placement:
    """Gaussians of an object and its ``to_world``; see :data:`Part`."""

    values: ParameterArrays  # of the Gaussians, and to_world
    fixed_inputs: str  # name of the parameter to_world, in messages

    def detach(self) -> Placement:
        """Return a detached copy."""
        return replace(self, values=dr.detach(self.values))

    def gaussians(self) -> Gaussians:
        """Return all parameters; PluginError where they leave float32."""
        arrays = {name: values for name, values in self.values.items() if name != TO_WORLD}
        if dr.grad_enabled(self.values[TO_WORLD]) or not self._place.is_identity:
            arrays |= self._transform_arrays(arrays)
        return Gaussians.from_arrays(arrays)

    @cached_property
    def _place(self) -> Similarity:
        return similarity_of(self.values[TO_WORLD], self.fixed_inputs)

    def _transform_arrays(self, arrays: ParameterArrays) -> ParameterArrays:
        place, split = self._place, {k: _columns_of(arrays[k]) for k in ("means", "quats", "shN")}
        turned = {
            "means": product(_device(place.scale * place.rotation), split["means"]),
            "quats": product(_device(left_multiplication_matrix(place.rotation)), split["quats"]),
            "shN": ShRotation.from_rotation(place.rotation).rotate_columns(split["shN"]),
        }
        scale = _device(np.array([place.scale, np.log(place.scale)]))
        log_scales = [c + entry(scale, 1) for c in _columns_of(arrays["log_scales"])]
        moved: ParameterColumns = turned | {"log_scales": log_scales}
        if "smoothing" in arrays:
            moved["smoothing"] = [arrays["smoothing"] * entry(scale, 0)]
        if dr.grad_enabled(self.values[TO_WORLD]):
            moved = self._with_motion(moved)
        translation = _device(place.translation)
        moved["means"] = [c + entry(translation, k) for k, c in enumerate(moved["means"])]
        self._check_finite(split, moved)
        smoothing = {k: moved.pop(k)[0] for k in list(moved) if k == "smoothing"}
        tensors = {k: mi.TensorXf(interleave_columns(v), arrays[k].shape) for k, v in moved.items()}
        return tensors | smoothing

    def _check_finite(self, own: ParameterColumns, moved: ParameterColumns) -> None:
        pairs = zip(own["means"] + own["quats"], moved["means"] + moved["quats"], strict=True)
        dr.eval(moved["means"], moved["quats"])
        beyond = [dr.isfinite(before) & ~dr.isfinite(after) for before, after in pairs]
        rows = mi.UInt32(dr.compress(reduce(operator.or_, beyond)))
        if dr.width(rows) > 0:
            raise PluginError(
                f"{self.fixed_inputs} moves Gaussian {rows[0]} beyond the end of float32, 3.4e38; "
                "crop or scale the object"
            )

    def _with_motion(self, moved: ParameterColumns) -> ParameterColumns:
        """Attach Gaussians, turned about the object's origin, to a change of the matrix.

        Numbers that are not finite do not move: they would make the matrix's derivative NaN.
        """
        scale, w, shift = self._motion(dr.width(moved["means"]))
        arms = {
            k: [dr.select(dr.isfinite(c), c, 0) for c in dr.detach(values)]
            for k, values in moved.items()
        }
        r, (real, *imaginary) = mi.Vector3f(arms["means"]), arms["quats"]
        v = mi.Vector3f(imaginary)
        turns = [ShRotation.from_matrices(each) for each in sh_rotation_generators(3)]
        about_axes = zip(*(turn.rotate_columns(arms["shN"]) for turn in turns), strict=True)
        changes = {
            "means": list(scale * r + dr.cross(w, r) + shift),
            "quats": [-dr.dot(w, v) / 2, *((w * real + dr.cross(w, v)) / 2)],
            "shN": [w.x * x + w.y * y + w.z * z for x, y, z in about_axes],
            "log_scales": [scale] * 3,
            "smoothing": [c * scale for c in arms.get("smoothing", [])],
        }
        return {
            k: [a + b for a, b in zip(values, changes[k], strict=True)]
            for k, values in moved.items()
        }

    def _motion(self, num: int) -> tuple[mi.Float, mi.Vector3f, mi.Vector3f]:
        """Return l, w and the translation of a change of the matrix: attached zeros (N,)."""
        matrix, place = self.values[TO_WORLD], self._place
        change = matrix - dr.detach(matrix)
        inverse = _device(place.rotation.T / place.scale)
        inverse = mi.Matrix3f([entry(inverse, k) for k in range(9)])
        d = mi.Matrix3f([change[i, k] for i in range(3) for k in range(3)]) @ inverse
        zero = dr.opaque(mi.Float, 0, num)
        return (
            (d[0, 0] + d[1, 1] + d[2, 2]) / 3 + zero,
            mi.Vector3f(d[2, 1] - d[1, 2], d[0, 2] - d[2, 0], d[1, 0] - d[0, 1]) / 2 + zero,
            mi.Vector3f([change[i, 3] for i in range(3)]) + zero,
        )


def similarity_of(to_world: Matrix4f, name: str) -> Similarity:
    """Return the similarity nearest to a matrix; PluginError if it is too far from one."""
    matrix = np.array(dr.detach(to_world), np.float64)
    if matrix.size != 16:
        raise PluginError(f"{name} must be one transform, got {matrix.shape[2]}")
    return Similarity.from_matrix(matrix.reshape(4, 4), name)


def _device(values: np.ndarray) -> mi.Float:
    return from_host(mi.Float, values.ravel())


def _columns_of(tensor: mi.TensorXf) -> list[Float]:
    return columns(tensor.array, math.prod(tensor.shape[1:]))


ELLIPSOID_DATA_WIDTH = 10  # numbers per row: centre, standard deviations, quaternion xyzw
OPACITY_RANGE = (2.0**-64, 1 - 2.0**-24)  # invisible, its reciprocal fits float32; below 1
TRANSPARENT_LOGIT = -1e4  # logit with a sigmoid of exactly zero


def read(shape: mi.Shape) -> ParameterArrays:
    """Return a shape's arrays, attached; PluginError for missing ones and wrong sizes."""
    values = mi.traverse(shape)
    where = f"splats: the {_name(shape)}"
    missing = [name for name in ("opacities", "sh_coeffs") if name not in values]
    if missing:
        others = [name for name in values.keys() if not name.startswith("extent")]  # noqa: SIM118
        raise PluginError(
            f"{where} must have the attributes opacities and sh_coeffs; missing: "
            f"{', '.join(missing)}; it has: {', '.join(others)}"
        )
    num = dr.width(values["data"]) // ELLIPSOID_DATA_WIDTH
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


@dataclass(frozen=True, eq=False)
class Conversion:
    """The arrays of a shape; see :data:`Part`."""

    values: ParameterArrays  # data (10 N,), opacities (N,), sh_coeffs (3 K N,)
    fixed_inputs: ShRotation | None  # of the harmonics, not differentiated

    def detach(self) -> Conversion:
        """Return a detached copy."""
        return replace(self, values=dr.detach(self.values))

    def gaussians(self) -> Gaussians:
        """Convert the parameters to Gaussians."""
        num = dr.width(self.values["opacities"])
        data = columns(self.values["data"], ELLIPSOID_DATA_WIDTH)
        sh = columns(self.values["sh_coeffs"], dr.width(self.values["sh_coeffs"]) // num)
        scales, (x, y, z, w) = [dr.abs(scale) for scale in data[3:6]], data[6:]
        # Written such that a NaN is not visible.
        is_visible = (scales[0] > 0) & (scales[1] > 0) & (scales[2] > 0)
        higher = sh[3:] if self.fixed_inputs is None else self.fixed_inputs.rotate_columns(sh[3:])
        opacity = self._opacity(is_visible)
        logits = dr.log(opacity / (1 - opacity))
        log_scales = [dr.log(dr.select(is_visible, scale, 1)) for scale in scales]
        return Gaussians(
            means=mi.TensorXf(interleave(data[:3]), (num, 3)),
            quats=mi.TensorXf(interleave([w, x, y, z]), (num, 4)),
            log_scales=mi.TensorXf(interleave(log_scales), (num, 3)),
            logit_opacities=dr.select(is_visible, logits, TRANSPARENT_LOGIT),
            sh0=mi.TensorXf(interleave(sh[:3]), (num, 1, 3)),
            shN=mi.TensorXf(interleave_columns(higher), (num, len(sh) // 3 - 1, 3)),
        )

    def _opacity(self, is_visible: mi.Bool) -> mi.Float:
        """Return clamped opacities, attached within 0..1; NaN stays NaN."""
        (lowest, highest), value = OPACITY_RANGE, self.values["opacities"]
        clamped = dr.detach(dr.select(value < lowest, lowest, value))
        clamped = dr.select(clamped > highest, highest, clamped)
        inside = (value >= 0) & (value <= 1) & is_visible
        return dr.select(inside, dr.replace_grad(clamped, value), clamped)


Part = Placement | Conversion
"""Stored Gaussians, and their conversion to raw parameters in world space: ``values`` are arrays by
name, held so that their indices are not reused; ``fixed_inputs`` are compared by ==."""


def conversions_of(
    shapes: Sequence[mi.Shape], rotations: Mapping[str, ShRotation]
) -> list[Conversion]:
    """Read shapes, attached; rotations: by their ids, "": of all other shapes."""
    unknown = set(rotations) - {shape.id() for shape in shapes} - {""}
    if unknown:
        found = ", ".join(f"'{shape.id()}'" for shape in shapes if shape.id()) or "none"
        raise PluginError(
            f"splats: shapes_to_world_{min(unknown)} must end with the id of a shape of type "
            f"ellipsoids or ellipsoidsmesh, ids are: {found}"
        )
    others = rotations.get("")
    return [Conversion(read(shape), rotations.get(shape.id(), others)) for shape in shapes]
