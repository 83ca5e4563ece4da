"""Cameras, photographs and datasets, as every reader returns them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import EllipsisType
from typing import TYPE_CHECKING, ClassVar, TypeVar

import numpy as np

from drgs.core.constants import SHUTTER_SAMPLES
from drgs.core.origin import WORLD, Origin

if TYPE_CHECKING:
    from drgs.cameras.lens import Lens


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


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """Motion of a camera while its shutter is open."""

    close_to_world: np.ndarray  # (4, 4) float64, OpenCV axes: the pose at the end
    shutter: str  # global: all pixels are exposed at once; rolling: row after row
    samples: int = SHUTTER_SAMPLES  # global: times at which the image is rendered


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """A camera in the world, and the size of its image."""

    name: str  # unique among those rendered together; a file name without folders or suffix
    camera_to_world: np.ndarray  # (4, 4) float64, rigid, OpenCV axes: x right, y down, z forward
    fx: float  # px
    fy: float  # px
    cx: float  # px; pixel centres are at (i + 0.5, j + 0.5)
    cy: float  # px
    width: int  # px
    height: int  # px
    lens: Lens | None = None  # with numbers of the host; None: a pinhole
    motion: CameraMotion | None = None  # while the shutter is open; None: the camera does not move

    @property
    def center(self) -> np.ndarray:
        """Position (3,) of the camera, world."""
        return self.camera_to_world[:3, 3]

    @property
    def K(self) -> np.ndarray:  # noqa: N802
        """Matrix (3, 3) float64 from camera coordinates to homogeneous pixel coordinates."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)

    @property
    def viewmat(self) -> np.ndarray:
        """Pose (4, 4) float64, world to camera, OpenCV axes, as ``drgs.rasterization`` takes it."""
        rotation = self.camera_to_world[:3, :3].T
        viewmat = np.eye(4)
        viewmat[:3] = np.column_stack([rotation, -rotation @ self.center])
        return viewmat

    def with_offset(self: V, offset: np.ndarray) -> V:
        """Return the same camera with ``offset`` (3,) added to its position."""
        if not np.any(offset):
            return self
        pose, motion = _translate_pose(self.camera_to_world, offset), self.motion
        if motion is not None:
            motion = replace(motion, close_to_world=_translate_pose(motion.close_to_world, offset))
        return replace(self, camera_to_world=pose, motion=motion)


V = TypeVar("V", bound=Viewpoint)


def _spread(views: Sequence[Viewpoint]) -> float:
    centers = np.stack([view.center for view in views])
    distances = np.linalg.norm(centers - centers.mean(axis=0), axis=1)
    return float(1.1 * distances.max())


def _translate_pose(pose: np.ndarray, offset: np.ndarray) -> np.ndarray:
    pose = pose.copy()
    pose[:3, 3] += offset
    return pose


@dataclass(frozen=True, eq=False, kw_only=True)
class View(Viewpoint):
    """A photograph and the camera that took it; its images become arrays by ``np.asarray``."""

    image: Pixels  # (height, width, 3) float32, display space 0..1, opaque
    alpha: Pixels | None = None  # (height, width) float32: opacity
    mask: Pixels | None = None  # (height, width) float32: 1 for valid pixels, else 0
    depth: Pixels | None = None  # (height, width) float32, scene units; 0 where not known
    files: Mapping[str, Path] = field(default_factory=dict)  # of image, mask, depth


ViewFilter = Callable[[str], bool]  # accepts names of views whose images are to be read


def all_views(name: str) -> bool:
    """Accept all views."""
    del name
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
        train, test = (
            tuple(view.with_offset(offset) for view in views) for views in (self.train, self.test)
        )
        return replace(self, train=train, test=test, origin=origin)
