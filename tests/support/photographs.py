"""Photographs in another frame of reference, and clouds of points."""

import json
import os
from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation


def write_points(path, positions, colors):
    kinds = [(n, "f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    rows = np.empty(len(positions), kinds)
    for name, column in zip([n for n, _ in kinds], np.hstack([positions, colors]).T, strict=True):
        rows[name] = column
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))


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
