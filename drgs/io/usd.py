"""USD: Gaussians as a ``ParticleField3DGaussianSplat``. The extra ``usd``.

The schema is that of OpenUSD's ``usdVol``, from version 26.03 on: positions, orientations (unit
quaternions wxyz), linear scales, opacities after the sigmoid, and harmonics Gaussian by Gaussian in
the order and with the signs of the 3DGS reference. In stages that are written, z is up and colours
are in display space. Stages with y up, half precision and animated ones, at their first time, are
read as well; a prim may be moved, but not turned or scaled.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Mapping
from functools import partial
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from typing_extensions import override

from drgs.core.child_process import run_in_child
from drgs.core.environment import require_module
from drgs.core.errors import UserError, UserNote, format_names, note_user, one_line
from drgs.core.files import refuse_damage
from drgs.core.memory import require_memory
from drgs.core.origin import WORLD
from drgs.io.formats import FORMATS, ORIGIN, UP, Arrays, FileFormat, Scalar, check_range, pop_origin
from drgs.io.quantization import (
    MIN_LOG_SCALE,
    arrays_from_activated,
    normalize_quaternions,
    opacities_from_logits,
    require_scene_memory,
)

PRIM = "/Gaussians"

COLOR_SPACE = "srgb_rec709_scene"  # openUSD's name of sRGB's primaries and transfer function

LEAST_S, BYTES_PER_S = 20.0, 1e6
LEAST_BYTES, RATIO = 1 << 31, 32
"""Time and memory that a file may take: of a file without content, and by its bytes."""

EXTENT_STDS = 3.0  # standard deviations of a Gaussian that count for the extent


@FORMATS.register("usd")
class Usd(FileFormat):
    """OpenUSD's particle fields."""

    suffix = ".usdc"
    other_names = frozenset({".usd", ".usda", ".usdz"})
    description = "OpenUSD's ParticleField3DGaussianSplat (extra usd)"
    up = "z"
    metadata = frozenset(ORIGIN)
    ranges = MappingProxyType({"log_scales": (MIN_LOG_SCALE, 80.0)})

    @override
    def read(self, path: Path) -> tuple[Arrays, Mapping[str, Scalar]]:
        """Return the Gaussians of the only prim of this kind, its translation, and the axis up."""
        _import_openusd()
        size = path.stat().st_size
        require_memory(path, 2 * size, "the file")
        limits = {"seconds": LEAST_S + size / BYTES_PER_S, "memory": LEAST_BYTES + RATIO * size}
        try:
            return run_in_child(_read_file, path, watch=note_user, **limits)
        except RuntimeError as error:  # OpenUSD may crash, wait, or take all memory
            text = str(error).partition(": ##")[0].strip()  # before the frame of a warning
            reason = one_line(text.splitlines()[-1], 200)
            raise UserError(f"{path}: not a valid USD file: OpenUSD ended: {reason}") from None

    @override
    def encode(self, gaussians: Arrays, rendered_with: Mapping[str, Scalar]) -> bytes:
        """Return a binary USD file, in which the origin is the translation of the prim."""
        Sdf, Usd, UsdGeom, UsdVol, Vt = _import_openusd("Sdf", "Usd", "UsdGeom", "UsdVol", "Vt")
        stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        splats = UsdVol.ParticleField3DGaussianSplat.Define(stage, Sdf.Path(PRIM))
        stage.SetDefaultPrim(splats.GetPrim())
        origin = pop_origin("rendered_with", dict(rendered_with))
        if origin != WORLD:
            UsdGeom.Xformable(splats).AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(origin)
        Usd.ColorSpaceAPI.Apply(splats.GetPrim()).CreateColorSpaceNameAttr(COLOR_SPACE)
        means = _float32(gaussians["means"])
        scales = _float32(np.exp(np.minimum(gaussians["log_scales"].astype(np.float64), 80)))
        quats_xyzw = _float32(np.roll(normalize_quaternions(gaussians["quats"]), -1, axis=1))
        opacities = _float32(opacities_from_logits(gaussians["logit_opacities"]))
        harmonics = np.concatenate([gaussians["sh0"], gaussians["shN"]], axis=1)
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


def _import_openusd(*names: str) -> list[Any]:
    """Return modules of OpenUSD, which has no stubs."""
    require_module("pxr", "usd", "USD")
    if not hasattr(import_module("pxr.UsdVol"), "ParticleField3DGaussianSplat"):
        raise UserError("USD needs OpenUSD 26.03 or newer: pip install 'drgs[usd]'")
    return [import_module(f"pxr.{name}") for name in names]


