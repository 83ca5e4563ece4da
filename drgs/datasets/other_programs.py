"""Cameras of LLFF, the 3DGS reference, OpenSfM and Metashape: in the layout of ``transforms.json``.

Each program has one file beside the photographs, whose numbers are converted to the keys of
``drgs.datasets.transforms``; these are checked as a file of that layout is. Where a folder has
COLMAP's model or a ``transforms.json`` as well, that is read.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation
from typing_extensions import override

from drgs.config.extensions import READERS
from drgs.config.section import parse_json
from drgs.core.errors import UserError
from drgs.core.files import open_regular, read_text, refuse_damage
from drgs.datasets.files import images_in
from drgs.datasets.nerfstudio import NerfstudioReader
from drgs.datasets.transforms import MAX_BYTES, MEMORY_RATIO, TransformsFile, transforms_of

Values = dict[str, Any]  # keys of a ``transforms.json``

OPENSFM_FILE = "reconstruction.json"

PANORAMA = "EQUIRECTANGULAR"

OPENSFM_MODELS = {
    **dict.fromkeys(("perspective", "simple_radial", "radial", "brown"), "OPENCV"),
    **dict.fromkeys(("fisheye", "fisheye_opencv"), "OPENCV_FISHEYE"),
    **dict.fromkeys(("spherical", "equirectangular"), PANORAMA),
}
METASHAPE_MODELS = {
    "frame": "OPENCV",
    **dict.fromkeys(("fisheye", "equidistant_fisheye"), "OPENCV_FISHEYE"),
    "spherical": PANORAMA,
}
"""COLMAP's names of the models of cameras."""

COEFFICIENTS = ("k1", "k2", "k3", "k4", "p1", "p2")


class ProgramReader(NerfstudioReader):
    """Base class of readers of the file of cameras of a program, ``layout``."""

    order = 3

    @override
    def read(self, path: Path, notes: list[str]) -> TransformsFile:
        with refuse_damage(f"{path}: not cameras as {self.layout} writes them"):
            values = self.values(path, notes)
        for frame in values["frames"]:
            frame["file_path"] = f"images/{frame['file_path']}"  # or nearly: see find_files
        return transforms_of(values, path)

    def values(self, path: Path, notes: list[str]) -> Values:
        """Return the content in the layout of ``transforms.json``; errors tell of damage."""
        raise NotImplementedError


@READERS.register("llff")
class LlffReader(ProgramReader):
    """Reads ``poses_bounds.npy``: 17 numbers for each photograph, in the order of their names.

    They are a matrix (3, 5), with the camera's axes down, right and backwards, its centre, and
    height, width and focal length, px, as columns; then bounds of the depth, which are not used.
    """

    layout, file = "LLFF", "poses_bounds.npy"

    @override
    def values(self, path: Path, notes: list[str]) -> Values:
        with open_regular(path, "file of cameras") as file:
            rows = np.load(file, allow_pickle=False)
        folder = path.parent / "images"
        folder = folder if folder.is_dir() else path.parent
        names = images_in(folder)
        if rows.shape != (len(names), 17):
            raise UserError(
                f"{path}: must have 17 numbers for each photograph in {folder}, in the order of "
                f"their names: {(len(names), 17)}, got {rows.shape}"
            )
        frames = []
        for name, row in zip(names, rows[:, :15].reshape(-1, 3, 5), strict=True):
            down, right, back, center, (height, width, focal) = row.T.tolist()
            pose = np.column_stack([right, np.negative(down), back, center])
            size = {"w": width, "h": height, "fl_x": focal}
            frames.append({"file_path": name, "transform_matrix": rows_of(pose), **size})
        return {"frames": frames}


@READERS.register("3dgs")
class ReferenceReader(ProgramReader):
    """Reads ``cameras.json`` of the 3DGS reference, beside photographs: pinholes."""

    layout, file = "3DGS", "cameras.json"

    @override
    def recognizes(self, folder: Path) -> bool:
        return super().recognizes(folder) and (folder / "images").is_dir()

    @override
    def values(self, path: Path, notes: list[str]) -> Values:
        cloud = "input.ply"  # the points that its fit started from
        names = {"w": "width", "h": "height", "fl_x": "fx", "fl_y": "fy", "file_path": "img_name"}
        frames = []
        for camera in read_json(path):
            pose = np.column_stack([np.array(camera["rotation"], float), camera["position"]])
            frame = {key: camera[name] for key, name in names.items()}
            frames.append({**frame, "transform_matrix": opengl_rows(pose)})
        there = {"ply_file_path": cloud} if (path.parent / cloud).is_file() else {}
        return {"frames": frames, **there}


@READERS.register("opensfm")
class OpenSfmReader(ProgramReader):
    """Reads the largest reconstruction of OpenSfM or OpenDroneMap, with its points.

    Focal lengths, and the principal point from the image's middle, are in larger sides of the
    image. Rotation (axis times angle) and translation are of world to camera, in OpenCV's axes.
    """

    layout, file = "OpenSfM", OPENSFM_FILE

    @override
    def values(self, path: Path, notes: list[str]) -> Values:
        scene = largest_reconstruction(path, notes)
        cameras = {name: opensfm_camera(values) for name, values in scene["cameras"].items()}
        frames = []
        for name, shot in scene["shots"].items():
            rotation = Rotation.from_rotvec(shot["rotation"]).as_matrix().T
            pose = np.column_stack([rotation, -rotation @ np.array(shot["translation"], float)])
            frame = {"file_path": name, "transform_matrix": opengl_rows(pose)}
            frames.append({**frame, **cameras[shot["camera"]]})
        there = {"ply_file_path": path.name} if scene.get("points") else {}
        return {"frames": frames, **there}


