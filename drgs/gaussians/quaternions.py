"""Rotations from quaternions."""

from __future__ import annotations

import drjit as dr

from drgs.core.arrays import types_of
from drgs.core.types import Array3f, Array4f, Matrix3f


def quat_to_rotation(quats: Array4f) -> Matrix3f:
    """Return the rotation matrix of ``quats`` (wxyz, any norm).

    The quaternion is first divided by its largest component, so that norms of 1e-20 and 1e20
    neither underflow nor overflow. A zero quaternion is the identity, with zero gradient.
    """
    t = types_of(type(quats.x))
    size = dr.detach(dr.max(dr.abs(quats)))
    usable = ~(size <= 0)  # a NaN goes through: projection then drops the Gaussian
    q = dr.select(usable, quats, t.Array4f(1, 0, 0, 0)) / dr.select(usable, size, 1)
    w, x, y, z = q
    two = 2 / dr.squared_norm(q)
    return t.Matrix3f(
        [
            [1 - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y)],
            [two * (x * y + w * z), 1 - two * (x * x + z * z), two * (y * z - w * x)],
            [two * (x * z - w * y), two * (y * z + w * x), 1 - two * (x * x + y * y)],
        ]
    )


def normalize(vector: Array3f) -> Array3f:
    """Return the unit vector; a zero vector stays zero, with zero gradient."""
    squared_norm = dr.squared_norm(vector)
    usable = squared_norm > 0
    return vector * dr.select(usable, dr.rsqrt(dr.select(usable, squared_norm, 1)), 0)
