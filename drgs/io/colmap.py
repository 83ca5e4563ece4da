"""COLMAP models: cameras, images with their poses, and points, in binary or in text files.

The formats are those of COLMAP's documentation ("Output Format") and of its ``reconstruction_io``.
Observations are skipped, and so are rigs and frames, which repeat what images contain. Errors in
records name the file, the byte or the line, what was expected and what was got.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from scipy.spatial.transform import Rotation

from drgs.core.errors import Place, UserError, did_you_mean, one_line
from drgs.core.files import read_bytes, read_text
from drgs.io.images import MAX_SIDE

_BROWN = ("k1", "k2", "p1", "p2")
_ONE, _TWO = ("f", "cx", "cy"), ("fx", "fy", "cx", "cy")

MODELS: Mapping[str, tuple[int, tuple[str, ...]]] = {
    "SIMPLE_PINHOLE": (0, _ONE),
    "PINHOLE": (1, _TWO),
    "SIMPLE_RADIAL": (2, (*_ONE, "k1")),
    "RADIAL": (3, (*_ONE, "k1", "k2")),
    "OPENCV": (4, (*_TWO, *_BROWN)),
    "OPENCV_FISHEYE": (5, (*_TWO, "k1", "k2", "k3", "k4")),
    "FULL_OPENCV": (6, (*_TWO, *_BROWN, "k3", "k4", "k5", "k6")),
    "FOV": (7, (*_TWO, "omega")),
    "SIMPLE_RADIAL_FISHEYE": (8, (*_ONE, "k1")),
    "RADIAL_FISHEYE": (9, (*_ONE, "k1", "k2")),
    "THIN_PRISM_FISHEYE": (10, (*_TWO, *_BROWN, "k3", "k4", "sx1", "sy1")),
    "RAD_TAN_THIN_PRISM_FISHEYE": (
        11,
        (*_TWO, *(f"k{i}" for i in range(6)), "p0", "p1", *(f"s{i}" for i in range(4))),
    ),
    "SIMPLE_DIVISION": (12, (*_ONE, "k")),
    "DIVISION": (13, (*_TWO, "k")),
    "SIMPLE_FISHEYE": (14, _ONE),
    "FISHEYE": (15, _TWO),
    "EUCM": (16, (*_TWO, "alpha", "beta")),
    "EQUIRECTANGULAR": (17, ("w", "h")),
}
"""Camera models by name: COLMAP's number of each, and its parameters in their order."""

MODEL_NAMES = {number: name for name, (number, _) in MODELS.items()}

MAX_NUMBER = 1e12  # largest magnitude of a parameter or a coordinate

QUATERNION_RANGE = (1e-6, 1e6)  # lengths of accepted quaternions; COLMAP writes 1

MAX_FILE_BYTES = 1 << 33

BINARY_MEMORY_RATIO, TEXT_MEMORY_RATIO = 4, 8  # memory that reading takes, in bytes of the file

MAX_NAME_BYTES = 4096

OBSERVATION_BYTES, TRACK_BYTES = 24, 8


@dataclass(frozen=True)
class ColmapCamera:
    """The intrinsics of some of the images."""

    number: int  # by which images refer to it
    model: str  # of MODELS
    width: int  # px
    height: int  # px
    values: Mapping[str, float]  # by the names in MODELS; px, and coefficients of distortion


@dataclass(frozen=True, eq=False)
class ColmapImage:
    """A photograph and its pose."""

    name: str  # of its file below the folder of photographs, with ``/`` between folders
    camera: int  # the number of its camera
    camera_to_world: np.ndarray  # (4, 4) float64, OpenCV axes


POINT = np.dtype(
    [("positions", "<f8", 3), ("colors", "u1", 3), ("errors", "<f8"), ("track_lengths", "<i8")]
)
"""A point: world position, colour, mean error (px; -1: not known) and number of observations."""


@dataclass(frozen=True, eq=False)
class ColmapModel:
    """A reconstruction."""

    cameras: Mapping[int, ColmapCamera]  # by number
    images: tuple[ColmapImage, ...]  # in the order of the file
    points_file: Path | None  # None: it has no points

    @property
    def has_points(self) -> bool:
        """True if there is at least one point."""
        file = self.points_file
        return file is not None and next(iter(_records(file)), None) is not None


def model_files(folder: Path) -> dict[str, Path] | None:
    """Return ``cameras``, ``images`` and maybe ``points3D``, binary if possible; None: no model."""
    for suffix in (".bin", ".txt"):
        files = {name: folder / f"{name}{suffix}" for name in ("cameras", "images", "points3D")}
        there = {name: path for name, path in files.items() if path.is_file()}
        if {"cameras", "images"} <= set(there):
            return there
    return None


