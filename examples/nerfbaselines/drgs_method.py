"""drgs as a method of nerfbaselines, which trains and evaluates methods by one protocol.

``NERFBASELINES_REGISTER=examples/nerfbaselines/drgs_method.py`` registers it in an environment that
has both programs. ``--set KEY=VALUE`` takes drgs' keys, such as ``densify.strategy=mcmc``.

Images of nerfbaselines become a :class:`drgs.datasets.types.Dataset`; a checkpoint is a folder of
the Gaussians, the trainer's state and the configuration. Cameras are rendered with their lenses,
as the dataset has them: ``cameras.optimise`` refines the cameras of training views only.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path

import drgs  # comes first: it selects the LLVM that Dr.Jit will load

# isort: split

import mitsuba as mi
import numpy as np
from nerfbaselines import Method, MethodInfo, ModelInfo, camera_model_from_int, register
from plyfile import PlyData, PlyElement

from drgs.cameras.lens import LENSES, Lens
from drgs.cameras.viewpoints import Viewpoint
from drgs.cli.execution import select_variant
from drgs.config.load import config_from
from drgs.config.schema import FitConfig
from drgs.core.environment import VARIANTS
from drgs.core.errors import UserError
from drgs.datasets.images import compact_mask, compact_photograph, downscale_mask, downscaled_size
from drgs.datasets.types import Dataset, View
from drgs.initialization.defaults import resolve_defaults
from drgs.initialization.start import initial_gaussians
from drgs.integrator.scene import check_lenses, make_scene, render_views
from drgs.training.trainer import Trainer

ITERATIONS, ITERATIONS_BLENDER = 4500, 3000  # as ``drgs fit`` chooses for COLMAP and NeRF-synthetic

GAUSSIANS, STATE, CONFIG = "point_cloud_drgs.ply", "state.npz", "config.json"  # of a checkpoint

COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Order of nerfbaselines' distortion parameters."""

LENS_OF_MODEL = {
    "opencv": ("opencv", ("k1", "k2", "p1", "p2")),
    "full_opencv": ("opencv", COEFFICIENTS),
    "opencv_fisheye": ("fisheye", ("k1", "k2", "k3", "k4")),
}
"""Lenses of drgs by nerfbaselines' camera models, with the coefficients that these use."""

MODULE = "drgs_method"


