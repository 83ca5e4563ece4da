"""``python -m drgs.bench recipes``: what each part of the recipe is worth.

The paper's recipe, and the whole new one; each ingredient of the new one alone on the paper's, and
the whole without it; the whole with what else was tried (``drgs.bench.ingredients``). The scenes
are the shipped one at 200x200 and, where its folder is there, the photographs of the fox. Each fit
is a run of ``drgs.fit`` in a process and a folder of its own. Interrupted fits go on, finished ones
are not repeated.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import re
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import mean
from typing import TYPE_CHECKING

from drgs import fit
from drgs.bench.ingredients import (
    CASES,
    INGREDIENTS,
    SCENES,
    SCENES_FOLDER,
    WHOLE,
    Case,
    Scene,
    config_of,
    shortened,
)
from drgs.bench.output import add_out, machine, markdown_table, own_files, write_csv
from drgs.cli.commands import CommandParser, at_least
from drgs.config.load import dump_config
from drgs.config.schema import FitConfig, ModelConfig
from drgs.core.errors import UserError
from drgs.io.figures import new_figure, write_figure
from drgs.results.files import METRICS

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

QUICK_ITERATIONS = 300

KEPT = SCENES_FOLDER / "measurements" / "recipes"
"""What the documents show."""

FOLDER = "recipes"
NAMES = ("recipes.csv", "recipes_time.png", "recipes_gaussians.png")


@dataclass(frozen=True)
class Point:
    """A finished fit."""

    scene: str
    case: str
    seed: int
    psnr: float  # dB, test views
    ssim: float
    gaussians: int
    iterations: int
    wall_s: float  # of all iterations
    viewers_psnr: float | None  # dB, as usual viewers show it; None: not measured


# ----------------------------------------------------------------------------------------------
# The command
# ----------------------------------------------------------------------------------------------


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.show_examples(
        "%(prog)s --scenes lego --only 1 2", "%(prog)s --data DIR --seeds 2 --keep"
    )
    add_out(parser, run, *(f"{FOLDER}/{name}" for name in NAMES))
    add_scenes(parser)
    parser.add_argument(
        "--only", type=int, nargs="+", metavar="K", choices=range(1, len(CASES) + 1),
        help="; ".join(f"{k}: {case.name}" for k, case in enumerate(CASES, 1)).replace("%", "%%"),
    )  # fmt: skip
    parser.add_argument(
        "--seeds", type=at_least(1, 100), default=1, metavar="N",
        help="fits of each recipe; tables show their mean and each of them (default: 1)",
    )  # fmt: skip
    parser.add_argument("--threads", type=int, metavar="N", help="(default: one a core)")
    parser.add_argument(
        "--keep", type=Path, nargs="?", const=KEPT, metavar="DIR",
        help=f"write table and plots there as well, for the documents (default: {KEPT})",
    )  # fmt: skip


def add_scenes(parser: CommandParser) -> None:
    """Add what is fitted, and how long."""
    parser.add_argument("--quick", action="store_true", help="a few hundred iterations")
    names = [scene.name for scene in SCENES]
    parser.add_argument(
        "--scenes", nargs="+", choices=names, default=names, metavar="SCENE",
        help="; ".join(f"{scene.name}: {scene.title}" for scene in SCENES) + " (default: all)",
    )  # fmt: skip
    parser.add_argument(
        "--data", type=Path, metavar="DIR", help="the photographs of the fox (default: data/fox)"
    )


def run(args: argparse.Namespace) -> None:
    """Fit what is asked for and not finished; tables, CSV and plots of all that is."""
    out = args.out / FOLDER
    folders = [out, *([args.keep] if args.keep else [])]
    with ExitStack() as blocks:
        if args.keep:
            blocks.enter_context(own_files(args.keep, NAMES))
        scenes = usable(SCENES, args.scenes, args.data)
        numbers = args.only or range(1, len(CASES) + 1)
        cases = [CASES[k - 1] for k in numbers]
        for scene in scenes:
            for seed in range(args.seeds):
                for case in (case for case in cases if case.concerns(scene)):
                    config = planned(case, scene, args, seed)
                    print(f"\n{scene.name}, {CASES.index(case) + 1}: {case.name}, seed {seed}")
                    fit_in_own_process(case, scene, config, out, args.threads)
        points = [
            point
            for scene in SCENES
            for case in CASES
            for point in points_of(case, scene, iterations_of(scene, args.quick), out)
        ]
        print(f"\n{machine()}\n\n{tables(points)}\n")
        for folder in folders:
            write(folder, points)


def usable(scenes: Sequence[Scene], names: Sequence[str], data: Path | None) -> list[Scene]:
    """Those that are asked for and whose pictures are there; says what is left out.

    data: of the fox, None: where its configuration has them.
    """
    found = []
    for scene in (scene for scene in scenes if scene.name in names):
        path = config_of(CASES[0], scene, data_of(scene, data)).data.path
        if path.is_dir():
            found.append(scene)
        elif data_of(scene, data) is not None:
            raise UserError(f"--data: must be the folder of {scene.title}, got {path}: not there")
        else:
            print(f"{scene.name} is left out: no folder {path}; give it with --data DIR")
    return found


def data_of(scene: Scene, data: Path | None) -> Path | None:
    """What ``--data`` says of a scene: the shipped one has its pictures."""
    return data if scene.name == "fox" else None


def iterations_of(scene: Scene, quick: bool) -> int:
    """Of each of its fits."""
    return min(QUICK_ITERATIONS, scene.iterations) if quick else scene.iterations


def planned(case: Case, scene: Scene, args: argparse.Namespace, seed: int) -> FitConfig:
    """The configuration of one fit."""
    config = config_of(case, scene, data_of(scene, args.data))
    config = shortened(config, iterations_of(scene, args.quick))
    return config.model_copy(update={"seed": seed})


def folder_of(case: Case, scene: Scene, iterations: int, out: Path) -> Path:
    """Where the fits of a recipe are written, each in a folder named by its seed."""
    words = re.findall(r"\w+", case.name.replace("'", ""))
    return out / scene.name / str(iterations) / "_".join(words)


def fit_in_own_process(
    case: Case, scene: Scene, config: FitConfig, out: Path, threads: int | None
) -> None:
    """Run, or go on with, one fit; once finished, do nothing."""
    folder = folder_of(case, scene, config.iterations, out) / str(config.seed)
    file = folder.with_suffix(".yml")
    file.parent.mkdir(parents=True, exist_ok=True)
    dump_config(config, file)
    arguments = [str(file), "--out", str(folder)]
    if threads is not None:
        arguments += ["--threads", str(threads)]
    sys.stdout.flush()
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        pool.submit(fit.main, arguments).result()


def points_of(case: Case, scene: Scene, iterations: int, out: Path) -> list[Point]:
    """The finished fits of a recipe, by their seeds."""
    found = []
    for path in folder_of(case, scene, iterations, out).glob(f"*/{METRICS}"):
        metrics = json.loads(path.read_text())
        found.append(
            Point(
                scene=scene.name,
                case=case.name,
                seed=metrics["seed"],
                psnr=metrics["test"]["psnr"],
                ssim=metrics["test"]["ssim"],
                gaussians=metrics["num_gaussians"],
                iterations=metrics["iterations"],
                wall_s=metrics["wall_s"],
                viewers_psnr=_viewers_psnr(metrics),
            )
        )
    return sorted(found, key=lambda point: point.seed)


def _viewers_psnr(metrics: dict) -> float | None:
    """As viewers show the fit that know no other approximations than the paper's."""
    if "viewers" in metrics:
        return metrics["viewers"]["psnr"]
    model = ModelConfig.model_validate(metrics["config"]["model"])
    return metrics["test"]["psnr"] if model.approximations.are_usual else None


