"""``python -m drgs.bench effects``: what each effect costs, on the bench scene.

Two tables. The first is of what the integrator simulates: a picture and its derivatives with an
effect against the same without it. The second is of what takes part in the iterations of a fit. An
effect and what it is compared with are timed in turns, so that whatever else the machine does meets
both; medians are reported, and the number of operations in their kernels.
"""

from __future__ import annotations

import argparse
import math
import statistics
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol, TypeVar

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.bench.output import add_out, machine, markdown_table, write_rows
from drgs.bench.scenes import (
    Scene,
    bench_camera,
    bench_gaussians,
    mitsuba_pose,
    mitsuba_sensor,
    trainer_of,
)
from drgs.bench.timing import seconds
from drgs.cli.commands import CommandParser
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.io.figures import new_figure, write_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZE = 400
"""px: width and height of all pictures."""

NUM_GAUSSIANS = 100_000

ROUNDS, QUICK_ROUNDS = 31, 3

ENVIRONMENT = (64, 128)
"""Rows and columns of the environment, and of the picture behind the splats."""


@dataclass(frozen=True)
class Case:
    """A picture with an effect, or without any."""

    effect: str
    variant: str
    sensor: dict[str, object] = field(default_factory=dict)  # instead of a perspective one
    integrator: dict[str, object] = field(default_factory=dict)
    scene: dict[str, object] = field(default_factory=dict)
    sh_degree: int = 3
    smoothing: bool = False
    of_camera: bool = False  # whether derivatives of the pose and the lens are asked for
    against: str = "none"  # variant that it is compared with


@dataclass(frozen=True)
class Price:
    """Medians, ms, and operations in the kernels; of the case, and of what it is compared with."""

    effect: str
    variant: str
    against: str
    forward_ms: float
    both_ms: float
    forward_ratio: float
    both_ratio: float
    operations: int
    operations_more: int


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.show_examples("%(prog)s --quick")
    add_out(parser, run, "effects.csv", "effects.png")
    parser.add_argument("--quick", action="store_true", help="10,000 Gaussians, few rounds")


def run(args: argparse.Namespace) -> None:
    """Measure all cases; write tables, CSV and a plot."""
    mi.set_variant("llvm_ad_rgb")
    count, rounds = (10_000, QUICK_ROUNDS) if args.quick else (NUM_GAUSSIANS, ROUNDS)
    gaussians = bench_gaussians(count)
    print(f"{machine()}\nbench scene, {count:,} Gaussians, {SIZE}x{SIZE}")
    rendered = measure(rendering_cases(), lambda case: Renderer(case, gaussians), rounds)
    print(f"\n{table(rendered, 'picture', 'picture + derivatives')}", flush=True)
    fitted = measure(fitting_cases(), lambda case: Fitter(case, gaussians), rounds)
    print(f"\n{table(fitted, '', 'training iteration')}")
    fitted = [replace(p, forward_ms=math.nan, forward_ratio=math.nan) for p in fitted]
    write_rows(args.out / "effects.csv", Price, [*rendered, *fitted])
    write_figure(args.out / "effects.png", plot(rendered, fitted))


# ----------------------------------------------------------------------------------------------
# What the integrator simulates
# ----------------------------------------------------------------------------------------------


def rendering_cases() -> list[Case]:
    """The first is what the others are compared with, unless they say otherwise."""
    camera = bench_camera(SIZE)
    focal = camera.fx
    calibrated = {"type": "calibrated", "fx": focal, "fy": focal}
    moving = calibrated | {"to_world_close": mitsuba_pose(camera, 0.02)}
    fox = {"k1": 0.0578421, "k2": -0.0805099, "p1": -0.000980296, "p2": 0.00015575}
    rational = fox | {"k3": 0.01, "k4": 0.02, "k5": -0.01, "k6": 0.005}
    fisheye = {"k1": 0.03, "k2": -0.01}
    prism = fisheye | {"p1": 0.001, "p2": -0.002, "sx1": 0.003, "sy1": -0.001}
    sky = {"type": "envmap", "bitmap": _bitmap()}
    # An orthographic film is 2 units wide: the camera is scaled to what the others see.
    wide = mi.ScalarTransform4f().scale([1.4, 1.4, 1])
    return [
        Case("none", "none"),
        *(Case("view dependence", f"SH degree {k}", sh_degree=k) for k in range(3)),
        Case("background", "environment", scene={"sky": sky}),
        Case(
            "background",
            "picture",
            integrator={"background": {"type": "bitmap", "bitmap": _bitmap(), "raw": True}},
        ),
        Case("lens", "distortion: k1 k2 p1 p2", calibrated | {"lens": "opencv", **fox}),
        Case("lens", "distortion: k1 to k6, p1 p2", calibrated | {"lens": "opencv", **rational}),
        Case("lens", "fisheye: k1 k2", calibrated | {"lens": "fisheye", **fisheye}),
        Case(
            "lens",
            "fisheye: k1 k2 p1 p2 sx1 sy1",
            calibrated | {"lens": "thin_prism_fisheye", **prism},
        ),
        Case(
            "lens",
            "orthographic",
            {"type": "orthographic", "to_world": mitsuba_pose(camera) @ wide},
        ),
        Case(
            "depth of field",
            "thin lens",
            mitsuba_sensor(camera)
            | {"type": "thinlens", "aperture_radius": 0.05, "focus_distance": 3.2},
        ),
        Case("motion", "blur, 8 times", moving | {"shutter_samples": 8}),
        Case("motion", "rolling shutter", moving | {"shutter": "rolling"}),
        Case("antialiasing", "opacity compensation", integrator={"antialiased": True}),
        Case("antialiasing", "3D smoothing filter", smoothing=True),
        Case("camera refinement", "pose and focal lengths", calibrated, of_camera=True),
    ]


