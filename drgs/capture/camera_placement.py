"""Placement of a capture's cameras: around a scene, or where its own sensors are.

Settings that are not given follow from the scene and its sensors (:func:`settings_for`).
"""

from __future__ import annotations

import math
from collections.abc import Set
from dataclasses import replace
from typing import NamedTuple, cast

import mitsuba as mi
import numpy as np

from drgs.cameras.viewpoints import OPENCV_TO_OPENGL, OPENGL_TO_MITSUBA, look_at
from drgs.capture.path_tracing import SPLITS, CaptureSettings, CaptureView, bounding_box, scale_fov
from drgs.core.errors import UserError
from drgs.core.types import Float

KINDS = ("around", "sensors")

ELEVATION = (0.0, 90.0)  # degrees above the horizon, lowest and highest

ENOUGH_SENSORS = 10  # number of sensors from which on the cameras stand where they are
TEST_EVERY = 8  # interval of the sensors that are for testing, as in the nerfstudio layout

NOT_OF_SENSORS = {"views", "val_views", "test_views"}
NOT_OF_SENSORS |= {"distance", "azimuth", "elevation", "target", "up", "fov"}
"""Settings that are not used with the scene's own sensors."""

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


class SceneSensor(NamedTuple):
    """A sensor of the scene itself."""

    pose: np.ndarray  # (4, 4) float64 camera to world, OpenGL axes
    narrower_fov: float  # radians, along the film's smaller side


def perspective_sensors(scene: mi.Scene) -> list[SceneSensor]:
    """Return the scene's sensors of the types ``perspective`` and ``thinlens``."""
    sensors = []
    for sensor in scene.sensors():
        parameters = mi.traverse(sensor)
        if "x_fov" not in parameters:
            continue
        pose = np.array(sensor.world_transform().matrix, np.float64).reshape(4, 4)
        pose[:3, :3] /= np.linalg.norm(pose[:3, :3], axis=0)
        width, height = sensor.film().size()
        fov = math.radians(cast("Float", parameters["x_fov"])[0])
        fov = scale_fov(fov, min(1.0, height / width))
        sensors.append(SceneSensor(pose @ OPENGL_TO_MITSUBA, fov))
    return sensors


def settings_for(scene: mi.Scene, settings: CaptureSettings, given: Set[str]) -> CaptureSettings:
    """Return settings from the scene but for ``given`` ones; UserError for one that is not used."""
    sensors = perspective_sensors(scene)
    if "cameras" not in given:
        has_enough = len(sensors) >= ENOUGH_SENSORS and not given & NOT_OF_SENSORS
        settings = replace(settings, cameras="sensors" if has_enough else "around")
    if settings.cameras == "sensors":
        for name in sorted(given & NOT_OF_SENSORS):
            option = f"--{name.replace('_', '-')}"
            raise UserError(f"{option}: is not used with --cameras sensors; leave it out")
        if not sensors:
            raise UserError(
                "--cameras sensors: the scene has no sensor of type perspective or thinlens; leave "
                "the option out"
            )
        tests = len(sensors[::TEST_EVERY]) if len(sensors) > 1 else 0
        derived = {"views": len(sensors) - tests, "val_views": 0, "test_views": tests}
    else:
        derived = _around_settings(scene, settings, given, sensors) if sensors else {}
    return replace(settings, **{name: derived[name] for name in derived.keys() - given})


def views_of(scene: mi.Scene, settings: CaptureSettings) -> list[CaptureView]:
    """Return all views, split after split; settings: from :func:`settings_for`."""
    if settings.cameras == "sensors":
        sensors = perspective_sensors(scene)
        tests = sensors[::TEST_EVERY] if settings.test_views > 0 else []
        train = [o for n, o in enumerate(sensors) if not tests or n % TEST_EVERY]
        return [
            CaptureView(split, index, o.pose, _fov(settings, o.narrower_fov))
            for split, cameras in (("train", train), ("test", tests))
            for index, o in enumerate(cameras)
        ]
    return views_around(settings, *target_and_distance(scene, settings))


# Settings from the scene


