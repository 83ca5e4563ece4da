"""Reading ``transforms*.json`` files: what the NeRF-synthetic and nerfstudio layouts share.

Both store camera-to-world matrices in OpenGL axes (x right, y up, z backward). A file is checked as
a whole against :class:`Transforms`; keys that it does not name are not read (``unread``).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Literal, TypeVar

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, Strict, ValidationError
from pydantic_core import ErrorDetails

from drgs.cameras.axes import between_opencv_and_opengl
from drgs.config.section import expectation
from drgs.core.constants import MAX_COEFFICIENT
from drgs.core.errors import UserError, listed, one_line
from drgs.core.files import read_text, shortened
from drgs.core.registry import HOW_TO_INSTALL
from drgs.datasets.types import Motion
from drgs.io.pictures import MAX_SIDE

if TYPE_CHECKING:
    from drgs.cameras.lens import Lens

MAX_BYTES = 1 << 28
"""Of a transforms file: 268 MB, a thousand bytes for each of a quarter of a million views."""

RIGID_TOLERANCE = 1e-4
"""Largest entry of |R R^T - I|: eighty times what files written with float32 show (1.3e-6), far
below any shear or scale that matters."""

MEMORY_RATIO = 30
"""Memory that JSON takes as Python's objects, in bytes of the text."""

MAX_COORDINATE = 1e9
"""Scene units, of a camera's position: far beyond what float32 can tell apart within a scene."""

FOCAL_RANGE = (1e-2, 1e4)
"""Focal lengths, in image sizes, that a pinhole camera can have: full angles of view from 178
degrees down to 0.006."""

MAX_OFFSET = 100
"""Image sizes: how far the principal point may lie from the picture."""

SMALLEST_ANGLE, LARGEST_ANGLE = (2 * math.atan(0.5 / focal) for focal in reversed(FOCAL_RANGE))
"""Radians: the same as full angles of view."""

DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "sx1", "sy1")

RATIONAL_MODEL = "FULL_OPENCV"
"""The model of a camera that has k4 to k6."""

THIN_PRISM_MODEL = "THIN_PRISM_FISHEYE"
"""The model of a fisheye that has more than k1 to k4."""

PLANE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", RATIONAL_MODEL)
FISHEYE_MODELS = ("SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE", "OPENCV_FISHEYE", THIN_PRISM_MODEL)
COLMAP_MODELS = (*PLANE_MODELS, *FISHEYE_MODELS)
"""COLMAP's models that are read."""
"""The others are a pinhole camera apart from their distortion."""

WITHOUT_EFFECT = frozenset(
    {
        *("applied_transform", "applied_scale", "orientation_override"),  # nerfstudio: done already
        *("aabb_scale", "scale", "offset", "up"),  # instant-ngp: where its grid lies
        *("colmap_im_id", "sharpness", "rotation"),
        *("origin", "lens_change"),  # ours: what a fit has used, beside cameras in the world
    }
)
"""Keys that change nothing of what is read here: none is missed."""

CLOSE = "transform_matrix_close"
"""Of a frame: where its camera was when the shutter closed, as ``transform_matrix`` is where it was
when the shutter opened."""

T = TypeVar("T")


# What a file may say


def _angle(value: float) -> float:
    if not SMALLEST_ANGLE <= value <= LARGEST_ANGLE:
        raise ValueError(f"must be between {SMALLEST_ANGLE:.2g} and {LARGEST_ANGLE:.4g} (radians)")
    return value


def _coordinate(value: float) -> float:
    if abs(value) > MAX_COORDINATE:
        raise ValueError(f"must be at most {MAX_COORDINATE:g} in size (scale the scene down)")
    return value


def _opencv_pose(rows: list[list[float]]) -> np.ndarray:
    """(4, 4) float64 camera to world in OpenCV axes, from the file's in OpenGL's."""
    if [len(row) for row in rows] != [4] * 4:
        lengths = " or ".join(map(str, sorted({len(row) for row in rows})[:3]))
        raise ValueError(f"must be 4 x 4 numbers ({len(rows)} rows of {lengths or 0})")
    matrix = np.array(rows, np.float64)
    rotation = matrix[:3, :3]
    error = np.abs(rotation @ rotation.T - np.eye(3)).max()
    with np.errstate(all="ignore"):  # NumPy takes logarithms, of a determinant of 0 as well
        sign = np.linalg.det(rotation)
    if error > RIGID_TOLERANCE or sign < 0:
        raise ValueError(
            f"must be rigid (rotation and translation) to {RIGID_TOLERANCE:g}: "
            f"|R R^T - I| is {error:.2g}, det R is {sign:.2g}"
        )
    if np.abs(matrix[3] - [0, 0, 0, 1]).max() > RIGID_TOLERANCE:
        raise ValueError("must end in the row 0 0 0 1")
    return between_opencv_and_opengl(matrix)


