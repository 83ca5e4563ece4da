"""View-dependent colour from real spherical harmonics, degrees 0 to 3.

Works on one Gaussian per lane; which degree is evaluated is a Python number, so that the terms of
higher degrees are in no kernel. Basis, signs and order are those of 3DGS files (Kerbl et al. 2023;
the constants are the usual normalisation, e.g. Sloan 2008, "Stupid Spherical Harmonics Tricks",
appendix A2, with the Condon-Shortley signs of the reference implementation).
"""

from __future__ import annotations

import drjit as dr

from drgs.core.constants import COLOR_MIN, SH_C0
from drgs.core.types import Array3f, Scalar

C1 = 0.4886025119029199
C2 = (
    1.0925484305920792,
    -1.0925484305920792,
    0.31539156525252005,
    -1.0925484305920792,
    0.5462742152960396,
)
C3 = (
    -0.5900435899266435,
    2.890611442640554,
    -0.4570457994644658,
    0.3731763325901154,
    -0.4570457994644658,
    1.445305721320277,
    -0.5900435899266435,
)


def num_coefficients(degree: int) -> int:
    """Return the coefficients per colour channel up to and including ``degree``."""
    return (degree + 1) ** 2


def sh_basis(direction: Array3f, degree: int) -> list[Scalar]:
    """Return the (degree + 1)^2 basis functions at a unit ``direction`` (world)."""
    basis: list[Scalar] = [SH_C0]
    if degree == 0:
        return basis
    x, y, z = direction.x, direction.y, direction.z
    basis += [-C1 * y, C1 * z, -C1 * x]
    if degree == 1:
        return basis
    xx, yy, zz = x * x, y * y, z * z
    basis += [
        C2[0] * (x * y),
        C2[1] * (y * z),
        C2[2] * (2 * zz - xx - yy),
        C2[3] * (x * z),
        C2[4] * (xx - yy),
    ]
    if degree >= 3:
        basis += [
            C3[0] * y * (3 * xx - yy),
            C3[1] * (x * y) * z,
            C3[2] * y * (4 * zz - xx - yy),
            C3[3] * z * (2 * zz - 3 * xx - 3 * yy),
            C3[4] * x * (4 * zz - xx - yy),
            C3[5] * z * (xx - yy),
            C3[6] * x * (xx - 3 * yy),
        ]
    return basis


def sh_color(coefficients: list[Array3f], direction: Array3f, degree: int) -> Array3f:
    """Return the display-space colour max(0, sum_k basis_k(direction) c_k + 0.5).

    coefficients: (degree + 1)^2; direction: unit, world, from the camera
    centre to the mean. Where the colour is clamped, its derivative is zero; at exactly 0 it passes.
    A NaN stays NaN: projection then drops the Gaussian.
    """
    color = coefficients[0] * SH_C0 + 0.5
    for basis, coefficient in zip(sh_basis(direction, degree)[1:], coefficients[1:], strict=True):
        color = dr.fma(coefficient, basis, color)
    return dr.select(color < COLOR_MIN, COLOR_MIN, color)
