"""A configuration for a folder that has none: what suits its pictures, and a laptop."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from drgs.config.load import config_from
from drgs.config.schema import FitConfig
from drgs.datasets import reader_of
from drgs.datasets.images import downscaled_size
from drgs.io.pictures import image_size

MAX_PIXELS = 600_000
"""Of a picture that is fitted, as 894 x 671. The width of larger ones is divided by the smallest
whole number that brings them there, and rounded down."""

ITERATIONS = {"nerf_synthetic": 4500, "nerfstudio": 4000, "colmap": 4000}
"""By layout, as ``scenes/lego.yml`` and ``scenes/photos.yml`` have them."""

NAMES = {
    "nerf_synthetic": "cut-out pictures in the layout of NeRF-synthetic",
    "nerfstudio": "photographs with the cameras of transforms.json",
    "colmap": "photographs with the cameras of COLMAP's model",
}


def config_for(folder: Path, overrides: Iterable[str] = ()) -> tuple[FitConfig, str]:
    """A configuration for the dataset in ``folder``, and why it is that one, as text.

    overrides: as for :func:`drgs.config.load.load_config`; what they give is not chosen.

    Raises :class:`UserError` for a folder that is no dataset, with what to do.
    """
    overrides, where = list(overrides), str(folder)
    given = config_from({"data": {"path": folder}}, where, overrides)
    layout, reader = reader_of(given.data, given.extensions)
    sizes = [image_size(file) for file in reader.image_files(given.data)]
    width, height = max(sizes, key=lambda size: (math.prod(size), size[1]))
    data = {"path": folder, "type": layout, "image_size": _max_width(width, height, sizes)}
    values = {"data": data, "iterations": ITERATIONS[layout]}
    config = config_from(values, where, overrides)
    size = "as they are"
    if (config.data.image_size or width) < width:
        which = "" if len(set(sizes)) == 1 else ", the largest,"
        size = f"scaled from {width} x {height} px{which} to a width of {config.data.image_size}"
    return config, (
        "no configuration is given, so that it follows from the folder: "
        f"{NAMES.get(layout, layout)}, {size}; "
        f"{config.iterations:,} iterations (--set changes any value, --budget 10m sets the time)"
    )


def _max_width(width: int, height: int, sizes: Sequence[tuple[int, int]]) -> int:
    """px, for pictures of ``sizes``, of which ``width`` x ``height`` is the largest."""
    if width * height <= MAX_PIXELS:
        return max(each for each, _ in sizes)
    widths = (width // factor for factor in range(2, width + 1))
    small = (w for w in widths if math.prod(downscaled_size(width, height, w)) <= MAX_PIXELS)
    return next(small, 1)
