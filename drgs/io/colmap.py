"""Models of COLMAP: cameras, images with their poses, and points, in binary or in text files.

The formats are those of COLMAP's documentation ("Output Format") and of its
``reconstruction_io``; ``drgs.io.colmap_binary`` and ``drgs.io.colmap_text`` read the records. What
images observe of the points is skipped; rigs and frames, which newer versions write beside them,
say nothing that images do not.

Files are not trusted: each record is checked before anything is made of it, and an error names the
file, the byte or the line, what was expected and what was got.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path, PurePosixPath
from types import ModuleType

import numpy as np
from scipy.spatial.transform import Rotation

from drgs.core.constants import MAX_COEFFICIENT
from drgs.core.errors import Place, UserError, one_line
from drgs.io.colmap_records import MODELS, CameraRecord, ImageRecord, PointRecord
from drgs.io.pictures import MAX_SIDE

MAX_NUMBER = 1e12
"""Of any parameter or coordinate, in size."""

QUATERNION_RANGE = (1e-6, 1e6)
"""Its length; COLMAP writes 1."""


@dataclass(frozen=True)
class ColmapCamera:
    """The intrinsics of some of the images."""

    number: int  # which images name
    model: str  # of MODELS
    width: int  # px
    height: int  # px
    values: tuple[float, ...]  # as MODELS names them; px, and coefficients of distortion

    def named(self) -> dict[str, float]:
        """The values by name."""
        return dict(zip(MODELS[self.model][1], self.values, strict=True))


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A picture, and where it was taken."""

    name: str  # of its file below the folder of pictures, with ``/`` between folders
    camera: int  # the number of its camera
    quaternion: tuple[float, ...]  # w, x, y, z: world to camera
    translation: tuple[float, ...]  # x, y, z: world to camera, scene units

    @property
    def camera_to_world(self) -> np.ndarray:
        """(4, 4) float64, OpenCV axes."""
        w, *xyz = self.quaternion
        to_world = Rotation.from_quat([*xyz, w]).inv()
        pose = np.eye(4)
        pose[:3, :3] = to_world.as_matrix()
        pose[:3, 3] = -to_world.apply(self.translation)
        return pose


