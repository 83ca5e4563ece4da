"""PLY files: Gaussians in the layout of the 3DGS reference, and plain point clouds.

The reference (Kerbl et al. 2023, ``save_ply``) writes one float32 row per Gaussian::

    x y z  nx ny nz  f_dc_0..2  f_rest_0..3(K-1)-1  opacity  scale_0..2  rot_0..3

with zero normals, the raw values that are optimised (logit opacity, natural logarithm of the
scales, unnormalised wxyz quaternion), and ``f_rest`` channel-major: all coefficients of red,
then of green, then of blue. K = (degree + 1)^2. Gaussians with a smoothing filter have one property
more, ``filter_3D``, the filter's standard deviation, as in Mip-Splatting's files.
"""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import IO

import numpy as np
from plyfile import PlyData, PlyElement, PlyElementParseError

from drgs.core.errors import UserError, one_line
from drgs.core.files import atomic_path

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
OPACITY = ("opacity",)
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
SMOOTHING = ("filter_3D",)
COLOR = ("red", "green", "blue")

NUM_REST = {3 * ((degree + 1) ** 2 - 1): degree for degree in range(4)}
"""Number of ``f_rest`` properties -> degree: 0, 9, 24, 45 -> 0, 1, 2, 3."""

MAX_HEADER_BYTES = 1 << 20
"""The header of 62 properties takes 1.5 kB; the rest is room for comments."""


def read_gaussians(path: str | Path) -> dict[str, np.ndarray]:
    """Gaussians as numpy float32 arrays, with the values and the SH degree that the file holds.

    By the names of the fields of :class:`drgs.gaussians.parameters.Gaussians`, whose ``load`` calls
    this; ``smoothing`` is missing where the file has none. Properties are found by name, in any
    order and of any numeric type; others are ignored.

    Raises :class:`UserError` naming the file and what it lacks: it must be whole, hold at least
    one row, and nothing but finite numbers.
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
    gaussians = {
        "means": _columns(vertex, POSITION),
        "quats": _columns(vertex, ROTATION),
        "log_scales": _columns(vertex, SCALE),
        "logit_opacities": _columns(vertex, OPACITY)[:, 0],
        "sh0": _columns(vertex, SH0)[:, None, :],
        "shN": np.ascontiguousarray(sh_rest.transpose(0, 2, 1)),
    }
    if set(SMOOTHING) <= set(vertex.dtype.names):
        _require(path, vertex, SMOOTHING, "Gaussians")
        gaussians["smoothing"] = _columns(vertex, SMOOTHING)[:, 0]
    return gaussians


def write_gaussians(path: str | Path, gaussians: Mapping[str, np.ndarray]) -> None:
    """Write Gaussians as the 3DGS reference does, binary little-endian, atomically.

    gaussians: numpy arrays by the names that :func:`read_gaussians` gives. Equal Gaussians give
    equal bytes.
    """
    g = gaussians
    num, num_rest = len(g["means"]), 3 * g["shN"].shape[1]
    names = (*POSITION, *NORMAL, *SH0, *_rest(num_rest), *OPACITY, *SCALE, *ROTATION)
    names += SMOOTHING if "smoothing" in g else ()
    rows = np.concatenate(
        [
            g["means"],
            np.zeros((num, 3)),
            g["sh0"].reshape(num, 3),
            g["shN"].transpose(0, 2, 1).reshape(num, num_rest),
            g["logit_opacities"].reshape(num, 1),
            g["log_scales"],
            g["quats"],
            *([g["smoothing"].reshape(num, 1)] if "smoothing" in g else []),
        ],
        axis=1,
    ).astype("<f4")
    vertex = rows.view([(name, "<f4") for name in names]).reshape(num)
    with atomic_path(path) as temporary:
        PlyData([PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(temporary))


def read_points(path: str | Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions (N, 3) float32, world, and colours (N, 3) float32 in 0..1, or None without any.

    Integer colours are scaled by their type's range, floats are taken as they are.

    Raises :class:`UserError` naming the file and what it lacks, as :func:`read_gaussians` does.
    """
    vertex = _read_vertices(path)
    _require(path, vertex, POSITION, "points")
    positions = _columns(vertex, POSITION)
    if not set(COLOR) <= set(vertex.dtype.names):
        return positions, None
    _require(path, vertex, COLOR, "coloured points")
    colors = _columns(vertex, COLOR)
    kind = vertex.dtype["red"]
    if np.issubdtype(kind, np.integer):
        colors = colors / np.float32(np.iinfo(kind).max)
    bad = np.argwhere(~((colors >= 0) & (colors <= 1)))
    if len(bad):
        row, channel = bad[0]
        raise UserError(
            f"{path}: element vertex, row {row}: red, green, blue must be integers or floats in "
            f"0..1, got {COLOR[channel]} = {vertex[COLOR[channel]][row]}"
        )
    return positions, colors


