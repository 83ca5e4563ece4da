"""The nerfstudio / instant-ngp layout: one ``transforms.json`` with intrinsics, and photographs.

Intrinsics (``fl_x, fl_y, cx, cy, w, h``) stand at the top or, overriding that, in a frame; where
focal lengths are missing, ``camera_angle_x`` (and ``_y``) give them. Views are sorted by file
name, and every ``data.test_every``-th is for testing, as in Mip-NeRF 360 and 3DGS.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from drgs.checks import UserError
from drgs.config import DataConfig
from drgs.data.frames import (
    focal_from_angle,
    image_path,
    in_parallel,
    number,
    opencv_camera_to_world,
    positive,
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
    frames = meta["frames"]
    if len(frames) < 2:
        raise UserError(f"{path}: at least 2 views are needed, one of them to test; got 1")
    locations = [f"{path}: frames[{index}]." for index in range(len(frames))]
    files = [
        image_path(config.path, frame, at) for frame, at in zip(frames, locations, strict=True)
    ]

    def load_view(index: int, name: str) -> View:
        # A frame's own values override those at the top.
        return _load_view(config, meta | frames[index], files[index], name, locations[index])

    order = sorted(range(len(frames)), key=lambda index: frames[index]["file_path"])
    names = unique_names([frames[index] for index in order])
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
            f"{views[0].width}x{views[0].height}, background {config.background}"
            + _ignored(meta, frames, config)
        ),
    )


def _load_view(
    config: DataConfig, values: dict[str, Any], file: Path, name: str, where: str
) -> View:
    """The view of one frame, whose values are merged over those at the top of the file."""
    _refuse_other_lenses(values, where)
    if not config.ignore_distortion:
        _refuse_distortion(values, where)
    camera_to_world = opencv_camera_to_world(values, where)
    image = composite(read_image(file), config.background_rgb)
    height, width = image.shape[:2]
    for key, size in (("w", width), ("h", height)):
        if key in values and positive(values, key, where) != size:
            raise UserError(
                f"{where}{key} must be the image's size, {size} px ({file}), got {values[key]:g}; "
                "scale the intrinsics or the images"
            )
    fx = _focal(values, "x", width, where)
    fy = _focal(values, "y", height, where) if _has_focal(values, "y") else fx
    cx = number(values, "cx", where) if "cx" in values else width / 2
    cy = number(values, "cy", where) if "cy" in values else height / 2

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


def _has_focal(values: dict[str, Any], axis: str) -> bool:
    return f"fl_{axis}" in values or f"camera_angle_{axis}" in values


def _focal(values: dict[str, Any], axis: str, size: int, where: str) -> float:
    if f"fl_{axis}" in values:
        return positive(values, f"fl_{axis}", where)
    if f"camera_angle_{axis}" in values:
        return focal_from_angle(values, f"camera_angle_{axis}", size, where)
    raise UserError(f"{where}fl_{axis} is missing, and there is no camera_angle_{axis} either")


def _coefficients(values: dict[str, Any], where: str) -> dict[str, float]:
    """The distortion coefficients that are not zero."""
    given = {key: number(values, key, where) for key in DISTORTION if key in values}
    return {key: value for key, value in given.items() if value != 0}


def _refuse_distortion(values: dict[str, Any], where: str) -> None:
    found = _coefficients(values, where)
    if found:
        listed = ", ".join(f"{key} = {value:g}" for key, value in found.items())
        raise UserError(
            f"{where.rstrip('.')} has lens distortion ({listed}), which is not supported: "
            "undistort the images, or set data.ignore_distortion: true"
        )


def _refuse_other_lenses(values: dict[str, Any], where: str) -> None:
    model = values.get("camera_model", "OPENCV")
    if model not in PINHOLE_MODELS:
        raise UserError(
            f"{where}camera_model must be one of {', '.join(PINHOLE_MODELS)}, got {model}"
        )
    if values.get("is_fisheye"):
        raise UserError(f"{where}is_fisheye must be false: only pinhole cameras are supported")


def _ignored(meta: dict[str, Any], frames: list[dict[str, Any]], config: DataConfig) -> str:
    """What the dataset has and the loader leaves out, for the description."""
    notes = ""
    keys = sorted({key for frame in frames for key in _coefficients({**meta, **frame}, "")})
    if keys:
        notes += f"; lens distortion ({', '.join(keys)}) ignored"
    if any("mask_path" in frame for frame in frames):
        notes += "; masks (mask_path) ignored"
    return notes
