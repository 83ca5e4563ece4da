"""The scene representation: N anisotropic 3D Gaussians with view-dependent colour.

A :class:`Gaussians` comes from disk (``drgs.io``) or from the trainer's optimizer and is what
``drgs.splatting.projection`` and ``drgs.gaussians.sh`` read. It holds either numpy arrays (as files
give them; no Dr.Jit backend is touched) or Dr.Jit arrays, and every stage derives its types from
it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from drgs.core.arrays import from_host

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
    smoothing: Any = (
        None  # (N,) world units, not optimised: see drgs.effects.smoothing; None: there is none
    )
    features: Any = None  # by name, (N, C) each: whatever else is to be composited; None: nothing

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
        features = self.features and {k: np.array(v) for k, v in self.features.items()}
        return Gaussians(
            **{name: np.array(getattr(self, name)) for name in self._names}, features=features
        )

    def to(self, tensor_type: type) -> Gaussians:
        """Copy to Dr.Jit tensors of type ``tensor_type`` (``TensorXf`` or ``TensorXf64``)."""
        flat_type = dr.array_t(tensor_type)

        def upload(values: Any) -> Any:
            values = np.asarray(values)
            flat = from_host(flat_type, values)
            return flat if values.ndim == 1 else tensor_type(flat, values.shape)

        features = self.features and {k: upload(v) for k, v in self.features.items()}
        return Gaussians(
            **{name: upload(getattr(self, name)) for name in self._names}, features=features
        )

    @property
    def _names(self) -> tuple[str, ...]:
        return PARAMETER_NAMES if self.smoothing is None else (*PARAMETER_NAMES, "smoothing")


def _exp(x: Any) -> Any:
    return np.exp(x) if isinstance(x, np.ndarray) else dr.exp(x)