def _read_vertices(path: str | Path) -> np.ndarray:
    """The rows of element ``vertex``, a structured array; at least one."""
    try:
        with open(path, "rb") as file:
            text = [b"format", b"ascii"] in [line[:2] for line in _read_header(path, file)]
            stream = io.TextIOWrapper(file, "ascii") if text else file
            ply = PlyData.read(stream)
            rest = stream.read()
    except UserError:
        raise
    except OSError as error:
        raise UserError(f"{path}: cannot read the file: {error.strerror or error}") from None
    except PlyElementParseError as error:
        raise UserError(f"{path}: not a valid PLY file: {_explain(error)}") from None
    except Exception as error:  # plyfile raises many types for a broken file
        reason = one_line(error) or type(error).__name__
        raise UserError(f"{path}: not a valid PLY file: {reason}") from None
    if rest.strip() if text else rest:
        promised = ", ".join(f"{element.count} of {element.name}" for element in ply.elements)
        raise UserError(
            f"{path}: the file must end after the rows that its header promises ({promised}), got "
            f"{len(rest):,} bytes more; correct the header's counts, or get the file again"
        )
    if "vertex" not in ply:
        names = ", ".join(element.name for element in ply.elements) or "none"
        raise UserError(f"{path}: element vertex is missing; elements are: {names}")
    if not len(ply["vertex"].data):
        raise UserError(f"{path}: element vertex must have at least 1 row, got 0")
    return ply["vertex"].data


def _read_header(path: str | Path, file: IO[bytes]) -> list[list[bytes]]:
    """The words of each line of the header, with ``file`` left at its start.

    Refuses counts of rows that the file cannot hold, each row being a byte or more, before memory
    is allocated for them.
    """
    header, end, _ = file.read(MAX_HEADER_BYTES).partition(b"end_header")
    if not end:
        raise UserError(
            f"{path}: not a valid PLY file: the header must end with end_header within the first "
            f"{MAX_HEADER_BYTES:,} bytes"
        )
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    lines = [line.split() for line in header.splitlines()]
    for words in lines:
        if words[:1] == [b"element"] and len(words) == 3 and int(words[2]) > size:
            raise UserError(
                f"{path}: the file is cut off: its header promises {int(words[2]):,} rows of "
                f"element {words[1].decode()}, got {size:,} bytes in all"
            )
    return lines


def _explain(error: PlyElementParseError) -> str:
    """Expected and got, for a row that cannot be read."""
    if error.message == "early end-of-file":
        return (
            f"element {error.element.name} must have the {error.element.count:,} rows that the "
            f"header promises, got {error.row:,}: the file is cut off; get it again"
        )
    return one_line(error)


def _require(path: str | Path, vertex: np.ndarray, names: tuple[str, ...], what: str) -> None:
    """Refuse properties that are missing, that are lists, or whose numbers are not all finite."""
    missing = [name for name in names if name not in vertex.dtype.names]
    if missing:
        raise UserError(f"{path}: not a PLY of {what}: properties {', '.join(missing)} are missing")
    lists = [name for name in names if vertex.dtype[name].hasobject]
    if lists:
        raise UserError(f"{path}: properties {', '.join(lists)} must be numbers, got lists")
    bad = [(np.flatnonzero(~np.isfinite(_columns(vertex, (name,))[:, 0])), name) for name in names]
    found = [(rows[0], name) for rows, name in bad if len(rows)]
    if found:
        row, name = min(found, key=lambda item: item[0])
        num_bad = len(np.unique(np.concatenate([rows for rows, _ in bad])))
        raise UserError(
            f"{path}: element vertex, row {row}: {name} must be a finite float32 number, got "
            f"{vertex[name][row]} ({num_bad:,} of {len(vertex):,} rows are not finite; remove them)"
        )


def _rest(num_rest: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(num_rest))


def _columns(vertex: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """(N, len(names)) float32, a copy."""
    rows = np.empty((len(vertex), len(names)), np.float32)
    with np.errstate(over="ignore"):  # a float64 beyond float32 becomes inf, which is refused
        for column, name in enumerate(names):
            rows[:, column] = vertex[name]
    return rows
