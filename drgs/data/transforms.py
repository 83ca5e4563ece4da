"""Reading ``transforms*.json`` files: what the NeRF-synthetic and nerfstudio layouts share.

Both store camera-to-world matrices in OpenGL axes (x right, y up, z backward).
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

import numpy as np

from drgs.cameras.axes import between_opencv_and_opengl
from drgs.core.errors import UserError, one_line
from drgs.core.files import read_text
from drgs.data.types import Motion

MAX_BYTES = 1 << 28
"""Of a transforms file: 268 MB, a thousand bytes for each of a quarter of a million views."""

RIGID_TOLERANCE = 1e-4
"""Largest entry of |R R^T - I|: eighty times what files written with float32 show (1.3e-6), far
below any shear or scale that matters."""

MAX_COORDINATE = 1e9
"""Scene units, of a camera's position: far beyond what float32 can tell apart within a scene."""

FOCAL_RANGE = (1e-2, 1e4)
"""Focal lengths, in image sizes, that a pinhole camera can have: full angles of view from 178
degrees down to 0.006."""

MAX_OFFSET = 100
"""Image sizes: how far the principal point may lie from the picture."""

DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")

PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Values of ``camera_model`` that are a pinhole camera apart from their distortion."""

RATIONAL_MODEL = "FULL_OPENCV"
"""The one that has k4 to k6."""

FISHEYE_MODELS = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE")

CLOSE = "transform_matrix_close"
"""Of a frame: where its camera was when the shutter closed, as ``transform_matrix`` is where it was
when the shutter opened."""

SHUTTERS = ("global", "rolling")
"""Values of ``shutter``: all pixels see the whole motion, or the rows one time after the other."""

T = TypeVar("T")


def read_transforms(path: Path) -> dict[str, Any]:
    """The content of a transforms file, with at least one frame."""
    text = read_text(path, "file", MAX_BYTES)
    try:
        meta = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not valid JSON: {one_line(error)}") from None
    if not isinstance(meta, dict):
        raise UserError(f"{path}: must hold an object with frames, got {_show(meta)}")
    if "frames" not in meta:
        raise UserError(f"{path}: frames is missing; it must be a list of objects, one per view")
    frames = meta["frames"]
    if not isinstance(frames, list):
        raise UserError(f"{path}: frames must be a list of objects, got {_show(frames)}")
    for index, frame in enumerate(frames):
        if not isinstance(frame, dict):
            raise UserError(f"{path}: frames[{index}] must be an object, got {_show(frame)}")
    if not frames:
        raise UserError(f"{path}: frames is empty; there must be at least one view")
    return meta


def number(values: dict[str, Any], key: str, where: str) -> float:
    """``values[key]``, a finite number."""
    value = values.get(key)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < math.inf:
        raise UserError(f"{where}{key} must be a finite number, got {_show(value)}")
    try:
        return float(value)
    except OverflowError:
        raise UserError(f"{where}{key} must be a finite number, got an integer beyond it") from None


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
    low, high = (2 * math.atan(0.5 / focal) for focal in reversed(FOCAL_RANGE))
    if not low <= angle <= high:
        raise UserError(
            f"{where}{key} must be between {low:.2g} and {high:.4g} (radians), got {angle:g}"
        )
    return 0.5 * size / math.tan(0.5 * angle)


def focal_length(values: dict[str, Any], key: str, where: str, size: int) -> float:
    """Focal length in px of a picture of ``size`` px."""
    focal = positive(values, key, where)
    low, high = (size * factor for factor in FOCAL_RANGE)
    if not low <= focal <= high:
        raise UserError(
            f"{where}{key} must be between {low:g} and {high:g} px for {size} px, got {focal:g}"
        )
    return focal


def principal_point(values: dict[str, Any], key: str, where: str, size: int) -> float:
    """Coordinate in px of the principal point along ``size`` px."""
    value = number(values, key, where)
    if abs(value) > MAX_OFFSET * size:
        raise UserError(
            f"{where}{key} must be within {MAX_OFFSET * size} px of the picture, got {value:g}"
        )
    return value


def opencv_camera_to_world(
    frame: dict[str, Any], where: str, name: str = "transform_matrix"
) -> np.ndarray:
    """(4, 4) float64 camera to world in OpenCV axes, from the file's in OpenGL's."""
    key = f"{where}{name}"
    if name not in frame:
        raise UserError(f"{key} is missing")
    matrix = _numbers(frame[name], key)
    if matrix.shape != (4, 4):
        raise UserError(f"{key} must be 4 x 4 numbers, got shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        row, column = np.argwhere(~np.isfinite(matrix))[0]
        raise UserError(f"{key}[{row}][{column}] must be finite, got {matrix[row, column]}")
    if np.abs(matrix).max() > MAX_COORDINATE:
        row, column = np.unravel_index(np.abs(matrix).argmax(), matrix.shape)
        raise UserError(
            f"{key}[{row}][{column}] must be at most {MAX_COORDINATE:g} in size, got "
            f"{matrix[row, column]:g}; scale the scene down"
        )
    rotation = matrix[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if error > RIGID_TOLERANCE or np.linalg.det(rotation) < 0:
        raise UserError(
            f"{key} must be rigid (rotation and translation) to {RIGID_TOLERANCE:g}: "
            f"|R R^T - I| is {error:.2g}, det R is {np.linalg.det(rotation):.2g}"
        )
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > RIGID_TOLERANCE:
        raise UserError(f"{key} must end in the row 0 0 0 1, got {matrix[3].tolist()}")
    return between_opencv_and_opengl(matrix)


class InheritedValues:
    """The values of a frame, where what it does not have is the file's; and where they are."""

    def __init__(self, own: dict[str, Any], where: str, meta: dict[str, Any], path: Path) -> None:
        """own, meta: the frame's values and the file's; where: the prefix of a frame's key."""
        self.values, self.where = meta | own, where
        self.own, self.meta, self.top = own, meta, f"{path}: "

    def __contains__(self, key: str) -> bool:
        return key in self.values

    def get(self, key: str, default: Any = None) -> Any:
        """Of a key that may be missing."""
        return self.values.get(key, default)

    def at(self, key: str) -> tuple[dict[str, Any], str, str]:
        """The object that holds ``key``, the key, and the prefix that messages name it with."""
        return (self.own, key, self.where) if key in self.own else (self.meta, key, self.top)