def _read_file(path: Path, report: Callable[[str], None]) -> tuple[Arrays, Mapping[str, Scalar]]:
    """Read a file, in a process of its own; report: takes notes for the user."""
    os.environ["PXR_WORK_THREAD_LIMIT"] = "1"  # each thread takes addresses from the limit
    with warnings.catch_warnings(record=True) as notes:
        warnings.simplefilter("always", UserNote)
        with refuse_damage(f"{path}: not a valid USD file"):
            result = _read_stage(path)
    for note in notes:
        if issubclass(note.category, UserNote):
            report(str(note.message))
    return result


def _read_stage(path: Path) -> tuple[Arrays, Mapping[str, Scalar]]:
    Gf, Sdf, Usd, UsdGeom, UsdVol = _import_openusd("Gf", "Sdf", "Usd", "UsdGeom", "UsdVol")
    layer = Sdf.Layer.FindOrOpen(str(path))
    if others := [*layer.GetCompositionAssetDependencies(), *layer.GetExternalAssetDependencies()]:
        raise UserError(
            f"{path}: refers to other files, which are not read ({format_names(others)}); join "
            "them first: usdcat --flatten"
        )
    stage = Usd.Stage.Open(layer)
    prims = [p for p in stage.Traverse() if p.IsA(UsdVol.ParticleField3DGaussianSplat)]
    if len(prims) != 1:
        raise UserError(
            f"{path}: must have one ParticleField3DGaussianSplat, got {len(prims) or 'none'}"
        )
    place, time = f"{path}: prim {prims[0].GetPath()}", Usd.TimeCode.EarliestTime()
    space = Usd.ColorSpaceAPI(prims[0]).GetColorSpaceNameAttr().Get()
    if space not in (None, "", COLOR_SPACE):
        note = f"colours of the space {one_line(space, 40)} are read as of {COLOR_SPACE}"
        note_user(f"{place}: {note}")
    to_world = UsdGeom.Xformable(prims[0]).ComputeLocalToWorldTransform(time)
    origin = to_world.ExtractTranslation()
    if to_world != Gf.Matrix4d().SetTranslate(origin):
        raise UserError(
            f"{place}: splats that a prim rotates or scales are not read; apply it to them in "
            "the program that wrote the file"
        )
    read = partial(_read_attribute, place, UsdVol.ParticleField3DGaussianSplat(prims[0]), time)
    means = read("Positions", 3)
    num = len(means)
    quats_xyzw, scales = read("Orientations", 4, num), read("Scales", 3, num, 0)
    opacities = read("Opacities", 1, num, 0, 1)[:, 0]
    harmonics = read("RadianceSphericalHarmonicsCoefficients", 3)
    per_gaussian, rest = divmod(len(harmonics), num)
    if rest or per_gaussian not in (1, 4, 9, 16):
        raise UserError(
            f"{place}: RadianceSphericalHarmonicsCoefficients: 1, 4, 9 or 16 for each of "
            f"{num:,} Gaussians were expected, got {len(harmonics):,}"
        )
    require_scene_memory(path, num, per_gaussian, turned=True)
    harmonics = harmonics.reshape(num, per_gaussian, 3)
    quats = np.roll(quats_xyzw, 1, axis=1)
    arrays = arrays_from_activated(means, quats, scales, opacities, harmonics)
    rendered_with: dict[str, Scalar] = {UP: UsdGeom.GetStageUpAxis(stage).lower()}
    if tuple(origin) != WORLD:
        rendered_with |= zip(ORIGIN, map(float, origin), strict=True)
    return arrays, rendered_with


def _read_attribute(
    place: str,
    field: Any,
    time: object,
    name: str,
    width: int,
    num: int | None = None,
    least: float = -np.inf,
    most: float = np.inf,
) -> np.ndarray:
    """Return an attribute (N, width) of single or else half precision."""
    values = getattr(field, f"Get{name}Attr")().Get(time)
    if not values:
        values = getattr(field, f"Get{name}hAttr")().Get(time)
    rows = np.asarray(values or [], np.float32).reshape(-1, width)
    if not len(rows) or num not in (None, len(rows)):
        expected = "at least one" if num is None else f"{num:,} of them"
        raise UserError(f"{place}: {name}: {expected} expected, got {len(rows):,}")
    check_range(place, name, rows, least, most)
    return rows


def _float32(values: ArrayLike) -> np.ndarray:
    return np.ascontiguousarray(values, np.float32)
