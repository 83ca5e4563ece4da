"""Placement of a capture's cameras: around a scene, inside it, or where its own sensors are.

Settings that are not given follow from the scene and its sensors (:func:`settings_for`). A room is
photographed from inside, as its walls are dark or transparent from behind.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Set
from dataclasses import replace
from typing import NamedTuple, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from drgs.cameras.viewpoints import OPENCV_TO_OPENGL, OPENGL_TO_MITSUBA, look_at
from drgs.capture.path_tracing import (
    MIN_LIT_PART,
    SPLITS,
    CaptureCamera,
    CaptureSettings,
    CaptureView,
    bounding_box,
    lit_part,
    scale_fov,
)
from drgs.core.errors import UserError
from drgs.core.types import Float

KINDS = ("around", "inside", "sensors")

ELEVATIONS = {"around": (0.0, 90.0), "inside": (-60.0, 60.0)}
"""Degrees above the horizon, lowest and highest. Inside, the ceiling is seen from below."""

INSIDE_FOV = math.radians(70)  # in a room, walls are near
INSIDE_PART = 0.6  # place of a camera on the way from the target to the wall behind it
ENOUGH_SENSORS = 10  # number of sensors from which on the cameras stand where they are
TEST_EVERY = 8  # interval of the sensors that are for testing, as in the nerfstudio layout

COUNTS = {"views", "val_views", "test_views"}

ORBITING = {"distance", "azimuth", "elevation"}  # settings that place cameras around a scene

UNUSED = {
    "around": set(),
    "inside": {"distance"},
    "sensors": {*COUNTS, *ORBITING, "target", "up", "fov"},
}
"""Settings that a kind of cameras does not use."""

MIN_ENCLOSED_SHARE = 0.75  # of all directions, which have a surface in a room: 5/6 in Cornell's box

NUM_SPOTS, NUM_DIRECTIONS = 128, 128  # points that may be in a room, and rays from each

ROOM_QUANTILE = 0.1  # of the distances from a spot to its surroundings: the size of its room

PREVIEWS, PREVIEW_SIZE, PREVIEW_SPP = 12, (16, 16), 4

GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))

PLASTIC_RATIO = 1.2207440846057596
"""The root of x^4 = x + 1: its powers spread points evenly over a box (Roberts 2018, "R_3")."""


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
    """Return ``settings`` with values from the scene for those that are not named in ``given``.

    Raises :class:`UserError` for a setting that the cameras do not use.
    """
    sensors = perspective_sensors(scene)
    if "cameras" not in given:
        kind = _kind_for(scene, settings, given, sensors)
        return settings_for(scene, replace(settings, cameras=kind), {*given, "cameras"})
    for name in sorted(given & UNUSED[settings.cameras]):
        option = f"--{name.replace('_', '-')}"
        raise UserError(f"{option}: is not used with --cameras {settings.cameras}; leave it out")
    if settings.cameras == "sensors":
        derived = _sensor_settings(sensors)
    elif settings.cameras == "inside":
        spot, _ = _room(scene, settings)
        derived = {"target": tuple(spot.tolist()), "fov": _fov(settings, INSIDE_FOV)}
    else:
        derived = _around_settings(scene, settings, given, sensors) if sensors else {}
    if sensors and settings.cameras != "sensors":
        derived["up"] = _up_axis(sensors)
    return replace(settings, **{name: derived[name] for name in derived.keys() - given})


def views_of(scene: mi.Scene, settings: CaptureSettings) -> list[CaptureView]:
    """Return all views, split after split; settings: from :func:`settings_for`."""
    if settings.cameras == "sensors":
        return views_of_sensors(perspective_sensors(scene), settings)
    if settings.cameras == "inside":
        return views_inside(scene, settings)
    return views_around(settings, *target_and_distance(scene, settings))


# Settings from the scene


def _kind_for(
    scene: mi.Scene, settings: CaptureSettings, given: Set[str], sensors: list[SceneSensor]
) -> str:
    if given & ORBITING:
        return "around"
    if len(sensors) >= ENOUGH_SENSORS and not given & {*COUNTS, "target", "up", "fov"}:
        return "sensors"
    _, is_closed = _room(scene, settings)
    if not is_closed:
        return "around"
    author_is_inside = any(
        _measure_enclosure(scene, [o.pose[:3, 3] for o in sensors])[0] >= MIN_ENCLOSED_SHARE
    )
    if not author_is_inside and _is_lit(scene, replace(settings, cameras="around"), given):
        return "around"
    return "inside" if _is_lit(scene, replace(settings, cameras="inside"), given) else "around"


def _is_lit(scene: mi.Scene, settings: CaptureSettings, given: Set[str]) -> bool:
    """Return whether most surfaces are lit in a few small images of this kind."""
    settings = settings_for(scene, settings, {*given, "cameras"})
    few = replace(
        settings, size=PREVIEW_SIZE, spp=PREVIEW_SPP, views=PREVIEWS, val_views=0, test_views=0
    )
    camera = CaptureCamera(scene, few)
    return lit_part(np.stack([camera.image(view) for view in views_of(scene, few)])) >= MIN_LIT_PART


def _around_settings(
    scene: mi.Scene, settings: CaptureSettings, given: Set[str], sensors: list[SceneSensor]
) -> dict[str, object]:
    """Return settings for the view of the scene's sensors, if they look at its middle."""
    middle = np.mean(bounding_box(scene), axis=0, dtype=np.float64)
    ahead = [(o.pose[:3, 3], -o.pose[:3, 2]) for o in sensors]
    aims = [c + ((middle - c) @ axis) * axis for c, axis in ahead if (middle - c) @ axis > 0]
    if not aims or given & {"fov", "distance"}:
        return {}
    target = np.mean(aims, axis=0) if settings.target is None else np.array(settings.target)
    distance = float(np.median([np.linalg.norm(o.pose[:3, 3] - target) for o in sensors]))
    fov = _fov(settings, float(np.median([o.narrower_fov for o in sensors])))
    return {"target": tuple(target.tolist()), "distance": distance, "fov": fov}


