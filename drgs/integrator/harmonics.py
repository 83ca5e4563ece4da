"""Spherical harmonics coefficients on the device, turned by a rotation that the host knows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.core.arrays import from_host, types_of
from drgs.gaussians.rotation import sh_rotation_generators, sh_rotation_matrices
from drgs.gaussians.sh import num_coefficients

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