def lens_of(frame: InheritedValues) -> Any:
    """The lens that a frame names, with its coefficients; None for a pinhole.

    ``camera_model`` as nerfstudio writes it, ``is_fisheye`` as instant-ngp does.
    """
    model = frame.get("camera_model", PINHOLE_MODELS[0])
    if model not in (*PINHOLE_MODELS, *FISHEYE_MODELS):
        raise UserError(
            f"{frame.at('camera_model')[2]}camera_model must be one of "
            f"{', '.join((*PINHOLE_MODELS, *FISHEYE_MODELS))}, got {one_line(model)}"
        )
    is_fisheye = model in FISHEYE_MODELS or bool(frame.get("is_fisheye"))
    coefficients = distortion_of(frame)
    if not is_fisheye and not coefficients:
        return None
    _check_fourth(frame, coefficients, model, is_fisheye)
    kind = _lens_type(is_fisheye)
    for name in coefficients:
        if name not in kind.names:
            raise UserError(
                f"{frame.at(name)[2]}{name}: a fisheye lens has the coefficients "
                f"{', '.join(kind.names)}, got {name} = {coefficients[name]:g}"
            )
    return kind.of(**coefficients)


def _lens_type(is_fisheye: bool) -> Any:
    if is_fisheye:
        from drgs.cameras.fisheye import Fisheye

        return Fisheye
    from drgs.cameras.radial_tangential import RadialTangential

    return RadialTangential


def _check_fourth(
    frame: InheritedValues, coefficients: dict[str, float], model: str, is_fisheye: bool
) -> None:
    """Raise UserError for a k4 of which one cannot know what it multiplies.

    In OpenCV it is the first coefficient of a denominator, in nerfstudio the fourth of the
    polynomial. Files that have k5 or k6 mean OpenCV's.
    """
    if is_fisheye or model == RATIONAL_MODEL or {"k5", "k6"} & set(coefficients):
        return
    if "k4" in coefficients:
        raise UserError(
            f"{frame.at('k4')[2]}k4 is read as OpenCV's, of a denominator 1 + k4 r^2, where "
            f"camera_model is {RATIONAL_MODEL}; nerfstudio's, of a term k4 r^8, is not supported. "
            f"Got k4 = {coefficients['k4']:g} and camera_model {model}: set camera_model, or "
            "calibrate without k4"
        )


def distortion_of(frame: InheritedValues) -> dict[str, float]:
    """The coefficients that are not zero."""
    given = {key: number(*frame.at(key)) for key in DISTORTION if key in frame}
    return {key: value for key, value in given.items() if value != 0}


def motion_of(frame: InheritedValues, samples: int) -> Motion | None:
    """Of a frame that says where its camera was when the shutter closed.

    samples: times at which what a global shutter blurs is rendered.
    """
    if CLOSE not in frame.own:
        return None
    shutter = frame.get("shutter", SHUTTERS[0])
    if shutter not in SHUTTERS:
        raise UserError(
            f"{frame.at('shutter')[2]}shutter must be one of {', '.join(SHUTTERS)}, got "
            f"{one_line(shutter)}"
        )
    close_to_world = opencv_camera_to_world(frame.own, frame.where, CLOSE)
    return Motion(close_to_world, shutter, samples)


def image_path(folder: Path, frame: dict[str, Any], where: str, key: str = "file_path") -> Path:
    """The file that ``frame`` names, with ``.png`` added where its name has no suffix."""
    name = frame.get(key)
    if not isinstance(name, str) or not name:
        raise UserError(f"{where}{key} must be text, got {_show(name)}")
    for candidate in (folder / name, folder / f"{name}.png"):
        if os.path.isfile(candidate):  # False, not an error, for a name that no file can have
            return candidate
    raise UserError(
        f"{where}{key}: there is no image {one_line(folder / name)} (or with .png added)"
    )


def _numbers(values: Any, key: str) -> np.ndarray:
    """Nested lists of numbers, float64."""
    try:
        array = np.array(values)
    except ValueError:  # rows of different lengths
        raise UserError(f"{key} must be 4 x 4 numbers, got {_show(values)}") from None
    if array.dtype.kind not in "iuf":
        raise UserError(f"{key} must be 4 x 4 numbers, got {_show(values)}")
    return array.astype(np.float64)


def _show(value: Any) -> str:
    """The value as JSON writes it, shortened."""
    return one_line(json.dumps(value), limit=60)


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
