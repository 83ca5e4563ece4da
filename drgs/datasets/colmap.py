"""COLMAP's layout: a model of cameras, images and points, and photographs.

The model is in ``sparse/0``, ``sparse`` or ``colmap/sparse/0``, beside the photographs, or in
``dense/0`` as COLMAP's automatic reconstruction leaves it. The photographs are in ``images`` (or
beside the model's folder) or, at a half, a quarter or an eighth of their size, in ``images_2``,
``images_4``, ``images_8``; masks are in ``masks``, black where pixels do not count: see
``drgs.datasets.mask_names``.

Cameras are rendered with the lens that COLMAP found, without undistorting. Their numbers are for
the size that COLMAP saw; the size of the picture that is there decides what they are for that.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

from drgs.config.extensions import READERS
from drgs.config.schema import DataConfig
from drgs.core.errors import UserError, listed, one_line
from drgs.datasets.file_names import (
    PICTURE_SUFFIXES,
    FileFinder,
    key_of,
    note_missing,
    note_near,
)
from drgs.datasets.images import is_scaled
from drgs.datasets.mask_names import masks_of
from drgs.datasets.photographs import MAX_WIDTH, Photographs, dataset_of
from drgs.datasets.reader import DatasetReader
from drgs.datasets.recognition import COLMAP_FOLDERS, colmap_dataset
from drgs.datasets.splits import lists_by_folders, lists_in_files
from drgs.datasets.transforms import Frame, FrameValues
from drgs.datasets.types import Dataset, Keeps, all_of_them
from drgs.io.colmap import ColmapCamera, ColmapImage, ColmapModel, model_files, read_model
from drgs.io.pictures import MAX_SIDE, image_orientation, image_size

FACTORS = (1, 2, 4, 8)
"""What pictures in folders of their own are smaller by."""

LENSES = {
    "SIMPLE_PINHOLE": "PINHOLE",
    "PINHOLE": "PINHOLE",
    "SIMPLE_RADIAL": "OPENCV",
    "RADIAL": "OPENCV",
    "OPENCV": "OPENCV",
    "FULL_OPENCV": "FULL_OPENCV",
    "SIMPLE_FISHEYE": "OPENCV_FISHEYE",
    "FISHEYE": "OPENCV_FISHEYE",
    "SIMPLE_RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "RADIAL_FISHEYE": "OPENCV_FISHEYE",
    "OPENCV_FISHEYE": "OPENCV_FISHEYE",
    "THIN_PRISM_FISHEYE": "THIN_PRISM_FISHEYE",
}
"""Camera models that can be rendered, and what their coefficients are read as."""


@dataclass(frozen=True, eq=False)
class ColmapFrame(Frame):
    """An image of a model."""

    @property
    def numbers_are_as_stored(self) -> bool:
        """COLMAP does not turn pictures."""
        return True

    def where(self, key: str) -> str:
        """Of which image."""
        return f"{self.path}: image {one_line(self.own.file_path, 100)}: {key}"


def model_folder(folder: Path) -> Path:
    """The folder of the model. Raises :class:`UserError` where there is none."""
    return _root_and_model(folder)[1]


def _root_and_model(folder: Path) -> tuple[Path, Path]:
    """The folder of the photographs' folders and masks, and that of the model."""
    if (found := colmap_dataset(folder)) is None:
        raise UserError(f"{folder}: there is no model of COLMAP in {', '.join(COLMAP_FOLDERS)}")
    return found


def _where(folder: Path, model: Path) -> str:
    """Name the model that is read, for a description, where there are several; else ""."""
    if (below := model.relative_to(folder)) != Path() and below.parts[0] == "dense":
        return f"; model {below}"
    if model.name != "0":
        return ""
    numbered = [path for path in model.parent.iterdir() if path.name.isdecimal() and path != model]
    others = sorted((path.name for path in numbered if model_files(path)), key=int)
    if not others:
        return ""
    return f"; model {model.parent.name}/0 (others are there: {listed(others)})"


def picture_files(config: DataConfig) -> list[Path]:
    """The photographs of all images, as large as they are there."""
    folder = model_folder(config.path)
    model = read_model(folder)
    widest = config.model_copy(update={"image_size": MAX_SIDE})
    return [file for _, file in _images_there(widest, folder, model, [])]


def load(config: DataConfig, keeps: Keeps = all_of_them) -> Dataset:
    """Read all views: see :func:`drgs.datasets.photographs.dataset_of`."""
    notes: list[str] = []
    root, folder = _root_and_model(config.path)
    model = read_model(folder)
    there = _images_there(config, folder, model, notes)
    pictures = picture_folder(config, model)
    names = [file.relative_to(pictures).as_posix() for _, file in there]
    masks = masks_of(root, names, [] if config.ignore_masks else notes, pictures)
    frames = []
    for index, ((image, file), mask) in enumerate(zip(there, masks, strict=True)):
        own = _values(model.cameras[image.camera], image, file, mask, folder)
        has_mask = mask is not None and not config.ignore_masks
        files = {"image": file} | ({"mask": mask} if has_mask else {})
        frames.append(ColmapFrame(own, own, index, folder, files))
    all_names = [image.name for image in model.images]
    lists = lists_in_files((folder, root), all_names, notes) or lists_by_folders(all_names)
    cloud, note = None, f"; pictures of {pictures.name}"
    note += _where(config.path, folder)
    if model.has_points:
        if config.ignore_points:
            note += "; points of the model ignored"
        else:
            cloud = model.points_file
    photographs = Photographs("COLMAP", folder, frames, lists, cloud, note, notes)
    return dataset_of(config, photographs, keeps)


