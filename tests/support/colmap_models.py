"""Models of COLMAP that are written, in binary and in text, without the program."""

import struct
from dataclasses import dataclass, field

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from drgs.io.colmap import MODELS


def _values(names):
    size = [600.0] if "f" in names else [600.0, 620.0]
    coefficients = (0.01 * (k + 1) for k in range(len(names) - len(size) - 2))
    return (*size, 320.5, 239.0, *coefficients)


PARAMETERS = {name: _values(names) for name, (_, names) in MODELS.items()}
PARAMETERS["EQUIRECTANGULAR"] = (640.0, 480.0)
"""Parameters of a 640 x 480 px camera, by model."""


@dataclass
class Model:
    """cameras: (number, model, width, height, values); images: (name, camera, pose (4, 4) camera to
    world in OpenCV axes); points: (position, color, error, track length)."""

    cameras: list = field(default_factory=list)
    images: list = field(default_factory=list)
    points: list = field(default_factory=list)


def quaternion_and_translation(pose):
    """Return a pose in COLMAP's convention: world to camera, w first."""
    inverse = np.linalg.inv(pose)
    return np.roll(Rotation.from_matrix(inverse[:3, :3]).as_quat(), 1), inverse[:3, 3]


def some_model(rng, names=("a.jpg", "b c.jpg", "cam/1.png"), models=("PINHOLE", "OPENCV")):
    """Cameras look at the origin, where the points are; numbers are not in order."""
    cameras = [(7 - k, model, 640, 480, PARAMETERS[model]) for k, model in enumerate(models)]
    poses = np.tile(np.eye(4), (len(names), 1, 1))
    poses[:, :3, :3] = Rotation.random(len(names), rng=rng).as_matrix()
    poses[:, :3, 3] = -4 * poses[:, :3, 2]
    images = [
        (name, cameras[k % len(cameras)][0], pose)
        for k, (name, pose) in enumerate(zip(names, poses, strict=True))
    ]
    points = [(rng.normal(size=3), rng.integers(0, 256, 3), rng.random(), k % 4) for k in range(9)]
    return Model(cameras, images, points)


def write_binary(folder, model, with_points=True):
    """Write COLMAP's binary model; images observe as many points as their number says."""
    folder.mkdir(parents=True, exist_ok=True)
    data = struct.pack("<Q", len(model.cameras))
    for number, name, width, height, values in model.cameras:
        data += struct.pack("<IiQQ", number, MODELS[name][0], width, height)
        data += np.array(values, "<f8").tobytes()
    (folder / "cameras.bin").write_bytes(data)
    data = struct.pack("<Q", len(model.images))
    for index, (name, camera, pose) in enumerate(model.images):
        quaternion, translation = quaternion_and_translation(pose)
        data += struct.pack("<I7dI", index + 1, *quaternion, *translation, camera)
        data += name.encode() + b"\0" + struct.pack("<Q", index)
        data += struct.pack("<ddq", 1.5, 2.5, -1) * index
    (folder / "images.bin").write_bytes(data)
    if with_points:
        data = struct.pack("<Q", len(model.points))
        for number, (position, color, error, length) in enumerate(model.points):
            data += struct.pack("<Q3d3BdQ", number, *position, *map(int, color), error, length)
            data += struct.pack("<II", 1, 0) * length
        (folder / "points3D.bin").write_bytes(data)
    return folder


def write_text(folder, model, with_points=True):
    """Write COLMAP's text model: comments first, two lines for each image, of which one may be
    empty."""
    folder.mkdir(parents=True, exist_ok=True)

    def words(*values):
        return " ".join(repr(float(v)) for v in values)

    lines = ["# Camera list with one line of data per camera:", "#   CAMERA_ID, MODEL, ..."]
    lines += [f"{n} {name} {w} {h} {words(*values)}" for n, name, w, h, values in model.cameras]
    (folder / "cameras.txt").write_text("\n".join(lines) + "\n")
    lines = ["# Image list with two lines of data per image:"]
    for index, (name, camera, pose) in enumerate(model.images):
        quaternion, translation = quaternion_and_translation(pose)
        lines.append(f"{index + 1} {words(*quaternion, *translation)} {camera} {name}")
        lines.append(" ".join(["1.5 2.5 -1"] * index))
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    if with_points:
        lines = ["# 3D point list with one line of data per point:"]
        for number, (position, color, error, length) in enumerate(model.points):
            color = " ".join(map(str, color))
            lines.append(f"{number} {words(*position)} {color} {words(error)} {'1 0 ' * length}")
        (folder / "points3D.txt").write_text("\n".join(lines) + "\n")
    return folder


WRITERS = {"binary": write_binary, "text": write_text}

SIZE = 640, 480  # of some_model's cameras

NAMES = ("a.jpg", "b.jpg", "cam/1.png", "cam/2.png")


def write_images(folder, names=NAMES, size=SIZE, **options):
    """Write images, each of one colour."""
    for number, name in enumerate(names):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.new("RGB", size, (40 * number, 20, 30)).save(path, **options)


def write_dataset(folder, models=("PINHOLE",), below="sparse/0", write=write_binary):
    """Images are in the file in another order than by name."""
    model = some_model(np.random.default_rng(1), NAMES[::-1], models)
    write(folder / below, model)
    write_images(folder / "images")
    return model
