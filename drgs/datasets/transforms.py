"""Files ``transforms*.json`` of the NeRF-synthetic and nerfstudio layouts, and their frames.

Both store camera-to-world matrices in OpenGL axes (x right, y up, z backward). Values at the top of
a file hold for every frame without its own; poses are in frames only.

``mask_path`` names an image that is black where pixels do not count. ``depth_file_path`` names an
image of 16 bits or an ``.npy`` file; ``depth_unit_scale_factor`` is the number of scene units of
one of its numbers.
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from types import MappingProxyType
from typing import Annotated, Literal

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    GetPydanticSchema,
    Strict,
    model_validator,
)
from pydantic_core.core_schema import no_info_after_validator_function
from typing_extensions import Self

from drgs.cameras.lens import LENSES, Lens
from drgs.cameras.viewpoints import MAX_COORDINATE, CameraMotion, between_opencv_and_opengl
from drgs.config.schema import DataConfig
from drgs.config.section import parse_json, validate
from drgs.core.errors import UserError, format_names, one_line
from drgs.core.files import read_text, shorten_stem
from drgs.core.registry import HOW_TO_INSTALL
from drgs.datasets.files import FileKind, find_files
from drgs.io.images import MAX_SIDE

MAX_BYTES = 1 << 28  # of a file: a thousand for each of a quarter of a million views

RIGID_TOLERANCE = 1e-4
"""Largest entry of |R R^T - I|, 80 times that of float32 (1.3e-6), and error of the last row."""

MEMORY_RATIO = 30  # memory that JSON takes as Python's objects, in bytes of the text

FOCAL_RANGE = (1e-2, 1e4)  # in image sizes: full angles of view from 178 degrees down to 0.006

MAX_OFFSET = 100  # of the principal point from the image, in image sizes

MIN_ANGLE, MAX_ANGLE = (2 * math.atan(0.5 / focal) for focal in reversed(FOCAL_RANGE))  # radians

DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2", "sx1", "sy1")

RATIONAL_MODEL = "FULL_OPENCV"  # the model of a camera that has k4 to k6

LENS_OF_MODEL = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL"), "opencv"),
    **dict.fromkeys(("OPENCV", RATIONAL_MODEL), "opencv"),
    **dict.fromkeys(("SIMPLE_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE"), "fisheye"),
    **dict.fromkeys(("RADIAL_FISHEYE", "OPENCV_FISHEYE"), "fisheye"),
    "THIN_PRISM_FISHEYE": "thin_prism_fisheye",
    "EQUIRECTANGULAR": "equirectangular",
}
"""Lenses of COLMAP's models; other values of ``camera_model`` are names of lenses."""

IGNORED_KEYS = frozenset(
    {
        *("applied_transform", "applied_scale", "orientation_override"),  # nerfstudio: done already
        *("aabb_scale", "scale", "offset", "up"),  # instant-ngp: place of its grid
        *("colmap_im_id", "sharpness", "rotation"),
        *("origin", "lens_change"),  # ours: used by a fit, beside cameras in the world
    }
)
"""Keys that are not read, without a note: they change nothing here."""

CLOSE_POSE_KEY = "transform_matrix_close"
"""A frame's camera pose when the shutter closed; ``transform_matrix``: when it opened."""

FILE_KEYS = {"image": "file_path", "mask": "mask_path", "depth": "depth_file_path"}

FILE_KINDS = {
    "image": FileKind("photographs", remedy="put them there, or take their frames out of the file"),
    "mask": FileKind(
        *("masks", "their photographs are left out"),
        remedy="put them there, or set data.ignore_masks",
    ),
    "depth": FileKind(
        *("files of depth", "their photographs have no depth"),
        remedy="put them there, or set data.ignore_depth",
        suffixes=frozenset(),
    ),
}


# Content of a file


def _opencv_pose(rows: list[list[float]]) -> np.ndarray:
    """Return the pose (4, 4) float64, camera to world, in OpenCV axes; the file's are OpenGL's."""
    if [len(row) for row in rows] != [4] * 4:
        raise ValueError("must be 4 x 4 numbers")
    matrix = np.array(rows, np.float64)
    rotation = matrix[:3, :3]
    errors = rotation @ rotation.T - np.eye(3), matrix[3] - [0, 0, 0, 1]
    error = max(np.abs(each).max() for each in errors)
    with np.errstate(all="ignore"):  # NumPy takes logarithms, of a determinant of 0 as well
        sign = np.linalg.det(rotation)
    if error > RIGID_TOLERANCE or sign < 0:
        raise ValueError(
            f"must be rigid (rotation, translation, row 0 0 0 1) to {RIGID_TOLERANCE:g}: "
            f"off by {error:.2g}, det R is {sign:.2g}"
        )
    return between_opencv_and_opengl(matrix)


