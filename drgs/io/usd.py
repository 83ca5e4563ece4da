"""USD: Gaussians as a ``ParticleField3DGaussianSplat``; written, not read. The extra ``usd``.

The schema is that of OpenUSD's ``usdVol``, from version 26.03 on: positions, orientations (unit
quaternions wxyz), linear scales, opacities after the sigmoid, and harmonics Gaussian by Gaussian in
the order and with the signs of the 3DGS reference. In the stage, z is up and colours are in display
space.
"""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import override

from drgs.core.environment import require_module
from drgs.core.errors import UserError
from drgs.core.origin import WORLD
from drgs.io.formats import FORMATS, ORIGIN, Arrays, FileFormat, Scalar, pop_origin
from drgs.io.quantization import normalize_quaternions, opacities_from_logits

PRIM = "/Gaussians"

COLOR_SPACE = "srgb_rec709_scene"  # openUSD's name of sRGB's primaries and transfer function

EXTENT_STDS = 3.0  # standard deviations of a Gaussian that count for the extent


@FORMATS.register("usd")
class Usd(FileFormat):
    """OpenUSD's particle fields."""

    suffix = ".usdc"
    description = "OpenUSD's ParticleField3DGaussianSplat (extra usd), written only"
    up = "z"
    metadata = frozenset(ORIGIN)

    @override
    def encode(self, gaussians: Arrays, rendered_with: Mapping[str, Scalar]) -> bytes:
        """Return a binary USD file, in which the origin is the translation of the prim."""
        require_module("pxr", "usd", "USD")
        # OpenUSD has no stubs.
        Sdf, Usd, UsdGeom, UsdVol, Vt = (
            import_module(f"pxr.{name}") for name in ("Sdf", "Usd", "UsdGeom", "UsdVol", "Vt")
        )
        if not hasattr(UsdVol, "ParticleField3DGaussianSplat"):
            raise UserError("USD needs OpenUSD 26.03 or newer: pip install 'drgs[usd]'")
        g = gaussians
        stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, Sdf.Path(PRIM))
        stage.SetDefaultPrim(splats.GetPrim())
        origin = pop_origin("rendered_with", dict(rendered_with))
        if origin != WORLD:
            UsdGeom.Xformable(splats).AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(origin)
        Usd.ColorSpaceAPI.Apply(splats.GetPrim()).CreateColorSpaceNameAttr(COLOR_SPACE)
        means = _float32(g["means"])
        scales = _float32(np.exp(np.minimum(g["log_scales"].astype(np.float64), 80)))
        quats_xyzw = _float32(np.roll(normalize_quaternions(g["quats"]), -1, axis=1))
        opacities = _float32(opacities_from_logits(g["logit_opacities"]))
        harmonics = np.concatenate([g["sh0"], g["shN"]], axis=1)
        splats.CreatePositionsAttr(Vt.Vec3fArray.FromNumpy(means))
        splats.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(quats_xyzw))
        splats.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scales))
        splats.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(opacities))
        splats.CreateRadianceSphericalHarmonicsDegreeAttr(round(np.sqrt(harmonics.shape[1])) - 1)
        coefficients = Vt.Vec3fArray.FromNumpy(_float32(harmonics.reshape(-1, 3)))
        splats.CreateRadianceSphericalHarmonicsCoefficientsAttr(coefficients)
        reach = EXTENT_STDS * scales.max(axis=1, keepdims=True)
        corners = _float32([(means - reach).min(axis=0), (means + reach).max(axis=0)])
        splats.CreateExtentAttr(Vt.Vec3fArray.FromNumpy(corners))
        with TemporaryDirectory() as folder:  # OpenUSD writes binary layers to files only
            path = Path(folder) / "gaussians.usdc"
            stage.GetRootLayer().Export(str(path))
            return path.read_bytes()


def _float32(values: ArrayLike) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32)
