"""Names of Dr.Jit's array types for signatures and fields, of any backend and precision.

Type checkers see ``drjit.auto.ad``. :func:`drgs.core.arrays.types_of` has types to create arrays.
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
    Array2f = Array2u = Array3f = Array3u = Array4f = Array4u = Any
    Bool = Float = Int32 = Matrix3f = Matrix4f = TensorXf = UInt32 = UInt64 = Any

Scalar = Float | float  # A Dr.Jit scalar or a number of the host
