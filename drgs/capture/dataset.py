"""The folder of a capture, in the NeRF-synthetic layout.

- ``transforms_{train,val,test}.json``: ``camera_angle_x`` and camera to world, OpenGL axes
- ``{train,val,test}/r_0.png``, ...: RGBA, 8 bits, straight alpha, colour in sRGB
- ``points3d.ply``: first hits of the training cameras' rays, a start for ``init.point_cloud``
- ``capture.json``: scene and settings

Files that exist are not written again: they are whole, and may have been edited since.
"""

from __future__ import annotations

import hashlib
import json
import math
import shlex
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path

import mitsuba as mi
import numpy as np

from drgs.capture.path_tracing import (
    MIN_LIT_PART,
    SPLITS,
    CaptureCamera,
    CaptureSettings,
    CaptureView,
    first_hits,
    lit_part,
    view_rays,
)
from drgs.cli.progress import RunProgress
from drgs.core.errors import UserError, one_line
from drgs.core.files import read_text, remove_stale_temporaries, write_bytes, write_json
from drgs.io.images import read_image, to_uint8, write_png
from drgs.io.ply import COLOR, POSITION, encode_elements

POINTS = "points3d.ply"
MANIFEST = "capture.json"
MAX_MANIFEST_BYTES = 1 << 20

NUM_FIRST = 10  # images after which a warning is printed if most are empty or black
MIN_COVERED_PART = 0.01  # of an image that is not empty

REMEDIES = {
    "around": "give --azimuth, --elevation, --target and --distance",
    "sensors": "give --cameras around",
}
"""Remedies for empty images, by kind of cameras."""