def _known_model(model: str) -> str:
    """A model of COLMAP or the name of a lens."""
    if model not in COLMAP_MODELS:
        from drgs.cameras.lens import LENSES

        if model not in LENSES.names():
            raise ValueError(
                f"must be one of {', '.join(COLMAP_MODELS)}, or a lens: "
                f"{', '.join(LENSES.names())}; {HOW_TO_INSTALL}"
            )
    return model


Number = Annotated[float, Field(allow_inf_nan=False)]
Coefficient = Annotated[float, Field(ge=-MAX_COEFFICIENT, le=MAX_COEFFICIENT)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Side = Annotated[float, Field(ge=1, le=MAX_SIDE)]
Angle = Annotated[Number, AfterValidator(_angle)]
Text = Annotated[str, Field(min_length=1)]
Rows = list[list[Annotated[Number, AfterValidator(_coordinate)]]]
Pose = Annotated[Rows, AfterValidator(_opencv_pose)]
Model = Annotated[str, AfterValidator(_known_model)]


class CameraValues(BaseModel):
    """Values at the top of a file, for all frames, or in a frame. None: not given.

    Other keys may be coefficients of a lens that drgs does not ship.
    """

    model_config = ConfigDict(strict=True, frozen=True, extra="allow")

    camera_angle_x: Angle | None = None  # radians, across the picture's width
    camera_angle_y: Angle | None = None
    fl_x: Positive | None = None  # px
    fl_y: Positive | None = None
    cx: Number | None = None  # px
    cy: Number | None = None
    w: Side | None = None  # px
    h: Side | None = None
    k1: Coefficient | None = None
    k2: Coefficient | None = None
    k3: Coefficient | None = None
    k4: Coefficient | None = None
    k5: Coefficient | None = None
    k6: Coefficient | None = None
    p1: Coefficient | None = None
    p2: Coefficient | None = None
    sx1: Coefficient | None = None
    sy1: Coefficient | None = None
    camera_model: Model | None = None  # as nerfstudio writes it, or the name of a lens
    is_fisheye: Annotated[bool | None, Strict(False)] = None  # as instant-ngp does
    shutter: Literal["global", "rolling"] | None = None  # all pixels at once, or row after row
    mask_path: Text | None = None
    depth_file_path: Text | None = None
    depth_unit_scale_factor: Positive | None = None


class FrameValues(CameraValues):
    """What a frame says; poses are checked, and in OpenCV axes."""

    transform_matrix: Pose
    transform_matrix_close: Pose | None = None
    file_path: Text | None = None


class Transforms(CameraValues):
    """A file."""

    frames: Annotated[list[FrameValues], Field(min_length=1)]
    ply_file_path: Text | None = None
    train_filenames: list[Text] | None = None
    val_filenames: list[Text] | None = None
    test_filenames: list[Text] | None = None


@dataclass(frozen=True, eq=False)
class Frame:
    """A view of a file: what its frame says, and where it says nothing, the file's top."""

    values: FrameValues
    own: FrameValues  # without what it inherits
    index: int
    path: Path
    files: Mapping[str, Path] = field(default_factory=dict)  # found: image, mask, depth

    @staticmethod
    def from_camera(
        source: Path,
        index: int,
        image: Path,
        camera_to_world: np.ndarray,
        focal: tuple[float, float],
        principal: tuple[float, float] | None = None,
    ) -> Frame:
        """Return the frame of a photograph by a pinhole camera.

        source: the file or folder that has the pose, for messages; index: among the frames;
        camera_to_world: (4, 4), OpenCV axes; focal, principal: px of the photograph (None: its
        middle).

        Raises :class:`UserError` for a pose that is not rigid and finite.
        """
        opengl = np.asarray(camera_to_world, np.float64) * [1, -1, -1, 1]
        values = {"fl_x": focal[0], "fl_y": focal[1], "file_path": image.name}
        if principal is not None:
            values |= {"cx": principal[0], "cy": principal[1]}
        try:
            own = FrameValues.model_validate({**values, "transform_matrix": opengl.tolist()})
        except ValidationError as error:
            raise UserError(f"{source}: frame {index}: {_explained(error.errors()[0])}") from None
        return Frame(own, own, index, source, {"image": image})

    @property
    def numbers_are_as_stored(self) -> bool:
        """Whether they are known to be for the picture as it is stored, if that has its size."""
        return False

    @property
    def moves(self) -> bool:
        """Whether it says where its camera was when the shutter closed."""
        return self.own.transform_matrix_close is not None

    def where(self, key: str) -> str:
        """The key as messages name it, with the file and the frame that holds it, if one does."""
        is_inherited = getattr(self.own, key, None) is None and hasattr(self.values, key)
        in_frame = key in FrameValues.model_fields.keys() - CameraValues.model_fields.keys()
        in_frame = in_frame or not is_inherited
        return f"{self.path}: frames[{self.index}].{key}" if in_frame else f"{self.path}: {key}"


@dataclass(frozen=True, eq=False)
class TransformsFile:
    """A file as it was read."""

    path: Path
    frames: Sequence[Frame]  # at least one
    point_cloud: str | None  # what ply_file_path names
    lists: Mapping[str, Sequence[str]]  # file names of train, val, test: those that it has
    unread: Sequence[str]  # keys that are passed over


def read_transforms(path: Path) -> TransformsFile:
    """Read and check a transforms file.

    Raises :class:`UserError` naming the file, the key, what was expected and what was got.
    """
    text = read_text(path, "file", MAX_BYTES, MEMORY_RATIO)
    try:
        content = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path}: not valid JSON: {one_line(error)}") from None
    try:
        meta = Transforms.model_validate(content)
    except ValidationError as error:
        raise UserError(f"{path}: {_explained(error.errors()[0])}") from None
    frames = [Frame(_inherited(own, meta), own, i, path) for i, own in enumerate(meta.frames)]
    names = {split: getattr(meta, f"{split}_filenames") for split in ("train", "val", "test")}
    lists = {split: listing for split, listing in names.items() if listing}
    return TransformsFile(path, frames, meta.ply_file_path, lists, _unread(content))