def _bitmap() -> mi.Bitmap:
    return mi.Bitmap(np.random.default_rng(1).uniform(size=(*ENVIRONMENT, 3)).astype(np.float32))


class Renderer:
    """Pictures of the bench scene, and their derivatives in all parameters."""

    def __init__(self, case: Case, gaussians: Gaussians) -> None:
        """gaussians: numpy, SH of degree 3."""
        sensor = mitsuba_sensor(bench_camera(SIZE))
        if case.sensor:
            sensor = {name: sensor[name] for name in ("to_world", "film", "sampler")} | case.sensor
        uploaded = gaussians.to(mi.TensorXf)
        integrator = {
            "type": "splats",
            "background": [1.0, 1.0, 1.0],
            "sh_degree": case.sh_degree,
            **{name: getattr(uploaded, name) for name in PARAMETER_NAMES},
            **case.integrator,
        }
        if case.smoothing:
            integrator["smoothing"] = dr.full(mi.Float, 1e-3, gaussians.num_gaussians)
        self.scene = mi.load_dict(
            {"type": "scene", "integrator": integrator, "sensor": sensor, **case.scene}
        )
        self.params = mi.traverse(self.scene)
        names = [f"integrator.{name}" for name in PARAMETER_NAMES]
        if case.of_camera:
            names += ["sensor.to_world", "sensor.fx", "sensor.fy"]
        self.differentiated = names
        for name in names:
            dr.enable_grad(self.params[name])
        weights = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
        self.weights = mi.TensorXf(weights)

    def forward(self) -> None:
        """Render a picture."""
        with dr.suspend_grad():
            dr.eval(self._render())
        dr.sync_thread()

    def both(self) -> None:
        """And its derivatives."""
        for name in self.differentiated:
            dr.clear_grad(self.params[name])
        dr.backward(dr.sum(self._render() * self.weights, axis=None))
        dr.eval([dr.grad(self.params[name]) for name in self.differentiated])
        dr.sync_thread()

    def _render(self) -> mi.TensorXf:
        # Nothing of the last picture may be used again.
        self.params.set_dirty("integrator.means")
        self.params.update()
        return mi.render(self.scene, self.params, spp=1)


# ----------------------------------------------------------------------------------------------
# What takes part in a fit
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FittingCase:
    """A training iteration with an effect, or without any."""

    effect: str
    variant: str
    changes: dict[str, object] = field(default_factory=dict)  # of the configuration
    view: tuple[str, ...] = ()  # what the data has besides colours
    against: str = "none"


def fitting_cases() -> list[FittingCase]:
    """The first is what the others are compared with."""
    return [
        FittingCase("none", "none"),
        FittingCase("background", "random", {"data.random_background": True}, ("alpha",)),
        FittingCase("exposure and white balance", "", {"colors.lr": 1e-3}),
        FittingCase("masks", "", view=("mask",)),
        FittingCase("depth", "supervision", view=("depth",)),
        FittingCase("camera refinement", "poses", {"cameras.optimise": True}),
        FittingCase("antialiasing", "3D smoothing filter", {"model.smoothing": True}),
    ]


class Fitter:
    """Training iterations on the bench scene; the population stays."""

    def __init__(self, case: FittingCase, gaussians: Gaussians) -> None:
        """gaussians: numpy."""
        scene = Scene("bench", gaussians, bench_camera(SIZE))
        self.trainer = trainer_of(scene, case.changes, {name: _extra(name) for name in case.view})

    def forward(self) -> None:
        """There is no half iteration."""

    def both(self) -> None:
        """One iteration."""
        self.trainer.step()
        dr.sync_thread()