class CaptureFolder:
    """The output folder of a capture."""

    def __init__(
        self, path: Path, scene_path: Path, settings: CaptureSettings, keep: Callable[[], object]
    ) -> None:
        """scene_path: loaded already; keep: see :func:`drgs.core.folders.sole_writer`."""
        self.path, self._settings, self._keep = path, settings, keep
        self._manifest = {
            "scene": scene_path.name,
            "scene_sha256": fingerprint(scene_path),
            "mitsuba": mi.__version__,
            **asdict(settings),
        }

    def check(self) -> None:
        """Raise :class:`UserError` for a folder that is not new, empty or of this capture."""
        remedy = "choose another --out, or remove it"
        if self.path.exists() and not self.path.is_dir():
            raise UserError(f"{self.path}: --out must be a folder, got a file")
        if self._is_empty():
            return
        path = self.path / MANIFEST
        if not path.is_file():
            raise UserError(
                f"{self.path}: the folder is not empty and holds no {MANIFEST}; {remedy}"
            )
        text = read_text(path, "settings of the capture", MAX_MANIFEST_BYTES)
        try:
            recorded = json.loads(text)
        except (ValueError, RecursionError) as error:
            raise UserError(f"{path}: not valid JSON: {one_line(error)}; {remedy}") from None
        recorded = recorded if isinstance(recorded, dict) else {}
        for key, value in json.loads(json.dumps(self._manifest)).items():
            if recorded.get(key) != value:
                theirs, ours = (_value_text(key, each) for each in (recorded.get(key), value))
                raise UserError(
                    f"{path}: the folder holds another capture: {key} is {theirs}, requested is "
                    f"{ours}; {remedy}"
                )

    def claim(self) -> None:
        """Create the folder with its manifest, or raise as :meth:`check`."""
        self._keep()
        self.check()
        if self._is_empty():
            write_json(self.path / MANIFEST, self._manifest, indent=2)
        remove_stale_temporaries(self.path)

    def _is_empty(self) -> bool:
        """Return whether there are hidden files only: a desktop's, or temporary ones."""
        path = self.path
        return not path.exists() or all(child.name.startswith(".") for child in path.iterdir())

    def image_path(self, view: CaptureView) -> Path:
        """Return the file of a view's image."""
        return self.path / f"{view.file_path}.png"

    def take_images(self, scene: mi.Scene, views: list[CaptureView]) -> None:
        """Take the images that are not there yet; warn if most of the first show nothing."""
        camera = CaptureCamera(scene, self._settings)
        missing = spread_first([view for view in views if not self.image_path(view).exists()])
        if num_done := len(views) - len(missing):
            print(f"{num_done} of {len(views)} images are there already")
        if not missing:
            self.claim()
        shown, num_first = [], min(NUM_FIRST, len(missing))
        with RunProgress("image", len(views), num_done) as progress:
            for done, view in enumerate(missing, num_done + 1):
                image = camera.image(view)
                if not shown:  # until now, the scene may have been refused
                    self.claim()
                write_png(self.image_path(view), image)
                is_covered = (image[:, :, 3] > 0).mean() >= MIN_COVERED_PART
                shown.append(is_covered and lit_part(image) >= MIN_LIT_PART)
                if len(shown) == num_first and sum(shown) < num_first / 2:
                    warning = (
                        f"warning: {num_first - sum(shown)} of the first {num_first} images are "
                        f"empty or black: {REMEDIES[self._settings.cameras]}, and another --out; "
                        "or give the scene light"
                    )
                    print(warning, file=sys.stderr, flush=True)
                progress.update(done, len(views))

    def write_dataset(self, scene: mi.Scene, views: list[CaptureView]) -> None:
        """Write points and transforms files, and print the command that fits the dataset."""
        settings, points_path = self._settings, self.path / POINTS
        if settings.points and not points_path.exists():
            positions, colors = self.visible_points(scene, views)
            if len(positions):
                write_points(points_path, positions, colors)
                print(f"{len(positions):,} points: {points_path}")
            else:
                print("no points: the images to train on show no surface")
        # The layout is recognised by the training split's file, so that one comes last.
        for split in reversed(SPLITS):
            path = self.path / f"transforms_{split}.json"
            if settings.count(split) and not path.exists():
                frames = [
                    {"file_path": view.file_path, "transform_matrix": view.pose.tolist()}
                    | ({} if view.fov == settings.fov else {"camera_angle_x": view.fov})
                    for view in views
                    if view.split == split
                ]
                write_json(path, {"camera_angle_x": settings.fov, "frames": frames})
        counted = ", ".join(f"{settings.count(s)} {s}" for s in SPLITS if settings.count(s))
        width, height = settings.size
        print(f"written: {self.path}: {counted} views, {width}x{height}, {settings.spp} spp")
        words = ["python", "-m", "drgs.fit", "scenes/photos.yml", "--data", str(self.path)]
        if points_path.exists():
            words += ["--set", f"init.point_cloud={points_path}"]
        if not settings.test_views and not settings.val_views:
            words += ["--set", "data.test_split=train"]
        print(f"fit it with: {shlex.join(words)}")

    def visible_points(
        self, scene: mi.Scene, views: list[CaptureView]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return first hits of random rays: (N, 3) float32 world, and colours (N, 3) uint8.

        Each training view has the same share of ``settings.points``, spread evenly over the covered
        part of its written image, whose colours they have. N may be smaller, even 0, where the few
        paths of a pixel met nothing.
        """
        settings, train = self._settings, [view for view in views if view.split == "train"]
        positions, colors = [np.empty((0, 3), np.float32)], [np.empty((0, 3), np.uint8)]
        ends = [number * settings.points // len(train) for number in range(len(train) + 1)]
        for view, share in zip(train, np.diff(ends).tolist(), strict=True):
            rng = np.random.default_rng([settings.seed, len(SPLITS), view.index])
            image = self._read_image(view).reshape(-1, 4)
            weights = image[:, 3].astype(np.float64)
            if not weights.any():
                continue
            # At the edge of a surface a ray can miss it: draw more than are kept.
            pixels = rng.choice(len(image), 2 * share + 64, p=weights / weights.sum())
            rows, columns = np.divmod(pixels, settings.size[0])
            spots = np.stack([columns, rows], axis=1) + rng.uniform(size=(len(pixels), 2))
            rays = view.pose[:3, 3], view_rays(view, spots, settings)
            hits, valid = first_hits(scene, *rays)
            positions.append(hits[valid][:share])
            colors.append(to_uint8(image[pixels[valid], :3])[:share])
        return np.concatenate(positions), np.concatenate(colors)

    def _read_image(self, view: CaptureView) -> np.ndarray:
        """Return a written image, (H, W, 4) float32."""
        path, (width, height) = self.image_path(view), self._settings.size
        image = read_image(path)
        if image.shape != (height, width, 4):
            raise UserError(
                f"{path}: must be an RGBA image of {width} x {height} px of this capture, got "
                f"{image.shape[1]} x {image.shape[0]} with {image.shape[2]} channels; remove it, "
                "and the same command takes it again"
            )
        return image


def fingerprint(path: Path) -> str:
    """Return the SHA-256 of a scene file and of the modules that it imported from its folder."""
    folder = path.parent.resolve()
    modules = [Path(getattr(module, "__file__", None) or "/") for module in sys.modules.values()]
    sources = sorted({path.resolve(), *(m.resolve() for m in modules if m.parent == folder)})
    return hashlib.sha256(b"".join(source.read_bytes() for source in sources)).hexdigest()


def spread_first(views: list[CaptureView]) -> list[CaptureView]:
    """Return the views in an order in which the first are spread over all heights."""
    chosen = range(0, len(views), max(1, len(views) // NUM_FIRST))[:NUM_FIRST]
    rest = sorted(set(range(len(views))) - set(chosen))
    return [views[index] for index in (*chosen, *rest)]


def write_points(path: Path, positions: np.ndarray, colors: np.ndarray) -> None:
    """Write a PLY of points: positions (N, 3) world, colours (N, 3) uint8 display space."""
    columns = dict(zip((*POSITION, *COLOR), (*positions.T, *colors.T), strict=True))
    dtype = [(name, column.dtype) for name, column in columns.items()]
    rows = np.rec.fromarrays(list(columns.values()), dtype=dtype)
    write_bytes(path, encode_elements({"vertex": rows}))


def _value_text(key: str, value: object) -> str:
    """Return a value of the manifest in the unit of its option."""
    if key == "fov" and isinstance(value, float):
        value = round(math.degrees(value), 4)
    return one_line(json.dumps(value), 120)
