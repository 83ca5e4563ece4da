"""A few blobs, cameras around them, and photographs of them: on disk and in memory."""

from __future__ import annotations

import json
from pathlib import Path

import imageio.v3 as iio
import numpy as np
import yaml

from drgs.cameras.viewpoints import Viewpoint
from drgs.datasets.types import Dataset, View
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.reference import splatting as reference
from support.helpers import NEAR_THRESHOLD, host_gaussians

WIDTH, HEIGHT = 32, 24
FIELD_OF_VIEW = 0.7  # radians, horizontal
RADIUS = 4.0
FOCUS = np.array([0.25, -0.5, 0.125])
WHITE = (1.0, 1.0, 1.0)


def blobs(count=30, seed=0) -> Gaussians:
    """Opaque and coloured, within a unit of the focus, numpy float32."""
    rng = np.random.default_rng(seed)
    found = reference.Gaussians(
        means=FOCUS + rng.uniform(-0.6, 0.6, (count, 3)),
        quats=rng.normal(size=(count, 4)),
        log_scales=np.log(rng.uniform(0.08, 0.3, (count, 3))),
        logit_opacities=rng.uniform(0.5, 3, count),
        sh0=rng.uniform(-1.5, 1.5, (count, 1, 3)),
        shN=rng.normal(0, 0.2, (count, 3, 3)),
    )
    return host_gaussians(found)


def pose_around(azimuth: float, elevation: float, radius=RADIUS) -> np.ndarray:
    """Camera to world, OpenCV axes, of a camera that looks at the focus with z up."""
    level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    forward = -np.cos(elevation) * level - np.sin(elevation) * np.array([0.0, 0.0, 1.0])
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    pose[:3, 3] = FOCUS - radius * forward
    return pose


def view(name: str, pose: np.ndarray, image: np.ndarray) -> View:
    """A view of the small size."""
    focal = WIDTH / 2 / np.tan(FIELD_OF_VIEW / 2)
    return View(name, pose, focal, focal, WIDTH / 2, HEIGHT / 2, WIDTH, HEIGHT, image=image)


def double(gaussians: Gaussians) -> reference.Gaussians:
    """The same numbers for the reference."""
    return reference.Gaussians(
        **{name: getattr(gaussians, name).astype(np.float64) for name in PARAMETER_NAMES}
    )


def reference_camera(view: View | Viewpoint, near=0.2) -> reference.Camera:
    """A view's camera for the reference; near: the configuration's."""
    pose = view.camera_to_world
    lens = view.fx, view.fy, view.cx, view.cy, view.width, view.height
    return reference.Camera(pose[:3, :3].T, pose[:3, 3], *lens, near)


def photograph(gaussians, view: View | Viewpoint, background=WHITE) -> reference.RenderedImage:
    """Pixels near a threshold, where float32 may decide otherwise, are marked."""
    camera, color = reference_camera(view), np.array(background)
    return reference.render(double(gaussians), camera, color, threshold_width=NEAR_THRESHOLD)


def assert_images_agree(image, expected, rendered: reference.RenderedImage, tolerance) -> None:
    """Compare (H, W, 3), leaving out pixels where float32 may decide otherwise than float64."""
    kept = ~rendered.near_threshold
    assert image.shape == expected.shape
    assert kept.mean() > 0.95
    errors = np.abs(image - expected)[kept]
    assert errors.max() <= tolerance, f"{errors.max()} at {(errors > tolerance).sum()} values"


def make_dataset(train=8, test=4, seed=0) -> Dataset:
    """Views at one height; the photographs are noise."""
    rng = np.random.default_rng(seed)

    def noise():
        return rng.uniform(0, 1, (HEIGHT, WIDTH, 3)).astype(np.float32)

    def views(count, offset):
        azimuths = offset + 2 * np.pi * np.arange(count) / count
        return tuple(
            view(f"r_{i}", pose_around(azimuth, 0.5), noise()) for i, azimuth in enumerate(azimuths)
        )

    return Dataset(
        train=views(train, 0.0),
        test=views(test, 0.3),
        test_split="test",
        background=WHITE,
        start_half_extent=None,
        description="noise <small>",
    )


def write_dataset(folder: Path, dataset: Dataset, alpha: float = 0.5) -> None:
    """The same views in the NeRF-synthetic layout; alpha: of every pixel."""
    for split, views in (("train", dataset.train), ("test", dataset.test)):
        (folder / split).mkdir(parents=True)
        frames = []
        for v in views:
            rgba = np.dstack([v.image, np.full((HEIGHT, WIDTH), alpha)])
            rgba = np.round(rgba * 255).astype(np.uint8)
            iio.imwrite(folder / split / f"{v.name}.png", rgba)
            opengl = v.camera_to_world * [1, -1, -1, 1]
            frames.append({"file_path": f"./{split}/{v.name}", "transform_matrix": opengl.tolist()})
        transforms = {"camera_angle_x": FIELD_OF_VIEW, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(transforms))


def write_fit(folder: Path, dataset: Dataset, **sections: object) -> Path:
    """``data/``, and ``run/`` as a fit leaves it, with other sections of its configuration."""
    write_dataset(folder / "data", dataset)
    blobs().save(folder / "run" / "point_cloud.ply")
    config = {"data": {"path": str(folder / "data")}, **sections}
    (folder / "run" / "config.yml").write_text(yaml.safe_dump(config))
    return folder / "run"


def decibels(image, target) -> float:
    """PSNR, computed plainly."""
    return float(10 * np.log10(1 / np.square(np.asarray(image) - target).mean()))
