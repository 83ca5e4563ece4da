"""``.splat`` files of antimatter15's viewer: 32 bytes per Gaussian, without harmonics.

Source of the layout: the README and ``convert.py`` of antimatter15/splat. A row has position and
scale, 3 float32 each, then red, green, blue, opacity and the quaternion wxyz in 8 bits each, that
as 128 (q + 1). Rows fall by the product of opacity and volume, so that a viewer can show the most
important Gaussians while it loads the rest. There is no header.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np
from typing_extensions import override

from drgs.core.constants import SH_C0
from drgs.core.errors import Place, UserError
from drgs.core.files import read_bytes
from drgs.io.formats import FORMATS, Arrays, FileFormat, Scalar, check_range
from drgs.io.quantization import (
    MIN_LOG_SCALE,
    arrays_from_activated,
    colors_from_sh0,
    normalize_quaternions,
    opacities_from_logits,
    require_scene_memory,
    round_to_uint32,
    sh0_from_colors,
)

MAX_BYTES = 1 << 33  # largest file: 8.6 GB

MAX_NUMBER = 1e12
"""Largest position or scale: letters of a file of another kind, read as numbers, are larger."""

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


@FORMATS.register("splat")
class Splat(FileFormat):
    """antimatter15's format."""

    suffix = ".splat"
    description = "antimatter15's .splat, for old viewers: no harmonics"
    has_harmonics = False
    ranges = MappingProxyType(
        {"sh0": (-0.5 / SH_C0, 0.5 / SH_C0), "log_scales": (MIN_LOG_SCALE, np.log(MAX_NUMBER))}
    )

    @override
    def read(self, path: Path) -> tuple[Arrays, Mapping[str, Scalar]]:
        content = read_bytes(path, "file", MAX_BYTES)
        if not content or len(content) % ROW.itemsize:
            raise UserError(
                f"{Place(path, 'byte', len(content))}: the file must have {ROW.itemsize} bytes for "
                "each Gaussian, at least one; it is damaged, or was cut off"
            )
        rows = np.frombuffer(content, ROW)
        require_scene_memory(path, len(rows), 1)
        check_range(path, "mean", rows["mean"], -MAX_NUMBER, MAX_NUMBER)
        check_range(path, "scale", rows["scale"], 0, MAX_NUMBER)
        quats, rgba = rows["quat"].astype(np.float64) / 128 - 1, rows["rgba"] / 255
        sh0 = sh0_from_colors(rgba[:, :3])
        return arrays_from_activated(rows["mean"], quats, rows["scale"], rgba[:, 3], sh0), {}

    @override
    def encode(self, gaussians: Arrays, rendered_with: Mapping[str, Scalar]) -> bytes:
        if (extent := np.abs(gaussians["means"]).max()) > MAX_NUMBER:
            raise UserError(
                f"the format splat holds positions of at most {MAX_NUMBER:g}, got {extent:g}; crop "
                "or scale the scene"
            )
        opacities = opacities_from_logits(gaussians["logit_opacities"])
        log_scales = gaussians["log_scales"].astype(np.float64)
        importance = log_scales.sum(axis=1) + np.log(opacities)
        rows = np.empty(len(opacities), ROW)
        rows["mean"] = gaussians["means"]
        rows["scale"] = np.exp(np.minimum(log_scales, np.log(MAX_NUMBER))).astype(np.float32)
        rgba = np.column_stack([colors_from_sh0(gaussians["sh0"]), opacities])
        rows["rgba"] = round_to_uint32(rgba * 255, 255)
        rows["quat"] = round_to_uint32(normalize_quaternions(gaussians["quats"]) * 128 + 128, 255)
        return rows[np.argsort(-importance, kind="stable")].tobytes()