class DrgsMethod(Method):
    """A fit of drgs, one training view an iteration."""

    def __init__(
        self,
        *,
        checkpoint: str | None = None,
        train_dataset: Mapping | None = None,
        config_overrides: Mapping[str, object] | None = None,
    ) -> None:
        """checkpoint: a folder of :meth:`save`; without ``train_dataset``, it is only rendered.

        config_overrides: values by drgs' keys; a checkpoint has its own.
        """
        if mi.variant() is None:
            select_variant(VARIANTS[0])
        self._checkpoint = None if checkpoint is None else Path(checkpoint)
        self._trainer, state = None, None
        if self._checkpoint is None:
            if train_dataset is None:
                raise UserError("DrgsMethod(): needs a checkpoint or a training dataset")
            config = make_config(train_dataset, config_overrides or {})
        else:
            config = FitConfig.model_validate_json((self._checkpoint / CONFIG).read_text())
            gaussians = drgs.Gaussians.load(self._checkpoint / GAUSSIANS)
            state = dict(np.load(self._checkpoint / STATE, allow_pickle=False))
        self._loaded_step = None if state is None else int(state["iteration"])
        if train_dataset is None:
            self.config = config
            self._scene = make_scene(gaussians, config.model, config.data.background_rgb)
            return
        with tempfile.TemporaryDirectory() as folder:
            dataset = make_dataset(train_dataset, config, Path(folder))
            self.config = resolve_defaults(config, dataset)
            check_lenses(self.config.model, dataset.train, "", "set model.projection=ewa")
            if state is None:
                gaussians = initial_gaussians(self.config, dataset)
        self._trainer = Trainer(self.config, dataset, gaussians)
        self._scene = self._trainer.scene
        if state is not None:
            self._trainer.restore(state)

    @classmethod
    def get_method_info(cls) -> MethodInfo:
        """Return what nerfbaselines reads for the method: images, points, all of its lenses."""
        return MethodInfo(
            method_id="",
            required_features=frozenset(("color", "points3D_xyz", "points3D_rgb")),
            supported_camera_models=frozenset(("pinhole", *LENS_OF_MODEL)),
            supported_outputs=("color",),
        )

    def get_info(self) -> ModelInfo:
        """Return the number of iterations, the checkpoint, and all values of the configuration."""
        values = self.config.model_dump(mode="json", exclude={"data": {"path"}, "output": True})
        return ModelInfo(
            num_iterations=self.config.iterations,
            loaded_step=self._loaded_step,
            loaded_checkpoint=None if self._checkpoint is None else str(self._checkpoint),
            hparams=dict(_by_key(values)),
            **self.get_method_info(),
        )

    def train_iteration(self, step: int) -> dict[str, float]:
        """Run iteration ``step``, which begins at 0; return loss and PSNR (dB) now and then.

        A step of drgs that averages several views runs their iterations at once.
        """
        trainer = self._trainer
        if trainer is None:
            raise UserError("DrgsMethod.train_iteration(): needs a training dataset")
        if trainer.iteration > step:
            return {}
        report = trainer.step()
        if not report.passes(self.config.output.history_every):
            return {}  # reading the numbers waits for the device
        trainer.check_iterations()
        return {
            "loss": report.loss,
            "psnr": report.psnr,
            "num_gaussians": float(report.num_gaussians),
        }

    def render(self, camera, *, options=None) -> dict[str, np.ndarray]:
        """Return ``color`` (H, W, 3) float32, display space, over the dataset's background."""
        del options
        if self._trainer is not None:
            self._trainer.sync_scene()
        (image,) = render_views(self._scene, (make_viewpoint(camera.item(), "rendered"),))
        return {"color": image.astype(np.float32)}

    def save(self, path: str) -> None:
        """Write a checkpoint; the same bytes for the same state."""
        folder = Path(path)
        folder.mkdir(parents=True, exist_ok=True)
        if self._trainer is None:
            for name in (GAUSSIANS, STATE, CONFIG):
                shutil.copy(self._checkpoint / name, folder / name)
            return
        header = self.config.model.approximations.non_default or None
        replace(self._trainer.gaussians(), rendered_with=header).save(folder / GAUSSIANS)
        np.savez(folder / STATE, **self._trainer.state())
        (folder / CONFIG).write_text(self.config.model_dump_json(indent=1))


def make_config(dataset: Mapping, overrides: Mapping[str, object]) -> FitConfig:
    """Return the configuration of a fit: drgs' recipe, with ``overrides`` by drgs' keys."""
    values = {"data": {"path": dataset["image_paths_root"] or "."}, "iterations": ITERATIONS}
    return config_from(values, "drgs", [f"{key}={value}" for key, value in overrides.items()])


def make_dataset(dataset: Mapping, config: FitConfig, folder: Path) -> Dataset:
    """Return the training views of a dataset of nerfbaselines; points are written to ``folder``.

    Transparent images are composited over ``data.background``, by default the dataset's, else
    white. Images wider than ``data.image_size`` are scaled down; nothing is by default.

    Raises :class:`UserError` for images that are not in display space.
    """
    metadata, images = dataset["metadata"], dataset["images"]
    if metadata.get("color_space", "srgb") != "srgb":
        raise UserError(f"dataset: must be of color space srgb, got {metadata['color_space']}")
    is_any_transparent = any(image.shape[2] == 4 for image in images)
    background = (1.0,) * 3 if is_any_transparent else (0.0,) * 3
    if config.data.background is not None:
        background = config.data.background_rgb
    elif (given := metadata.get("background_color")) is not None:
        background = tuple(float(level) / 255 for level in given)
    return Dataset(
        train=tuple(make_view(dataset, i, background, config) for i in range(len(images))),
        test=(),
        test_split="test",
        background=background,
        start_half_extent=None,
        description=f"{len(images)} views of nerfbaselines",
        point_cloud=None if config.data.ignore_points else write_points(dataset, folder),
    )