# ----------------------------------------------------------------------------------------------
# What is written
# ----------------------------------------------------------------------------------------------


def write(folder: Path, points: Sequence[Point]) -> None:
    """CSV and plots."""
    table, time_plot, gaussians_plot = (folder / name for name in NAMES)
    header = [*Point.__dataclass_fields__, "times_the_papers"]
    rows = [[*vars(point).values(), times_the_papers([point], points)] for point in points]
    write_csv(table, header, rows)
    write_figure(time_plot, plot(points, "wall_s", "time of all iterations, s"))
    write_figure(gaussians_plot, plot(points, "gaussians", "Gaussians"))
    print(f"written: {table}, {time_plot}, {gaussians_plot}")


def times_the_papers(fits: Sequence[Point], points: Sequence[Point]) -> float | None:
    """The time of fits of one recipe, divided by that of the paper's; None: there is none."""
    papers = [p.wall_s for p in points if (p.scene, p.case) == (fits[0].scene, CASES[0].name)]
    return mean(p.wall_s for p in fits) / mean(papers) if papers else None


def tables(points: Sequence[Point]) -> str:
    """A table for each scene that has been fitted, below its title."""
    parts = []
    for scene in SCENES:
        of_scene = [point for point in points if point.scene == scene.name]
        if of_scene:
            title = f"{scene.title}, {of_scene[0].iterations:,} iterations"
            parts.append(f"{title[0].upper()}{title[1:]}:\n\n{table(of_scene)}")
    return "\n\n".join(parts)