def _extra(name: str) -> np.ndarray:
    """What the data has of a view besides colours; depth: that of the box's middle."""
    values = np.ones((SIZE, SIZE), np.float32)
    if name == "depth":
        return 4 * values
    values[:, : SIZE // 4] = 0
    return values


# ----------------------------------------------------------------------------------------------
# Measuring
# ----------------------------------------------------------------------------------------------


class Measured(Protocol):
    """What is timed, ready to run."""

    def forward(self) -> None:
        """Render a picture."""

    def both(self) -> None:
        """Render one with its derivatives, or do an iteration."""


AnyCase = TypeVar("AnyCase", "Case", "FittingCase")


def measure(
    cases: Sequence[AnyCase], make: Callable[[AnyCase], Measured], rounds: int
) -> list[Price]:
    """Each case and the first one in turns."""
    base, prices = make(cases[0]), []
    base_operations = operations(base)
    for case in cases:
        subject = make(case)
        count = operations(subject)
        times: dict[str, list[float]] = {k: [] for k in ("f", "b", "base f", "base b")}
        for _ in range(rounds):
            for prefix, measured in (("base ", base), ("", subject)):
                times[f"{prefix}f"].append(seconds(measured.forward))
                times[f"{prefix}b"].append(seconds(measured.both))
        forward_ratio, both_ratio = (_ratio(times[k], times[f"base {k}"]) for k in ("f", "b"))
        prices.append(
            Price(
                effect=case.effect,
                variant=case.variant,
                against=case.against,
                forward_ms=1e3 * statistics.median(times["f"]),
                both_ms=1e3 * statistics.median(times["b"]),
                forward_ratio=forward_ratio,
                both_ratio=both_ratio,
                operations=count,
                operations_more=count - base_operations,
            )
        )
        print(f"{case.effect}, {case.variant}: x{both_ratio:.2f}", flush=True)
    return prices


def _ratio(times: list[float], base_times: list[float]) -> float:
    """Median over the rounds: those of a round were taken one after the other."""
    return statistics.median(t / base for t, base in zip(times, base_times, strict=True))


def operations(subject: Measured) -> int:
    """In all kernels of a picture and its derivatives, or of an iteration; warms up."""
    for _ in range(2):
        subject.forward()
        subject.both()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        subject.both()
        kernels = dr.kernel_history()
    return sum(k["operation_count"] for k in kernels if k["type"] == dr.KernelType.JIT)


def table(prices: list[Price], forward: str, both: str) -> str:
    """As the page of results holds it; without a name for pictures, there is no column of them."""
    header = ["effect", "", *([forward, "ratio"] if forward else []), both, "ratio"]
    rows = []
    for p in prices:
        first = [f"{p.forward_ms:.1f} ms", f"{p.forward_ratio:.2f}"] if forward else []
        more = f"{p.operations_more:+,}" if p.operations_more else "0"
        rows.append(
            [p.effect, p.variant, *first, f"{p.both_ms:.1f} ms", f"{p.both_ratio:.2f}", more]
        )
    return markdown_table([*header, "operations"], rows)


def plot(rendered: list[Price], fitted: list[Price]) -> Figure:
    """What each effect adds to the time, by bar."""
    parts = {"picture and derivatives": rendered[1:], "training iteration": fitted[1:]}
    heights = [len(prices) for prices in parts.values()]
    figure = new_figure(8, 0.28 * sum(heights) + 1.5)
    all_axes = figure.subplots(len(parts), sharex=True, height_ratios=heights)
    for axes, (title, prices) in zip(all_axes, parts.items(), strict=True):
        labels = [f"{p.effect}: {p.variant}" if p.variant else p.effect for p in prices]
        ratios = [p.both_ratio for p in prices]
        axes.barh(labels, [ratio - 1 for ratio in ratios], left=1)
        for row, ratio in enumerate(ratios):
            axes.text(max(ratio, 1) * 1.02, row, f"{ratio:.2f}", va="center", fontsize=8)
        axes.axvline(1, color="0.4", linewidth=1)
        axes.set(title=title, xscale="log", xlim=(0.8, 1.25 * max(p.both_ratio for p in rendered)))
        axes.set_xticks([1, 2, 4, 8], ["1", "2", "4", "8"])
        axes.minorticks_off()
        axes.invert_yaxis()
    all_axes[-1].set_xlabel("time, without the effect = 1")
    return figure
