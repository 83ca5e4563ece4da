"""Binary files of COLMAP's models: little-endian numbers, one record behind the other."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

from drgs.core.errors import Place, UserError, one_line
from drgs.core.files import read_bytes
from drgs.io.colmap_records import MODELS, CameraRecord, ImageRecord, PointRecord

MAX_BYTES = 1 << 33
"""Of a file: 8.6 GB."""

MEMORY_RATIO = 4
"""Memory that reading takes, in bytes of the file: its content and the table of its records."""

MAX_NAME = 4096
"""Bytes of an image's name."""

NAME_OF = {number: name for name, (number, _) in MODELS.items()}

COUNT = struct.Struct("<Q")
CAMERA = struct.Struct("<IiQQ")
IMAGE = struct.Struct("<I7dI")
POINT = struct.Struct("<Q3d3Bd")
OBSERVATION_BYTES, TRACK_BYTES = 24, 8


def cameras(path: Path) -> Iterator[CameraRecord]:
    """Of ``cameras.bin``."""
    file = _File(path)
    for _ in range(file.count(CAMERA.size, "cameras")):
        place = file.place
        number, model, width, height = file.take(CAMERA, "a camera")
        if model not in NAME_OF:
            raise UserError(
                f"{place}: the number of a camera model, 0 to {max(NAME_OF)}, was expected, got "
                f"{model}"
            )
        layout = struct.Struct(f"<{len(MODELS[NAME_OF[model]][1])}d")
        values = file.take(layout, "a camera's parameters")
        yield CameraRecord(place, number, NAME_OF[model], width, height, values)
    file.check_end("cameras")


def images(path: Path) -> Iterator[ImageRecord]:
    """Of ``images.bin``."""
    file = _File(path)
    for _ in range(file.count(IMAGE.size + 1 + COUNT.size, "images")):
        place = file.place
        _, *pose, camera = file.take(IMAGE, "an image")
        name = file.name()
        file.skip(OBSERVATION_BYTES, "observations")
        yield ImageRecord(place, name, camera, pose)
    file.check_end("images")


def points(path: Path) -> Iterator[PointRecord]:
    """Of ``points3D.bin``."""
    file = _File(path)
    for _ in range(file.count(POINT.size + COUNT.size, "points")):
        place = file.place
        _, x, y, z, red, green, blue, error = file.take(POINT, "a point")
        length = file.skip(TRACK_BYTES, "elements of a track")
        yield PointRecord(place, (x, y, z), (red, green, blue), error, length)
    file.check_end("points")


class _File:
    """Read from its beginning to its end."""

    def __init__(self, path: Path) -> None:
        self._path, self._at = path, 0
        self._data = read_bytes(path, "file", MAX_BYTES, MEMORY_RATIO)

    @property
    def place(self) -> Place:
        """Where what comes next begins."""
        return Place(self._path, "byte", self._at)

    @property
    def _left(self) -> int:
        return len(self._data) - self._at

    def take(self, layout: struct.Struct, what: str) -> tuple:
        """The next numbers."""
        if layout.size > self._left:
            raise UserError(
                f"{self.place}: {what} of {layout.size} bytes was expected, and the file ends "
                f"after {self._left}; it was cut off"
            )
        values = layout.unpack_from(self._data, self._at)
        self._at += layout.size
        return values

    def count(self, least_bytes: int, what: str) -> int:
        """A number of records that follow, of so many bytes each, or more."""
        place = self.place
        (count,) = self.take(COUNT, f"the number of {what}")
        room = self._left // least_bytes
        if count > room:
            raise UserError(
                f"{place}: at most {room:,} {what}, for which there is room in the rest of the "
                f"file, were expected, got {count:,}; it is damaged, or was cut off"
            )
        return count

    def skip(self, size: int, what: str) -> int:
        """Leave out records of ``size`` bytes whose number comes first, and return that."""
        count = self.count(size, what)
        self._at += size * count
        return count

    def name(self) -> str:
        """Text that a zero byte ends."""
        place, end = self.place, self._data.find(b"\0", self._at, self._at + MAX_NAME)
        if end < 0:
            raise UserError(
                f"{place}: a name of less than {MAX_NAME:,} bytes was expected, got a longer one; "
                "the file is damaged, or was cut off"
            )
        encoded = self._data[self._at : end]
        self._at = end + 1
        try:
            return encoded.decode()
        except UnicodeDecodeError:
            got = one_line(str(encoded), 60)
            raise UserError(f"{place}: a name in UTF-8 was expected, got {got}") from None

    def check_end(self, what: str) -> None:
        """Nothing follows."""
        if self._left:
            raise UserError(
                f"{self.place}: the end of the file was expected behind its {what}, got "
                f"{self._left:,} bytes more"
            )
