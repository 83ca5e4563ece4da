"""Photographs without any effect, of five kinds that are hard to examine, path traced."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import drgs  # noqa: F401  (registers the sensors)
import mitsuba as mi
import numpy as np
from drgs.cameras.equirectangular import Equirectangular
from drgs.datasets.types import Dataset, View
from drgs.integrator.scene import make_sensors

KINDS = ("glossy", "dark", "few views", "textureless", "panoramas")
NUM_VIEWS, FEW_VIEWS, SPP = 48, 22, 64
WIDTH, HEIGHT = 132, 100
DARK_EXPOSURE, NOISE = 0.3, 0.012  # of dark photographs, in display space

ROOM = 3.0  # half of its sides, scene units


def _rgb(values: np.ndarray) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(value) for value in values]}


def _texture(rng: np.random.Generator, is_plain: bool, cells: int = 8) -> dict[str, Any]:
    if is_plain:
        return _rgb(np.full(3, 0.5) + rng.uniform(-0.05, 0.05))
    colors = rng.uniform(0.05, 0.9, (cells, cells, 3)).astype(np.float32)
    bitmap = mi.Bitmap(np.repeat(np.repeat(colors, 8, axis=0), 8, axis=1))
    return {"type": "bitmap", "bitmap": bitmap, "raw": True}


def _scene(kind: str, seed: int) -> mi.Scene:
    """Return a room with some balls and boxes, and a lamp in its middle."""
    rng, at = np.random.default_rng(seed), mi.ScalarTransform4f()
    is_plain = kind == "textureless"
    parts: dict[str, Any] = {"type": "scene", "integrator": {"type": "path", "max_depth": 6}}
    parts["sky"] = {"type": "constant", "radiance": _rgb(np.full(3, 0.6))}
    parts["lamp"] = {
        "type": "point",
        "position": [0.5, 0.4, 2.5],
        "intensity": _rgb(np.full(3, 3.0)),
    }
    walls = {"floor": at.translate([0, 0, -1])}
    if kind == "panoramas":
        sides = [([0, 1, 0], 90), ([0, 1, 0], -90), ([1, 0, 0], 90), ([1, 0, 0], -90)]
        for name, (axis, angle) in zip("abcd", sides, strict=True):
            walls[name] = at.rotate(axis, angle).translate([0, 0, -ROOM])
    for name, place in walls.items():
        surface = {
            "type": "twosided",
            "bsdf": {"type": "diffuse", "reflectance": _texture(rng, is_plain, 20)},
        }
        parts[name] = {
            "type": "rectangle",
            "to_world": place.scale([ROOM, ROOM, 1]),
            "bsdf": surface,
        }
    for k in range(12):
        x, y = rng.uniform(-1.6, 1.6, 2)
        size = rng.uniform(0.2, 0.45)
        surface = {"type": "diffuse", "reflectance": _texture(rng, is_plain)}
        if kind == "glossy":
            surface = {
                "type": "roughplastic",
                "alpha": 0.08,
                "diffuse_reflectance": _texture(rng, False),
            }
            if k % 2:
                surface = {"type": "roughconductor", "material": "Al", "alpha": 0.12}
        place = at.translate([x, y, size - 1]).rotate([0, 0, 1], rng.uniform(0, 90)).scale(size)
        parts[f"part{k}"] = {
            "type": ("sphere", "cube")[k % 3 // 2],
            "to_world": place,
            "bsdf": surface,
        }
    return mi.load_dict(parts)


def _views(kind: str, seed: int) -> list[View]:
    rng = np.random.default_rng(seed + 1)
    count = FEW_VIEWS if kind == "few views" else NUM_VIEWS
    views, empty = [], np.zeros((HEIGHT, WIDTH, 3), np.float32)
    for k in range(count):
        turn = 2.4 * k  # golden angle
        if kind == "panoramas":
            center = np.array([*rng.uniform(-0.8, 0.8, 2), rng.uniform(0.3, 1.0)])
            target = center + np.array([np.cos(turn), np.sin(turn), 0])
        else:
            height = 0.6 + 1.6 * (k + 0.5) / count
            center = 3.6 * np.array([np.cos(turn), np.sin(turn), 0]) + [0, 0, height]
            target = np.array([*rng.uniform(-0.2, 0.2, 2), -0.6])
        z = target - center
        z /= np.linalg.norm(z)
        x = np.cross(z, [0, 0, 1])
        x /= np.linalg.norm(x)
        pose = np.eye(4)
        pose[:3] = np.column_stack([x, np.cross(z, x), z, center])
        focal = 0.9 * WIDTH
        view = View(
            f"{k:03d}", pose, focal, focal, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, image=empty
        )
        if kind == "panoramas":
            view = replace(view, lens=Equirectangular(), height=WIDTH // 2, cy=WIDTH / 4)
        views.append(view)
    return views


def clean_set(kind: str, seed: int = 0) -> Dataset:
    """Return photographs of one of :data:`KINDS`; the seed places things and cameras."""
    scene, rng, taken = _scene(kind, seed), np.random.default_rng(seed + 2), []
    views = _views(kind, seed)
    for view, sensor in zip(views, make_sensors(views), strict=True):
        linear = np.array(mi.render(scene, sensor=sensor, spp=SPP, seed=len(taken)))[..., :3]
        image = np.clip(linear * 0.7, 0, 1) ** (1 / 2.2)
        if kind == "dark":
            image = image * DARK_EXPOSURE + NOISE * rng.normal(size=image.shape)
        taken.append(replace(view, image=np.clip(image, 0, 1).astype(np.float32)))
    black = (0.0, 0.0, 0.0)
    return Dataset(tuple(taken), (), "none", black, None, f"{kind}, path traced")