def _known_model(model: str) -> str:
    if model not in LENS_OF_MODEL and model not in LENSES.names():
        raise ValueError(
            f"must be one of {', '.join(LENS_OF_MODEL)}, or a lens: {', '.join(LENSES.names())}; "
            f"{HOW_TO_INSTALL}"
        )
    return model


Number = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Side = Annotated[float, Field(ge=1, le=MAX_SIDE)]
Angle = Annotated[Number, Field(ge=MIN_ANGLE, le=MAX_ANGLE)]
Text = Annotated[str, Field(min_length=1)]
Rows = list[list[Annotated[Number, Field(ge=-MAX_COORDINATE, le=MAX_COORDINATE)]]]
Pose = Annotated[
    np.ndarray,
    GetPydanticSchema(
        lambda _, handler: no_info_after_validator_function(_opencv_pose, handler(Rows))
    ),
]
Model = Annotated[str, AfterValidator(_known_model)]


class CameraValues(BaseModel):
    """Values at the top of a file or in a frame, None if not given; others may be a lens's."""

    model_config = ConfigDict(strict=True, frozen=True, extra="allow")

    camera_angle_x: Angle | None = None  # radians, across the image's width
    camera_angle_y: Angle | None = None
    fl_x: Positive | None = None  # px
    fl_y: Positive | None = None
    cx: Number | None = None  # px
    cy: Number | None = None
    w: Side | None = None  # px
    h: Side | None = None
    camera_model: Model | None = None  # nerfstudio's, or the name of a lens
    is_fisheye: Annotated[bool | None, Strict(False)] = None  # instant-ngp's
    shutter: Literal["global", "rolling"] | None = None  # all pixels at once, or row after row
    mask_path: Text | None = None
    depth_file_path: Text | None = None
    depth_unit_scale_factor: Positive | None = None
    distortion_params: Annotated[list[Number], Field(min_length=6, max_length=6)] | None = None

    @model_validator(mode="after")
    def _name_coefficients(self) -> Self:
        """Give nerfstudio's list of coefficients their names."""
        if self.distortion_params is None:
            return self
        named = zip(("k1", "k2", "k3", "k4", "p1", "p2"), self.distortion_params, strict=True)
        return self.model_copy(update={**dict(named), "distortion_params": None})


class FrameValues(CameraValues):
    """Values of a frame; poses are in OpenCV axes."""

    transform_matrix: Pose
    transform_matrix_close: Pose | None = None
    file_path: Text | None = None


class Transforms(CameraValues):
    """Content of a file."""

    frames: Annotated[list[FrameValues], Field(min_length=1)]
    ply_file_path: Text | None = None
    train_filenames: list[Text] | None = None
    val_filenames: list[Text] | None = None
    test_filenames: list[Text] | None = None


@dataclass(frozen=True, eq=False)
class TransformsFrame:
    """A photograph's camera, and its files."""

    values: FrameValues  # with those at the top of the file where the frame has none
    path: Path  # the file or folder that contains the values, for messages
    place: str  # in that, with the separator before a key: ``frames[3].``
    inherited: Collection[str] = ()  # keys that the frame itself does not have
    is_as_stored: bool = False  # the camera's values are for the image without EXIF's orientation
    files: Mapping[str, Path] = field(default_factory=dict)  # found: image, mask, depth

    @staticmethod
    def from_camera(
        source: Path,
        index: int,
        image: Path,
        camera_to_world: np.ndarray,
        focal: tuple[float, float],
        principal: tuple[float, float] | None = None,
        lens: Mapping[str, object] = MappingProxyType({}),
        files: Mapping[str, Path] = MappingProxyType({}),
    ) -> TransformsFrame:
        """Return the frame of a photograph.

        source: the file or folder with the pose, and index: the frame's, for messages;
        camera_to_world: (4, 4), OpenCV axes; focal, principal: px (None: the image's middle);
        lens: keys as in ``transforms.json``, such as ``camera_model`` and ``k1`` (none: a pinhole);
        files: ``mask`` and ``depth`` of the photograph, where there are any.

        Raises :class:`UserError` for a pose that is not rigid and finite.
        """
        opengl = np.asarray(camera_to_world, np.float64) * [1, -1, -1, 1]
        values = {"fl_x": focal[0], "fl_y": focal[1], "file_path": image.name, **lens}
        values |= {FILE_KEYS[what]: str(file) for what, file in files.items()}
        if principal is not None:
            values |= {"cx": principal[0], "cy": principal[1]}
        values |= {"transform_matrix": opengl.tolist()}
        checked = validate(FrameValues, values, f"{source}: frame {index}: ")
        found = {"image": image, **files}
        return TransformsFrame(checked, source, f"frames[{index}].", files=found)

    @property
    def file_path(self) -> str:
        """The photograph's name in the file."""
        assert self.values.file_path is not None, "frames without a name are rejected when read"
        return self.values.file_path

    def location(self, key: str) -> str:
        """Return the file and the key, with the frame if that contains it, for messages."""
        return f"{self.path}: {'' if key in self.inherited else self.place}{key}"


