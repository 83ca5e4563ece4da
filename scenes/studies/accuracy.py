"""Measure the error and the time of each approximation, on a fit and on a stress scene.

Compares renderings of a trained and a stress scene (wide lens, large splats near the camera,
interpenetrating layers) with the most accurate form: the float64 numpy reference that evaluates
splats and harmonics along each pixel's ray, sorts all splats at each pixel, and cuts only alphas
below a millionth. What error budgets choose is measured like the other choices.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import drgs  # noqa: F401  (chooses libLLVM before Dr.Jit is imported)
import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np
import reference_rays
from drgs.accuracy.error_budget import Search
from drgs.accuracy.pipeline import pipeline_of
from drgs.bench.output import (
    count_operations,
    machine,
    markdown_table,
    time_in_turns,
    write_rows,
)
from drgs.bench.scenes import bench_camera, device_camera
from drgs.cameras.camera import Camera
from drgs.cli.ending import exit_on_user_error
from drgs.config.approximations import Approximations
from drgs.config.load import load_config
from drgs.core.errors import UserError
from drgs.datasets import load_dataset
from drgs.datasets.types import View
from drgs.effects.smoothing import bake_smoothing
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.error_budget import renderer_of
from drgs.io.figures import new_figure, write_figure
from drgs.reference import splatting as reference
from drgs.results import metrics
from drgs.results.folder import CONFIG, require_results, viewer_gaussians
from drgs.results.model_arguments import error_budget
from drgs.splatting import rendering

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PLOTS = ("accuracy.png", "accuracy_stress.png")  # of the given scene, and of the stress scene
ROUNDS, QUICK_ROUNDS = 9, 3
MARKER_PX = 15  # of the plot's marker of the default
FILM_SIZE_PX = 400  # film of scenes without cameras
CROP_SIZE_PX = 8  # side of the crops on which every pixel evaluates every splat
MIN_ALPHA = 1e-6  # alpha cut of the most accurate form

BUDGET = "error at most "  # begins the names of rungs that an error budget chooses
BUDGETS = (0.02, 0.01, 0.005)

UNCUT = {"alpha_cut": 0.0, "transmittance_stop": 0.0}
EXACT_PIXEL = {"projection": "exact", "order": "pixel"}


@dataclass(frozen=True)
class Rung:
    """A choice of approximations."""

    name: str
    approximations: Mapping[str, Any] = field(default_factory=dict)
    float64: bool = False


RUNGS = (
    Rung("default"),
    Rung("unscented", {"projection": "unscented"}),
    Rung("exact", {"projection": "exact"}),
    Rung("pixel order, window 4", {"order": "pixel"}),
    Rung("exact, pixel order, window 1", {**EXACT_PIXEL, "order_window": 1}),
    Rung("exact, pixel order, window 4", EXACT_PIXEL),
    Rung("exact, pixel order, window 16", {**EXACT_PIXEL, "order_window": 16}),
    Rung("alpha cut 1/64", {"alpha_cut": 1 / 64}),
    Rung("no alpha cut", {"alpha_cut": 0.0}),
    Rung("transmittance stop 1e-2", {"transmittance_stop": 1e-2}),
    Rung("no transmittance stop", {"transmittance_stop": 0.0}),
    Rung("extent 3 sigma", {"extent": 3.0}),
    Rung("no cut-offs", UNCUT),
    Rung("exact, pixel order (16), no cut-offs", {**EXACT_PIXEL, "order_window": 16, **UNCUT}),
    Rung("harmonics along each pixel's ray", {"sh_direction": "pixel"}),
    Rung("all of these", {**EXACT_PIXEL, "order_window": 16, "sh_direction": "pixel", **UNCUT}),
    Rung("default in float64", float64=True),
)


@dataclass(frozen=True)
class Subject:
    """Gaussians and their cameras."""

    name: str
    gaussians: Gaussians  # numpy
    cameras: list[reference.Camera]
    background: tuple[float, float, float]


@dataclass(frozen=True)
class AccuracyMeasurement:
    """Means over views, and the largest error, of a rung on a subject."""

    scene: str
    rung: str
    milliseconds: float  # forward, median, per view
    both_milliseconds: float  # forward and backward
    operations: int  # in the kernels of a forward pass
    psnr: float  # dB, against the most accurate form
    ssim: float
    largest_error: float

    @property
    def root_mean_square(self) -> float:
        """The root mean square error, in 0..1."""
        return 10 ** (-self.psnr / 20)


def main() -> None:
    """Entry point of the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_scene(parser)
    parser.add_argument("--views", type=int, default=3, help="test views of a fit (default: 3)")
    parser.add_argument(
        "--error",
        type=error_budget,
        nargs="+",
        default=BUDGETS,
        help=f"error budgets, see drgs render (default: {' '.join(map(str, BUDGETS))})",
    )
    parser.add_argument("--quick", action="store_true", help="one view, fewer rounds")
    parser.add_argument("--out", type=Path, default=Path("out/studies/accuracy"), metavar="DIR")
    args = parser.parse_args()
    with exit_on_user_error():
        run(args)


