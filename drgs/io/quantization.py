"""Numbers rounded to bits, as several file formats hold them, and Morton order."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from drgs.core.constants import SH_C0
from drgs.core.memory import require_memory

MAX_LOGIT = 23 * math.log(2)
"""Logit of the largest opacity below 1 that a sigmoid in float32 gives: 1 / (1 + 2^-23)."""

MIN_LOGIT = -125 * math.log(2)  # of about the smallest: exp of less is no number in float32

MIN_LOG_SCALE, MAX_LOG_SCALE = -126 * math.log(2), 127 * math.log(2)
"""Logarithms of the extreme normal numbers of float32; the smallest one is for a scale of 0."""

_REMAINING_COMPONENTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])
"""Indices of the other three components, by the index of one of four."""


def require_scene_memory(
    path: str | Path, count: int, harmonics: int, turned: bool = False
) -> None:
    """Raise :class:`UserError` unless there is the memory to decode so many Gaussians.

    harmonics: coefficients of each; turned: whether the axes are turned to ours afterwards.
    Measured: 276 bytes at degree 0, 808 at degree 3, and 1,372 where they are turned.
    """
    needed = count * (240 + (72 if turned else 36) * harmonics)
    require_memory(path, needed, f"a scene of {count:,} Gaussians")


def round_to_uint32(values: np.ndarray, largest: int) -> np.ndarray:
    """Return the nearest whole numbers from 0 to ``largest``."""
    return np.clip(np.floor(np.asarray(values, np.float64) + 0.5), 0, largest).astype(np.uint32)


def opacities_from_logits(logits: np.ndarray) -> np.ndarray:
    """Return opacities (N,) float64."""
    return 1 / (1 + np.exp(-np.clip(logits.astype(np.float64), -700, 700)))


def logits_from_opacities(opacities: np.ndarray) -> np.ndarray:
    """Return logits (N,) float32 of opacities (N,); those of 0 and 1 are finite."""
    opacities = opacities.astype(np.float64)
    with np.errstate(divide="ignore"):
        logits = np.log(opacities) - np.log1p(-opacities)
    return np.clip(logits, MIN_LOGIT, MAX_LOGIT).astype(np.float32)


def log_scales_from_scales(scales: np.ndarray) -> np.ndarray:
    """Return finite logarithms (N, 3) float32 of standard deviations (N, 3), also of 0."""
    with np.errstate(divide="ignore"):
        logarithms = np.log(scales.astype(np.float64))
    return np.maximum(logarithms, MIN_LOG_SCALE).astype(np.float32)


def colors_from_sh0(sh0: np.ndarray) -> np.ndarray:
    """Return base colours (N, 3) float64, display space, of coefficients (N, 1, 3)."""
    return 0.5 + SH_C0 * sh0[:, 0].astype(np.float64)


def sh0_from_colors(colors: np.ndarray) -> np.ndarray:
    """Return coefficients (N, 1, 3) of base colours (N, 3), display space."""
    return ((colors - 0.5) / SH_C0)[:, None, :]


def arrays_from_activated(
    means: np.ndarray, quats: np.ndarray, scales: np.ndarray, opacities: np.ndarray, sh: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the arrays of :data:`drgs.io.formats.Arrays` from values as they are seen.

    quats: (N, 4) wxyz; scales: (N, 3) standard deviations; opacities: (N,); sh: (N, K, 3).
    """
    return {
        "means": means,
        "quats": quats,
        "log_scales": log_scales_from_scales(scales),
        "logit_opacities": logits_from_opacities(opacities),
        "sh0": sh[:, :1],
        "shN": sh[:, 1:],
    }


def normalize_quaternions(quats: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) wxyz, float64, of length 1; one of length 0 is the identity."""
    quats = quats.astype(np.float64)
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    usable = lengths > 0
    return np.where(usable, quats, [1.0, 0, 0, 0]) / np.where(usable, lengths, 1)


def drop_largest_component(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the index (N,) of the largest component, made positive, and the other three (N, 3)."""
    rows = np.arange(len(quats))
    index = np.argmax(np.abs(quats), axis=1)
    sign = np.where(quats[rows, index] < 0, -1.0, 1.0)
    return index, sign[:, None] * quats[rows[:, None], _REMAINING_COMPONENTS[index]]


def restore_largest_component(index: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return quaternions (N, 4) float64 of length 1: see :func:`drop_largest_component`."""
    rows = np.arange(len(index))
    quats = np.empty((len(index), 4))
    quats[rows[:, None], _REMAINING_COMPONENTS[index]] = others
    quats[rows, index] = np.sqrt(np.maximum(0, 1 - np.square(others).sum(axis=1)))
    return quats


MORTON_BITS = 21  # per axis: a cell is half a millionth of the box's longest side


def morton_order(positions: np.ndarray) -> np.ndarray:
    """Return indices (N,) that sort positions (N, 3) along the Z-order curve; ties by index.

    Morton 1966, "A computer oriented geodetic data base".
    """
    positions = positions.astype(np.float64)
    low = positions.min(axis=0, initial=np.inf)
    side = (positions - low).max(initial=0) or 1.0
    cells = ((positions - low) / side * (2**MORTON_BITS - 1)).astype(np.uint64)
    code = np.zeros(len(positions), np.uint64)
    for place in range(3 * MORTON_BITS):
        bit, axis = divmod(place, 3)
        code |= (cells[:, axis] >> np.uint64(bit) & np.uint64(1)) << np.uint64(place)
    return np.argsort(code, kind="stable")