@READERS.register("metashape")
class MetashapeReader(ProgramReader):
    """Reads ``cameras.xml`` of Metashape ("Export Cameras"), in the coordinates of its chunk.

    cx and cy are from the image's middle, the focal length along x is f + b1, and p1 and p2 are
    OpenCV's p2 and p1: appendix on camera models of Metashape's manual.
    """

    layout, file = "Metashape", "cameras.xml"

    @override
    def values(self, path: Path, notes: list[str]) -> Values:
        text = read_text(path, "file of cameras", MAX_BYTES, MEMORY_RATIO)
        root = ElementTree.fromstring(text)
        sensors = {each.get("id"): each for each in root.iter("sensor")}
        aligned = [camera for camera in root.iter("camera") if camera.findtext("transform")]
        parts = Counter(camera.get("component_id") for camera in aligned)
        largest = max(parts, key=parts.__getitem__)
        note_rest(path, notes, len(aligned) - parts[largest], "components")
        frames = []
        for camera in aligned:
            if camera.get("component_id") == largest:
                pose = np.array((camera.findtext("transform") or "").split(), float)
                frame = {"file_path": camera.attrib["label"]}
                frame |= {"transform_matrix": opengl_rows(pose.reshape(4, 4)[:3])}
                frames.append({**frame, **metashape_camera(path, sensors[camera.get("sensor_id")])})
        return {"frames": frames}


def read_json(path: Path) -> Any:
    """Return the content of a file of cameras."""
    return parse_json(read_text(path, "file of cameras", MAX_BYTES, MEMORY_RATIO), f"{path}: ")


def rows_of(pose: np.ndarray) -> list[list[float]]:
    """Return a pose (3, 4) with its last row, as lists."""
    return [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]]


def opengl_rows(pose: np.ndarray) -> list[list[float]]:
    """Return a pose (3, 4), camera to world in OpenCV's axes, as one in OpenGL's."""
    return rows_of(pose * [1, -1, -1, 1])


def note_rest(path: Path, notes: list[str], number: int, parts: str) -> None:
    """Note photographs whose cameras are not in the largest part, if there are any."""
    if number:
        notes.append(f"{path}: left out, in other {parts} than most: {number:,} photographs")


def model_of(kind: str, models: Mapping[str, str]) -> str:
    """Return COLMAP's name of a model of cameras."""
    if kind not in models:
        raise ValueError(f"a camera must be one of {', '.join(models)}, got {kind}")
    return models[kind]


def largest_reconstruction(path: Path, notes: list[str]) -> Values:
    """Return the reconstruction with the most photographs, in a file of OpenSfM."""
    scenes = read_json(path)
    sizes = [len(scene["shots"]) for scene in scenes]
    note_rest(path, notes, sum(sizes) - max(sizes), "reconstructions")
    return scenes[int(np.argmax(sizes))]


def read_opensfm_points(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and colours, 0 to 1, each (N, 3), of the points of OpenSfM's file."""
    with refuse_damage(f"{path}: not points as OpenSfM writes them"):
        points = list(largest_reconstruction(path, [])["points"].values())
        positions = np.array([point["coordinates"] for point in points], np.float64)
        return positions, np.array([point["color"] for point in points], np.float32) / 255


def opensfm_camera(camera: Values) -> Values:
    """Return a camera of OpenSfM's file in the layout of ``transforms.json``."""
    width, height = camera["width"], camera["height"]
    values = {"w": width, "h": height}
    values["camera_model"] = model_of(camera["projection_type"], OPENSFM_MODELS)
    if values["camera_model"] == PANORAMA:
        return values
    side = max(width, height)
    for axis in "xy":
        focal = camera["focal"] if "focal" in camera else camera[f"focal_{axis}"]
        values[f"fl_{axis}"] = side * focal
        values[f"c{axis}"] = values["wh"["xy".index(axis)]] / 2 + side * camera.get(f"c_{axis}", 0)
    return values | {key: camera[key] for key in COEFFICIENTS if key in camera}


def metashape_camera(path: Path, sensor: ElementTree.Element) -> Values:
    """Return a sensor of Metashape's file in the layout of ``transforms.json``."""
    model = model_of(sensor.attrib["type"], METASHAPE_MODELS)
    size = sensor.findall("resolution")[-1].attrib
    width, height = float(size["width"]), float(size["height"])
    values = {"w": width, "h": height, "camera_model": model}
    if model == PANORAMA:
        return values
    found = {each.tag: each.text for each in sensor.findall("calibration")[-1]}
    names = ("cx", "cy", "b1", "b2", *COEFFICIENTS)
    numbers: dict[str, float] = {key: float(found.get(key) or 0) for key in names}
    focal = float(found["f"] or "")
    for key in ("b2", "k4") if model == "OPENCV" else ("b2", "p1", "p2"):
        if numbers[key]:
            raise UserError(
                f"{path}: sensor {sensor.get('id')} has {key} = {numbers[key]:g}, which no lens "
                "here has; optimize the cameras in Metashape without it, or export them for COLMAP"
            )
    coefficients = {key: numbers[key] for key in COEFFICIENTS}
    coefficients |= {"p1": numbers["p2"], "p2": numbers["p1"]}
    return {
        **values,
        **{"fl_x": focal + numbers["b1"], "fl_y": focal},
        **{"cx": width / 2 + numbers["cx"], "cy": height / 2 + numbers["cy"]},
        **{key: value for key, value in coefficients.items() if value},
    }
