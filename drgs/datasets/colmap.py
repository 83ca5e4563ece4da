"""COLMAP's layout: a model of cameras, images and points, and photographs.

The model is in ``sparse/0``, ``sparse`` or ``colmap/sparse/0``, beside the photographs, or in
``dense/0`` as COLMAP's automatic reconstruction leaves it. The photographs are in ``images`` (or
beside the model's folder) or, at a half, a quarter or an eighth of their size, in ``images_2``,
``images_4``, ``images_8``; masks: see ``drgs.datasets.files``.

Cameras are rendered with the lens that COLMAP found, without undistorting. Their intrinsics are
scaled from the size in the model to that of the photograph.
"""

from __future__ import annotations

import os
from pathlib import Path

from typing_extensions import override

from drgs.config.extensions import READERS
from drgs.config.schema import DataConfig
from drgs.core.errors import UserError, format_names, one_line
from drgs.datasets.files import FileKind, find_files, images_in, key_of, masks_of
from drgs.datasets.images import is_scaled
from drgs.datasets.reader import MAX_WIDTH, DatasetReader, Photographs
from drgs.datasets.splits import unlisted_splits
from drgs.datasets.transforms import LENS_OF_MODEL, FrameValues, TransformsFrame
from drgs.io.colmap import ColmapCamera, ColmapImage, ColmapModel, model_files, read_model
from drgs.io.images import FIRST_TRANSPOSED_ORIENTATION, MAX_SIDE, read_header

MODEL_FOLDERS = ("sparse/0", "sparse", "colmap/sparse/0")  # folders of COLMAP's models in datasets

WORKSPACES = ("", "dense/0", "dense")  # where COLMAP's automatic reconstruction has these folders

FACTORS = {"images": 1, "images_2": 2, "images_4": 4, "images_8": 8}
"""Divisors of the size of photographs, by folder."""

PHOTOGRAPHS = FileKind("photographs", remedy="put the photographs there that COLMAP saw")


@READERS.register("colmap")
class ColmapReader(DatasetReader):
    """Reads a model of COLMAP and its photographs."""

    order = 2

    @override
    def recognizes(self, folder: Path) -> bool:
        return find_model(folder) is not None

    @override
    def photographs(self, config: DataConfig) -> Photographs:
        notes: list[str] = []
        root, folder = require_model(config.path)
        model = read_model(folder)
        images, files = _images_and_files(config, folder, model, notes)
        below = image_folder(config, model)
        names = [file.relative_to(below).as_posix() for file in files]
        masks = masks_of(root, names, [] if config.ignore_masks else notes, below)
        frames = []
        for image, file, mask in zip(images, files, masks, strict=True):
            values = _values(model.cameras[image.camera], image, file, mask, folder)
            paths = {"image": file}
            if mask is not None:
                paths["mask"] = mask
            place = f"image {one_line(image.name, 100)}: "
            frames.append(TransformsFrame(values, folder, place, is_as_stored=True, files=paths))
        lists = unlisted_splits((folder, root), [image.name for image in model.images], notes)
        cloud, note = model.points_file if model.has_points else None, f"; images of {below.name}"
        if cloud is not None and config.ignore_points:
            cloud, note = None, f"{note}; points of the model ignored"
        return Photographs("COLMAP", folder, frames, lists, cloud, note, notes)

    @override
    def image_files(self, config: DataConfig) -> list[Path]:
        """Return the photographs of all images, at their stored size."""
        _, folder = require_model(config.path)
        widest = config.model_copy(update={"image_size": MAX_SIDE})
        return _images_and_files(widest, folder, read_model(folder), [])[1]


def find_model(folder: Path) -> tuple[Path, Path] | None:
    """Return the folder of the photographs' folders and masks, and the model's; None: no model.

    The first place with both photographs and a model, else the first model in MODEL_FOLDERS.
    """
    for workspace in WORKSPACES:
        root = folder / workspace
        for below in (*(_folder_in(root, name) for name in MODEL_FOLDERS), root):
            if model_files(below) and (
                any((root / name).is_dir() for name in FACTORS)
                or any(map(images_in, (root, *folders_in(root))))
            ):
                return root, below
    below = (_folder_in(folder, name) for name in MODEL_FOLDERS)
    return next(((folder, model) for model in below if model_files(model)), None)


def _folder_in(folder: Path, name: str) -> Path:
    """Return the folder ``name`` in another, or one whose name differs in case."""
    for part in name.split("/"):
        similar = [path for path in folders_in(folder) if key_of(path.name) == part]
        folder = min(similar, key=lambda path: path.name != part, default=folder / part)
    return folder


def folders_in(folder: Path) -> list[Path]:
    """Return the sorted folders in a folder, without hidden and unreadable ones."""
    paths = sorted(folder.iterdir()) if folder.is_dir() else []
    return [
        path
        for path in paths
        if not path.name.startswith(".") and path.is_dir() and os.access(path, os.R_OK | os.X_OK)
    ]


