"""Splat objects: Gaussians that a ``to_world`` places in the scene, and derivatives of that.

Imported when a scene has such objects. A ``to_world`` x' = k R x + t makes of a Gaussian

    mean' = k R mean + t    quat' = q_R quat    log_scale' = log_scale + ln k
    smoothing' = k smoothing    shN' = D(R) shN

with D the rotation of spherical harmonics (:mod:`drgs.gaussians.rotation`). k and R are those of
the similarity that is nearest to the matrix, so that each of its twelve numbers has a derivative:
a change dA of its upper 3 x 3 block A rotates by w and scales by 1 + l, where

    dA A^-1 = l I + [w]x + S

and S, symmetric and without trace, changes nothing. Along l and w, means change by l r + w x r with
r = mean' - t, quaternions by (0, w) quat' / 2, and harmonics by sum_a w_a G_a shN' with G_a the
generators of D. Sums over Gaussians have an order that is the same in every run.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, reduce
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.core.arrays import from_host
from drgs.core.errors import PluginError
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.gaussians.rotation import left_multiplication_matrix
from drgs.gaussians.similarity import Similarity
from drgs.integrator.gathering import Turn, columns, interleaved, number_of

TO_WORLD = "to_world"


@dataclass(frozen=True)
class PlacedGaussians:
    """Gaussians in the space of their object, and its place."""

    gaussians: Gaussians
    to_world: Any  # Matrix4f, of one lane

    @property
    def num_gaussians(self) -> int:
        """N."""
        return self.gaussians.num_gaussians

    @property
    def sh_degree(self) -> int:
        """Highest spherical-harmonics degree stored: 0 to 3."""
        return self.gaussians.sh_degree

    def parameters(self) -> dict[str, Any]:
        """Differentiable arrays by name."""
        raw = {name: getattr(self.gaussians, name) for name in PARAMETER_NAMES}
        return {**raw, **(self.gaussians.features or {}), TO_WORLD: self.to_world}


@dataclass(frozen=True, eq=False)
class Placement:
    """The move of an object into the scene; see :class:`drgs.integrator.gathering.Part`."""

    values: PlacedGaussians
    name: str  # of the parameter to_world, in messages

    @property
    def fixed(self) -> None:
        """Nothing besides the values."""

    def gaussians(self) -> Gaussians:
        """All parameters, detached; where nothing is moved, the object's own.

        Raises PluginError where they leave float32.
        """
        own = self.values.gaussians
        if self._place.is_identity:
            return own
        numbers, turned = self._numbers, self._turned(_Columns.of(vars(own)))
        means = [mean + number_of(numbers.translation, k) for k, mean in enumerate(turned.means)]
        moved = turned._replace(means=means)
        self._check_finite(moved)
        return replace(
            own,
            **moved.tensors(),
            log_scales=_plus(own.log_scales, number_of(numbers.scale, 1)),
            smoothing=self._smoothing,
        )

    def tangent(self, tangent: Mapping[str, Any]) -> Gaussians:
        """Derivatives of the parameters along those of ``values.parameters()``."""
        own, motion = self.values.gaussians, self._motion_along(tangent[TO_WORLD])
        smoothing = self._smoothing
        turned, moving = self._turned(_Columns.of(tangent)), self._moving(motion)
        sums = [
            [a + b for a, b in zip(*both, strict=True)] for both in zip(turned, moving, strict=True)
        ]
        return Gaussians(
            **_Columns(*sums).tensors(),
            log_scales=_plus(tangent["log_scales"], motion.scale),
            logit_opacities=tangent["logit_opacities"],
            sh0=tangent["sh0"],
            smoothing=None if smoothing is None else smoothing * motion.scale,
            features=own.features and {name: tangent[name] for name in own.features},
        )

    def adjoint(self, gradients: Gaussians, names: Collection[str]) -> dict[str, Any]:
        """Derivatives with respect to parameters of these names, from those of ``gaussians()``."""
        found = {**vars(gradients), **(gradients.features or {})}
        if not self._place.is_identity:
            found |= self._turned(_Columns.of(vars(gradients)), transposed=True).tensors()
        if TO_WORLD in names:
            found[TO_WORLD] = self._matrix_adjoint(self._adjoint_of_moving(gradients))
        return {name: found[name] for name in names}

    # ------------------------------------------------------------------------------------------
    # The move
    # ------------------------------------------------------------------------------------------

    @cached_property
    def _place(self) -> Similarity:
        return similarity_of(self.values.to_world, self.name)

    @cached_property
    def _numbers(self) -> _Numbers:
        return _Numbers.of(self._place)

    def _check_finite(self, moved: _Columns) -> None:
        own = _Columns.of(vars(self.values.gaussians))
        columns = zip(own.means + own.quats, moved.means + moved.quats, strict=True)
        dr.eval(moved.means, moved.quats)
        beyond = [dr.isfinite(before) & ~dr.isfinite(after) for before, after in columns]
        rows = dr.compress(reduce(operator.or_, beyond))
        if dr.width(rows) > 0:
            raise PluginError(
                f"{self.name} moves Gaussian {rows[0]} beyond the end of float32, 3.4e38; crop or "
                "scale the object"
            )

    def _turned(self, of: _Columns, transposed: bool = False) -> _Columns:
        """The linear part of the move, or its transpose."""
        if self._place.is_identity:
            return of
        numbers = self._numbers
        return _Columns(
            _product(numbers.linear, of.means, transposed),
            _product(numbers.quaternion, of.quats, transposed),
            numbers.harmonics.of(of.shN, transposed),
        )

    @property
    def _smoothing(self) -> Any:
        """The filter as large as the object is."""
        own = self.values.gaussians.smoothing
        return None if own is None else own * number_of(self._numbers.scale, 0)

    @cached_property
    def _arms(self) -> _Columns:
        """The Gaussians turned and scaled, about the object's origin.

        Numbers that are not finite, of Gaussians that are not visible, are zeros: they would make
        all of a sum NaN.
        """
        turned = self._turned(_Columns.of(vars(self.values.gaussians)))
        return _Columns(*([dr.select(dr.isfinite(c), c, 0) for c in part] for part in turned))

    def _moving(self, motion: _Motion) -> _Columns:
        """Derivatives along a motion of the object."""
        arms, w = self._arms, motion.rotation
        r, (real, *imaginary) = mi.Vector3f(arms.means), arms.quats
        v = mi.Vector3f(imaginary)
        quats = [-dr.dot(w, v) / 2, *((w * real + dr.cross(w, v)) / 2)]
        about_axes = zip(*(turn.of(arms.shN) for turn in Turn.generators()), strict=True)
        return _Columns(
            list(motion.scale * r + dr.cross(w, r) + motion.translation),
            quats,
            [w.x * x + w.y * y + w.z * z for x, y, z in about_axes],
        )

    def _adjoint_of_moving(self, gradients: Gaussians) -> _Motion:
        """Derivatives with respect to a motion of the object."""
        arms, of = self._arms, _Columns.of(vars(gradients))
        r, (real, *imaginary) = mi.Vector3f(arms.means), arms.quats
        v = mi.Vector3f(imaginary)
        d_means, (d_real, *d_imaginary) = mi.Vector3f(of.means), of.quats
        d_v = mi.Vector3f(d_imaginary)
        scale = dr.dot(d_means, r) + sum(columns(gradients.log_scales.array, 3))
        if gradients.smoothing is not None and self._smoothing is not None:
            scale += gradients.smoothing * self._smoothing
        rotation = dr.cross(r, d_means) + (real * d_v - d_real * v + dr.cross(v, d_v)) / 2
        for axis, turn in enumerate(Turn.generators()):
            for d_c, c in zip(of.shN, turn.of(arms.shN), strict=True):
                rotation[axis] += d_c * c
        return _Motion(scale, rotation, d_means).summed()

    # ------------------------------------------------------------------------------------------
    # The matrix
    # ------------------------------------------------------------------------------------------

    def _motion_along(self, d_matrix: Any) -> _Motion:
        """The motion that a change of the matrix is."""
        dr.make_opaque(d_matrix)
        d = _matrix_product(_block(d_matrix), self._numbers.inverse)
        return _Motion(
            scale=(d[0][0] + d[1][1] + d[2][2]) / 3,
            rotation=mi.Vector3f(d[2][1] - d[1][2], d[0][2] - d[2][0], d[1][0] - d[0][1]) / 2,
            translation=mi.Vector3f([d_matrix[i, 3] for i in range(3)]),
        )

    def _matrix_adjoint(self, of: _Motion) -> Any:
        """Derivatives with respect to the matrix, from those with respect to a motion."""
        x, y, z = of.rotation / 2
        scale = of.scale / 3
        d_motion = [[scale, -z, y], [z, scale, -x], [-y, x, scale]]
        rows = _matrix_product(d_motion, self._numbers.inverse, transposed=True)
        rows = [[*row, t] for row, t in zip(rows, of.translation, strict=True)]
        return mi.Matrix4f([*rows, [0, 0, 0, 0]])


def similarity_of(to_world: Any, name: str) -> Similarity:
    """The similarity that is nearest to a Matrix4f, which is read back from the device.

    Raises PluginError that begins with ``name`` unless it is close to one.
    """
    matrix = np.array(dr.detach(to_world), np.float64)
    if matrix.size != 16:
        raise PluginError(f"{name} must be one transform, got {matrix.shape[2]}")
    return Similarity.of(matrix.reshape(4, 4), name)


# ----------------------------------------------------------------------------------------------
# Numbers
# ----------------------------------------------------------------------------------------------


class _Columns(NamedTuple):
    """Columns of the parameters that turn."""

    means: list[Any]
    quats: list[Any]
    shN: list[Any]  # noqa: N815

    @staticmethod
    def of(tensors: Mapping[str, Any]) -> _Columns:
        """Split (N, ...) tensors by name into columns."""
        found = (tensors[name] for name in _Columns._fields)
        return _Columns(*(columns(t.array, math.prod(t.shape[1:])) for t in found))

    def tensors(self) -> dict[str, Any]:
        """Arrays by name, (N, ...)."""
        num = dr.width(self.means)
        shapes = {"means": (num, 3), "quats": (num, 4), "shN": (num, len(self.shN) // 3, 3)}
        return {n: mi.TensorXf(interleaved(getattr(self, n)), s) for n, s in shapes.items()}


class _Motion(NamedTuple):
    """A change of place, or derivatives with respect to it."""

    scale: Any  # Float: relative change
    rotation: Any  # Vector3f: angle times axis, world
    translation: Any  # Vector3f, world

    def summed(self) -> _Motion:
        """Over all Gaussians."""
        dr.eval(self)
        return _Motion(
            dr.sum(self.scale),
            mi.Vector3f([dr.sum(c) for c in self.rotation]),
            mi.Vector3f([dr.sum(c) for c in self.translation]),
        )


@dataclass(frozen=True)
class _Numbers:
    """Numbers of a place on the device, compiled into no kernel."""

    linear: Any  # Float (9,): k R
    inverse: Any  # Float (9,): of that
    translation: Any  # Float (3,)
    quaternion: Any  # Float (16,): the product with q_R from the left
    scale: Any  # Float (2,): k, ln k
    harmonics: Turn

    @staticmethod
    def of(place: Similarity) -> _Numbers:
        """All numbers of one place."""
        numbers = {
            "linear": place.scale * place.rotation,
            "inverse": place.rotation.T / place.scale,
            "translation": place.translation,
            "quaternion": left_multiplication_matrix(place.rotation),
            "scale": np.array([place.scale, np.log(place.scale)]),
        }
        on_device = {name: from_host(mi.Float, values) for name, values in numbers.items()}
        return _Numbers(**on_device, harmonics=Turn.by(place.rotation))


def _product(matrix: Any, vector: list[Any], transposed: bool = False) -> list[Any]:
    """matrix: flat, square."""
    n = len(vector)
    cells = [[k * n + j if transposed else j * n + k for k in range(n)] for j in range(n)]
    rows = [[number_of(matrix, cell) for cell in row] for row in cells]
    return [_dot(row, vector) for row in rows]


def _matrix_product(
    rows: list[list[Any]], matrix: Any, transposed: bool = False
) -> list[list[Any]]:
    """rows of a 3 x 3 matrix, times ``matrix``, flat."""
    return [_product(matrix, row, not transposed) for row in rows]


def _dot(a: list[Any], b: list[Any]) -> Any:
    terms = [x * y for x, y in zip(a, b, strict=True)]
    return sum(terms[1:], terms[0])


def _block(matrix: Any) -> list[list[Any]]:
    return [[matrix[i, k] for k in range(3)] for i in range(3)]


def _plus(tensor: Any, number: Any) -> Any:
    return mi.TensorXf(tensor.array + number, tensor.shape)