def _around_settings(
    scene: mi.Scene, settings: CaptureSettings, given: Set[str], sensors: list[SceneSensor]
) -> dict[str, object]:
    """Return settings for the view of the scene's sensors, if they look at its middle."""
    middle = np.mean(bounding_box(scene), axis=0, dtype=np.float64)
    ahead = [(o.pose[:3, 3], -o.pose[:3, 2]) for o in sensors]
    aims = [c + ((middle - c) @ axis) * axis for c, axis in ahead if (middle - c) @ axis > 0]
    mean_up = np.mean([o.pose[:3, 1] for o in sensors], axis=0)
    axis = int(np.argmax(np.abs(mean_up)))  # the nearest to up in the sensors' images
    up = f"{'-' if mean_up[axis] < 0 else ''}{'xyz'[axis]}"
    if not aims or given & {"fov", "distance"}:
        return {"up": up}
    target = np.mean(aims, axis=0) if settings.target is None else np.array(settings.target)
    distance = float(np.median([np.linalg.norm(o.pose[:3, 3] - target) for o in sensors]))
    fov = _fov(settings, float(np.median([o.narrower_fov for o in sensors])))
    return {"up": up, "target": tuple(target.tolist()), "distance": distance, "fov": fov}


def _fov(settings: CaptureSettings, narrower: float) -> float:
    """Return the horizontal field of view, radians, from that along the image's smaller side."""
    width, height = settings.size
    return scale_fov(narrower, max(1.0, width / height))


# Cameras


def target_and_distance(scene: mi.Scene, settings: CaptureSettings) -> tuple[np.ndarray, float]:
    """Return the target of cameras around a scene, (3,) world, and their distance from it.

    By default, the bounding box's sphere just fits into the image: radius / sin(fov / 2), with the
    narrower field of view. NeRF-synthetic's 4.03 is 10% less: its box has empty corners.
    """
    low, high = bounding_box(scene)
    target = (low + high) / 2 if settings.target is None else np.array(settings.target)
    radius = float(np.linalg.norm(high - low)) / 2
    return target, settings.distance or radius / math.sin(settings.narrower_fov / 2)


def views_around(
    settings: CaptureSettings, target: np.ndarray, distance: float
) -> list[CaptureView]:
    """Return views from all sides, at one distance from the target."""
    views, axis = [], settings.up[-1]
    up = np.eye(3)["xyz".index(axis)] * (-1 if settings.up.startswith("-") else 1)
    for number, split in enumerate(SPLITS):
        rng = np.random.default_rng([settings.seed, number])
        # Test views are spread evenly; training views at random, but without gaps.
        jitter = 0.0 if split == "test" else 1.0
        directions = remap_to_ranges(hemisphere(settings.count(split), jitter, rng), settings)
        directions = np.roll(directions, "zxy".index(axis), axis=1) * up.sum()
        for index, offset in enumerate(distance * directions):
            pose = look_at(target + offset, target, up) @ OPENCV_TO_OPENGL
            views.append(CaptureView(split, index, pose, settings.fov))
    return views


def remap_to_ranges(directions: np.ndarray, settings: CaptureSettings) -> np.ndarray:
    """Return directions (N, 3) of the upper hemisphere about z, moved evenly into the ranges."""
    elevation = settings.elevation or ELEVATION
    if settings.azimuth is None and elevation == ELEVATION:
        return directions
    low, high = np.sin(np.radians(elevation))
    height = low + (high - low) * directions[:, 2]
    turn = (np.arctan2(directions[:, 1], directions[:, 0]) / (2 * math.pi)) % 1
    first, last = np.radians(settings.azimuth or (0.0, 360.0))
    azimuth = first + (last - first) * turn
    radius = np.sqrt(np.maximum(1 - height**2, 0))
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)


def hemisphere(count: int, jitter: float, rng: np.random.Generator) -> np.ndarray:
    """Return unit vectors (count, 3) with z > 0, of equal density per solid angle.

    A golden-angle spiral from the rim to the pole: equal steps of height are equal areas (the
    sphere's hat-box theorem). ``jitter`` 1 moves each within its own step, 0 not at all.
    """
    step = np.arange(count)
    offset = rng.uniform(0, 2 * math.pi)
    moved = jitter * rng.uniform(-0.5, 0.5, (2, count))
    height = (step + 0.5 + moved[0]) / max(count, 1)
    azimuth = offset + GOLDEN_ANGLE * (step + moved[1])
    radius = np.sqrt(1 - height**2)
    return np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height], axis=1)
