"""``drgs bench speed``: drgs and other renderers side by side.

One process measures all implementations with the same Gaussians, camera and loss. Each round times
every implementation once, so that other load affects all of them. Medians and their ratios are
reported. ``--without-avx512`` measures kernels compiled for AVX2.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.bench.output import add_out, machine, markdown_table, time_in_turns, write_rows
from drgs.bench.scenes import bench_camera, bench_gaussians, mitsuba_sensor
from drgs.cli.commands import CommandParser
from drgs.config.schema import ModelConfig
from drgs.core.private import disable_avx512
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.scene import make_scene
from drgs.io.figures import new_figure, write_figure
from drgs.reference import splatting as reference
from drgs.results.folder import own_gaussians

if TYPE_CHECKING:
    from matplotlib.figure import Figure

IMAGE_SIZE_PX = 400
SHELL_STDS = 3.0  # extent of Mitsuba's ellipsoids, standard deviations (its default, and 3DGS's)
ROUNDS, QUICK_ROUNDS = 15, 5


@dataclass(frozen=True)
class Timing:
    """Median times of one implementation on one scene, seconds."""

    scene: str
    renderer: str
    forward: float
    forward_backward: float
    rounds: int


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.show_examples("%(prog)s --trained out/lego/point_cloud_drgs.ply")
    add_out(parser, run, "speed.csv", "speed.png")
    parser.add_argument("--quick", action="store_true", help="10,000 Gaussians only; two minutes")
    text = "compile for AVX2; only where Dr.Jit uses AVX-512"
    parser.add_argument("--without-avx512", action="store_true", help=text)
    text = "also measure this fitted scene (default: that of out/lego, if it exists)"
    path = own_gaussians(Path("out/lego"))
    parser.add_argument("--trained", type=Path, default=path, metavar="PLY", help=text)


def run(args: argparse.Namespace) -> None:
    """Measure all scenes; write tables, CSV and a plot."""
    mi.set_variant("llvm_ad_rgb")
    if args.without_avx512:
        disable_avx512()
    print(machine() + (", without AVX-512" if args.without_avx512 else ""))
    timings: list[Timing] = []
    for problem in make_problems(args.trained, args.quick):
        measured = measure(problem, QUICK_ROUNDS if args.quick else ROUNDS)
        timings += measured
        print(f"\n{problem.scene}\n\n{comparison_table(measured)}", flush=True)
    write_rows(args.out / "speed.csv", Timing, timings)
    *_, largest = (timing.scene for timing in timings if "trained" not in timing.scene)
    write_figure(args.out / "speed.png", plot([t for t in timings if t.scene == largest]))


@dataclass(frozen=True)
class Problem:
    """A scene, the input of every implementation."""

    scene: str
    gaussians: Gaussians  # numpy
    camera: reference.Camera
    weights: np.ndarray  # (H, W, 3): the loss is sum(weights * image) / (H W)


def make_problems(trained: Path, quick: bool) -> list[Problem]:
    """Return the bench scene at one or two sizes, and the trained one if it exists."""
    counts = (10_000,) if quick else (10_000, 100_000)
    scenes = {f"bench scene, {n:,}": bench_gaussians(n) for n in counts}
    if trained.exists():
        gaussians = Gaussians.load(trained)
        scenes[f"trained, {gaussians.num_gaussians:,}"] = gaussians
    else:
        print(f"{trained}: not there; fit a scene, or name one with --trained, to measure it")
    camera = bench_camera(IMAGE_SIZE_PX)
    weights = np.random.default_rng(0).normal(size=(camera.height, camera.width, 3))
    return [Problem(name, gaussians, camera, weights) for name, gaussians in scenes.items()]


@dataclass(frozen=True)
class TimedRenderer:
    """An implementation with a loaded scene; its functions return when the device has finished."""

    name: str
    forward: Callable[[], None]
    forward_backward: Callable[[], None]  # d sum(weights * image) / pixels by all parameters


def drgs_renderer(problem: Problem) -> TimedRenderer:
    """Return the ``splats`` integrator, called by ``mi.render``."""
    scene = make_scene(problem.gaussians, ModelConfig().with_3dgs_defaults(), (1.0, 1.0, 1.0))
    return _mitsuba_renderer("drgs", scene, problem, "integrator.")


def volprim_renderer(problem: Problem, shape: str) -> TimedRenderer:
    """Return Mitsuba's ``volprim_rf_basic`` on ``ellipsoids`` or ``ellipsoidsmesh``."""
    scene = mi.load_dict(volprim_scene(problem.gaussians, shape, 256))
    return _mitsuba_renderer(f"volprim_rf_basic, {shape}", scene, problem, "shapes.")