@dataclass(frozen=True, eq=False)
class ColmapPoints:
    """What structure from motion found, N points."""

    positions: np.ndarray  # (N, 3) float64, world
    colors: np.ndarray  # (N, 3) uint8
    errors: np.ndarray  # (N,) float64, px: mean distance of its observations; -1: not known
    track_lengths: np.ndarray  # (N,) int64: how often it is observed


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A reconstruction."""

    cameras: Mapping[int, ColmapCamera]  # by number
    images: tuple[ColmapImage, ...]  # as the file has them
    points_file: Path | None  # None: it has no points

    @property
    def has_points(self) -> bool:
        """Whether there are any, from the first record."""
        file = self.points_file
        return file is not None and next(_records_of(file).points(file), None) is not None

    @cached_property
    def points(self) -> ColmapPoints:
        """Read when they are first asked for; errors as in :func:`read_model`."""
        return _points(iter(())) if self.points_file is None else read_points3d(self.points_file)


def model_files(folder: Path) -> dict[str, Path] | None:
    """The files ``cameras``, ``images`` and, if it is there, ``points3D``; None: no model.

    Binary ones where there are both.
    """
    for suffix in (".bin", ".txt"):
        files = {name: folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D")}
        there = {name: path for name, path in files.items() if path.is_file()}
        if {"cameras", "images"} <= set(there):
            return there
    return None


def read_model(folder: str | Path) -> ColmapModel:
    """The model in ``folder``, of whose points nothing is read yet.

    Raises :class:`UserError` naming the file, the byte or the line, what was expected and what was
    got.
    """
    files = model_files(Path(folder))
    if files is None:
        raise UserError(
            f"{folder}: is no model of COLMAP: there are neither cameras.bin and images.bin nor "
            "cameras.txt and images.txt"
        )
    records = _records_of(files["cameras"])
    cameras = _cameras(records.cameras(files["cameras"]))
    images = _images(records.images(files["images"]), cameras)
    return ColmapModel(cameras, images, files.get("points3D"))


def read_points3d(path: str | Path) -> ColmapPoints:
    """The points of ``points3D.bin`` or ``points3D.txt``; errors as in :func:`read_model`."""
    return _points(_records_of(Path(path)).points(Path(path)))


def _records_of(path: Path) -> ModuleType:
    """What reads files of this kind."""
    if path.suffix == ".txt":
        from drgs.io import colmap_text

        return colmap_text
    from drgs.io import colmap_binary

    return colmap_binary


def _cameras(records: Iterator[CameraRecord]) -> dict[int, ColmapCamera]:
    cameras: dict[int, ColmapCamera] = {}
    for place, number, model, width, height, values in records:
        for name, side in (("width", width), ("height", height)):
            if not 1 <= side <= MAX_SIDE:
                raise UserError(
                    f"{place}: {name} must be between 1 and {MAX_SIDE:,} px, got {side:,}"
                )
        names = MODELS[model][1]
        if len(values) != len(names):
            raise UserError(
                f"{place}: a camera of the model {model} has {len(names)} parameters "
                f"({', '.join(names)}), got {len(values)}"
            )
        for name, value in zip(names, values, strict=True):
            is_length = name in ("f", "fx", "fy", "cx", "cy", "w", "h")
            _check_number(place, name, value, MAX_NUMBER if is_length else MAX_COEFFICIENT)
        if number in cameras:
            raise UserError(f"{place}: each camera must be there once, got a second one {number}")
        cameras[number] = ColmapCamera(number, model, width, height, tuple(values))
    return cameras


def _images(
    records: Iterator[ImageRecord], cameras: Mapping[int, ColmapCamera]
) -> tuple[ColmapImage, ...]:
    images: dict[str, ColmapImage] = {}
    for place, name, camera, pose in records:
        if not name or name in images:
            got = "an empty one" if not name else f"{one_line(name, 100)} a second time"
            raise UserError(f"{place}: each image must have a name of its own, got {got}")
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts:
            raise UserError(
                f"{place}: a name must be that of a file below the folder of pictures, got "
                f"{one_line(name, 100)}"
            )
        length = math.hypot(*pose[:4])
        if not QUATERNION_RANGE[0] <= length <= QUATERNION_RANGE[1]:
            raise UserError(
                f"{place}: the length of a rotation's quaternion must be 1, got {length:g}"
            )
        for axis, value in zip("xyz", pose[4:], strict=True):
            _check_number(place, f"a translation's {axis}", value)
        if camera not in cameras:
            raise UserError(f"{place}: the number of a camera was expected, got {camera}")
        images[name] = ColmapImage(name, camera, tuple(pose[:4]), tuple(pose[4:]))
    return tuple(images.values())


_POINT = np.dtype(
    [("position", "<f8", 3), ("color", "u1", 3), ("error", "<f8"), ("track_length", "<i8")]
)


def _points(records: Iterator[PointRecord]) -> ColmapPoints:
    def checked(records: Iterator[PointRecord]) -> Iterator[tuple[object, ...]]:
        for place, position, color, error, track_length in records:
            for axis, value in zip("xyz", position, strict=True):
                _check_number(place, axis, value)
            _check_number(place, "an error", error)
            yield tuple(position), tuple(color), error, track_length

    table = np.fromiter(checked(records), _POINT)
    return ColmapPoints(*(np.ascontiguousarray(table[name]) for name in _POINT.names))


def _check_number(place: Place, name: str, value: float, most: float = MAX_NUMBER) -> None:
    if not abs(value) <= most:
        raise UserError(
            f"{place}: {name} must be a number of at most {most:g} in size, got {value:g}"
        )