def note_unread(path: Path, keys: Sequence[str]) -> str:
    """Describe keys that are not read, for the user."""
    return f"{path}: keys that are not read: {listed(keys, 8)}"


def _unread(content: Mapping[str, object]) -> list[str]:
    """Sorted; those of frames as ``frames[].key``."""
    frames = content["frames"]
    models = {values.get("camera_model") for values in (content, *frames)}
    without_effect = WITHOUT_EFFECT.union(*(_coefficients(model) for model in models))
    top = content.keys() - Transforms.model_fields.keys() - without_effect
    in_frames = set().union(*frames) - FrameValues.model_fields.keys() - without_effect
    keys = [*sorted(top), *(f"frames[].{key}" for key in sorted(in_frames))]
    return [one_line(key, 60) for key in keys]


def _coefficients(model: str | None) -> tuple[str, ...]:
    """Return the names of the coefficients of a lens, if ``model`` is none of COLMAP's."""
    if model in (None, *COLMAP_MODELS):
        return ()
    from drgs.cameras.lens import LENSES

    return LENSES.get(model).value.coefficient_names()


def _inherited(own: FrameValues, meta: Transforms) -> FrameValues:
    inherited = {name: getattr(meta, name) for name in CameraValues.model_fields}
    inherited |= meta.model_extra
    return own.model_copy(
        update={k: v for k, v in inherited.items() if getattr(own, k, None) is None}
    )


def _explained(error: ErrorDetails) -> str:
    """One of pydantic's errors: the key, what was expected, and what was got."""
    parts = [f"[{part}]" if isinstance(part, int) else f".{part}" for part in error["loc"]]
    key = "".join(parts).removeprefix(".")
    if error["type"] == "missing":
        remedy = "; it must be a list of objects, one per view" if key == "frames" else ""
        return f"{key} is missing{remedy}"
    got = f"got {_show(error['input'])}"
    if not key:
        return f"must hold an object with frames, {got}"
    if key == "frames":
        expected = "must be a list of objects" if error["input"] else "must have at least one view"
        return f"{key} {expected}, {got}"
    if error["type"] == "model_type":
        return f"{key} must be an object, {got}"
    return f"{key} {expectation(error)}, {got}"


def _show(value: object) -> str:
    """The value as JSON writes it, shortened."""
    return one_line(json.dumps(value), limit=60)


# What follows from it


def focal_from_angle(angle: float, size: int) -> float:
    """Focal length in px from a full field of view in radians across ``size`` px."""
    return 0.5 * size / math.tan(0.5 * angle)


def focal_length(focal: float, where: str, size: int) -> float:
    """``focal``, px, if a picture of ``size`` px can have it; where: the key."""
    low, high = (size * factor for factor in FOCAL_RANGE)
    if not low <= focal <= high:
        raise UserError(
            f"{where} must be between {low:g} and {high:g} px for {size} px, got {focal:g}"
        )
    return focal