def add_scene(parser: argparse.ArgumentParser) -> None:
    """Add the argument that :func:`load_subject` reads."""
    parser.add_argument(
        "scene",
        nargs="?",
        default="out/lego",
        metavar="SCENE",
        help="a fit's output folder or a PLY file (default: out/lego)",
    )


def run(args: argparse.Namespace) -> None:
    """Measure both scenes; print tables, write CSV and plots."""
    subjects = [
        load_subject(Path(args.scene), 1 if args.quick else args.views),
        Subject("stress", *stress_scene(FILM_SIZE_PX), (0.0, 0.0, 0.0)),
    ]
    args.out.mkdir(parents=True, exist_ok=True)
    print(f"{machine()}")
    results = []
    for subject in subjects:
        accurate = [most_accurate(subject, camera, MIN_ALPHA) for camera in subject.cameras]
        error = check_on_crops(subject, accurate[0])
        print(
            f"\n{subject.name}: {subject.gaussians.num_gaussians:,} Gaussians, "
            f"{len(subject.cameras)} views; the most accurate form is within {error:.1e} of an "
            "uncut one on crops\n",
            flush=True,
        )
        rungs = [*RUNGS, *rungs_of_budgets(subject, args.error)]
        measured = measure(subject, accurate, rungs, QUICK_ROUNDS if args.quick else ROUNDS)
        results += measured
        print(table(measured), flush=True)
    write_rows(args.out / "accuracy.csv", AccuracyMeasurement, results)
    for subject, name in zip(subjects, PLOTS, strict=True):
        write_figure(args.out / name, plot([m for m in results if m.scene == subject.name]))


