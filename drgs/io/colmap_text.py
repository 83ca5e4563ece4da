"""Text files of COLMAP's models: a record a line, ``#`` before comments.

An image's are two lines, of which the second has what it observes, or nothing. Some programs leave
out the second.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from drgs.core.errors import Place, UserError, did_you_mean, one_line
from drgs.core.files import read_text
from drgs.io.colmap_records import MODELS, CameraRecord, ImageRecord, PointRecord

MAX_BYTES = 1 << 33
"""Of a file: 8.6 GB."""

MEMORY_RATIO = 8
"""Memory that reading takes, in bytes of the file: its text, lines and numbers."""

MAX_DIGITS = 19
"""Of a whole number."""

CAMERA = ("CAMERA_ID", "MODEL", "WIDTH", "HEIGHT", "PARAMS")
IMAGE = ("IMAGE_ID", "QW", "QX", "QY", "QZ", "TX", "TY", "TZ", "CAMERA_ID", "NAME")
POINT = ("POINT3D_ID", "X", "Y", "Z", "R", "G", "B", "ERROR")


def cameras(path: Path) -> Iterator[CameraRecord]:
    """Of ``cameras.txt``."""
    for line in _records(path):
        number, model, width, height, values = line.words(CAMERA, "a camera")
        if model not in MODELS:
            raise UserError(
                f"{line.place}: MODEL must be a camera model of COLMAP, got {one_line(model, 40)}"
                f"{did_you_mean(model, MODELS)}"
            )
        yield CameraRecord(
            line.place,
            line.whole(number, "CAMERA_ID"),
            model,
            line.whole(width, "WIDTH"),
            line.whole(height, "HEIGHT"),
            [line.real(value, "a parameter") for value in values.split()],
        )


def images(path: Path) -> Iterator[ImageRecord]:
    """Of ``images.txt``."""
    lines = _lines(path)
    line = next(lines, None)
    while line is not None:
        following = next(lines, None)
        if line.is_record:
            _, *pose, camera, name = line.words(IMAGE, "an image")
            pose = [line.real(word, key) for word, key in zip(pose, IMAGE[1:], strict=False)]
            camera = line.whole(camera, "CAMERA_ID")
            yield ImageRecord(line.place, name.rstrip(), camera, pose)
            if following is not None and not _is_image(following):
                _check_observations(following)
                following = next(lines, None)
        line = following


def _is_image(line: _Line) -> bool:
    """Return whether a line is as long as an image's first and ends in a name, not a number."""
    words = line.text.split()
    if len(words) < len(IMAGE):
        return False
    try:
        float(words[-1])
    except ValueError:
        return True
    return False


def _check_observations(line: _Line) -> None:
    if len(line.text.split()) % 3:
        raise UserError(
            f"{line.place}: what an image observes (X, Y, POINT3D_ID of each point) was expected; "
            "each image has two lines, of which the second may be empty"
        )


def points(path: Path) -> Iterator[PointRecord]:
    """Of ``points3D.txt``."""
    for line in _records(path):
        _, x, y, z, *color, error, track = [*line.words((*POINT, "TRACK"), "a point", 8), ""][:9]
        ids = track.split()
        if len(ids) % 2:
            raise UserError(
                f"{line.place}: TRACK must be pairs of IMAGE_ID and POINT2D_IDX, got "
                f"{len(ids)} numbers"
            )
        yield PointRecord(
            line.place,
            [line.real(word, key) for word, key in zip((x, y, z), "XYZ", strict=True)],
            [line.whole(word, key, 255) for word, key in zip(color, "RGB", strict=True)],
            line.real(error, "ERROR"),
            len(ids) // 2,
        )


@dataclass(frozen=True)
class _Line:
    path: Path
    number: int
    text: str

    @property
    def place(self) -> Place:
        """Where it stands."""
        return Place(self.path, "line", self.number)

    @property
    def is_record(self) -> bool:
        """Whether it is more than a comment."""
        return self.text.strip()[:1] not in ("", "#")

    def words(self, names: tuple[str, ...], what: str, least: int | None = None) -> list[str]:
        """Those of a record, which begins with ``names``; the last one is the rest of the line."""
        words = self.text.split(maxsplit=len(names) - 1)
        if len(words) < (least or len(names)):
            raise UserError(
                f"{self.place}: {what} ({', '.join(names)}) was expected, got "
                f"{one_line(self.text, 60)}"
            )
        return words

    def real(self, word: str, name: str) -> float:
        """A number."""
        try:
            value = float(word)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise UserError(f"{self.place}: {name} must be a number, got {one_line(word, 40)}")
        return value

    def whole(self, word: str, name: str, most: int = 10**MAX_DIGITS) -> int:
        """A number that counts."""
        is_whole = word.isascii() and word.isdigit() and len(word) <= MAX_DIGITS
        if not is_whole or int(word) > most:
            limit = "" if most == 10**MAX_DIGITS else f" of at most {most}"
            raise UserError(
                f"{self.place}: {name} must be a whole number{limit}, got {one_line(word, 40)}"
            )
        return int(word)


def _lines(path: Path) -> Iterator[_Line]:
    """All of them."""
    text = read_text(path, "file", MAX_BYTES, MEMORY_RATIO)
    return (_Line(path, number, line) for number, line in enumerate(text.split("\n"), 1))


def _records(path: Path) -> Iterator[_Line]:
    """Those that are no comments."""
    return (line for line in _lines(path) if line.is_record)
