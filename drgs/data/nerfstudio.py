"""The nerfstudio / instant-ngp layout: one ``transforms.json`` with intrinsics, and photographs.

Intrinsics (``fl_x, fl_y, cx, cy, w, h``) stand at the top or, overriding that, in a frame; where
focal lengths are missing, ``camera_angle_x`` (and ``_y``) give them. Views are sorted by file
name, and every ``data.test_every``-th is for testing, as in Mip-NeRF 360 and 3DGS.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drgs.checks import UserError, one_line
from drgs.config import DataConfig
from drgs.data.frames import (
    focal_from_angle,
    focal_length,
    image_path,
    in_parallel,
    number,
    opencv_camera_to_world,
    positive,
    principal_point,
    read_transforms,
    unique_names,
)
from drgs.data.images import composite, downscale, read_image
from drgs.data.types import Dataset, View

DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")

PINHOLE_MODELS = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
"""Values of ``camera_model`` that are a pinhole camera apart from their distortion."""


def load(config: DataConfig) -> Dataset:
    """Read all views; those at indices 0, n, 2n, ... of the sorted names are the test split."""
    path = config.path / "transforms.json"
    meta = read_transforms(path)
    if config.test_split not in (None, "test"):
        raise UserError(
            f"{path}: this layout has no split {config.test_split}; leave data.test_split out "
            "(data.test_every chooses the test views)"
        )
    if len(meta["frames"]) < 2:
        raise UserError(f"{path}: at least 2 views are needed, one of them to test; got 1")
    frames = [
        _Frame(meta, own, path, f"{path}: frames[{index}].")
        for index, own in enumerate(meta["frames"])
    ]
    files = [image_path(config.path, frame.own, frame.where) for frame in frames]
    if not config.ignore_distortion:
        for frame in frames:
            _refuse_distortion(frame)

    def load_view(index: int, name: str) -> View:
        return _load_view(config, frames[index], files[index], name)

    order = sorted(range(len(frames)), key=lambda index: frames[index].own["file_path"])
    names = unique_names([frames[index].own for index in order])
    views = in_parallel(load_view, order, names)
    test = views[:: config.test_every]
    train = tuple(v for i, v in enumerate(views) if i % config.test_every != 0)
    return Dataset(
        train=train,
        test=test,
        test_split="test",
        background=config.background_rgb,
        start_half_extent=None,
        description=(
            f"{config.path.name} (nerfstudio layout): {len(train)} train views, measured on "
            f"{len(test)} views (every {config.test_every}th by file name), "
            f"{views[0].width}x{views[0].height}, background {config.background}" + _ignored(frames)
        ),
    )


@dataclass(frozen=True)
class _Frame:
    """One frame's values and, for those that it does not have, the file's."""

    meta: dict[str, Any]
    own: dict[str, Any]
    path: Path
    where: str  # how messages name the frame: prefix of a key

    def __contains__(self, key: str) -> bool:
        return key in self.own or key in self.meta

    def get(self, key: str, default: Any = None) -> Any:
        return self.own.get(key, self.meta.get(key, default))

    def at(self, key: str) -> tuple[dict[str, Any], str, str]:
        """The object that holds ``key``, the key, and the prefix that messages name it with."""
        return (self.own, key, self.where) if key in self.own else (self.meta, key, self.top)

    @property
    def top(self) -> str:
        return f"{self.path}: "


def _load_view(config: DataConfig, frame: _Frame, file: Path, name: str) -> View:
    _refuse_other_lenses(frame)
    camera_to_world = opencv_camera_to_world(frame.own, frame.where)
    image = composite(read_image(file), config.background_rgb)
    height, width = image.shape[:2]
    for key, size in (("w", width), ("h", height)):
        if key in frame and (given := positive(*frame.at(key))) != size:
            raise UserError(
                f"{frame.at(key)[2]}{key} must be the image's size, {size} px ({file}), got "
                f"{given:g}; scale the intrinsics or the images"
            )
    fx = _focal(frame, "x", width)
    fy = _focal(frame, "y", height) if "fl_y" in frame or "camera_angle_y" in frame else fx
    cx = principal_point(*frame.at("cx"), width) if "cx" in frame else width / 2
    cy = principal_point(*frame.at("cy"), height) if "cy" in frame else height / 2

    image = downscale(image, config.image_size)
    scale_x, scale_y = image.shape[1] / width, image.shape[0] / height
    return View(
        name=name,
        image=image,
        camera_to_world=camera_to_world,
        fx=fx * scale_x,
        fy=fy * scale_y,
        cx=cx * scale_x,
        cy=cy * scale_y,
        width=image.shape[1],
        height=image.shape[0],
    )


def _focal(frame: _Frame, axis: str, size: int) -> float:
    if f"fl_{axis}" in frame:
        return focal_length(*frame.at(f"fl_{axis}"), size)
    if f"camera_angle_{axis}" in frame:
        return focal_from_angle(*frame.at(f"camera_angle_{axis}"), size)
    raise UserError(f"{frame.top}fl_{axis} is missing, and there is no camera_angle_{axis} either")


def _coefficients(frame: _Frame) -> dict[str, float]:
    """The distortion coefficients that are not zero."""
    given = {key: number(*frame.at(key)) for key in DISTORTION if key in frame}
    return {key: value for key, value in given.items() if value != 0}


def _refuse_distortion(frame: _Frame) -> None:
    found = _coefficients(frame)
    if found:
        listed = ", ".join(f"{key} = {value:g}" for key, value in found.items())
        raise UserError(
            f"{frame.where.rstrip('.')}: lens distortion ({listed}) is not supported: undistort "
            "the images, or set data.ignore_distortion: true"
        )


def _refuse_other_lenses(frame: _Frame) -> None:
    model = frame.get("camera_model", PINHOLE_MODELS[0])
    if model not in PINHOLE_MODELS:
        raise UserError(
            f"{frame.at('camera_model')[2]}camera_model must be one of "
            f"{', '.join(PINHOLE_MODELS)}, got {one_line(model)}"
        )
    if frame.get("is_fisheye"):
        raise UserError(
            f"{frame.at('is_fisheye')[2]}is_fisheye must be false: only pinhole cameras are "
            "supported"
        )


def _ignored(frames: list[_Frame]) -> str:
    """What the dataset has and the loader leaves out, for the description."""
    notes = ""
    keys = {key for frame in frames for key in _coefficients(frame)}
    if keys:
        notes += f"; lens distortion ({', '.join(sorted(keys))}) ignored"
    if any("mask_path" in frame for frame in frames):
        notes += "; masks (mask_path) ignored"
    return notes