def _images_there(
    config: DataConfig, folder: Path, model: ColmapModel, notes: list[str]
) -> list[tuple[ColmapImage, Path]]:
    """Images of the model, by name, and their files; those without one are left out."""
    if not model.images:
        raise UserError(f"{folder}: at least 2 views are needed, one of them to test; got 0")
    images = sorted(model.images, key=lambda image: image.name)
    names = [image.name for image in images]
    finder = FileFinder(picture_folder(config, model))
    found, near = finder.find_all(names, PICTURE_SUFFIXES)
    note_near(folder, near, "photographs", notes)

    def explain(index: int) -> str:
        name = names[index]
        return (
            f"{folder}: image {one_line(name, 100)}: there is no picture "
            f"{one_line(finder.folder / name)}{finder.suggestion(name, PICTURE_SUFFIXES)}; put the "
            "photographs there that COLMAP saw"
        )

    note_missing(folder, names, found, explain, ("photographs", "left out"), notes)
    return [(image, found[image.name]) for image in images if image.name in found]


def picture_folder(config: DataConfig, model: ColmapModel) -> Path:
    """The folder of the pictures that are to be read.

    That of ``data.downscale``; without it, the one whose pictures are the smallest that still have
    the width of ``data.image_size``, or the largest ones there are.
    """
    root, _ = _root_and_model(config.path)
    factors = {"images" if factor == 1 else f"images_{factor}": factor for factor in FACTORS}
    folders = [path for path in sorted(root.iterdir()) if path.is_dir()]
    there = {factors[key]: path for path in folders if (key := key_of(path.name)) in factors}
    if 1 not in there and any((root / image.name).is_file() for image in model.images):
        there[1] = root
    if not there:
        raise UserError(
            f"{root}: there is no folder images (or images_2, images_4, images_8) of the "
            "photographs beside COLMAP's model"
        )
    if config.downscale is not None:
        if config.downscale not in there:
            names = listed([path.name for path in there.values()], len(FACTORS))
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
    model = LENSES.get(camera.model)
    if model is None:
        raise UserError(
            f"{folder}: camera {camera.number} is of the model {camera.model}, which cannot be "
            f"rendered (those that can: {', '.join(LENSES)}); undistort the pictures "
            "(colmap image_undistorter), or have COLMAP find another model"
        )
    width, height = _size_as_calibrated(file, camera, image, folder)
    named = camera.named()
    scale_x, scale_y = width / camera.width, height / camera.height
    focal = named.pop("f", None)
    values = {
        "fl_x": scale_x * (named.pop("fx") if focal is None else focal),
        "fl_y": scale_y * (named.pop("fy") if focal is None else focal),
        "cx": scale_x * named.pop("cx"),
        "cy": scale_y * named.pop("cy"),
        "w": width,
        "h": height,
        "camera_model": model,
        **named,
    }
    return FrameValues.model_construct(
        file_path=image.name,
        transform_matrix=image.camera_to_world,
        mask_path=None if mask is None else str(mask),
        **values,
    )


def _size_as_calibrated(
    file: Path, camera: ColmapCamera, image: ColmapImage, folder: Path
) -> tuple[int, int]:
    """Width and height of the picture, px, as the camera's numbers have it.

    COLMAP reads pictures as they are stored; what was turned since, as EXIF says, is so here.
    """
    width, height = image_size(file)
    seen = camera.width, camera.height
    sizes = [(width, height)]
    if image_orientation(file) >= SIDEWAYS:
        sizes.append((height, width))
    if seen in sizes:
        return seen
    for size in sizes:
        if is_scaled(size, seen):
            return size
    raise UserError(
        f"{folder}: image {one_line(image.name, 100)} was {camera.width} x {camera.height} px for "
        f"COLMAP, and {file} is {width} x {height} px, of another shape; give the pictures that "
        "COLMAP saw, or smaller ones of the same shape"
    )


SIDEWAYS = 5
"""EXIF's numbers from this one exchange width and height."""


@READERS.register("colmap")
class ColmapReader(DatasetReader):
    """Reads a model of COLMAP and its photographs."""

    def recognizes(self, folder: Path, names: Collection[str]) -> bool:
        """See :class:`DatasetReader`."""
        del names
        return colmap_dataset(folder) is not None

    def load(self, config: DataConfig, keeps: Keeps = all_of_them) -> Dataset:
        """See :class:`DatasetReader`."""
        return load(config, keeps)

    def image_files(self, config: DataConfig) -> list[Path]:
        """See :class:`DatasetReader`."""
        return picture_files(config)
