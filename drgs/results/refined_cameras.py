"""Refined and original cameras in a fit's folder, in the layout of ``transforms.json``."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drgs.cameras.axes import between_opencv_and_opengl
from drgs.cameras.viewpoints import Viewpoint
from drgs.core.errors import UserError, one_line
from drgs.core.files import atomic_path, read_text
from drgs.core.origin import WORLD, Origin
from drgs.datasets.camera_file import read_viewpoints
from drgs.datasets.transforms import CLOSE_POSE_KEY, MAX_BYTES
from drgs.datasets.types import Dataset, View
from drgs.results.files import CAMERAS, VIEWS
from drgs.results.folder import load_run_config

MODELS = {
    "opencv": "FULL_OPENCV",
    "fisheye": "OPENCV_FISHEYE",
    "thin_prism_fisheye": "THIN_PRISM_FISHEYE",
}
"""COLMAP's lens names; other lenses have their registered names."""


@dataclass(frozen=True)
class LensChange:
    """A refinement of the lens shared by all cameras."""

    focal: tuple[float, float] = (1.0, 1.0)  # factors of fx and fy
    principal: tuple[float, float] = (0.0, 0.0)  # shift in image widths and heights

    def apply(self, view: View) -> View:
        """Return the view with this lens."""
        return replace(
            view,
            fx=view.fx * self.focal[0],
            fy=view.fy * self.focal[1],
            cx=view.cx + self.principal[0] * view.width,
            cy=view.cy + self.principal[1] * view.height,
        )


def refined_dataset(dataset: Dataset, folder: Path) -> Dataset:
    """Return a dataset with the refined cameras in ``folder``, if any."""
    path = folder / CAMERAS
    if not path.is_file():
        return dataset
    try:
        found = json.loads(read_text(path, "refined cameras", MAX_BYTES))
        change = LensChange(**{k: tuple(v) for k, v in found["lens_change"].items()})
        poses = {f["file_path"]: _opencv_pose(f["transform_matrix"]) for f in found["frames"]}
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
    path = folder / CAMERAS
    if not path.is_file() or not load_run_config(folder).cameras.optimise:
        return None
    return _read_relative(path, origin)


def training_cameras(folder: Path, origin: Origin) -> list[Viewpoint] | None:
    """Return the training cameras, refined if possible; see :func:`refined_viewpoints`."""
    if (refined := refined_viewpoints(folder, origin)) is not None:
        return refined
    return _read_relative(folder / VIEWS, origin) if (folder / VIEWS).is_file() else None


def _read_relative(path: Path, origin: Origin) -> list[Viewpoint]:
    return [view.with_offset(-np.array(origin)) for view in read_viewpoints(path, None)]


def _opencv_pose(rows: list[list[float]]) -> np.ndarray:
    return between_opencv_and_opengl(np.array(rows, np.float64).reshape(4, 4))


def _with_pose(view: View, camera_to_world: np.ndarray) -> View:
    """Return the view with another pose; both poses of a moving camera change alike."""
    motion = view.motion
    if motion is not None:
        between = np.linalg.solve(view.camera_to_world, motion.close_to_world)
        motion = replace(motion, close_to_world=camera_to_world @ between)
    return replace(view, camera_to_world=camera_to_world, motion=motion)


def cameras_json(views: Iterable[View], origin: Origin) -> dict[str, object]:
    """Return cameras in the layout of ``transforms.json``, in world coordinates.

    origin: of the views' positions, world; recorded if not zero.
    """
    recorded = {"origin": list(origin)} if origin != WORLD else {}
    frames = [
        {
            "file_path": view.name,
            "transform_matrix": between_opencv_and_opengl(view.camera_to_world).tolist(),
            **{"fl_x": view.fx, "fl_y": view.fy, "cx": view.cx, "cy": view.cy},
            **{"w": view.width, "h": view.height},
            **_lens_and_motion(view),
        }
        for view in (view.with_offset(np.array(origin)) for view in views)
    ]
    return {**recorded, "frames": frames}


def write_views(path: Path, dataset: Dataset) -> None:
    """Write the dataset's cameras of the training views."""
    with atomic_path(path) as temporary:
        content = cameras_json(dataset.train, dataset.origin)
        temporary.write_text(json.dumps(content, indent=1) + "\n")


def _lens_and_motion(view: View) -> dict[str, object]:
    """Return the values of a camera in ``transforms.json`` besides pose and intrinsics."""
    values: dict[str, object] = {}
    if view.lens is not None:
        model = MODELS.get(view.lens.kind, view.lens.kind)
        values |= {"camera_model": model, **view.lens.coefficients()}
    if view.motion is not None:
        values[CLOSE_POSE_KEY] = between_opencv_and_opengl(view.motion.close_to_world).tolist()
        values["shutter"] = view.motion.shutter
    return values
