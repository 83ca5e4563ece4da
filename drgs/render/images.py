"""Images of Gaussians from the cameras that a command line names."""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterator, Sequence
from importlib.util import find_spec

import numpy as np

from drgs.cameras.orbits import orbit_of_gaussians, orbit_of_views, orbit_size
from drgs.cameras.viewpoints import (
    FIELD_OF_VIEW,
    Viewpoint,
    field_of_view,
    look_at,
    panorama,
    pinhole,
)
from drgs.config.schema import FitConfig
from drgs.core.constants import SHUTTER_SAMPLES
from drgs.core.files import write_json
from drgs.datasets.camera_file import read_viewpoints
from drgs.effects.cameras import CamerasConfig
from drgs.io.images import check_animation, write_animation
from drgs.results.folder import METRICS, ORBIT
from drgs.results.metrics import flip, psnr, ssim
from drgs.results.model import ImageFolder, Model
from drgs.results.model_arguments import UP
from drgs.results.refined_cameras import refined_cameras_file, training_cameras

FLIP = "flip_evaluator"  # a module that measures FLIP, where it is installed

DEFAULT_SIZE, PANORAMA_SIZE = (400, 400), (800, 400)
"""Width and height, px, where nothing else decides how large an image is."""


def render_model(args: argparse.Namespace, model: Model, folder: ImageFolder) -> None:
    """Render Gaussians from the cameras that the command line names."""
    if model.config is not None:
        folder.check_no_photographs(model.config.data.path)
    if args.orbit is not None:
        render_orbit(model, args, folder)
    elif args.camera is not None or args.origin is not None:
        for _ in render_cameras(model, viewpoints_of(args, model), folder):
            pass
    else:
        render_split(model, args.split or "test", folder)
    folder.write_budget()


def render_split(model: Model, split: str, folder: ImageFolder) -> None:
    """Render the views of a dataset's split, measure them, and print and write the result."""
    dataset = model.dataset(f"--split {split}")
    print(dataset.description)
    views = dataset.train if split == "train" else dataset.test
    column = max(len("view"), *(len(view.name) for view in views))
    images = model.images(views, folder, [METRICS], "give --set data.image_size=...")
    measures = {"psnr": psnr, "ssim": ssim, **({"flip": flip} if find_spec(FLIP) else {})}
    titles = "".join(f"    {name.upper()}" for name in measures if name != "psnr")
    print(f"{'view':{column}}  PSNR [dB]{titles}")
    scores: dict[str, dict[str, float]] = {}
    for view, image in zip(views, images, strict=True):
        folder.write_png(f"{view.name}.png", image)
        pair = image, view.image, view.mask
        score = scores[view.name] = {k: measure(*pair) for k, measure in measures.items()}
        print(f"{view.name:{column}}  {_line(**score)}", flush=True)
    rows = list(scores.values())
    mean = {name: float(np.mean([row[name] for row in rows])) for name in measures}
    print(f"{'mean':{column}}  {_line(**mean)}")
    report = {
        "split": dataset.test_split if split == "test" else "train",
        "num_views": len(rows),
        "num_gaussians": model.gaussians.num_gaussians,
        "mean": mean,
        "views": scores,
    }
    write_json(folder.path / METRICS, _replace_infinities(report), indent=2)


def render_orbit(model: Model, args: argparse.Namespace, folder: ImageFolder) -> None:
    """Render frames around the scene, and animations of them."""
    if model.config is None:
        fov, (width, height) = args.fov or FIELD_OF_VIEW, args.size or _default_size(args)
        orbit = orbit_of_gaussians(model.gaussians, np.array(args.up or UP), fov)
    else:
        views = _orbited_views(model, model.config, args)
        size = PANORAMA_SIZE if args.panorama else orbit_size(views)
        fov, (width, height) = args.fov or field_of_view(views), args.size or size
        orbit = orbit_of_views(views, model.gaussians)
    check_animation(args.orbit, width, height)
    viewpoints = orbit.viewpoints(args.orbit, width, height, fov)
    if args.panorama:
        viewpoints = [panorama(view, orbit.up) for view in viewpoints]
    write_animation(folder.path / ORBIT, render_cameras(model, viewpoints, folder, [ORBIT]))


def _orbited_views(
    model: Model, config: FitConfig, args: argparse.Namespace
) -> Sequence[Viewpoint]:
    """Return the training cameras: those in a fit's folder, unless photographs are named."""
    if args.what.is_dir() and (args.scene, args.data, args.set) == (None, None, None):
        refined = refined_cameras_file(args.what)
        if config.section("cameras", CamerasConfig).optimise and refined is not None:
            print(f"cameras: as refined, from {refined}")
        if (views := training_cameras(args.what, model.gaussians.origin)) is not None:
            return views
    return model.dataset("--orbit").train


def render_cameras(
    model: Model, viewpoints: Sequence[Viewpoint], folder: ImageFolder, others: Sequence[str] = ()
) -> Iterator[np.ndarray]:
    """Write and yield images without photographs; others: further files to be written."""
    images = model.images(viewpoints, folder, others, "give a smaller --size")
    for camera, image in zip(viewpoints, images, strict=True):
        folder.write_png(f"{camera.name}.png", image)
        print(f"{camera.name}: {camera.width}x{camera.height}", flush=True)
        yield image


def _default_size(args: argparse.Namespace) -> tuple[int, int]:
    return PANORAMA_SIZE if args.panorama else DEFAULT_SIZE


def viewpoints_of(args: argparse.Namespace, model: Model) -> list[Viewpoint]:
    """Return the cameras of ``--camera`` or of ``--origin``, relative to the model's origin."""
    size: tuple[int, int] | None = tuple(args.size) if args.size else None
    origin = model.gaussians.origin
    if args.camera is not None:
        samples = model.config.data.shutter_samples if model.config else SHUTTER_SAMPLES
        of_file = PANORAMA_SIZE if args.panorama else None
        views = read_viewpoints(args.camera, size or of_file, samples)
    else:
        pose = look_at(args.origin, args.target or origin, args.up or UP)
        views = [pinhole("camera", pose, *(size or _default_size(args)), args.fov or FIELD_OF_VIEW)]
    if args.panorama:
        up = None if args.camera is not None else np.array(args.up or UP)
        views = [panorama(view, up) for view in views]
    return [view.with_offset(-np.array(origin)) for view in views]


def _line(psnr: float, **others: float) -> str:
    return f"{psnr:9.2f}" + "".join(f"  {value:.4f}" for value in others.values())


def _replace_infinities(value: object) -> object:
    """Replace infinities, such as the PSNR of equal images, by JSON's null."""
    if isinstance(value, dict):
        return {key: _replace_infinities(item) for key, item in value.items()}
    return None if isinstance(value, float) and not math.isfinite(value) else value