@dataclass(frozen=True, eq=False)
class TransformsFile:
    """A file and its frames."""

    path: Path
    frames: Sequence[TransformsFrame]  # at least one
    point_cloud: str | None  # ply_file_path
    lists: Mapping[str, Sequence[str]]  # file names of train, val, test, where the file has them
    unread: Sequence[str]  # keys that are not read


def read_transforms(path: Path) -> TransformsFile:
    """Read and check a transforms file.

    Raises :class:`UserError` naming the file, the key, the expected and the actual value.
    """
    text = read_text(path, "file", MAX_BYTES, MEMORY_RATIO)
    return transforms_of(parse_json(text, f"{path}: "), path)


def transforms_of(content: object, path: Path) -> TransformsFile:
    """Check the content of a transforms file, or of cameras in its layout from ``path``."""
    meta = validate(Transforms, content, f"{path}: ")
    top = {name: getattr(meta, name) for name in CameraValues.model_fields}
    top |= meta.model_extra or {}
    frames = []
    for index, frame in enumerate(meta.frames):
        inherited = {key: value for key, value in top.items() if getattr(frame, key, None) is None}
        values = frame.model_copy(update=inherited)
        frames.append(TransformsFrame(values, path, f"frames[{index}].", inherited.keys()))
    names = {split: getattr(meta, f"{split}_filenames") for split in ("train", "val", "test")}
    lists = {split: listing for split, listing in names.items() if listing}
    models = {values.camera_model for values in (meta, *meta.frames)}
    known = IGNORED_KEYS.union(*map(_coefficient_names, models))
    in_frames = set().union(*(frame.model_extra or {} for frame in meta.frames)) - known
    unread = sorted((meta.model_extra or {}).keys() - known)
    unread += [f"frames[].{key}" for key in sorted(in_frames)]
    unread = [one_line(key, 60) for key in unread]
    return TransformsFile(path, frames, meta.ply_file_path, lists, unread)


def note_unread(path: Path, keys: Sequence[str]) -> str:
    """Describe keys that are not read, for the user."""
    return f"{path}: keys that are not read: {format_names(keys, 8)}"


def _coefficient_names(model: str | None) -> tuple[str, ...]:
    if model is None or model in LENS_OF_MODEL:
        return DISTORTION
    return LENSES.get(model).value.coefficient_names()


# Files of frames


def frames_with_files(
    config: DataConfig, meta: TransformsFile, notes: list[str]
) -> list[TransformsFrame]:
    """Return the frames whose files are there, with the files that are not ignored.

    A frame without its depth stays. notes: see :func:`drgs.datasets.files.find_files`, which also
    raises :class:`UserError`.
    """
    if nameless := [frame for frame in meta.frames if frame.values.file_path is None]:
        raise UserError(f"{nameless[0].location('file_path')} is missing")
    ignored = {"mask": config.ignore_masks, "depth": config.ignore_depth}
    frames = list(meta.frames)
    for what, key in FILE_KEYS.items():
        naming = [frame for frame in frames if getattr(frame.values, key) is not None]
        if ignored.get(what) or not naming:
            continue
        names = [getattr(frame.values, key) for frame in naming]
        places = [frame.location(key) for frame in naming]
        existing = find_files(config.path, meta.path, names, FILE_KINDS[what], places, notes)
        kept = []
        for frame in frames:
            name = getattr(frame.values, key)
            if name in existing:
                kept.append(replace(frame, files={**frame.files, what: existing[name]}))
            elif name is None or what == "depth":
                kept.append(frame)
        frames = kept
    return frames