def _sensor_settings(sensors: list[SceneSensor]) -> dict[str, object]:
    if not sensors:
        raise UserError(
            "--cameras sensors: the scene has no sensor of type perspective or thinlens; leave the "
            "option out"
        )
    tests = len(sensors[::TEST_EVERY]) if len(sensors) > 1 else 0
    return {"views": len(sensors) - tests, "val_views": 0, "test_views": tests}


def _up_axis(sensors: list[SceneSensor]) -> str:
    """Return the axis that is nearest to up in the sensors' images, such as ``z`` or ``-y``."""
    up = np.mean([o.pose[:3, 1] for o in sensors], axis=0)
    axis = int(np.argmax(np.abs(up)))
    return f"{'-' if up[axis] < 0 else ''}{'xyz'[axis]}"


def _fov(settings: CaptureSettings, narrower: float) -> float:
    """Return the horizontal field of view, radians, from that along the image's smaller side."""
    width, height = settings.size
    return scale_fov(narrower, max(1.0, width / height))


def _room(scene: mi.Scene, settings: CaptureSettings) -> tuple[np.ndarray, bool]:
    """Return the spot with most room, (3,) world, in a room if any is, and whether it is in one."""
    low, high = np.array(bounding_box(scene), np.float64)
    if settings.target is not None:
        spots = np.array([settings.target])
        if not ((low < spots[0]) & (spots[0] < high)).all():
            return spots[0], False
    else:
        steps = np.arange(NUM_SPOTS)[:, None] * PLASTIC_RATIO ** -np.arange(1.0, 4.0)
        spots = low + (high - low) * ((0.5 + steps) % 1)
    closed, room = _measure_enclosure(scene, spots)
    is_closed = closed >= MIN_ENCLOSED_SHARE
    best = np.argmax(np.where(is_closed, room, -1)) if is_closed.any() else np.argmax(closed)
    return spots[best], bool(is_closed.any())