def stress_scene(size: int, seed: int = 0) -> tuple[Gaussians, list[reference.Camera]]:
    """Return a scene that is hard for the affine approximation and a global depth order.

    A 110 degree lens; two layers of flat discs that cross in the image's middle; large, faint
    splats close to the camera; a shell of splats around the scene.
    """
    rng = np.random.default_rng(seed)
    layer, near, shell = 700, 60, 1500

    def crossing(angle: float) -> tuple[np.ndarray, np.ndarray]:
        """Return discs on a plane through (0, 0, 3), rotated about the vertical axis."""
        u, v = rng.uniform(-3, 3, layer), rng.uniform(-2, 2, layer)
        means = np.stack([u * np.cos(angle), v, 3 + u * np.sin(angle)], axis=-1)
        # About y by -angle: the disc's thin axis, z, becomes the plane's normal.
        quat = [np.cos(-angle / 2), 0, np.sin(-angle / 2), 0]
        return means, np.tile(quat, (layer, 1))

    directions = rng.normal(size=(shell, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    close = rng.normal(size=(near, 3)) * [0.8, 0.8, 0.3] + [0, 0, 1.2]
    close[:, 2] = np.maximum(close[:, 2], 0.4)
    (first, turned), (second, turned_back) = crossing(0.7), crossing(-0.7)
    means = [first, second, close, directions * rng.uniform(5, 8, (shell, 1))]
    quats = [turned, turned_back, rng.normal(size=(near, 4)), rng.normal(size=(shell, 4))]
    scales = [np.tile([0.15, 0.15, 0.004], (2 * layer, 1))]
    scales += [rng.uniform(0.08, 0.4, (near, 3)), rng.uniform(0.1, 0.6, (shell, 3))]
    opacities = [rng.uniform(0.5, 0.98, 2 * layer), rng.uniform(0.05, 0.3, near)]
    opacities = np.concatenate([*opacities, rng.uniform(0.3, 0.9, shell)])
    colors = [np.tile(color, (layer, 1)) for color in ([0.9, 0.35, 0.1], [0.1, 0.45, 0.85])]
    colors = np.concatenate([*colors, rng.uniform(0, 1, (near + shell, 3))])
    colors = np.clip(colors + rng.normal(0, 0.08, colors.shape), 0, 1)
    values = {
        "means": np.concatenate(means),
        "quats": np.concatenate(quats),
        "log_scales": np.log(np.concatenate(scales)),
        "logit_opacities": np.log(opacities / (1 - opacities)),
        "sh0": ((colors - 0.5) / reference.C_00)[:, None],
        "shN": rng.normal(0, 0.05, (len(colors), 15, 3)),
    }
    gaussians = Gaussians(**{name: value.astype(np.float32) for name, value in values.items()})
    focal = float(np.float32(size / 2 / np.tan(np.radians(110) / 2)))
    principal_point = size / 2, size / 2
    camera = reference.Camera(np.eye(3), np.zeros(3), focal, focal, *principal_point, size, size)
    return gaussians, [camera]


def rungs_of_budgets(subject: Subject, budgets: Sequence[float]) -> list[Rung]:
    """Return what error budgets choose for the subject's views; print each choice, or why not."""
    cameras = [device_camera(camera, llvm.Float) for camera in subject.cameras]
    gaussians, rungs = subject.gaussians.to(llvm.TensorXf), []
    renderer = renderer_of(gaussians, Approximations(), gaussians.sh_degree, subject.background)
    search = Search(renderer, cameras)
    for budget in budgets:
        try:
            report = search.choose(budget)
        except ValueError as refusal:
            print(f"error {refusal}")
            continue
        print(report.line(), flush=True)
        rungs.append(Rung(f"{BUDGET}{budget:g}", report.chosen.changes))
    return rungs


def load_subject(path: Path, num_views: int) -> Subject:
    """Load a fit's folder with evenly spaced test views, or a PLY file with the bench camera.

    A folder's Gaussians for viewers, fitted to the defaults, come first. A 3D smoothing filter is
    baked into the Gaussians. Raises UserError for views other than pinholes at rest.
    """
    if not path.is_dir():
        camera = bench_camera(FILM_SIZE_PX)
        return Subject(path.stem, bake_smoothing(Gaussians.load(path)), [camera], (1.0, 1.0, 1.0))
    ply, config_file = viewer_gaussians(path), path / CONFIG
    require_results(path, ply.name)
    config = load_config(str(config_file), [])
    gaussians = bake_smoothing(Gaussians.load(ply))
    dataset = load_dataset(config.data).relative_to(gaussians.origin)
    views = dataset.test[:: max(1, len(dataset.test) // num_views)][:num_views]
    _check_pinholes(views, config_file, ply)
    cameras = [camera_of(view, config.model.near_plane) for view in views]
    return Subject(path.name, gaussians, cameras, dataset.background)


def _check_pinholes(views: Sequence[View], config_file: Path, ply: Path) -> None:
    for view in views:
        if view.lens is not None or view.motion is not None:
            has = "lens distortion" if view.lens is not None else "motion"
            raise UserError(
                f"{config_file}: view {view.name} has {has}, expected pinhole cameras at rest, the "
                f"only ones that the most accurate form has; give {ply} instead, which is seen by "
                "a camera of the benchmark's own"
            )


def camera_of(view: View, near: float) -> reference.Camera:
    """Return the camera of a photograph, rounded to single precision."""
    pose = view.camera_to_world.astype(np.float32)
    fx, fy, cx, cy = (float(np.float32(v)) for v in (view.fx, view.fy, view.cx, view.cy))
    rotation, center = pose[:3, :3].T, pose[:3, 3]
    return reference.Camera(rotation, center, fx, fy, cx, cy, view.width, view.height, near)


@dataclass(frozen=True)
class RungRenderer:
    """A rung, ready to render one view."""

    rung: Rung
    gaussians: Gaussians  # on the device
    camera: Camera
    background: tuple[float, float, float]

    @staticmethod
    def from_rung(rung: Rung, subject: Subject, camera: reference.Camera) -> RungRenderer:
        """Return the renderer of a subject in one of the accuracies."""
        Float = llvm.Float64 if rung.float64 else llvm.Float
        gaussians = subject.gaussians.to(llvm.TensorXf64 if rung.float64 else llvm.TensorXf)
        return RungRenderer(rung, gaussians, device_camera(camera, Float), subject.background)

    def frame(self) -> rendering.Frame:
        """Render and synchronize."""
        approximations = Approximations(**self.rung.approximations)
        pipeline = pipeline_of(approximations, self.gaussians.sh_degree)
        frame = rendering.render(self.gaussians, self.camera, pipeline)
        dr.eval(frame.planes())
        dr.sync_thread()
        return frame

    def image(self) -> np.ndarray:
        """Return (H, W, 3) float64, display space, not clamped."""
        shape = self.camera.height, self.camera.width
        T, *color = (np.array(p, np.float64).reshape(shape) for p in self.frame().planes())
        return np.stack(color, axis=-1) + T[..., None] * np.array(self.background)

    def forward_backward(self) -> None:
        """Differentiate the sum of all planes."""
        frame = self.frame()
        ones = dr.ones(type(self.camera.near), self.camera.width * self.camera.height)
        gradients = rendering.frames_adjoint(self.gaussians, [frame], [[ones] * 4])
        dr.eval(gradients.parameters)
        dr.sync_thread()


def most_accurate(
    subject: Subject,
    camera: reference.Camera,
    min_alpha: float,
    region: tuple[slice, slice] | None = None,
) -> np.ndarray:
    """Return the most accurate image, or its region (rows, columns)."""
    gaussians = reference.Gaussians(*(getattr(subject.gaussians, n) for n in PARAMETER_NAMES))
    model = reference_rays.ImageModel(
        projection="exact",
        order="pixel",
        sh_direction="pixel",
        alpha_cut=min_alpha,
        transmittance_stop=0.0,
    )
    return reference_rays.render(gaussians, camera, subject.background, model, region).image


def check_on_crops(subject: Subject, accurate: np.ndarray) -> float:
    """Return the largest difference of three crops from uncut ones."""
    camera, size, errors = subject.cameras[0], CROP_SIZE_PX, []
    for x, y in ((0.5, 0.5), (0.35, 0.6), (0.6, 0.35)):
        column, row = int(x * (camera.width - size)), int(y * (camera.height - size))
        region = slice(row, row + size), slice(column, column + size)
        uncut = most_accurate(subject, camera, 0.0, region)
        errors.append(np.abs(uncut - accurate[region]).max())
    return max(errors)


def measure(
    subject: Subject, accurate: Sequence[np.ndarray], rungs: Sequence[Rung], rounds: int
) -> list[AccuracyMeasurement]:
    """Measure errors of all rungs, and their times on the first view, in turns."""
    renderers = [RungRenderer.from_rung(rung, subject, subject.cameras[0]) for rung in rungs]
    operations = [count_operations(each.frame) for each in renderers]  # compiles the kernels
    times = time_in_turns([(each.frame, each.forward_backward) for each in renderers], rounds)
    results = []
    for rung, count, spent in zip(rungs, operations, times, strict=True):
        images = [
            RungRenderer.from_rung(rung, subject, camera).image() for camera in subject.cameras
        ]
        pairs = list(zip(images, accurate, strict=True))
        quality = metrics.mean_quality(pairs)
        results.append(
            AccuracyMeasurement(
                subject.name,
                rung.name,
                *(1e3 * np.median(spent, axis=0)).tolist(),
                operations=count,
                psnr=quality.psnr,
                ssim=quality.ssim,
                largest_error=max(np.abs(image - exact).max() for image, exact in pairs),
            )
        )
    return results


def pareto_front(results: Sequence[AccuracyMeasurement]) -> list[AccuracyMeasurement]:
    """Return the Pareto-optimal approximations in time and PSNR, fastest first."""
    front: list[AccuracyMeasurement] = []
    for m in sorted(results, key=lambda m: (m.milliseconds, -m.psnr)):
        if not front or m.psnr > front[-1].psnr:
            front.append(m)
    return front


def table(results: Sequence[AccuracyMeasurement]) -> str:
    """Format all rungs; times relative to the first."""
    first, front = results[0], pareto_front(results)
    header = [first.scene, "forward", "forward + backward", "operations", "PSNR", "SSIM"]
    rows = [
        [
            f"{m.rung}{' *' if m in front else ''}",
            f"{m.milliseconds:.0f} ms, {m.milliseconds / first.milliseconds:.2f}x",
            f"{m.both_milliseconds:.0f} ms, {m.both_milliseconds / first.both_milliseconds:.2f}x",
            f"{m.operations:,}",
            f"{m.psnr:.1f} dB",
            f"{m.ssim:.5f}",
            f"{m.largest_error:.2g}",
        ]
        for m in results
    ]
    table = markdown_table([*header, "largest error"], rows)
    return f"{table}\n\n* on the Pareto front"


def plot(results: Sequence[AccuracyMeasurement]) -> Figure:
    """Plot error over time of a scene; only the default and the Pareto front have names."""
    from matplotlib.ticker import NullLocator

    default = results[0]
    front = pareto_front([m for m in results if not m.rung.startswith(BUDGET)])
    figure = new_figure(7.6, 4.2)
    axes = figure.subplots()

    def point(m: AccuracyMeasurement) -> tuple[float, float]:
        return m.milliseconds / default.milliseconds, 255 * m.root_mean_square

    times, errors = zip(*map(point, results), strict=True)
    axes.set(
        xscale="log", xlim=(min(times) / 4, max(times) * 1.5), xticks=(1, 10, 100),
        xlabel="time of a frame: times that of the default",
        yscale="log", ylim=(min(errors) / 1.3, max(errors) * 1.3), yticks=(0.5, 1, 2, 5, 10),
        ylabel="error: steps of 8-bit colour",
    )  # fmt: skip
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_locator(NullLocator())
    axes.spines[["top", "right"]].set_visible(False)
    axes.plot(times, errors, "o", color="0.8", markersize=5)
    axes.plot(*zip(*map(point, front), strict=True), "o-", color="C0", markersize=8, alpha=0.6)
    axes.plot(*point(default), "o", color="C3", markersize=12)
    for m in results:
        if m.rung.startswith(BUDGET):
            budget = 255 * float(m.rung.removeprefix(BUDGET))
            axes.plot(*point(m), "s", color="C2", markersize=7)
            axes.plot([point(m)[0]] * 2, [point(m)[1], budget], "-_", color="C2", linewidth=1)
    style = {"textcoords": "offset points", "fontsize": 10, "va": "center"}
    names = [
        axes.annotate(
            "default", point(default), (-12, -3), ha="right", color="C3", weight="bold", **style
        )
    ]
    for m in front:
        pixels = np.subtract(*axes.transData.transform([point(m), point(default)]))
        if np.hypot(*pixels) > MARKER_PX:
            name = axes.annotate(m.rung, point(m), (10, 5), color="C0", **style)
            here = name.get_window_extent()
            if any(here.overlaps(other.get_window_extent()) for other in names):
                name.remove()
            else:
                names.append(name)
    return figure


if __name__ == "__main__":
    main()
