"""Folders of datasets: their readers, configurations for them, explanations of other folders."""

from __future__ import annotations

import math
import os
import shlex
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import MappingProxyType

from pydantic import BaseModel

from drgs.config.extensions import READERS, section_of
from drgs.config.load import config_from
from drgs.config.schema import DataConfig, FitConfig
from drgs.core.errors import UserError, format_names
from drgs.core.file_kinds import describe_file
from drgs.datasets.colmap import find_model, folders_in
from drgs.datasets.files import images_in
from drgs.datasets.images import downscaled_size
from drgs.datasets.reader import DatasetReader, read_photograph
from drgs.datasets.splits import ends_in
from drgs.io.images import image_size

MAX_PIXELS = 600_000
"""Pixels of an image that is fitted, as 894 x 671. The width of larger ones is divided by the
smallest whole number that brings them there, and rounded down."""

ITERATIONS = {"nerf_synthetic": 3000, "nerfstudio": 4000, "colmap": 4500}
"""Iterations by layout, as ``scenes/lego.yml`` and ``scenes/photos.yml`` have them."""

NAMES = {
    "nerf_synthetic": "cut-out images in the layout of NeRF-synthetic",
    "nerfstudio": "photographs with the cameras of transforms.json",
    "colmap": "photographs with the cameras of COLMAP's model",
}

MARKERS = ("transforms_train.json", "transforms.json")  # of NeRF-synthetic and nerfstudio

GUIDE = "docs/guide/photographs.md"


def find_reader(
    config: DataConfig, sections: Mapping[str, BaseModel] = MappingProxyType({})
) -> tuple[str, DatasetReader]:
    """Return name and reader of ``data.type``, or of the first that recognizes the folder.

    Raises :class:`UserError` for a folder that no reader recognizes, with a remedy.
    """
    try:
        os.listdir(config.path)
    except FileNotFoundError:
        source = f", or get it from {config.source}" if config.source else ""
        raise UserError(
            f"data.path: there is no folder {config.path}; say where it is (--data DIR){source}"
        ) from None
    except OSError as error:
        raise UserError(
            f"data.path: cannot open the folder {config.path}: {error.strerror}"
        ) from None
    is_auto = config.type == "auto"
    if is_auto:
        candidates = sorted(READERS.all(), key=lambda reader: reader.value.order)
    else:
        candidates = [READERS.get(config.type, "data.type")]
    for extension in candidates:
        reader = extension.value(section_of(extension, sections))
        if not is_auto or reader.recognizes(config.path):
            return extension.name, reader
    raise UserError(f"{config.path}: {explain(config.path)}")


OTHER_CAMERAS = {
    "cameras.json": "those of 3DGS are read where the photographs are in the folder images",
    "cameras.csv": "in RealityScan, export the registration for COLMAP",
    "bundle.out": "export COLMAP's format from the program that wrote it",
}
"""Files of other programs with cameras, and the way to cameras that are read."""


def config_for(folder: Path, overrides: Iterable[str] = ()) -> tuple[FitConfig, str]:
    """Return a configuration for the dataset in ``folder``, and the reasons for it, as text.

    overrides: given values, as for :func:`drgs.config.load.load_config`.
    """
    overrides, where = list(overrides), str(folder)
    given = config_from({"data": {"path": folder}}, where, overrides)
    layout, reader = find_reader(given.data, given.sections)
    out, files = given.data.leave_out, reader.image_files(given.data)
    files = [file for file in files if not any(ends_in(file, name) for name in out)] or files
    sizes = [read_photograph(image_size, file) for file in files]
    width, height = max(sizes, key=lambda size: (math.prod(size), size[1]))
    largest = max(each for each, _ in sizes)
    if width * height > MAX_PIXELS:
        widths = (width // factor for factor in range(2, width + 1))
        shapes = (downscaled_size(width, height, each) for each in widths)
        largest = next((each[0] for each in shapes if math.prod(each) <= MAX_PIXELS), 1)
    data = {"path": folder, "type": layout, "image_size": largest}
    values = {"data": data, "iterations": ITERATIONS.get(layout, 4500)}
    config = config_from(values, where, overrides)
    size = "as they are"
    if (config.data.image_size or width) < width:
        which = "" if len(set(sizes)) == 1 else ", the largest,"
        size = f"scaled from {width} x {height} px{which} to a width of {config.data.image_size}"
    return config, (
        "no configuration is given, so that it follows from the folder: "
        f"{NAMES.get(layout, f'photographs with the cameras of {layout}')}, {size}; "
        f"{config.iterations:,} iterations (--set changes any value, --budget 10m sets the time)"
    )


def explain(folder: Path) -> str:
    """Explain why a folder is no dataset, with a remedy; without the folder's name."""
    for below in folders_in(folder):
        if any((below / marker).is_file() for marker in MARKERS) or find_model(below):
            return f"holds a dataset in its folder {below.name}; give {shlex.quote(str(below))}"
    return explain_photographs(folder) or (
        f"neither {' nor '.join(MARKERS)} is there, nor a model of COLMAP in sparse/0 with its "
        f"photographs in images; see {GUIDE}"
    )


def explain_photographs(folder: Path) -> str:
    """Explain how photographs, or videos, in a folder and below get cameras; "": there are none."""
    images = folder / "images"
    places = [p for p in (folder, *folders_in(folder), *folders_in(images)) if images_in(p)]
    if not places:
        kinds = filter(None, map(describe_file, sorted(folder.iterdir())))
        return next((f"holds a file that {kind}" for kind in kinds), "")
    first, given, move = places[0], folder, ""
    if first.parent == folder and first != images:
        given = first if len(places) == 1 else folder
        move = "" if len(places) == 1 else f"move those of one scene into {images}, and "
    cameras = [(name, way) for name, way in OTHER_CAMERAS.items() if (folder / name).is_file()]
    if cameras:
        name, way = cameras[0]
        return (
            f"holds photographs, and {name}, whose cameras are not read: {way}; or find them anew: "
            f"drgs poses {shlex.quote(str(given))}"
        )
    there = format_names([str(place.relative_to(folder.parent)) for place in places])
    return (
        f"holds photographs ({there}), but no cameras: {move}find out where each was taken: "
        f"drgs poses {shlex.quote(str(given))}; see {GUIDE}"
    )
