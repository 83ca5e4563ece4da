"""Fit degraded images with and without the corresponding effect.

The shipped scene is fitted at a small size to images that were spoiled in a known way, with the
effect that is made for it and without: other exposures, something before the lens that a mask
leaves out, few images with and without depth, cameras that are somewhere else than the data says,
colours behind transparent images; and renderings at other sizes than that of the fit. All fits
are measured on images that were not spoiled.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import drgs  # noqa: F401  (registers the integrator)
import mitsuba as mi
import numpy as np
from drgs.bench.output import machine, markdown_table
from drgs.capture.path_tracing import first_hits, load_scene
from drgs.config.changes import with_changes, with_iterations
from drgs.config.schema import FitConfig
from drgs.datasets import load_dataset
from drgs.datasets.images import smaller_view
from drgs.datasets.types import Dataset, View
from drgs.initialization.start import initial_gaussians
from drgs.integrator.scene import render_views
from drgs.io.figures import new_figure, write_figure
from drgs.io.images import to_uint8
from drgs.results.metrics import mean_quality
from drgs.training.trainer import Trainer
from fits import SCENES
from recipes import LEGO, PAPERS, config_of
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:
    from matplotlib.figure import Figure

GENERATOR = SCENES / "brick_crane.py"

SCENE = LEGO
SIZE = 100  # px: width and height of the fitted images
ITERATIONS = 3000
NUM_POINTS = 20_000
DARKENING_FACTOR = 0.65  # of all colours, before exposures vary
NUM_FEW_VIEWS = 8  # of fits with depth

SIZES = {"2x": 2.0, "1x": 1.0, "1/2": 0.5, "1/4": 0.25}
"""Sizes of renderings, relative to that of the fit."""

Measure = Callable[[Trainer, Dataset, Dataset], dict[str, float]]


@dataclass(frozen=True)
class Case:
    """One fit."""

    effect: str
    name: str
    spoil: Callable[[Dataset, np.random.Generator], Dataset] = lambda data, rng: data
    changes: tuple[tuple[str, object], ...] = ()  # of the configuration
    measure: Measure | None = None  # None: quality on the test views


@dataclass(frozen=True)
class Result:
    """A measured quantity of a fit."""

    effect: str
    name: str
    quantity: str
    value: float


def base_config(iterations: int) -> FitConfig:
    """The paper's recipe on the shipped scene at a smaller size: later defaults change nothing.

    It starts at random points. Masks would be carved through the spoiled cameras.
    """
    small = {"data.image_size": SIZE, "init.num_points": NUM_POINTS}
    return with_iterations(with_changes(config_of(PAPERS, SCENE), small), iterations)


def fit_case(case: Case, config: FitConfig) -> tuple[Trainer, Dataset, Dataset]:
    """One fit: the trainer at its end, the data as it is, and what was fitted."""
    config = with_changes(config, dict(case.changes))
    dataset = load_dataset(config.data)
    spoiled = case.spoil(dataset, np.random.default_rng(0))
    trainer = Trainer(config, spoiled, initial_gaussians(config, spoiled))
    for _ in range(config.iterations):
        trainer.step()
    trainer.gaussians()  # what effects leave for renderings is there
    return trainer, dataset, spoiled


# ----------------------------------------------------------------------------------------------
# What is spoiled
# ----------------------------------------------------------------------------------------------


def _map_training_views(dataset: Dataset, change: Callable[[View], View]) -> Dataset:
    return replace(dataset, train=tuple(change(view) for view in dataset.train))


def darken(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Darken all images, so that no gain of :func:`spoil_exposure` clips a colour."""
    del rng

    def dark(view: View) -> View:
        return _with_image(view, DARKENING_FACTOR * np.asarray(view.image))

    return replace(_map_training_views(dataset, dark), test=tuple(map(dark, dataset.test)))


