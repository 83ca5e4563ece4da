"""Names of Dr.Jit's array types for signatures and fields.

The code works with every backend and precision: type checkers see the types of ``drjit.auto.ad``,
and at run time the names stand for any type. Use :func:`drgs.core.arrays.types_of` to create
arrays.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from drjit.auto.ad import (
        Array2f,
        Array2u,
        Array3f,
        Array3u,
        Array4f,
        Array4u,
        ArrayXf,
        Bool,
        Float,
        Int32,
        Matrix3f,
        Matrix4f,
        TensorXf,
        UInt32,
        UInt64,
    )
else:
    Array2f = Array2u = Array3f = Array3u = Array4f = Array4u = ArrayXf = Any
    Bool = Float = Int32 = Matrix3f = Matrix4f = TensorXf = UInt32 = UInt64 = Any

Scalar = Float | float  # A Dr.Jit scalar or a number of the host
