"""Stages of a training iteration on the bench scene, and their work: what studies share.

:class:`StageClock` synchronizes with the device at the stages' borders and assigns Dr.Jit's kernel
history since the last border to the stage that ends. Borders are calls of functions that are
patched while the clock runs. Synchronization prevents overlap: the sum of the stages slightly
exceeds the time without a clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any
from unittest.mock import patch

import drgs  # noqa: F401  (registers the plugins)
import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np
from drgs.bench.scenes import device_camera
from drgs.config.changes import with_changes
from drgs.config.schema import FitConfig, ModelConfig
from drgs.core.arrays import types_of
from drgs.core.types import UInt32
from drgs.datasets.types import Dataset, View
from drgs.gaussians.parameters import Gaussians
from drgs.reference import splatting as reference
from drgs.splatting import order, rasterize, rendering
from drgs.splatting.grid import PIXELS, load_lane_row, make_lanes
from drgs.splatting.tiles import Cursor, Entries
from drgs.training.trainer import Trainer

STAGES = (
    "projection and SH",
    "binning",
    "compositing",
    "image and loss",
    "adjoint",
    "reduction",
    "projection and SH, adjoint",
    "optimizer and statistics",
)

COPIES = ("Memset", "Memcpy")  # entries of the kernel history that are not kernels
NUM_WARM_UP_STEPS = 3


@dataclass
class StageClock:
    """Milliseconds of each stage, and the entries of the kernel history."""

    kernel_ms: dict[str, float] = field(default_factory=dict)
    wall_ms: dict[str, float] = field(default_factory=dict)
    history: list[tuple[str, dict[str, Any]]] = field(default_factory=list)  # (stage, entry)
    started: float = field(default_factory=time.perf_counter)

    def end(self, stage: str) -> None:
        """Assign all kernels since the last call to ``stage``."""
        dr.sync_thread()
        wall_ms = 1e3 * (time.perf_counter() - self.started)
        entries = dr.kernel_history()
        self.history += [(stage, entry) for entry in entries]
        spent = sum(entry["execution_time"] for entry in entries)
        self.kernel_ms[stage] = self.kernel_ms.get(stage, 0.0) + spent
        self.wall_ms[stage] = self.wall_ms.get(stage, 0.0) + wall_ms
        self.started = time.perf_counter()  # excludes reading the history

    def num_kernels(self, stage: str) -> int:
        """Count the launched kernels of a stage."""
        return sum(s == stage and e["type"].name not in COPIES for s, e in self.history)


@contextmanager
def stage_clock() -> Iterator[StageClock]:
    """Run a clock that ends the renderer's stages.

    The caller ends what precedes the first stage, and what follows the last.
    """
    clock = StageClock()

    def wrap(function: Callable, before: str | None, after: str | None) -> Callable:
        def call(*arguments: object, **keywords: object) -> object:
            if before:
                clock.end(before)
            result = function(*arguments, **keywords)
            dr.eval(result)
            if after:
                clock.end(after)
            return result

        return call

    borders = [
        (rendering, "splat_table", None, "projection and SH"),
        (rendering, "bin_splats", None, "binning"),
        (order, "composite", None, "compositing"),
        (order, "composite_adjoint", "image and loss", None),
        (rasterize, "sum_entries", "adjoint", "reduction"),
        (rasterize, "splat_gradients", None, "reduction"),
        (rendering, "_as_tensors", None, "projection and SH, adjoint"),
    ]
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory), ExitStack() as patches:
        dr.sync_thread()
        dr.kernel_history_clear()
        for module, name, before, after in borders:
            timed = wrap(getattr(module, name), before, after)
            patches.enter_context(patch.object(module, name, timed))
        yield clock


@dataclass(frozen=True)
class Scene:
    """Gaussians and a camera."""

    name: str
    gaussians: Gaussians  # numpy
    camera: reference.Camera


def frame_of(scene: Scene) -> rendering.Frame:
    """Render the scene in single precision."""
    pipeline = rendering.Pipeline(scene.gaussians.sh_degree)
    camera = device_camera(scene.camera, llvm.Float)
    return rendering.render(scene.gaussians.to(llvm.TensorXf), camera, pipeline)


def view_of(scene: Scene) -> View:
    """Return the scene's image shifted by a pixel, for derivatives of realistic size."""
    camera = scene.camera
    _, *planes = frame_of(scene).planes()
    image = np.stack([np.array(p).reshape(camera.height, camera.width) for p in planes], axis=-1)
    to_world = np.eye(4)
    to_world[:3, :3], to_world[:3, 3] = camera.rotation.T, camera.center
    photograph = np.clip(np.roll(image, 1, axis=1), 0, 1).astype(np.float32)
    return View(
        "bench", to_world, camera.fx, camera.fy, camera.cx, camera.cy, camera.width, camera.height,
        image=photograph,
    )  # fmt: skip


