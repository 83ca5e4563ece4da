"""PLY files: Gaussians in the layout of the 3DGS reference, and plain point clouds.

Layer 1. The reference (Kerbl et al. 2023, ``save_ply``) writes one float32 row per Gaussian::

    x y z  nx ny nz  f_dc_0..2  f_rest_0..3(K-1)-1  opacity  scale_0..2  rot_0..3

with zero normals, the raw values that are optimised (logit opacity, natural logarithm of the
scales, unnormalised wxyz quaternion), and ``f_rest`` channel-major: all coefficients of red,
then of green, then of blue. K = (degree + 1)^2.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement, PlyParseError

from drgs.checks import UserError
from drgs.files import atomic_path
from drgs.gaussians import Gaussians

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
OPACITY = ("opacity",)
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
COLOR = ("red", "green", "blue")

NUM_REST = {3 * ((degree + 1) ** 2 - 1): degree for degree in range(4)}
"""Number of ``f_rest`` properties -> degree: 0, 9, 24, 45 -> 0, 1, 2, 3."""


def read_ply(path: str | Path) -> Gaussians:
    """Gaussians as numpy float32 arrays, with the values and the SH degree that the file holds.

    Properties are found by name, in any order and of any numeric type; others are ignored.

    Raises :class:`UserError` naming the file and what it lacks.
    """
    vertex = _read_vertices(path)
    num_rest = sum(name.startswith("f_rest_") for name in vertex.dtype.names)
    if num_rest not in NUM_REST:
        raise UserError(
            f"{path}: the number of f_rest properties must be one of {sorted(NUM_REST)} "
            f"(SH degree 0 to 3), got {num_rest}"
        )
    _require(
        path, vertex, (*POSITION, *SH0, *_rest(num_rest), *OPACITY, *SCALE, *ROTATION), "Gaussians"
    )
    sh_rest = _columns(vertex, _rest(num_rest)).reshape(len(vertex), 3, num_rest // 3)
    return Gaussians(
        means=_columns(vertex, POSITION),
        quats=_columns(vertex, ROTATION),
        log_scales=_columns(vertex, SCALE),
        logit_opacities=_columns(vertex, OPACITY)[:, 0],
        sh0=_columns(vertex, SH0)[:, None, :],
        shN=np.ascontiguousarray(sh_rest.transpose(0, 2, 1)),
    )


def write_ply(path: str | Path, gaussians: Gaussians) -> None:
    """Write Gaussians as the 3DGS reference does, binary little-endian, atomically.

    Equal Gaussians give equal bytes.
    """
    g = gaussians.numpy()
    num, num_rest = g.num_gaussians, 3 * g.shN.shape[1]
    names = (*POSITION, *NORMAL, *SH0, *_rest(num_rest), *OPACITY, *SCALE, *ROTATION)
    rows = np.concatenate(
        [
            g.means,
            np.zeros((num, 3)),
            g.sh0.reshape(num, 3),
            g.shN.transpose(0, 2, 1).reshape(num, num_rest),
            g.logit_opacities.reshape(num, 1),
            g.log_scales,
            g.quats,
        ],
        axis=1,
    ).astype("<f4")
    vertex = rows.view([(name, "<f4") for name in names]).reshape(num)
    with atomic_path(path) as temporary:
        PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(temporary))


def read_points(path: str | Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions (N, 3) float32, world, and colours (N, 3) float32 in 0..1, or None without any.

    Integer colours are scaled by their type's range, floats are taken as they are.

    Raises :class:`UserError` naming the file and what it lacks.
    """
    vertex = _read_vertices(path)
    _require(path, vertex, POSITION, "points")
    positions = _columns(vertex, POSITION)
    if not np.isfinite(positions).all():
        bad = int((~np.isfinite(positions).all(axis=1)).sum())
        raise UserError(f"{path}: {bad} of {len(vertex)} points have positions that are not finite")
    if not set(COLOR) <= set(vertex.dtype.names):
        return positions, None
    colors = _columns(vertex, COLOR)
    kind = vertex.dtype["red"]
    if np.issubdtype(kind, np.integer):
        colors = colors / np.float32(np.iinfo(kind).max)
    if not ((colors >= 0) & (colors <= 1)).all():
        raise UserError(f"{path}: red, green, blue must be integers or floats in 0..1")
    return positions, colors


def _read_vertices(path: str | Path) -> np.ndarray:
    """The rows of element ``vertex``, a structured array."""
    try:
        ply = PlyData.read(str(path))
    except OSError as error:
        raise UserError(f"{path}: cannot read the file: {error.strerror or error}") from None
    except (PlyParseError, UnicodeDecodeError, ValueError) as error:
        raise UserError(f"{path}: not a valid PLY file: {error}") from None
    if "vertex" not in ply:
        names = ", ".join(element.name for element in ply.elements) or "none"
        raise UserError(f"{path}: element vertex is missing; elements are: {names}")
    return ply["vertex"].data


def _require(path: str | Path, vertex: np.ndarray, names: tuple[str, ...], what: str) -> None:
    missing = [name for name in names if name not in vertex.dtype.names]
    if missing:
        raise UserError(f"{path}: not a PLY of {what}: properties {', '.join(missing)} are missing")
    lists = [name for name in names if vertex.dtype[name].hasobject]
    if lists:
        raise UserError(f"{path}: properties {', '.join(lists)} must be numbers, got lists")


def _rest(num_rest: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(num_rest))


def _columns(vertex: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """(N, len(names)) float32, a copy."""
    rows = np.empty((len(vertex), len(names)), np.float32)
    for column, name in enumerate(names):
        rows[:, column] = vertex[name]
    return rows
