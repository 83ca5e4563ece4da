"""Measure the cost of each effect, on the bench scene.

Two tables, each relative to the case without an effect: images and derivatives with the
integrator's effects, and training iterations with a fit's. Both cases are timed in turns, so that
other load affects both. Medians and the kernels' numbers of operations are reported.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import drgs  # noqa: F401  (registers the plugins)
import drjit as dr
import mitsuba as mi
import numpy as np
from drgs.bench.output import columns_table, count_operations, machine, seconds, write_rows
from drgs.bench.scenes import (
    bench_camera,
    bench_gaussians,
    mitsuba_pose,
    mitsuba_sensor,
)
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.io.figures import new_figure, write_figure
from stages import Scene, trainer_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SIZE = 400  # px: width and height of all images
NUM_GAUSSIANS = 100_000
ROUNDS, QUICK_ROUNDS = 31, 3
ENVIRONMENT_SHAPE = (64, 128)  # (height, width) px of environment and background image


@dataclass(frozen=True)
class RenderingCase:
    """A rendering with at most one effect."""

    effect: str
    variant: str
    sensor: Mapping[str, object] = field(default_factory=dict)  # empty: perspective
    integrator: Mapping[str, object] = field(default_factory=dict)
    scene: Mapping[str, object] = field(default_factory=dict)
    sh_degree: int = 3
    smoothing: bool = False
    with_camera: bool = False  # differentiate pose and lens


@dataclass(frozen=True)
class FittingCase:
    """A training iteration with at most one effect."""

    effect: str
    variant: str
    changes: dict[str, object] = field(default_factory=dict)  # of the configuration
    view: tuple[str, ...] = ()  # the view's data besides colours


@dataclass(frozen=True)
class EffectCost:
    """Median times (ms) and operations of a case; ratios to the case without an effect."""

    effect: str
    variant: str
    forward_ms: float
    both_ms: float
    forward_ratio: float
    both_ratio: float
    operations: int
    operations_more: int


def main() -> None:
    """Measure all cases; write tables, CSV and a plot."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="10,000 Gaussians, few rounds")
    parser.add_argument("--out", type=Path, default=Path("out/studies/effects"), metavar="DIR")
    args = parser.parse_args()
    args.out.mkdir(parents=True, exist_ok=True)
    mi.set_variant("llvm_ad_rgb")
    count, rounds = (10_000, QUICK_ROUNDS) if args.quick else (NUM_GAUSSIANS, ROUNDS)
    gaussians = bench_gaussians(count)
    print(f"{machine()}\nbench scene, {count:,} Gaussians, {SIZE}x{SIZE}")
    rendered = measure(rendering_cases(), lambda case: CaseRenderer(case, gaussians), rounds)
    print(f"\n{table(rendered, 'rendered', 'rendered + derivatives')}", flush=True)
    fitted = measure(fitting_cases(), lambda case: CaseTrainer(case, gaussians), rounds)
    print(f"\n{table(fitted, '', 'training iteration')}")
    fitted = [replace(p, forward_ms=math.nan, forward_ratio=math.nan) for p in fitted]
    write_rows(args.out / "effects.csv", EffectCost, [*rendered, *fitted])
    write_figure(args.out / "effects.png", plot(rendered, fitted))


def rendering_cases() -> list[RenderingCase]:
    """Return the integrator's cases, the first without an effect."""
    camera = bench_camera(SIZE)
    calibrated = {"type": "calibrated", "fx": camera.fx, "fy": camera.fx}
    moving = calibrated | {"to_world_close": mitsuba_pose(camera, 0.02)}
    fox = {"k1": 0.0578421, "k2": -0.0805099, "p1": -0.000980296, "p2": 0.00015575}
    rational = fox | {"k3": 0.01, "k4": 0.02, "k5": -0.01, "k6": 0.005}
    fisheye = {"k1": 0.03, "k2": -0.01}
    prism = fisheye | {"p1": 0.001, "p2": -0.002, "sx1": 0.003, "sy1": -0.001}
    noise = np.random.default_rng(1).uniform(size=(*ENVIRONMENT_SHAPE, 3)).astype(np.float32)
    sky = {"type": "envmap", "bitmap": mi.Bitmap(noise)}
    behind = {"type": "bitmap", "bitmap": mi.Bitmap(noise), "raw": True}
    # An orthographic film is 2 units wide: the scale matches the other cameras.
    wide = mitsuba_pose(camera) @ mi.ScalarTransform4f().scale([1.4, 1.4, 1])
    focused = {"type": "thinlens", "aperture_radius": 0.05, "focus_distance": 3.2}

    def lens(kind: str, coefficients: dict[str, float]) -> dict[str, object]:
        return calibrated | {"lens": kind, **coefficients}

    exact = {"projection": "exact"}
    sensors = {
        "pinhole": {},
        "distortion: k1 k2 p1 p2": lens("opencv", fox),
        "fisheye: k1 k2": lens("fisheye", fisheye),
        "rolling shutter": moving | {"shutter": "rolling"},
    }
    return [
        RenderingCase("none", "none"),
        *(RenderingCase("exact projection", name, s, exact) for name, s in sensors.items()),
        *(RenderingCase("view dependence", f"SH degree {k}", sh_degree=k) for k in range(3)),
        RenderingCase("background", "environment", scene={"sky": sky}),
        RenderingCase("background", "image", integrator={"background": behind}),
        RenderingCase("lens", "distortion: k1 k2 p1 p2", lens("opencv", fox)),
        RenderingCase("lens", "distortion: k1 to k6, p1 p2", lens("opencv", rational)),
        RenderingCase("lens", "fisheye: k1 k2", lens("fisheye", fisheye)),
        RenderingCase("lens", "fisheye: k1 k2 p1 p2 sx1 sy1", lens("thin_prism_fisheye", prism)),
        RenderingCase("lens", "orthographic", {"type": "orthographic", "to_world": wide}),
        RenderingCase("depth of field", "thin lens", mitsuba_sensor(camera) | focused),
        RenderingCase("motion", "blur, 8 times", moving | {"shutter_samples": 8}),
        RenderingCase("motion", "rolling shutter", moving | {"shutter": "rolling"}),
        RenderingCase("antialiasing", "opacity compensation", integrator={"antialiased": True}),
        RenderingCase("antialiasing", "3D smoothing filter", smoothing=True),
        RenderingCase("camera refinement", "pose and focal lengths", calibrated, with_camera=True),
    ]


