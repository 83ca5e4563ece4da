"""Gaussians with their rendering settings, and the output folder of their images."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import mitsuba as mi
import numpy as np

from drgs.cameras.orbits import near_plane_of
from drgs.cameras.viewpoints import Viewpoint
from drgs.config.approximations import from_ply_header
from drgs.config.changes import is_open
from drgs.config.load import load_config
from drgs.config.schema import NAMED_COLORS, FitConfig, ModelConfig
from drgs.core.errors import PluginError, UserError, format_names
from drgs.core.files import write_json
from drgs.core.folders import FolderRecord, sole_writer
from drgs.datasets import Dataset, load_dataset
from drgs.effects.cameras import CamerasConfig
from drgs.gaussians.parameters import Gaussians
from drgs.initialization.defaults import resolve_defaults
from drgs.integrator.scene import check_lenses, check_sizes, make_scene, make_sensors, render_views
from drgs.integrator.state import is_splats
from drgs.integrator.summary import format_effects, summary_of_views
from drgs.io.images import write_png
from drgs.results.folder import CONFIG, ERROR_BUDGET, own_gaussians, relocate_data, require_results
from drgs.results.refined_cameras import refined_cameras_file, refined_dataset

if TYPE_CHECKING:  # imported where there is an error budget
    from drgs.accuracy.error_budget import BudgetReport

Background = tuple[float, float, float] | Path  # display space, or an image file

Render = Callable[..., Iterator[np.ndarray]]
"""Yields images (H, W, 3) of a scene and views: ``render_views``, or several processes."""

COMMAND = "render"
BUDGET_KEY = "drgs error budget"  # of images' metadata
ERROR_SUFFIX = ".error.png"  # of the picture of an image's error
BRIGHTEST_ERROR = 4  # budgets: error of a pixel that has the brightest colour
PHOTOGRAPHS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr")

Image = TypeVar("Image")


@dataclass
class ImageFolder:
    """An output folder of images; see :func:`open_image_folder`."""

    path: Path
    keep: Callable[[], object]  # see :func:`drgs.core.folders.sole_writer`
    budget: BudgetReport | None = None  # of the images

    def write_png(self, name: str, image: np.ndarray) -> None:
        """Write a claimed image, with the approximations that an error budget has chosen."""
        text = {} if self.budget is None else {BUDGET_KEY: json.dumps(self.budget.record())}
        write_png(self.path / name, image, text)

    def write_budget(self) -> None:
        """Write what an error budget has chosen, if there is one."""
        if self.budget is not None:
            write_json(self.path / ERROR_BUDGET, self.budget.record(), indent=2)

    def claim(self, names: Iterable[str], images: Iterable[Image]) -> Iterator[Image]:
        """Claim files and yield images; UserError before the first if a file was not rendered."""
        names, record = list(names), FolderRecord(self.path, COMMAND)
        record.check(names)
        for index, image in enumerate(images):
            if index == 0:  # there is something to write
                self.keep()
                record.claim(names)
            yield image

    def check_no_photographs(self, dataset: Path) -> None:
        """Raise :class:`UserError` if the folder contains images of the folder ``dataset``."""
        if not self.path.is_dir() or not self.path.resolve().is_relative_to(dataset.resolve()):
            return
        images = [n for n in sorted(os.listdir(self.path)) if n.lower().endswith(PHOTOGRAPHS)]
        if photographs := FolderRecord(self.path, COMMAND).foreign_files(images):
            raise UserError(
                f"--out {self.path}: holds images of the dataset ({format_names(photographs)}); "
                "choose a folder of its own"
            )


@contextmanager
def open_image_folder(path: Path) -> Iterator[ImageFolder]:
    """Render into a folder within the block; then record the images, also after Ctrl-C."""
    with sole_writer(path) as keep:
        try:
            yield ImageFolder(path, keep)
        finally:
            with suppress(UserError):  # on a full disk, the claims remain
                record = FolderRecord(path, COMMAND)
                if record.exists:
                    keep()  # or it is another command's
                    record.seal()


@dataclass(frozen=True, eq=False)
class Model:
    """Gaussians and their rendering settings."""

    gaussians: Gaussians
    settings: ModelConfig
    background: Background
    config: FitConfig | None  # names the dataset
    ignored: str = ""  # effects not simulated: see the plugin
    path: Path | None = None  # of the file, beside which there may be refined cameras
    from_header: Collection[str] = ()  # names of settings from the file's header
    render: Render = render_views
    error: float | None = None  # budget of the approximations' error; None: as ``settings``
    error_images: bool = False  # whether pictures of the error are written as well

    def scene(self) -> mi.Scene:
        """Return a Mitsuba scene that renders in display space."""
        settings = {"ignore": self.ignored} if self.ignored else {}
        return make_scene(self.gaussians, self.settings, self.background, **settings)

    def images(
        self, views: Sequence[Viewpoint], folder: ImageFolder, others: Sequence[str], remedy: str
    ) -> Iterator[np.ndarray]:
        """Print a summary of the simulated effects; return images (H, W, 3) of the views.

        Claims a PNG file per view, and ``others``, in ``folder``. remedy: for too large images.
        """
        check_sizes(views, remedy)
        if "distortion" not in self.ignored:
            check_lenses(self.settings, views, where="", remedy="give --ignore distortion")
        scene = self.scene()
        integrator = scene.integrator()
        assert is_splats(integrator), "scene() sets it"
        summary = summary_of_views(integrator.state, views, self.from_header)
        print(format_effects(summary), flush=True)
        names = [*(f"{view.name}.png" for view in views), *others]
        if self.error is not None:
            folder.budget = self.meet_error_budget(scene, views)
            names.append(ERROR_BUDGET)
        if self.error_images:
            names += [f"{view.name}{ERROR_SUFFIX}" for view in views]
        images = folder.claim(names, self.render(scene, views))
        return self._with_errors(views, folder, images) if self.error_images else images

    def meet_error_budget(self, scene: mi.Scene, views: Sequence[Viewpoint]) -> BudgetReport:
        """Set approximations within the error; print and return what was found."""
        from drgs.integrator.error_budget import digest_of, meet_error_budget
        from drgs.results.budget_memory import memory_path, recall, remember

        integrator, sensors = scene.integrator(), make_sensors(views)
        assert self.error is not None and is_splats(integrator), "scene() sets it"
        splats, path = integrator.state, self.path and memory_path(self.path)
        digest = f"{self.error} {digest_of(splats, scene, sensors)}"
        report = splats.budget_report = recall(path, digest, splats.given_approximations)
        if report is None:
            try:
                report = meet_error_budget(splats, scene, sensors, self.error)
            except PluginError as error:
                raise UserError(f"--{str(error).removeprefix('splats: ')}") from None
            remember(path, digest, report)
        print(report.line(), flush=True)
        return report

    def _with_errors(
        self, views: Sequence[Viewpoint], folder: ImageFolder, images: Iterator[np.ndarray]
    ) -> Iterator[np.ndarray]:
        """Yield the images; write each pixel's root mean square error over channels, as colours."""
        from matplotlib import colormaps

        assert folder.budget is not None, "errors are relative to its most accurate image"
        report, changes = folder.budget, {**folder.budget.most_accurate}
        if (samples := changes.pop("shutter_samples", 0)) > 0:
            motions = [one.motion and replace(one.motion, samples=samples) for one in views]
            views = [replace(one, motion=m) for one, m in zip(views, motions, strict=True)]
        settings = self.settings.model_copy(update=changes)
        exact = render_views(replace(self, settings=settings).scene(), views)
        brightest = BRIGHTEST_ERROR * report.budget
        for view, image in zip(views, images, strict=True):
            square = np.square(image - next(exact), dtype=np.float64).mean(axis=-1)
            colors = colormaps["inferno"](np.sqrt(square) / brightest)[..., :3]
            folder.write_png(f"{view.name}{ERROR_SUFFIX}", colors)
            print(
                f"{view.name}{ERROR_SUFFIX}: {math.sqrt(square.mean()):.2g}, at most "
                f"{math.sqrt(square.max()):.2g} (brightest from {brightest:.2g}), for "
                f"{report.chosen.cost:.2g} times the time of the default",
                flush=True,
            )
            yield image

    def within_error(self, error: float, views: Sequence[Viewpoint]) -> Model:
        """Return this with approximations within an error at the views; print what was found."""
        report = replace(self, error=error).meet_error_budget(self.scene(), views)
        return replace(self, settings=self.settings.model_copy(update=report.chosen.changes))

    def dataset(self, option: str) -> Dataset:
        """Return the photographs that ``option`` requires."""
        if self.config is None:
            raise UserError(
                f"{option}: needs photographs: give the configuration of a fit (--scene CONFIG.yml)"
            )
        dataset = load_dataset(self.config.data_for_rendering, sections=self.config.sections)
        dataset = dataset.relative_to(self.gaussians.origin)
        if self.path is None or (path := refined_cameras_file(self.path.parent)) is None:
            return dataset
        if not self.config.section("cameras", CamerasConfig).optimise:
            print(
                f"cameras: as the dataset has them; those of {path} are used with "
                "--set cameras.optimise=true"
            )
            return dataset
        print(f"cameras: as refined, from {path}")
        return refined_dataset(dataset, self.path.parent)