def spoil_exposure(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Multiply each training image by random gains per channel with mean 1."""
    gains = rng.uniform(0.6, 1.4, (len(dataset.train), 3))
    gains = iter(gains / gains.mean(axis=0))
    return _map_training_views(
        darken(dataset, rng), lambda v: _with_image(v, np.asarray(v.image) * next(gains))
    )


def spoil_parts(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Hide a sixth of each training image with a red square."""

    def hidden(view: View) -> View:
        mask, side = np.ones((view.height, view.width), np.float32), round(0.4 * view.width)
        row, column = rng.integers(0, view.width - side, 2)
        mask[row : row + side, column : column + side] = 0
        red = np.array([1.0, 0.0, 0.0])
        image = np.where(mask[:, :, None] > 0, view.image, red)
        return replace(_with_image(view, image), mask=mask)

    return _map_training_views(dataset, hidden)


def few_views(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Keep :data:`NUM_FEW_VIEWS` training images, with depth."""
    del rng
    scene = load_scene(GENERATOR)
    step = len(dataset.train) // NUM_FEW_VIEWS
    kept = dataset.train[::step][:NUM_FEW_VIEWS]
    return replace(dataset, train=tuple(replace(v, depth=depth_of(scene, v)) for v in kept))


def depth_of(scene: mi.Scene, view: View) -> np.ndarray:
    """Return (H, W) float32: depth of the surface at each pixel's centre, 0 without one."""
    x, y = np.meshgrid(np.arange(view.width) + 0.5, np.arange(view.height) + 0.5)
    local = np.stack([(x - view.cx) / view.fx, (y - view.cy) / view.fy, np.ones_like(x)], axis=-1)
    rotation = view.camera_to_world[:3, :3]
    hits, valid = first_hits(scene, view.center, local.reshape(-1, 3) @ rotation.T)
    depths = (hits - view.center) @ rotation[:, 2]
    return np.where(valid, depths, 0).reshape(view.height, view.width).astype(np.float32)


def move_cameras(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Move the training cameras by a degree and 0.04 units."""

    def moved(view: View) -> View:
        pose = view.camera_to_world.copy()
        turn = Rotation.from_rotvec(np.radians(rng.normal(0, 0.6, 3))).as_matrix()
        pose[:3, :3] = pose[:3, :3] @ turn
        pose[:3, 3] += rng.normal(0, 0.025, 3)
        return replace(view, camera_to_world=pose)

    return _map_training_views(dataset, moved)


def stretch_lenses(dataset: Dataset, rng: np.random.Generator) -> Dataset:
    """Increase focal lengths by 4 %."""
    del rng
    return _map_training_views(
        dataset, lambda view: replace(view, fx=1.04 * view.fx, fy=1.04 * view.fy)
    )


def _with_image(view: View, image: np.ndarray) -> View:
    return replace(view, image=image.astype(np.float32))


# ----------------------------------------------------------------------------------------------
# What is measured
# ----------------------------------------------------------------------------------------------


def quality(trainer: Trainer, dataset: Dataset, spoiled: Dataset) -> dict[str, float]:
    """Return the PSNR of the test views."""
    del spoiled
    return {"PSNR, dB": _psnr(trainer, dataset.test)}


def psnr_at_training_exposure(
    trainer: Trainer, dataset: Dataset, spoiled: Dataset
) -> dict[str, float]:
    """Return the PSNR of test views as dark as the training views are on average.

    Also with each image's colours fitted to the photograph's by an affine transform: what is lost
    besides the exposure.
    """
    del dataset
    pairs = zip(render_views(trainer.scene, spoiled.test), spoiled.test, strict=True)
    fitted = ((fitted_colors(p, np.asarray(v.image)), v.image) for p, v in pairs)
    return {
        **quality(trainer, spoiled, spoiled),
        "with colours fitted, dB": mean_quality(fitted).psnr,
    }


def fitted_colors(image: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return an image (H, W, 3) after the least-squares affine colour map to another."""
    colors = np.concatenate([image, np.ones_like(image[:, :, :1])], axis=2).reshape(-1, 4)
    matrix, *_ = np.linalg.lstsq(colors, target.reshape(-1, 3), rcond=None)
    return np.clip(colors @ matrix, 0, 1).reshape(image.shape)


def at_sizes(trainer: Trainer, dataset: Dataset, spoiled: Dataset) -> dict[str, float]:
    """Return the PSNR of the test views at several sizes."""
    del dataset, spoiled
    views = views_at_sizes(trainer.config)
    return {f"PSNR at {name}, dB": _psnr(trainer, resized) for name, resized in views.items()}


def views_at_sizes(config: FitConfig) -> dict[str, list[View]]:
    """Return the test views with their photographs at a size."""
    views = load_dataset(with_changes(config, {"data.image_size": None}).data).test
    return {
        name: [smaller_view(view, view.width / (SIZE * factor)) for view in views]
        for name, factor in SIZES.items()
    }


def render_at_sizes(trainer: Trainer) -> list[np.ndarray]:
    """Render the first test view at all sizes."""
    views = views_at_sizes(trainer.config).values()
    return [next(iter(render_views(trainer.scene, of_size[:1]))) for of_size in views]


def photographs_at_sizes(config: FitConfig) -> list[np.ndarray]:
    """Return the data's images of the first test view at all sizes."""
    return [np.asarray(of_size[0].image) for of_size in views_at_sizes(config).values()]


def cameras(trainer: Trainer, dataset: Dataset, spoiled: Dataset) -> dict[str, float]:
    """Compare the training cameras with the true ones, and renderings with their images.

    What all have in common (a similarity) is undone first. *Shift* is how far the image of a
    point at the middle of the scene, or a tenth of the distance around it, is from its place.
    """
    refinements = [effect for effect in trainer.effects if effect.name == "cameras"]
    views = list(spoiled.train)
    for refinement in refinements:
        views = refinement.refined_views(views)
    scale, turn, move = similarity([v.center for v in views], [v.center for v in dataset.train])
    shifts, angles, distances = [], [], []
    for view, true in zip(views, dataset.train, strict=True):
        pose = np.eye(4)
        pose[:3, :3] = turn @ view.camera_to_world[:3, :3]
        pose[:3, 3] = scale * turn @ view.center + move
        aligned = replace(view, camera_to_world=pose)
        shifts.append(np.linalg.norm(_pixels(aligned) - _pixels(true), axis=1).mean())
        relative = Rotation.from_matrix(pose[:3, :3].T @ true.camera_to_world[:3, :3])
        angles.append(np.degrees(relative.magnitude()))
        distances.append(np.linalg.norm(pose[:3, 3] - true.center))
    focal = np.mean([v.fx / t.fx for v, t in zip(views, dataset.train, strict=True)])
    seen = [replace(v, image=t.image, mask=None) for v, t in zip(views, dataset.train, strict=True)]
    return {
        "shift, px": float(np.mean(shifts)),
        "rotation, degrees": float(np.mean(angles)),
        "position, units": float(np.mean(distances)),
        "focal length, %": float(100 * (focal - 1)),
        "PSNR of training views, dB": _psnr(trainer, seen),
    }


def similarity(
    points: Sequence[np.ndarray], targets: Sequence[np.ndarray]
) -> tuple[float, np.ndarray, np.ndarray]:
    """Return the least-squares similarity from points to targets (Umeyama 1991)."""
    a, b = np.array(points), np.array(targets)
    a0, b0 = a - a.mean(axis=0), b - b.mean(axis=0)
    u, s, vt = np.linalg.svd(b0.T @ a0)
    sign = np.diag([1, 1, np.linalg.det(u @ vt)])
    turn = u @ sign @ vt
    scale = np.trace(np.diag(s) @ sign) / (a0**2).sum()
    return float(scale), turn, b.mean(axis=0) - scale * turn @ a.mean(axis=0)


def _pixels(view: View) -> np.ndarray:
    """Project a grid of 27 points in the scene's middle; return (27, 2) px."""
    grid = np.stack(np.meshgrid(*[[-0.4, 0.0, 0.4]] * 3), axis=-1).reshape(-1, 3)
    x, y, z = view.camera_to_world[:3, :3].T @ (grid - view.center).T
    return np.stack([view.fx * x / z + view.cx, view.fy * y / z + view.cy], axis=-1)


def _psnr(trainer: Trainer, views: Sequence[View]) -> float:
    renders = render_views(trainer.scene, tuple(views))
    return mean_quality((p, v.image) for p, v in zip(renders, views, strict=True)).psnr


# ----------------------------------------------------------------------------------------------
# Cases
# ----------------------------------------------------------------------------------------------

EXPOSURE = "exposure and white balance"

BLACK = (("data.background", "black"),)
"""A gain does not change what is behind transparent images."""

REFINED = (("cameras.optimise", True),)

FAST = (("cameras.rotation_lr", 5e-3), ("cameras.translation_lr", 5e-3))
"""Rates for short fits: of 3,000 iterations, each of 100 cameras gets 30."""

CASES = (
    Case(EXPOSURE, "all alike", darken, BLACK, psnr_at_training_exposure),
    Case(EXPOSURE, "without", spoil_exposure, BLACK, psnr_at_training_exposure),
    Case(
        EXPOSURE, "with", spoil_exposure, (*BLACK, ("colors.lr", 0.02)), psnr_at_training_exposure
    ),
    Case("masks", "without", lambda data, rng: without(spoil_parts(data, rng), "mask")),
    Case("masks", "with", spoil_parts),
    Case("depth", "without", few_views, (("loss.depth_weight", 0.0),)),
    Case("depth", "with", few_views),
    Case("camera refinement", "poses, without", move_cameras, (), cameras),
    Case("camera refinement", "poses, with", move_cameras, (*REFINED, *FAST), cameras),
    Case("camera refinement", "focal length, without", stretch_lenses, (), cameras),
    Case(
        "camera refinement",
        "focal length, with",
        stretch_lenses,
        (*REFINED, ("cameras.start", 300), ("cameras.focal_lr", 1e-3)),
        cameras,
    ),
    Case("antialiasing", "none", measure=at_sizes),
    Case("antialiasing", "opacities", changes=(("model.antialiased", True),), measure=at_sizes),
    Case("antialiasing", "3D filter", changes=(("model.smoothing", True),), measure=at_sizes),
    Case(
        "antialiasing",
        "both",
        changes=(("model.antialiased", True), ("model.smoothing", True)),
        measure=at_sizes,
    ),
)


def without(dataset: Dataset, name: str) -> Dataset:
    """Remove masks or depths of the training views."""
    return _map_training_views(dataset, lambda view: replace(view, **{name: None}))


def table(results: Sequence[Result]) -> str:
    """A row for each quantity, a column for each fit of an effect."""
    rows = []
    for effect in dict.fromkeys(result.effect for result in results):
        for name in dict.fromkeys(r.name for r in results if r.effect == effect):
            values = [r for r in results if (r.effect, r.name) == (effect, name)]
            text = "; ".join(f"{r.quantity} {r.value:.2f}" for r in values)
            rows.append([effect, name, text])
    return markdown_table(["effect", "fit", "measured"], rows)


def plot(rows: dict[str, list[np.ndarray]]) -> Figure:
    """Plot images: a row per name, a column per size."""
    figure = new_figure(2 * len(SIZES) + 0.4, 2 * len(rows))
    grid = figure.subplots(len(rows), len(SIZES), squeeze=False)
    for name, renders, of_row in zip(rows, rows.values(), grid, strict=True):
        for axes, rendered in zip(of_row, renders, strict=True):
            axes.imshow(to_uint8(rendered), interpolation="none")
            axes.set(xticks=[], yticks=[])
        of_row[0].set_ylabel(name)
    for axes, name in zip(grid[0], SIZES, strict=True):
        axes.set_title(name)
    return figure


def main() -> None:
    """Fit all cases; print a table, and write renderings at several sizes."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--only", nargs="+", metavar="EFFECT", help="such as masks")
    parser.add_argument("--iterations", type=int, default=ITERATIONS, metavar="N")
    parser.add_argument("--out", type=Path, default=Path("out/studies/benefits"))
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    config = base_config(args.iterations)
    results, shown = [], {}
    for case in (case for case in CASES if not args.only or case.effect in args.only):
        trainer, dataset, spoiled = fit_case(case, config)
        found = (case.measure or quality)(trainer, dataset, spoiled)
        if case.measure is at_sizes:
            shown[case.name] = render_at_sizes(trainer)
        results += [Result(case.effect, case.name, k, v) for k, v in found.items()]
        print(f"{case.effect}, {case.name}", flush=True)
    print(f"\n{machine()}\n\n{table(results)}")
    if shown:
        args.out.mkdir(parents=True, exist_ok=True)
        shown = {"photograph": photographs_at_sizes(config)} | shown
        write_figure(args.out / "antialiasing.png", plot(shown))


if __name__ == "__main__":
    main()