def volprim_scene(gaussians: Gaussians, shape: str, max_depth: int) -> dict[str, object]:
    """Return ``ellipsoids`` or ``ellipsoidsmesh`` as a scene without sensor, in display space."""
    quats_xyzw = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    quats_xyzw = np.roll(quats_xyzw, -1, axis=1)
    sh = np.concatenate([gaussians.sh0, gaussians.shN], axis=1)
    attributes = {
        "data": np.concatenate([gaussians.means, gaussians.scales, quats_xyzw], axis=1),
        "opacities": gaussians.opacities[:, None],
        "sh_coeffs": sh.reshape(len(sh), -1),
    }
    tensors = {name: mi.TensorXf(v.astype(np.float32)) for name, v in attributes.items()}
    integrator = {"type": "volprim_rf_basic", "srgb_primitives": False, "max_depth": max_depth}
    return {
        "type": "scene",
        "integrator": integrator,
        "emitter": {"type": "constant"},
        "shapes": {"type": shape, "extent": SHELL_STDS, **tensors},
    }


def _mitsuba_renderer(name: str, scene: mi.Scene, problem: Problem, prefix: str) -> TimedRenderer:
    camera = problem.camera
    sensor = mi.load_dict(mitsuba_sensor(camera) | {"near_clip": 1e-3})
    params = mi.traverse(scene)
    names = [prefix + name for name in (*PARAMETER_NAMES, "data", "opacities", "sh_coeffs")]
    names = [name for name in names if name in params]
    num_pixels = np.float32(camera.width * camera.height)
    weights = mi.TensorXf(problem.weights.astype(np.float32) / num_pixels)
    integrator = scene.integrator()

    def forward() -> None:
        integrator.parameters_changed([])  # clears the render cache
        with dr.suspend_grad():
            dr.eval(mi.render(scene, sensor=sensor, spp=1))
        dr.sync_thread()

    def forward_backward() -> None:
        integrator.parameters_changed([])
        values = [params[name] for name in names]
        dr.enable_grad(values)
        dr.clear_grad(values)
        image = mi.render(scene, params, sensor=sensor, spp=1)
        dr.backward(dr.sum(image * weights, axis=None))
        dr.eval(dr.grad(values))
        dr.sync_thread()
        dr.disable_grad(values)

    return TimedRenderer(name, forward, forward_backward)


def reference_renderer(problem: Problem) -> TimedRenderer:
    """Return the float64 numpy reference."""
    fields = [getattr(problem.gaussians, name) for name in PARAMETER_NAMES]
    gaussians, white = reference.Gaussians(*fields), np.ones(3)
    d_image = problem.weights / problem.weights[..., 0].size

    def forward() -> None:
        reference.render(gaussians, problem.camera, white)

    def forward_backward() -> None:
        reference.render(gaussians, problem.camera, white)
        reference.render_gradients(gaussians, problem.camera, white, d_image)

    return TimedRenderer("numpy reference, float64", forward, forward_backward)


def measure(problem: Problem, rounds: int) -> list[Timing]:
    """Time all implementations, interleaved."""
    renderers = [
        drgs_renderer(problem),
        volprim_renderer(problem, "ellipsoids"),
        volprim_renderer(problem, "ellipsoidsmesh"),
        reference_renderer(problem),
    ]
    times = time_in_turns([(each.forward, each.forward_backward) for each in renderers], rounds)
    timings = []
    for renderer, spent in zip(renderers, times, strict=True):
        forward, both = np.median(spent, axis=0).tolist()
        timings.append(Timing(problem.scene, renderer.name, forward, both, len(spent)))
    return timings


def comparison_table(timings: list[Timing]) -> str:
    """Format times of all implementations, and their ratios to the first."""
    ours = timings[0]
    header = ["400x400", "forward", "forward + backward", "ratio", "ratio, both", "rounds"]
    rows: list[list[object]] = []
    for timing in timings:
        forward, both = timing.forward, timing.forward_backward
        ratios = f"{forward / ours.forward:.1f}", f"{both / ours.forward_backward:.1f}"
        times = _milliseconds(forward), _milliseconds(both)
        rows.append([timing.renderer, *times, *ratios, timing.rounds])
    return markdown_table(header, rows)


def _milliseconds(duration: float) -> str:
    return f"{1e3 * duration:.1f} ms" if duration < 1 else f"{duration:.2f} s"


def plot(timings: list[Timing]) -> Figure:
    """Draw the time of an image with its derivatives, for the first renderers of a scene."""
    names = {timing.renderer: timing.forward_backward for timing in timings}
    ours = names["drgs"]
    shown = {
        "drgs": ours,
        "Mitsuba's volprim_rf_basic": min(v for k, v in names.items() if "volprim" in k),
        "drgs's numpy reference": names["numpy reference, float64"],
    }
    figure = new_figure(7.6, 2.4)
    axes = figure.subplots()
    bars = axes.barh(list(shown), list(shown.values()), 0.7, color=["C3", "0.7", "0.7"])
    labels = [
        _milliseconds(v) if v == ours else f"{_milliseconds(v)}: {v / ours:.0f}x"
        for v in shown.values()
    ]
    axes.bar_label(bars, labels, padding=5, fontsize=12)
    axes.tick_params(axis="y", labelsize=12, length=0)
    axes.set(xticks=[], xlim=(0, 1.3 * max(shown.values())))
    axes.invert_yaxis()
    axes.spines[:].set_visible(False)
    return figure