def load_model(
    what: Path,
    scene: Path | None = None,
    overrides: Sequence[str] = (),
    background: Background | None = None,
    ignored: Sequence[str] = (),
) -> Model:
    """Load a file of Gaussians or the output folder of a fit.

    scene: a file, None: the folder's; overrides: KEY=VALUE; background: None: its own, or black.
    """
    path, config_path = what, scene
    if what.is_dir():
        config_path, path = scene or what / CONFIG, own_gaussians(what)
        require_results(what, path.name)
    config = None if config_path is None else load_open_config(config_path, overrides, background)
    if config is not None and what.is_dir() and scene is None:
        config = relocate_data(what, config, ("data.path",))
    gaussians = Gaussians.load(path)
    if config is not None:
        settings, default_background = config.model, config.data.background_rgb
    else:
        settings = ModelConfig(near=near_plane_of(gaussians)).with_3dgs_defaults()
        default_background = NAMED_COLORS["black"]
    # Precedence: overrides, the file's header, the configuration.
    given = {override.partition("=")[0].strip() for override in overrides}
    header = (gaussians.rendered_with or {}).items()
    left = {k: v for k, v in header if not given & {"model", f"model.{k}"}}
    values = from_ply_header(str(path), left)
    return Model(
        gaussians,
        settings.model_copy(update=values),
        default_background if background is None else background,
        config,
        ", ".join(ignored),
        path,
        tuple(values),
    )


def load_open_config(
    path: Path, overrides: Sequence[str], background: Background | None
) -> FitConfig:
    """Load a configuration, and resolve its defaults from the data."""
    if background is not None and not isinstance(background, Path):
        # Also composites photographs with alpha.
        overrides = [*overrides, f"data.background={list(background)}"]
    config = load_config(path, overrides)
    config = config.model_copy(update={"model": config.model.with_3dgs_defaults()})
    if not is_open(config):
        return config
    dataset = load_dataset(config.data_for_rendering, sections=config.sections)
    return resolve_defaults(config, dataset)
