"""Reading ``transforms*.json`` files: what the NeRF-synthetic and nerfstudio layouts share.

Both store camera-to-world matrices in OpenGL axes (x right, y up, z backward).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np

from drgs.checks import UserError

RIGID_TOLERANCE = 1e-3
"""Largest entry of |R R^T - I|: a thousand times what float32 files show, far below any shear
or scale that matters."""

T = TypeVar("T")


def read_transforms(path: Path) -> dict[str, Any]:
    """The content of a transforms file, with at least one frame."""
    try:
        meta = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: cannot read the file: {error.strerror}") from None
    except ValueError as error:  # JSON, or UTF-8
        raise UserError(f"{path}: not valid JSON: {error}") from None
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not all(isinstance(frame, dict) for frame in frames):
        raise UserError(f"{path}: frames must be a list of objects")
    if not frames:
        raise UserError(f"{path}: frames is empty; there must be at least one view")
    return meta


def number(values: dict[str, Any], key: str, where: str) -> float:
    """``values[key]``, a finite number."""
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise UserError(f"{where}{key} must be a finite number, got {json.dumps(value)}")
    return float(value)


def positive(values: dict[str, Any], key: str, where: str) -> float:
    """``values[key]``, a finite number > 0."""
    value = number(values, key, where)
    if value <= 0:
        raise UserError(f"{where}{key} must be > 0, got {value:g}")
    return value


def focal_from_angle(values: dict[str, Any], key: str, where: str, size: int) -> float:
    """Focal length in px from a full field of view in radians across ``size`` px."""
    angle = positive(values, key, where)
    if angle >= math.pi:
        raise UserError(f"{where}{key} must be < pi (radians), got {angle:g}")
    return 0.5 * size / math.tan(0.5 * angle)


def opencv_camera_to_world(frame: dict[str, Any], where: str) -> np.ndarray:
    """(4, 4) float64 camera to world in OpenCV axes: columns y and z of the file's change sign."""
    key = f"{where}transform_matrix"
    try:
        matrix = np.array(frame["transform_matrix"], np.float64)
    except KeyError:
        raise UserError(f"{key} is missing") from None
    except (TypeError, ValueError):
        raise UserError(f"{key} must be 4 x 4 numbers") from None
    if matrix.shape == (3, 4):
        matrix = np.concatenate([matrix, [[0.0, 0.0, 0.0, 1.0]]])
    if matrix.shape != (4, 4):
        raise UserError(f"{key} must be 4 x 4 numbers, got shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise UserError(f"{key} must be finite")
    rotation = matrix[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        raise UserError(
            f"{key} must be rigid (rotation and translation): |R R^T - I| is {error:.2g}, "
            f"det R is {np.linalg.det(rotation):.2g}"
        )
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > RIGID_TOLERANCE:
        raise UserError(f"{key} must end in the row 0 0 0 1, got {matrix[3].tolist()}")
    matrix[:3, 1:3] *= -1
    return matrix


def image_path(folder: Path, frame: dict[str, Any], where: str) -> Path:
    """The file that ``frame`` names, with ``.png`` added where its name has no suffix."""
    name = frame.get("file_path")
    if not isinstance(name, str) or not name:
        raise UserError(f"{where}file_path must be text, got {json.dumps(name)}")
    for candidate in (folder / name, folder / f"{name}.png"):
        if candidate.is_file():
            return candidate
    raise UserError(f"{where}file_path: there is no image {folder / name} (or with .png added)")


def unique_names(frames: Sequence[dict[str, Any]]) -> list[str]:
    """A name for each frame's outputs: the file's, with its folders where those are needed."""
    paths = [PurePosixPath(frame["file_path"].replace("\\", "/")) for frame in frames]
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        names = ["_".join(path.with_suffix("").parts) for path in paths]
    if len(set(names)) < len(names):
        names = [f"{index:04d}_{name}" for index, name in enumerate(names)]
    return names


def in_parallel(function: Callable[..., T], *arguments: Sequence[Any]) -> tuple[T, ...]:
    """``map`` on threads, in order: decoding images releases Python's lock."""
    with ThreadPoolExecutor() as pool:
        return tuple(pool.map(function, *arguments))