def table(points: Sequence[Point]) -> str:
    """A row for each recipe, of the points of one scene."""
    header = [
        "recipe", "PSNR", "difference", "SSIM", "Gaussians", "time", "times the paper's",
        "in usual viewers",
    ]  # fmt: skip
    fits = {case.name: [p for p in points if p.case == case.name] for case in CASES}
    rows = []
    for case in (case for case in CASES if fits[case.name]):
        found = fits[case.name]
        times = times_the_papers(found, points)
        shown = [p.viewers_psnr for p in found if p.viewers_psnr is not None]
        rows.append(
            [
                case.name,
                _mean_and_each([p.psnr for p in found]),
                _difference(found, fits.get(case.reference, [])),
                f"{mean(p.ssim for p in found):.4f}",
                f"{mean(p.gaussians for p in found):,.0f}",
                f"{mean(p.wall_s for p in found):.0f} s",
                "" if times is None else f"{times:.2f}",
                f"{mean(shown):.2f} dB" if shown else "",
            ]
        )
    return markdown_table(header, rows)


def _mean_and_each(psnr: Sequence[float]) -> str:
    """In dB; of one fit, just that."""
    each = f" ({', '.join(f'{value:.2f}' for value in psnr)})" if len(psnr) > 1 else ""
    return f"{mean(psnr):.2f} dB{each}"


def _difference(fits: Sequence[Point], reference: Sequence[Point]) -> str:
    """In dB, of the means over the seeds that both have; nothing where there are none."""
    seeds = {p.seed for p in fits} & {p.seed for p in reference}
    if not seeds:
        return ""
    first, second = (mean(p.psnr for p in each if p.seed in seeds) for each in (fits, reference))
    return f"{first - second:+.2f}"


def plot(points: Sequence[Point], quantity: str, label: str) -> Figure:
    """PSNR over ``quantity`` of the points, a panel for each scene, a mark for each recipe."""
    scenes = [scene for scene in SCENES if any(p.scene == scene.name for p in points)]
    figure = new_figure(5 * max(1, len(scenes)) + 4, 5)
    panels = figure.subplots(1, max(1, len(scenes)), squeeze=False)[0]
    for scene, panel in zip(scenes, panels, strict=False):
        of_scene = [point for point in points if point.scene == scene.name]
        _draw(panel, of_scene, quantity)
        panel.set_title(scene.title)
    for panel in panels:
        panel.set(xlabel=label, ylabel="PSNR on the test views, dB")
        panel.grid(alpha=0.3)
    handles = {}
    for panel in panels:
        found, names = panel.get_legend_handles_labels()
        handles.update(zip(names, found, strict=True))
    names = [case.name for case in CASES if case.name in handles]
    if names:
        shown = [handles[name] for name in names]
        figure.legend(shown, names, loc="outside right upper", fontsize=8)
    return figure


def _draw(panel: Axes, points: Sequence[Point], quantity: str) -> None:
    """A mark for the mean of each recipe's fits.

    Stars are the two ends. An ingredient has one colour, and points up where it is added and down
    where it is taken away.
    """
    for case in CASES:
        found = [point for point in points if point.case == case.name]
        if not found:
            continue
        if case.varied is None:
            color, marker, size = ("black" if case == WHOLE else "tab:gray"), "*", 13
        elif case.varied in INGREDIENTS:
            marker = "v" if case.reference == WHOLE.name else "^"
            color, size = f"C{INGREDIENTS.index(case.varied)}", 7
        else:
            number = CASES.index(case) - len(CASES)
            color, marker, size = f"C{10 + number}", "o", 6
        x, y = mean(getattr(p, quantity) for p in found), mean(p.psnr for p in found)
        style = {"color": color, "marker": marker, "markersize": size, "linestyle": "none"}
        panel.plot([x], [y], label=case.name, **style)
