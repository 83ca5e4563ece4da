"""Datasets of photographs made from others: from COLMAP's files, and in another frame of reference.

What is written is in the layout of nerfstudio, as its converters write it.
"""

import json
import os
import struct
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation

FLIP = np.diag([1.0, -1, -1, 1])
"""Between OpenCV's and OpenGL's camera axes."""


def read_colmap_images(path):
    """(name, (4, 4) camera to world in OpenCV axes) for each image of ``images.bin``."""
    data, images = path.read_bytes(), []
    (count,) = struct.unpack_from("<Q", data)
    at = 8
    for _ in range(count):
        _, *pose = struct.unpack_from("<I7d", data, at)
        at += 64  # 60 bytes, and the camera's number
        end = data.index(b"\0", at)
        (num_points,) = struct.unpack_from("<Q", data, end + 1)
        world_to_camera = np.eye(4)
        world_to_camera[:3, :3] = Rotation.from_quat(np.roll(pose[:4], -1)).as_matrix()
        world_to_camera[:3, 3] = pose[4:]
        images.append((data[at:end].decode(), np.linalg.inv(world_to_camera)))
        at = end + 9 + 24 * num_points
    return images


def read_colmap_points(path):
    """(N, 3) positions and (N, 3) colours, 0..255, of ``points3D.bin``."""
    data = path.read_bytes()
    (count,) = struct.unpack_from("<Q", data)
    at, positions, colors = 8, [], []
    for _ in range(count):
        _, x, y, z, r, g, b, _, length = struct.unpack_from("<Q3d3BdQ", data, at)
        positions.append((x, y, z))
        colors.append((r, g, b))
        at += 51 + 8 * length
    return np.array(positions), np.array(colors, np.uint8)


def write_points(path, positions, colors):
    kinds = [(n, "f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    rows = np.empty(len(positions), kinds)
    for name, column in zip([n for n, _ in kinds], np.hstack([positions, colors]).T, strict=True):
        rows[name] = column
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))


def from_colmap(source, images, folder, factor, with_points=True):
    """``folder`` with a ``transforms.json`` of COLMAP's model (SIMPLE_RADIAL) in ``source``.

    images: the folder of pictures, ``factor`` times as small as what COLMAP saw.
    """
    cameras = (source / "cameras.bin").read_bytes()
    width, height, *values = struct.unpack_from("<2Q4d", cameras, 16)
    focal, cx, cy = (value / factor for value in values[:3])
    meta = {"fl_x": focal, "fl_y": focal, "cx": cx, "cy": cy, "k1": values[3]}
    meta |= {"w": width // factor, "h": height // factor, "camera_model": "OPENCV"}
    meta["frames"] = [
        {"file_path": f"images/{name}", "transform_matrix": (pose @ FLIP).tolist()}
        for name, pose in read_colmap_images(source / "images.bin")
    ]
    folder.mkdir()
    os.symlink(images, folder / "images")
    if with_points:
        write_points(folder / "points.ply", *read_colmap_points(source / "points3D.bin"))
        meta["ply_file_path"] = "points.ply"
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder


def moved(source: Path, folder: Path, scale):
    """``folder`` with the photographs of ``source``, whose world is turned, moved and scaled.

    The origin is the mean of the cameras' positions, as in COLMAP's reconstructions; scale: the
    largest distance of a camera from there.
    """
    meta = json.loads((source / "transforms.json").read_text())
    poses = np.array([frame["transform_matrix"] for frame in meta["frames"]])
    turn = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()
    centers = poses[:, :3, 3]
    mean = centers.mean(axis=0)
    size = scale / np.linalg.norm(centers - mean, axis=1).max()
    for frame, pose in zip(meta["frames"], poses, strict=True):
        new = np.eye(4)
        new[:3, :3] = turn @ pose[:3, :3]
        new[:3, 3] = turn @ (pose[:3, 3] - mean) * size
        frame["transform_matrix"] = new.tolist()
    folder.mkdir()
    os.symlink(source / "images", folder / "images")
    (folder / "transforms.json").write_text(json.dumps(meta))
    return folder
