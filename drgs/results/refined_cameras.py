"""Refined and original cameras in a fit's folder, in the layout of ``transforms.json``."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np

from drgs.cameras.viewpoints import Viewpoint, between_opencv_and_opengl
from drgs.core.errors import UserError, one_line
from drgs.core.files import read_text, write_json
from drgs.core.origin import Origin
from drgs.datasets.camera_file import cameras_json, read_viewpoints
from drgs.datasets.transforms import MAX_BYTES
from drgs.datasets.types import Dataset, View
from drgs.effects.cameras import REFINED_CAMERAS, CamerasConfig, LensChange
from drgs.results.folder import CAMERAS, VIEWS, load_run_config


def refined_cameras_file(folder: Path) -> Path | None:
    """Return the file of refined cameras in ``folder``, or None; earlier: ``cameras.json``."""
    if (path := folder / REFINED_CAMERAS).is_file():
        return path
    if not (path := folder / CAMERAS).is_file():
        return None
    return None if read_text(path, "cameras", MAX_BYTES).lstrip().startswith("[") else path


def refined_dataset(dataset: Dataset, folder: Path) -> Dataset:
    """Return a dataset with the refined cameras in ``folder``, if any."""
    if (path := refined_cameras_file(folder)) is None:
        return dataset
    try:
        found = json.loads(read_text(path, "refined cameras", MAX_BYTES))
        change = LensChange(**{k: tuple(v) for k, v in found["lens_change"].items()})
        rows = {f["file_path"]: np.array(f["transform_matrix"], float) for f in found["frames"]}
        poses = {k: between_opencv_and_opengl(v.reshape(4, 4)) for k, v in rows.items()}
        for pose in poses.values():
            pose[:3, 3] -= dataset.origin
        train = [change.apply(_with_pose(view, poses[view.name])) for view in dataset.train]
    except (ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(
            f"{path}: must hold the refined cameras of all training views, as the fit wrote them: "
            f"{one_line(error)}; remove it to use the dataset's own"
        ) from None
    return replace(dataset, train=tuple(train), test=tuple(map(change.apply, dataset.test)))


def refined_viewpoints(folder: Path, origin: Origin) -> list[Viewpoint] | None:
    """Return the refined training cameras of the fit in ``folder``, or None.

    origin: of their positions, world. Raises :class:`UserError` as ``read_viewpoints``.
    """
    path = refined_cameras_file(folder)
    if path is None or not load_run_config(folder).section("cameras", CamerasConfig).optimise:
        return None
    return _read_relative(path, origin)


def training_cameras(folder: Path, origin: Origin) -> list[Viewpoint] | None:
    """Return the training cameras, refined if possible; see :func:`refined_viewpoints`."""
    if (refined := refined_viewpoints(folder, origin)) is not None:
        return refined
    return _read_relative(folder / VIEWS, origin) if (folder / VIEWS).is_file() else None


def _read_relative(path: Path, origin: Origin) -> list[Viewpoint]:
    return [view.with_offset(-np.array(origin)) for view in read_viewpoints(path, None)]


def _with_pose(view: View, camera_to_world: np.ndarray) -> View:
    """Return the view with another pose; both poses of a moving camera change alike."""
    motion = view.motion
    if motion is not None:
        between = np.linalg.solve(view.camera_to_world, motion.close_to_world)
        motion = replace(motion, close_to_world=camera_to_world @ between)
    return replace(view, camera_to_world=camera_to_world, motion=motion)


def write_views(path: Path, dataset: Dataset) -> None:
    """Write the dataset's cameras of the training views."""
    write_json(path, cameras_json(dataset.train, dataset.origin))


def write_pinholes(folder: Path, dataset: Dataset) -> None:
    """Write the training cameras, refined if possible, as the 3DGS reference does.

    Positions are those of ``point_cloud.ply``; distortion and principal point are left out.
    """
    views, cameras = refined_viewpoints(folder, dataset.origin) or dataset.train, []
    for view, given in zip(views, dataset.train, strict=True):
        camera = {"id": len(cameras), "img_name": given.name, "position": view.center.tolist()}
        camera["rotation"] = view.camera_to_world[:3, :3].tolist()
        cameras.append(camera | {k: getattr(view, k) for k in ("width", "height", "fx", "fy")})
    write_json(folder / CAMERAS, cameras)