# Optics


def focal_from_angle(angle: float, size: int) -> float:
    """Return the focal length, px, of a full field of view in radians across ``size`` px."""
    return 0.5 * size / math.tan(0.5 * angle)


def focal_length(focal: float, where: str, size: int) -> float:
    """Return ``focal``, px, if an image of ``size`` px can have it; where: the key."""
    low, high = (size * factor for factor in FOCAL_RANGE)
    if not low <= focal <= high:
        raise UserError(
            f"{where} must be between {low:g} and {high:g} px for {size} px, got {focal:g}"
        )
    return focal


def principal_point(value: float, where: str, size: int) -> float:
    """Return ``value``, px, if it is not too far from an image of ``size`` px; where: the key."""
    if abs(value) > MAX_OFFSET * size:
        raise UserError(
            f"{where} must be within {MAX_OFFSET * size} px of the image, got {value:g}"
        )
    return value


def lens_of(frame: TransformsFrame) -> Lens | None:
    """Return the lens that a frame names, with its coefficients; None for a pinhole.

    Raises :class:`UserError` for coefficients that the lens does not have, and for a k4 that may be
    OpenCV's, the first coefficient of a denominator, or nerfstudio's, the fourth of the polynomial.
    """
    model, values = frame.values.camera_model, frame.values
    name = "opencv" if model is None else LENS_OF_MODEL.get(model, model)
    is_of_colmap = model is None or model in LENS_OF_MODEL
    given = {k: v for k in _coefficient_names(model) if (v := getattr(values, k, None)) is not None}
    for key, value in given.items():
        if type(value) not in (int, float) or not math.isfinite(value):
            got = one_line(json.dumps(value), 60)
            raise UserError(f"{frame.location(key)} must be a finite number, got {got}")
    if is_of_colmap:
        given = {key: value for key, value in given.items() if value}
        if name == "opencv":
            name = "fisheye" if values.is_fisheye else "opencv" if given else "pinhole"
        elif name == "thin_prism_fisheye" and given.keys() <= {"k1", "k2", "k3", "k4"}:
            name = "fisheye"  # thin prisms of zero
    if name == "pinhole":
        return None
    is_rational = model == RATIONAL_MODEL or {"k5", "k6"} & given.keys()  # OpenCV's only
    if is_of_colmap and name == "opencv" and "k4" in given and not is_rational:
        raise UserError(
            f"{frame.location('k4')} is read as OpenCV's, of a denominator 1 + k4 r^2, where "
            f"camera_model is {RATIONAL_MODEL}; nerfstudio's, of a term k4 r^8, is not supported. "
            f"Got k4 = {given['k4']:g} and camera_model {model or 'PINHOLE'}: set "
            "camera_model, or calibrate without k4"
        )
    lens = LENSES.get(name).value
    for key in sorted(given.keys() - set(lens.coefficient_names())):
        raise UserError(
            f"{frame.location(key)}: a lens of the kind {name} has the coefficients "
            f"{', '.join(lens.coefficient_names()) or 'none'}, got {key} = {given[key]:g}; set "
            f"camera_model to the model that was calibrated, or leave {key} out"
        )
    try:
        return lens.from_coefficients(**given)
    except UserError as error:
        raise UserError(f"{frame.location('camera_model')}: {error}") from error


def motion_of(frame: TransformsFrame, samples: int) -> CameraMotion | None:
    """Return the camera's motion while the shutter was open; None: it stands still."""
    close = frame.values.transform_matrix_close
    return None if close is None else CameraMotion(close, frame.values.shutter or "global", samples)


def unique_names(files: Sequence[str]) -> list[str]:
    """Return a name for the outputs of each ``file_path``: the file's, with folders where needed.

    Numbers precede names that are still not unique, or too long.
    """
    paths = [PurePosixPath(file.replace("\\", "/")) for file in files]
    names = [path.stem for path in paths]
    if len(set(names)) < len(names):
        relative = [path.with_suffix("").relative_to(path.anchor) for path in paths]
        names = ["_".join(path.parts) for path in relative]
    if len(set(names)) < len(names) or any(name != shorten_stem(name) for name in names):
        names = [f"{index:04d}_{shorten_stem(name)}" for index, name in enumerate(names)]
    return names
