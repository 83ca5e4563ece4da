"""What the files of COLMAP's models say, record by record, before it is checked."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from drgs.core.errors import Place

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


class CameraRecord(NamedTuple):
    """A camera as a file has it."""

    place: Place
    number: int
    model: str
    width: int
    height: int
    values: Sequence[float]


class ImageRecord(NamedTuple):
    """An image as a file has it."""

    place: Place
    name: str
    camera: int
    pose: Sequence[float]  # w, x, y, z; x, y, z


class PointRecord(NamedTuple):
    """A point as a file has it."""

    place: Place
    position: Sequence[float]
    color: Sequence[int]
    error: float
    track_length: int
