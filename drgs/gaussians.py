"""The scene representation: N anisotropic 3D Gaussians with view-dependent colour.

Layer 1. A :class:`Gaussians` comes from disk (``drgs.io``) or from the trainer's optimizer and
is what ``drgs.projection`` and ``drgs.sh`` read. It holds either numpy arrays (as files give
them; no Dr.Jit backend is touched) or Dr.Jit arrays, and every stage derives its types from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

PARAMETER_NAMES = ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN")


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians. Raw, unconstrained values carry ``log_`` / ``logit_`` in their names.

    All are row-major tensors (``TensorXf`` / ``TensorXf64``, or numpy arrays), except
    ``logit_opacities``, a flat ``Float``.
    """

    means: Any  # (N, 3) world
    quats: Any  # (N, 4) wxyz, not normalised
    log_scales: Any  # (N, 3) natural logarithm of the standard deviations, world units
    logit_opacities: Any  # (N,)
    sh0: Any  # (N, 1, 3) degree-0 coefficients, display space
    shN: Any  # (N, K - 1, 3) coefficients of degree >= 1, K = (degree + 1)^2  # noqa: N815

    @property
    def num_gaussians(self) -> int:
        """N."""
        return self.means.shape[0]

    @property
    def sh_degree(self) -> int:
        """Highest spherical-harmonics degree stored: 0 to 3."""
        return {0: 0, 3: 1, 8: 2, 15: 3}[self.shN.shape[1]]

    @property
    def scales(self) -> Any:
        """(N, 3) standard deviations, world units."""
        return _exp(self.log_scales)

    @property
    def opacities(self) -> Any:
        """(N,) in (0, 1)."""
        return 1.0 / (1.0 + _exp(-self.logit_opacities))

    def numpy(self) -> Gaussians:
        """The same Gaussians as numpy arrays on the host."""
        arrays = {name: np.array(getattr(self, name)) for name in PARAMETER_NAMES}
        return Gaussians(**arrays)

    def to(self, tensor_type: type) -> Gaussians:
        """Copy to Dr.Jit tensors of type ``tensor_type`` (``TensorXf`` or ``TensorXf64``)."""
        flat_type = dr.array_t(tensor_type)

        def upload(name: str) -> Any:
            values = np.ascontiguousarray(getattr(self, name), dtype=_numpy_dtype(flat_type))
            # Dr.Jit wraps numpy's memory on the CPU, and may drop a gather of all of it: only
            # what is written to memory of its own is a copy.
            flat = dr.empty(flat_type, values.size)
            if values.size > 0:
                index = dr.arange(dr.uint32_array_t(flat_type), values.size)
                dr.scatter(flat, flat_type(values.ravel()), index)
                dr.eval(flat)
            return flat if name == "logit_opacities" else tensor_type(flat, values.shape)

        uploaded = Gaussians(**{name: upload(name) for name in PARAMETER_NAMES})
        dr.sync_thread()  # the source may change from here on
        return uploaded


def _exp(x: Any) -> Any:
    return np.exp(x) if isinstance(x, np.ndarray) else dr.exp(x)


def _numpy_dtype(flat_type: type) -> type:
    return np.float64 if dr.type_v(flat_type) == dr.VarType.Float64 else np.float32