def principal_point(value: float, where: str, size: int) -> float:
    """``value``, px, if it is not too far from a picture of ``size`` px; where: the key."""
    if abs(value) > MAX_OFFSET * size:
        raise UserError(
            f"{where} must be within {MAX_OFFSET * size} px of the picture, got {value:g}"
        )
    return value


def lens_of(frame: Frame) -> Lens | None:
    """Return the lens that a frame names, with its coefficients; None for a pinhole."""
    model, values = frame.values.camera_model, frame.values
    if model not in (None, *COLMAP_MODELS):
        return _lens_by_name(frame, model)
    is_fisheye = model in FISHEYE_MODELS or bool(values.is_fisheye)
    coefficients = {name: value for name in DISTORTION if (value := getattr(values, name))}
    if not is_fisheye and not coefficients:
        return None
    _check_fourth(frame, coefficients, is_fisheye)
    return _with_coefficients(frame, _lens_name(model, is_fisheye, coefficients), coefficients)


def _lens_by_name(frame: Frame, name: str) -> Lens | None:
    """Return a lens of the registry, with the coefficients that the frame has by name."""
    given = {n: v for n in _coefficients(name) if (v := getattr(frame.values, n, None)) is not None}
    for key, value in given.items():
        if type(value) not in (int, float) or not math.isfinite(value):
            raise UserError(f"{frame.where(key)} must be a finite number, got {_show(value)}")
    return None if name == "pinhole" else _with_coefficients(frame, name, given)


def _with_coefficients(frame: Frame, name: str, coefficients: Mapping[str, float]) -> Lens:
    from drgs.cameras.lens import LENSES

    lens = LENSES.get(name).value
    for key in coefficients:
        if key not in lens.coefficient_names():
            raise UserError(
                f"{frame.where(key)}: a lens of the kind {name} has the coefficients "
                f"{', '.join(lens.coefficient_names())}, got {key} = {coefficients[key]:g}; set "
                f"camera_model to the model that was calibrated, or leave {key} out"
            )
    try:
        return lens.from_coefficients(**coefficients)
    except UserError as error:
        raise UserError(f"{frame.where('camera_model')}: {error}") from error


def _lens_name(model: str | None, is_fisheye: bool, coefficients: Mapping[str, float]) -> str:
    """Return the name of the lens with these coefficients that are not zero."""
    if model == THIN_PRISM_MODEL and not set(coefficients) <= {"k1", "k2", "k3", "k4"}:
        return "thin_prism_fisheye"
    return "fisheye" if is_fisheye else "opencv"


def _check_fourth(frame: Frame, coefficients: dict[str, float], is_fisheye: bool) -> None:
    """Raise UserError for a k4 of which one cannot know what it multiplies.

    In OpenCV it is the first coefficient of a denominator, in nerfstudio the fourth of the
    polynomial. Files that have k5 or k6 mean OpenCV's.
    """
    model = frame.values.camera_model or "PINHOLE"
    if is_fisheye or model == RATIONAL_MODEL or {"k5", "k6"} & set(coefficients):
        return
    if "k4" in coefficients:
        raise UserError(
            f"{frame.where('k4')} is read as OpenCV's, of a denominator 1 + k4 r^2, where "
            f"camera_model is {RATIONAL_MODEL}; nerfstudio's, of a term k4 r^8, is not supported. "
            f"Got k4 = {coefficients['k4']:g} and camera_model {model}: set camera_model, or "
            "calibrate without k4"
        )


def motion_of(frame: Frame, samples: int) -> Motion | None:
    """Of a frame that says where its camera was when the shutter closed.

    samples: times at which what a global shutter blurs is rendered.
    """
    if not frame.moves:
        return None
    shutter = frame.values.shutter or "global"
    return Motion(frame.own.transform_matrix_close, shutter, samples)


def unique_names(files: Sequence[str]) -> list[str]:
    """A name for the outputs of each ``file_path``: the file's, with its folders where needed.

    Where that is not enough, or too long for a file's name, numbers precede it.
    """
    paths = [PurePosixPath(file.replace("\\", "/")) for file in files]
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        relative = [path.with_suffix("").relative_to(path.anchor) for path in paths]
        names = ["_".join(path.parts) for path in relative]
    if len(set(names)) < len(names) or any(name != shortened(name) for name in names):
        names = [f"{index:04d}_{shortened(name)}" for index, name in enumerate(names)]
    return names


def in_parallel(
    function: Callable[..., T], *arguments: Sequence[object], threads: int | None = None
) -> tuple[T, ...]:
    """``map`` on threads, in order: decoding images releases Python's lock."""
    with ThreadPoolExecutor(threads) as pool:
        return tuple(pool.map(function, *arguments))