def read_model(folder: str | Path) -> ColmapModel:
    """Return the model in ``folder``, without its points."""
    files = model_files(Path(folder))
    if files is None:
        raise UserError(
            f"{folder}: is no model of COLMAP: there are neither cameras.bin and images.bin nor "
            "cameras.txt and images.txt"
        )
    cameras = _cameras(_records(files["cameras"]))
    return ColmapModel(cameras, _images(_records(files["images"]), cameras), files.get("points3D"))


def read_points3d(path: str | Path) -> np.recarray:
    """Return the points of ``points3D.bin`` or ``.txt``, each a :data:`POINT`."""
    return _points(_records(Path(path)))


def _records(path: Path) -> Iterator[tuple]:
    take, parse, form = _KINDS[path.stem]
    if path.suffix == ".txt":
        return _text_records(path, parse, form)
    return _binary_records(path, take)


# Checks


def _cameras(records: Iterable[tuple]) -> dict[int, ColmapCamera]:
    cameras: dict[int, ColmapCamera] = {}
    for place, number, model, width, height, values in records:
        if not (1 <= width <= MAX_SIDE and 1 <= height <= MAX_SIDE):
            raise UserError(
                f"{place}: width and height must be between 1 and {MAX_SIDE:,} px, got {width:,} "
                f"and {height:,}"
            )
        if model not in MODELS:
            raise UserError(
                f"{place}: a camera model of COLMAP was expected, got {one_line(model, 40)}"
                f"{did_you_mean(model, MODELS)}"
            )
        names = MODELS[model][1]
        if len(values) != len(names):
            raise UserError(
                f"{place}: a camera of the model {model} has {len(names)} parameters "
                f"({', '.join(names)}), got {len(values)}"
            )
        _check_numbers(place, names, values)
        if number in cameras:
            raise UserError(f"{place}: each camera must be there once, got a second one {number}")
        named = dict(zip(names, values, strict=True))
        cameras[number] = ColmapCamera(number, model, width, height, named)
    return cameras


def _images(
    records: Iterable[tuple], cameras: Mapping[int, ColmapCamera]
) -> tuple[ColmapImage, ...]:
    images: dict[str, ColmapImage] = {}
    for place, name, camera, pose in records:
        path = PurePosixPath(name)
        if not name or name in images or path.is_absolute() or ".." in path.parts:
            raise UserError(
                f"{place}: each image must have a name of its own, that of a file below the folder "
                f"of photographs, got {one_line(name, 100) or 'an empty one'}"
            )
        length = math.hypot(*pose[:4])
        if not QUATERNION_RANGE[0] <= length <= QUATERNION_RANGE[1]:
            raise UserError(
                f"{place}: the length of a rotation's quaternion must be 1, got {length:g}"
            )
        _check_numbers(place, ("TX", "TY", "TZ"), pose[4:])
        if camera not in cameras:
            raise UserError(f"{place}: the number of a camera was expected, got {camera}")
        rotation = Rotation.from_quat([*pose[1:4], pose[0]]).inv()
        camera_to_world = np.eye(4)
        camera_to_world[:3, :3] = rotation.as_matrix()
        camera_to_world[:3, 3] = -rotation.apply(pose[4:])
        images[name] = ColmapImage(name, camera, camera_to_world)
    return tuple(images.values())


def _points(records: Iterable[tuple]) -> np.recarray:
    def rows() -> Iterator[tuple]:
        for place, position, color, error, track_length in records:
            _check_numbers(place, ("X", "Y", "Z", "ERROR"), (*position, error))
            if not 0 <= min(color) <= max(color) <= 255:
                raise UserError(f"{place}: colours must be 0 to 255, got {tuple(color)}")
            yield tuple(position), tuple(color), error, track_length

    return np.fromiter(rows(), POINT).view(np.recarray)


def _check_numbers(place: Place, names: Sequence[str], values: Sequence[float]) -> None:
    for name, value in zip(names, values, strict=True):
        if not abs(value) <= MAX_NUMBER:
            raise UserError(
                f"{place}: {name} must be a number of at most {MAX_NUMBER:g} in size, got {value:g}"
            )


# Binary files: little-endian numbers without padding