def trainer_of(
    scene: Scene, changes: Mapping[str, object] = {}, extras: Mapping[str, np.ndarray] = {}
) -> Trainer:
    """Return a trainer on one view, with a fixed population whose statistics are gathered.

    changes: of :func:`bench_config`; extras: of the view, besides colours.
    """
    view = replace(view_of(scene), **extras)
    dataset = Dataset((view,), (view,), "bench", (1.0, 1.0, 1.0), None, "bench")
    config = bench_config(scene.gaussians)
    trainer = Trainer(with_changes(config, changes), dataset, scene.gaussians)
    trainer.iteration = 10  # all SH degrees are in use
    return trainer


def bench_config(gaussians: Gaussians) -> FitConfig:
    """Return the configuration of a fit that renders as 3DGS and keeps the population."""
    model = ModelConfig(sh_degree=gaussians.sh_degree, sh_increase_every=1).with_3dgs_defaults()
    values = {
        "data": {"path": "."},
        "model": model.model_dump(),
        "densify": {
            "start": 1_000_000,
            "stop": 1_000_001,
            "strategy": "adc",
            "adc": {"reset_every": 1_000_000},
        },
        "iterations": 2_000_000,
    }
    return FitConfig.model_validate(values)


def steps(trainer: Trainer, count: int) -> None:
    """Run ``count`` training iterations and synchronize."""
    for _ in range(count):
        trainer.step()
    dr.sync_thread()


def warm_trainer(scene: Scene) -> Trainer:
    """Return a trainer with compiled kernels."""
    trainer = trainer_of(scene)
    steps(trainer, NUM_WARM_UP_STEPS)
    return trainer


def clocked_step(trainer: Trainer) -> StageClock:
    """Time a training iteration by stage."""
    with stage_clock() as clock:
        report = trainer.step()
        dr.eval([(view.loss, view.squared_error) for view in report.views])
        clock.end("optimizer and statistics")
    return clock


@dataclass(frozen=True)
class Work:
    """Numbers of pairs that the compositing kernels visit."""

    entries: int  # (Gaussian, tile)
    micro_entries: int  # (Gaussian, micro-tile)
    evaluated: int  # (pixel, Gaussian) pairs whose alpha compositing computes
    useful: int  # pairs with alpha >= 1/255 at an unfinished pixel


def count_work(frame: rendering.Frame) -> Work:
    """Count the frame's entries and pairs."""
    composited, bins = frame.tiles, frame.tiles.bins
    t = types_of(bins.rows.Float)
    lanes = make_lanes(t.Float, bins.grid)
    stop = dr.gather(t.UInt32, composited.stop, lanes.micro_tile)
    entries = Entries(bins, lanes, stop)
    ends = load_lane_row(composited.ends, lanes.micro_tile, 1)
    model = bins.model.bind(lanes, bins.grid)

    def body(cursor: Cursor, visited: UInt32, useful: UInt32) -> tuple[Cursor, UInt32, UInt32]:
        entry, active = entries.current(cursor)
        geometry, _ = composited.records.load(entry, active)
        footprint = model.footprint(geometry, lanes, active)
        for pixel, alpha in enumerate(model.alphas(geometry, footprint)):
            useful = useful + dr.select((alpha.value > 0) & (entry < ends[pixel]), t.UInt32(1), 0)
        return entries.advance(cursor), visited + dr.select(active, t.UInt32(1), 0), useful

    zero = dr.zeros(t.UInt32, dr.width(lanes.tile))
    _, visited, useful = dr.while_loop(
        state=(entries.begin(), zero, t.UInt32(zero)),
        cond=lambda cursor, visited, useful: entries.pending(cursor),
        body=body,
    )
    dr.eval(visited, useful)
    return Work(
        entries=bins.num_entries,
        micro_entries=int(dr.sum(dr.popcnt(bins.masks))[0]),
        evaluated=int(dr.sum(visited)[0]) * PIXELS,
        useful=int(dr.sum(useful)[0]),
    )