def fitting_cases() -> list[FittingCase]:
    """Return the cases of a fit, the first without an effect."""
    return [
        FittingCase("none", "none"),
        FittingCase("background", "random", {"data.random_background": True}, ("alpha",)),
        FittingCase("exposure and white balance", "", {"colors.lr": 1e-3}),
        FittingCase("masks", "", view=("mask",)),
        FittingCase("depth", "supervision", view=("depth",)),
        FittingCase("camera refinement", "poses", {"cameras.optimise": True}),
        FittingCase("antialiasing", "3D smoothing filter", {"model.smoothing": True}),
    ]


class CaseRenderer:
    """Renders the bench scene and its derivatives with respect to all parameters."""

    def __init__(self, case: RenderingCase, gaussians: Gaussians) -> None:
        """gaussians: numpy, SH of degree 3."""
        sensor = mitsuba_sensor(bench_camera(SIZE))
        if case.sensor:
            kept = {name: sensor[name] for name in ("to_world", "film", "sampler")}
            sensor = {**kept, **case.sensor}
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
        self.differentiated = [f"integrator.{name}" for name in PARAMETER_NAMES]
        if case.with_camera:
            self.differentiated += ["sensor.to_world", "sensor.fx", "sensor.fy"]
        for name in self.differentiated:
            dr.enable_grad(self.params[name])
        weights = np.random.default_rng(0).normal(size=(SIZE, SIZE, 3)).astype(np.float32)
        self.weights = mi.TensorXf(weights)

    def forward(self) -> None:
        """Render an image."""
        with dr.suspend_grad():
            dr.eval(self._render())
        dr.sync_thread()

    def forward_and_backward(self) -> None:
        """Render an image and its derivatives, or run an iteration."""
        for name in self.differentiated:
            dr.clear_grad(self.params[name])
        dr.backward(dr.sum(self._render() * self.weights, axis=None))
        dr.eval([dr.grad(self.params[name]) for name in self.differentiated])
        dr.sync_thread()

    def _render(self) -> mi.TensorXf:
        # Clears the render cache.
        self.params.set_dirty("integrator.means")
        self.params.update()
        return mi.render(self.scene, self.params, spp=1)


class CaseTrainer:
    """Runs training iterations on the bench scene with a fixed population."""

    def __init__(self, case: FittingCase, gaussians: Gaussians) -> None:
        """gaussians: numpy."""
        scene = Scene("bench", gaussians, bench_camera(SIZE))
        mask = np.ones((SIZE, SIZE), np.float32)
        mask[:, : SIZE // 4] = 0
        depth = np.full((SIZE, SIZE), 4, np.float32)  # of the box's middle
        extras = {name: depth if name == "depth" else mask for name in case.view}
        self.trainer = trainer_of(scene, case.changes, extras)

    def forward(self) -> None:
        """Do nothing: an iteration cannot be split."""

    def forward_and_backward(self) -> None:
        """Render an image and its derivatives, or run an iteration."""
        self.trainer.step()
        dr.sync_thread()


C = TypeVar("C", RenderingCase, FittingCase)
TimedCase = CaseRenderer | CaseTrainer


def measure(cases: Sequence[C], make: Callable[[C], TimedCase], rounds: int) -> list[EffectCost]:
    """Time each case and the first one in turns."""
    base, costs = make(cases[0]), []
    base_operations = operations(base)
    for case in cases:
        subject = make(case)
        count = operations(subject)
        calls = [f for s in (base, subject) for f in (s.forward, s.forward_and_backward)]
        times = np.array([[seconds(call) for call in calls] for _ in range(rounds)])
        milliseconds = 1e3 * np.median(times[:, 2:], axis=0)
        ratios = np.median(times[:, 2:] / times[:, :2], axis=0)
        numbers = *milliseconds.tolist(), *ratios.tolist(), count, count - base_operations
        costs.append(EffectCost(case.effect, case.variant, *numbers))
        print(f"{case.effect}, {case.variant}: x{ratios[1]:.2f}", flush=True)
    return costs


def operations(subject: TimedCase) -> int:
    """Count the operations of an image and its derivatives, or of an iteration; warms up."""
    for _ in range(2):
        subject.forward()
        subject.forward_and_backward()
    return count_operations(subject.forward_and_backward)


def table(prices: list[EffectCost], forward: str, both: str) -> str:
    """Format times and operations; an empty name ``forward`` omits the images' columns."""
    columns = [("effect", "{.effect}"), ("", "{.variant}")]
    if forward:
        columns += [(forward, "{.forward_ms:.1f} ms"), ("ratio", "{.forward_ratio:.2f}")]
    columns += [(both, "{.both_ms:.1f} ms"), ("ratio", "{.both_ratio:.2f}")]
    return columns_table([*columns, ("operations", "{.operations_more:+,}")], prices)


def plot(rendered: list[EffectCost], fitted: list[EffectCost]) -> Figure:
    """Plot a bar per effect: its additional time."""
    parts = {"image and derivatives": rendered[1:], "training iteration": fitted[1:]}
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


if __name__ == "__main__":
    main()