class _BinaryFile:
    def __init__(self, path: Path) -> None:
        self._path, self._at = path, 0
        self._data = read_bytes(path, "file", MAX_FILE_BYTES, BINARY_MEMORY_RATIO)

    @property
    def place(self) -> Place:
        return Place(self._path, "byte", self._at)

    @property
    def left(self) -> int:
        return len(self._data) - self._at

    def skip(self, size: int) -> None:
        if size > self.left:
            raise UserError(
                f"{self.place}: {size:,} bytes were expected, and {self.left:,} are left; the file "
                "is damaged, or was cut off"
            )
        self._at += size

    def take(self, layout: str) -> tuple:
        """Return the next numbers, in a layout of :mod:`struct`."""
        start = self._at
        self.skip(struct.calcsize(f"<{layout}"))
        return struct.unpack_from(f"<{layout}", self._data, start)

    def name(self) -> str:
        """Return the next text, which a zero byte ends."""
        place, end = self.place, self._data.find(b"\0", self._at, self._at + MAX_NAME_BYTES)
        encoded, self._at = self._data[self._at : end], end + 1
        try:
            if end >= 0:
                return encoded.decode()
        except UnicodeDecodeError:
            pass
        raise UserError(
            f"{place}: a name in UTF-8 of less than {MAX_NAME_BYTES:,} bytes was expected; the "
            "file is damaged, or was cut off"
        )


def _binary_records(path: Path, take: Callable[[_BinaryFile], tuple]) -> Iterator[tuple]:
    file = _BinaryFile(path)
    for _ in range(*file.take("Q")):
        yield file.place, *take(file)
    if file.left:
        raise UserError(
            f"{file.place}: the end of the file was expected after its last record, got "
            f"{file.left:,} bytes more"
        )


def _take_camera(file: _BinaryFile) -> tuple:
    number, model_number, width, height = file.take("IiQQ")
    model = MODEL_NAMES.get(model_number, f"number {model_number}")
    values = file.take(f"{len(MODELS[model][1])}d") if model in MODELS else ()
    return number, model, width, height, values


def _take_image(file: _BinaryFile) -> tuple:
    _, *pose, camera = file.take("I7dI")
    name, (num_observations,) = file.name(), file.take("Q")
    file.skip(OBSERVATION_BYTES * num_observations)
    return name, camera, pose


def _take_point(file: _BinaryFile) -> tuple:
    _, x, y, z, red, green, blue, error, track_length = file.take("Q3d3BdQ")
    file.skip(TRACK_BYTES * track_length)
    return (x, y, z), (red, green, blue), error, track_length


# Text files: a record a line, ``#`` before comments


def _text_records(path: Path, parse: Callable[[str], tuple], form: str) -> Iterator[tuple]:
    text = read_text(path, "file", MAX_FILE_BYTES, TEXT_MEMORY_RATIO)
    follows_image = False
    for number, line in enumerate(text.split("\n"), 1):
        # An image's second line may be empty, or, of some programs, missing. Otherwise it has
        # X Y POINT3D_ID of some points; a photograph's line ends with its name.
        words = line.split()
        has_points = follows_image and len(words) % 3 == 0
        if line.strip()[:1] in ("", "#") or (has_points and words[-1].lstrip("-").isdecimal()):
            follows_image = False
            continue
        follows_image, place = path.stem == "images", Place(path, "line", number)
        try:
            record = parse(line)
        except ValueError:
            raise UserError(f"{place}: {form} was expected, got {one_line(line, 60)}") from None
        yield place, *record


def _parse_camera(line: str) -> tuple:
    number, model, width, height, *values = line.split()
    return int(number), model, int(width), int(height), [float(value) for value in values]


def _parse_image(line: str) -> tuple:
    _, w, x, y, z, tx, ty, tz, camera, name = line.split(maxsplit=9)
    return name.rstrip(), int(camera), [float(value) for value in (w, x, y, z, tx, ty, tz)]


def _parse_point(line: str) -> tuple:
    _, x, y, z, red, green, blue, error, *track = line.split()
    if len(track) % 2:
        raise ValueError("a track has pairs of numbers")
    color = int(red), int(green), int(blue)
    return (float(x), float(y), float(z)), color, float(error), len(track) // 2


_KINDS = {
    "cameras": (_take_camera, _parse_camera, "a camera (CAMERA_ID MODEL WIDTH HEIGHT PARAMS)"),
    "images": (
        *(_take_image, _parse_image),
        "an image (IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME)",
    ),
    "points3D": (
        *(_take_point, _parse_point),
        "a point (POINT3D_ID X Y Z R G B ERROR, pairs of a track)",
    ),
}
"""Readers of the records of binary and of text files, and the form of a line."""