def require_model(folder: Path) -> tuple[Path, Path]:
    """Return the folders of :func:`find_model`; raise :class:`UserError` where there is none."""
    if (folders := find_model(folder)) is None:
        raise UserError(f"{folder}: there is no model of COLMAP in {', '.join(MODEL_FOLDERS)}")
    return folders


def _images_and_files(
    config: DataConfig, folder: Path, model: ColmapModel, notes: list[str]
) -> tuple[list[ColmapImage], list[Path]]:
    """Return the sorted images, and their files; images without one are left out."""
    if not model.images:
        raise UserError(f"{folder}: at least 2 views are needed, one of them to test; got 0")
    images = sorted(model.images, key=lambda image: image.name)
    names = [image.name for image in images]
    places = [f"{folder}: image {one_line(name, 100)}" for name in names]
    existing = find_files(image_folder(config, model), folder, names, PHOTOGRAPHS, places, notes)
    images = [image for image in images if image.name in existing]
    return images, [existing[image.name] for image in images]


def image_folder(config: DataConfig, model: ColmapModel) -> Path:
    """Return the folder of the photographs to read, by ``data.downscale``.

    By default, the smallest photographs of at least the width ``data.image_size``, or the largest.
    """
    root, _ = require_model(config.path)
    folders = [path for path in sorted(root.iterdir()) if path.is_dir()]
    there = {FACTORS[key]: path for path in folders if (key := key_of(path.name)) in FACTORS}
    if 1 not in there and any((root / image.name).is_file() for image in model.images):
        there[1] = root
    if not there:
        raise UserError(
            f"{root}: there is no folder images (or images_2, images_4, images_8) of the "
            "photographs beside COLMAP's model"
        )
    if config.downscale is not None:
        if config.downscale not in there:
            names = format_names([path.name for path in there.values()], len(FACTORS))
            raise UserError(
                f"data.downscale: {root} has the folders {names}, got {config.downscale}"
            )
        return there[config.downscale]
    width = min((camera.width for camera in model.cameras.values()), default=1)
    wanted = min(config.image_size or MAX_WIDTH, width)
    wide = [factor for factor in there if width / factor >= wanted - 1]
    return there[max(wide, default=min(there))]


def _values(
    camera: ColmapCamera, image: ColmapImage, file: Path, mask: Path | None, folder: Path
) -> FrameValues:
    """Return the values of a frame in a transforms file, for the size of ``file``."""
    if camera.model not in LENS_OF_MODEL:
        raise UserError(
            f"{folder}: camera {camera.number} is of the model {camera.model}, which cannot be "
            f"rendered (those that can: {', '.join(LENS_OF_MODEL)}); undistort the images "
            "(colmap image_undistorter), or have COLMAP find another model"
        )
    width, height = _size_as_calibrated(file, camera, image, folder)
    return FrameValues.model_construct(
        None,
        file_path=image.name,
        transform_matrix=image.camera_to_world,
        mask_path=None if mask is None else str(mask),
        w=width,
        h=height,
        camera_model=camera.model,
        **_intrinsics(camera, width, height, folder),
    )


def _intrinsics(camera: ColmapCamera, width: int, height: int, folder: Path) -> dict[str, float]:
    """Return a frame's numbers for photographs of this size, and the lens's coefficients."""
    named = dict(camera.values)
    if camera.model == "EQUIRECTANGULAR":
        if (size := (named["w"], named["h"])) != (camera.width, camera.height):
            raise UserError(
                f"{folder}: camera {camera.number}: w and h of a panorama must be its size, "
                f"{camera.width} x {camera.height} px, got {size[0]:g} x {size[1]:g}; "
                "give whole panoramas"
            )
        return {}
    scale_x, scale_y = width / camera.width, height / camera.height
    focal = named.pop("f", None)
    return {
        "fl_x": scale_x * (named.pop("fx") if focal is None else focal),
        "fl_y": scale_y * (named.pop("fy") if focal is None else focal),
        "cx": scale_x * named.pop("cx"),
        "cy": scale_y * named.pop("cy"),
        **named,
    }


def _size_as_calibrated(
    file: Path, camera: ColmapCamera, image: ColmapImage, folder: Path
) -> tuple[int, int]:
    """Return width and height, px, of the photograph as COLMAP read it: not turned by EXIF."""
    header = read_header(file)
    (width, height), calibrated = header.size, (camera.width, camera.height)
    sizes = [(width, height)]
    if header.orientation >= FIRST_TRANSPOSED_ORIENTATION:
        sizes.append((height, width))
    if calibrated in sizes:
        return calibrated
    for size in sizes:
        if is_scaled(size, calibrated):
            return size
    raise UserError(
        f"{folder}: image {one_line(image.name, 100)} was {camera.width} x {camera.height} px for "
        f"COLMAP, and {file} is {width} x {height} px, of another shape; give the images that "
        "COLMAP saw, or smaller ones of the same shape"
    )
