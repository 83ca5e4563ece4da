"""Cameras, photographs and datasets, as every reader returns them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import EllipsisType
from typing import ClassVar, TypeVar

import numpy as np

from drgs.cameras.viewpoints import Viewpoint
from drgs.core.origin import WORLD, Origin

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class LazyImage:
    """An image that is converted to floats at each access: by ``np.asarray`` or an index."""

    shape: tuple[int, ...]  # (H, W) or (H, W, 3)
    compute: Callable[[], np.ndarray]  # returns float32
    nbytes: int  # kept in memory, beside another image's
    shifted: Callable[[int, int], np.ndarray] | None = None  # by x, y of the file's; shift_pixels
    is_on_disk: bool = False  # reads a file at each access
    is_elsewhere: bool = False  # another process has it: computing it raises

    dtype: ClassVar = np.dtype(np.float32)

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> np.ndarray:
        if copy is False:
            raise ValueError("a lazy image becomes an array only by a copy")
        return np.asarray(self.compute(), dtype)

    def __getitem__(
        self, index: int | slice | tuple[int | slice | EllipsisType | None, ...] | np.ndarray
    ) -> np.ndarray:
        return self.compute()[index]

    def __len__(self) -> int:
        return self.shape[0]


Pixels = np.ndarray | LazyImage  # an image of a view; ``np.asarray`` makes an array of either


def evenly_spaced(items: Sequence[T], most: int) -> tuple[T, ...]:
    """Return at most so many of the items, the first and the last among them, in order."""
    chosen = np.linspace(0, len(items) - 1, min(most, len(items))).round().astype(int)
    return tuple(items[index] for index in chosen)


def _spread(views: Sequence[Viewpoint]) -> float:
    centers = np.stack([view.center for view in views])
    return float(1.1 * np.linalg.norm(centers - centers.mean(axis=0), axis=1).max())


@dataclass(frozen=True, eq=False, kw_only=True)
class View(Viewpoint):
    """A photograph and the camera that took it; its images become arrays by ``np.asarray``."""

    image: Pixels  # (height, width, 3) float32, display space 0..1, opaque
    alpha: Pixels | None = None  # (height, width) float32: opacity
    mask: Pixels | None = None  # (height, width) float32: 1 for valid pixels, else 0
    depth: Pixels | None = None  # (height, width) float32, scene units; 0 where not known
    files: Mapping[str, Path] = field(default_factory=dict)  # of image, mask, depth

    def planes(self) -> dict[str, Pixels]:
        """Return the images that there are, by field."""
        planes = {name: getattr(self, name) for name in ("image", "alpha", "mask", "depth")}
        return {name: plane for name, plane in planes.items() if plane is not None}


ViewFilter = Callable[[str], bool]  # accepts names of views whose images are to be read


def all_views(name: str) -> bool:
    """Accept all views."""
    return True


@dataclass(frozen=True, eq=False)
class Dataset:
    """Views to train on and views to measure on."""

    train: tuple[View, ...]
    test: tuple[View, ...]
    test_split: str  # name of the split that ``test`` is
    background: tuple[float, float, float]  # display space, under transparent pixels of the images
    start_half_extent: float | None  # of the layout's own start box [-h, h]^3; None: it has none
    description: str  # one line: source and assumptions
    ignored: tuple[str, ...] = ()  # data of frames that ``data.ignore_*`` leaves out
    rendered: bool = False  # the images are another renderer's, not photographs
    point_cloud: Path | None = None  # to start from: a PLY file that the dataset names
    origin: Origin = WORLD  # world: positions of the views are relative to it

    @property
    def extent(self) -> float:
        """Scale of the scene: 1.1 x the largest distance of a train camera from their centroid.

        Defined as in the 3DGS reference (``getNerfppNorm``); from all cameras if those of the train
        views share a centre, and 1 if all do.
        """
        return _spread(self.train) or _spread((*self.train, *self.test)) or 1.0

    def relative_to(self, origin: Origin) -> Dataset:
        """Return the same views with positions relative to ``origin``, world."""
        offset = np.subtract(self.origin, origin)
        train = tuple(view.with_offset(offset) for view in self.train)
        test = tuple(view.with_offset(offset) for view in self.test)
        return replace(self, train=train, test=test, origin=origin)