def make_view(
    dataset: Mapping, index: int, background: tuple[float, float, float], config: FitConfig
) -> View:
    """Return a training view; background: display space, under transparent pixels."""
    path, root = dataset["image_paths"][index], dataset["image_paths_root"]
    viewpoint = make_viewpoint(dataset["cameras"][index], os.path.relpath(path, root or "."))
    height, width = viewpoint.height, viewpoint.width
    pixels = dataset["images"][index][:height, :width]  # images of several sizes may be padded
    widest = config.data.image_size
    image, alpha = compact_photograph(pixels, background, widest)
    mask, masks = None, dataset["sampling_masks"]
    if masks is not None and not config.data.ignore_masks:
        counts = np.asarray(masks[index][:height, :width], np.float32)
        mask = compact_mask(downscale_mask(counts, widest))
    size = downscaled_size(width, height, widest)
    x, y = size[0] / width, size[1] / height
    return View(
        viewpoint.name,
        viewpoint.camera_to_world,
        viewpoint.fx * x,
        viewpoint.fy * y,
        viewpoint.cx * x,
        viewpoint.cy * y,
        *size,
        lens=None if config.data.ignore_distortion else viewpoint.lens,
        image=image,
        alpha=alpha,
        mask=mask,
    )


def make_viewpoint(camera, name: str) -> Viewpoint:
    """Return one camera of nerfbaselines: OpenCV axes, pixel centres at 0.5, as in drgs."""
    pose = np.eye(4)
    pose[:3] = camera.poses[:3, :4]
    intrinsics, size = map(float, camera.intrinsics), map(int, camera.image_sizes)
    return Viewpoint(name, pose, *intrinsics, *size, lens=make_lens(camera))


def make_lens(camera) -> Lens | None:
    """Return the lens of a camera; None for a pinhole, and for a distortion of zero."""
    model = camera_model_from_int(int(camera.camera_models))
    if model not in LENS_OF_MODEL:
        return None
    kind, names = LENS_OF_MODEL[model]
    values = dict(zip(COEFFICIENTS, map(float, camera.distortion_parameters), strict=False))
    given = {name: values[name] for name in names if values.get(name)}
    if not given and kind == "opencv":
        return None
    return LENSES.get(kind).value.from_coefficients(**given)


def write_points(dataset: Mapping, folder: Path) -> Path | None:
    """Write the points of a dataset to a PLY file, with their colours; None: it has none."""
    positions, colors = dataset["points3D_xyz"], dataset["points3D_rgb"]
    if positions is None or len(positions) == 0:
        return None
    kinds = [(axis, "f4") for axis in "xyz"]
    columns = list(np.asarray(positions, np.float32).T)
    if colors is not None:
        kinds += [(name, "u1") for name in ("red", "green", "blue")]
        columns += list(np.asarray(colors, np.uint8).T)
    vertices = np.empty(len(positions), kinds)
    for (name, _), column in zip(kinds, columns, strict=True):
        vertices[name] = column
    path = folder / "points.ply"
    PlyData([PlyElement.describe(vertices, "vertex")]).write(path)
    return path


def _by_key(values: Mapping, prefix: str = "") -> Iterator[tuple[str, object]]:
    """Yield values by dotted key; lists as text."""
    for name, value in values.items():
        if isinstance(value, Mapping):
            yield from _by_key(value, f"{prefix}{name}.")
        else:
            yield prefix + name, json.dumps(value) if isinstance(value, list) else value


if __name__ != MODULE:  # the file is run as a specification, and then imported for its class
    sys.path.append(str(Path(__file__).resolve().parent))
    register(
        {
            "id": "drgs",
            "method_class": f"{MODULE}:{DrgsMethod.__name__}",
            "backends_order": ["python"],
            "presets": {
                "blender": {
                    "@apply": [{"dataset": "blender"}],
                    "@description": "As many iterations as drgs chooses for cut-out objects.",
                    "iterations": ITERATIONS_BLENDER,
                }
            },
            "metadata": {
                "name": "drgs",
                "description": "3D Gaussian splatting in Dr.Jit and Mitsuba 3, on CPUs.",
            },
        }
    )
