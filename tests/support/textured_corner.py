"""Images of the corner of a room with noise on its walls, and where they were taken."""

import numpy as np
from PIL import Image
from scipy.ndimage import gaussian_filter, map_coordinates

from support.datasets import look_at

SIZE, FOCAL = (320, 240), 300.0

TEXELS_PER_UNIT = 64  # texels


def walls(seed=0, side=512):
    """Textures of the planes x = 0, y = 0 and z = 0: noise of several sizes."""
    rng = np.random.default_rng(seed)
    layers = [gaussian_filter(rng.normal(size=(3, side, side, 3)), (0, s, s, 0)) for s in (1, 3, 9)]
    noise = sum(layer / layer.std() for layer in layers)
    return np.clip(0.5 + 0.2 * noise, 0, 1)


def image_of(textures, pose):
    """(H, W, 3) uint8 of a pinhole camera; pose: (4, 4) camera to world, OpenGL axes."""
    width, height = SIZE
    x, y = np.meshgrid(np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2)
    rays = np.stack([x, -y, np.full_like(x, -FOCAL)], axis=-1) @ pose[:3, :3].T
    center, rendered = pose[:3, 3], np.zeros((height, width, 3))
    distances = np.stack([-center[k] / np.minimum(rays[..., k], -1e-9) for k in range(3)])
    nearest = distances.argmin(axis=0)
    for k in range(3):
        points = center + distances[k][..., None] * rays
        place = np.delete(points, k, axis=-1) * TEXELS_PER_UNIT
        for channel in range(3):
            texture = textures[k, :, :, channel]
            seen = map_coordinates(texture, np.moveaxis(place, -1, 0), order=1, mode="wrap")
            rendered[..., channel] = np.where(nearest == k, seen, rendered[..., channel])
    return np.round(255 * rendered).astype(np.uint8)


def poses(count):
    """In front of the corner, along an arc, all looking at about the same place."""
    angles = np.linspace(0.35, 1.2, count)
    return [
        look_at(
            (6 * np.cos(a), 6 * np.sin(a), 2.5 + np.sin(5 * a)),
            (1.2, 1.2, 1.2 + 0.3 * np.sin(7 * a)),
        )
        for a in angles
    ]


def write_photographs(folder, names, **options):
    """An image of each name; their poses."""
    folder.mkdir(parents=True, exist_ok=True)
    textures = walls()
    found = poses(len(names))
    for name, pose in zip(names, found, strict=True):
        Image.fromarray(image_of(textures, pose)).save(folder / name, **options)
    return found