def _measure_enclosure(scene: mi.Scene, spots: ArrayLike) -> tuple[np.ndarray, np.ndarray]:
    """Return the part of all directions with a surface, and the room, (N,), at places (N, 3).

    Surfaces seen from behind do not count: the place is inside an object.
    """
    spots = np.array(spots, np.float64).reshape(-1, 3)
    up = hemisphere(NUM_DIRECTIONS // 2, 0.0, np.random.default_rng(0))
    directions = np.concatenate([up, -up])
    pairs = np.repeat(spots, len(directions), axis=0), np.tile(directions, (len(spots), 1))
    distances, is_front = _first_surfaces(scene, *pairs)
    shape = len(spots), len(directions)
    room = np.quantile(distances.reshape(shape), ROOM_QUANTILE, axis=1, method="lower")
    return is_front.reshape(shape).mean(axis=1), room


def _first_surfaces(
    scene: mi.Scene, origins: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return distances (N,) to surfaces or lamps, and whether these scatter on the seen side."""
    if not len(origins):
        return np.empty(0), np.empty(0, bool)
    hit = scene.ray_intersect(mi.Ray3f(mi.Point3f(origins.T), mi.Vector3f(directions.T)))
    side = dr.select(hit.wi.z > 0, int(mi.BSDFFlags.FrontSide), int(mi.BSDFFlags.BackSide))
    is_front = hit.is_valid() & ((hit.bsdf().flags() & side) != 0)
    return np.array(hit.t, np.float64), np.array(is_front)


# Cameras


def target_and_distance(scene: mi.Scene, settings: CaptureSettings) -> tuple[np.ndarray, float]:
    """Return the target of cameras around a scene, (3,) world, and their distance from it.

    By default, the bounding box's sphere just fits between the edges of the image: radius /
    sin(fov / 2), with the narrower field of view. NeRF-synthetic's 4.03 is 10% less: its box has
    empty corners.
    """
    low, high = bounding_box(scene)
    target = (low + high) / 2 if settings.target is None else np.array(settings.target)
    radius = float(np.linalg.norm(high - low)) / 2
    return target, settings.distance or radius / math.sin(settings.narrower_fov / 2)


def views_around(
    settings: CaptureSettings, target: np.ndarray, distance: float
) -> list[CaptureView]:
    """Return views from all sides, at one distance from the target."""
    return _views(settings, target, lambda directions: np.full(len(directions), distance))


def views_inside(scene: mi.Scene, settings: CaptureSettings) -> list[CaptureView]:
    """Return views from between ``settings.target`` and its surroundings."""
    target = np.array(settings.target)
    low, high = np.array(bounding_box(scene), np.float64)
    if not ((low < target) & (target < high)).all():
        raise UserError(
            f"target must lie within the scene's bounding box, {low.tolist()} to {high.tolist()}, "
            f"for cameras inside it, got {target.tolist()}"
        )

    def distances(directions: np.ndarray) -> np.ndarray:
        with np.errstate(divide="ignore"):
            leaving = (np.where(directions > 0, high, low) - target) / directions
        leaving = np.where(directions == 0, np.inf, leaving).min(axis=1)
        way, _ = _first_surfaces(scene, np.tile(target, (len(directions), 1)), directions)
        return INSIDE_PART * np.minimum(way, leaving)

    return _views(settings, target, distances)


def views_of_sensors(sensors: list[SceneSensor], settings: CaptureSettings) -> list[CaptureView]:
    """Return the views of the scene's own sensors."""
    has_tests = settings.test_views > 0
    tests = sensors[::TEST_EVERY] if has_tests else []
    train = [o for n, o in enumerate(sensors) if not (has_tests and n % TEST_EVERY == 0)]
    return [
        CaptureView(split, index, o.pose, _fov(settings, o.narrower_fov))
        for split, cameras in (("train", train), ("test", tests))
        for index, o in enumerate(cameras)
    ]


def _views(
    settings: CaptureSettings, target: np.ndarray, distances: Callable[[np.ndarray], np.ndarray]
) -> list[CaptureView]:
    """Return views of ``target``; distances: from it, (N,), in directions (N, 3)."""
    views, axis = [], settings.up[-1]
    up = np.eye(3)["xyz".index(axis)] * (-1 if settings.up.startswith("-") else 1)
    for number, split in enumerate(SPLITS):
        rng = np.random.default_rng([settings.seed, number])
        # Test views are spread evenly; training views at random, but without gaps.
        jitter = 0.0 if split == "test" else 1.0
        directions = remap_to_ranges(hemisphere(settings.count(split), jitter, rng), settings)
        directions = np.roll(directions, "zxy".index(axis), axis=1) * up.sum()
        offsets = distances(directions)[:, None] * directions
        for index, offset in enumerate(offsets):
            pose = look_at(target + offset, target, up) @ OPENCV_TO_OPENGL
            views.append(CaptureView(split, index, pose, settings.fov))
    return views


def remap_to_ranges(directions: np.ndarray, settings: CaptureSettings) -> np.ndarray:
    """Return directions (N, 3) of the upper hemisphere about z, moved evenly into the ranges."""
    elevation = settings.elevation or ELEVATIONS[settings.cameras]
    if settings.azimuth is None and elevation == ELEVATIONS["around"]:
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
