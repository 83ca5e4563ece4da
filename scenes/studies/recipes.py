"""Fit the parts of a recipe alone, together, and taken out of it; takes hours.

The paper's recipe, and the whole new one; each ingredient of the new one alone on the paper's, and
the whole without it; the whole with what else was tried. ``--batches`` fits the whole recipe with
1 to 16 views a step, which all see as many views, and compares rules by which rates and decays
follow from the views a step. Scenes are the shipped one at 200x200 and, where ``--data`` names
their folder, the photographs of the fox. Results: ``recipes.md``.

Both ends are written out here, value by value, and not taken from the defaults of configurations:
those may change, and the comparison shall not.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from drgs.bench.output import machine, markdown_table
from drgs.config.changes import with_changes
from drgs.config.load import load_config
from drgs.config.schema import FitConfig, ModelConfig
from drgs.io.figures import new_figure, write_figure
from drgs.results.history import write_csv
from fits import SCENES as SCENES_FOLDER
from fits import add_case_option, fit, make_parser

Values = Mapping[str, object]
"""Values of a configuration, by names such as ``densify.every``."""


# ----------------------------------------------------------------------------------------------
# The paper's recipe
# ----------------------------------------------------------------------------------------------

PAPER: Values = {
    "init.start": "random",
    "init.opacity": 0.1,
    "model.sh_degree": 3,
    "model.alpha_cut": 1 / 255,
    "model.low_pass": 0.3,
    "model.antialiased": False,
    "model.smoothing": False,
    "optimizer.means_lr": 1.6e-4,
    "optimizer.means_lr_final": 1.6e-6,
    "optimizer.sh0_lr": 2.5e-3,
    "optimizer.shN_lr": 1.25e-4,
    "optimizer.opacities_lr": 0.05,
    "optimizer.scales_lr": 5e-3,
    "optimizer.quats_lr": 1e-3,
    "optimizer.decay": 1.0,
    "optimizer.decay_from": 0.5,
    "optimizer.views_per_step": 1,
    "optimizer.views": 1,
    "optimizer.views_from": 0.75,
    "loss.dssim_weight": 0.2,
    "densify.strategy": "adc",
    "densify.every": 100,
    "densify.max_gaussians": 1_000_000,
    "densify.adc.grad_threshold": 2e-4,
    "densify.adc.clone_scale": 0.01,
    "densify.adc.split_count": 2,
    "densify.adc.split_shrink": 1.6,
    "densify.adc.prune_opacity": 0.005,
    "densify.adc.prune_scale": 0.1,
    "densify.adc.reset_every": 3000,
    "densify.adc.reset_opacity": 0.01,
    "densify.budget.prune_opacity": 0.005,
    "densify.prune.to": None,
    "coarse": [],
}
"""``scenes/lego_paper.yml``, but for what depends on the scene or on the number of iterations."""


@dataclass(frozen=True)
class Scene:
    """A dataset, and the numbers that suit it."""

    name: str
    title: str
    config: Path  # for its data only
    iterations: int
    paper: Values  # what PAPER leaves open
    gaussians: int  # that growth to a number ends with
    carved: int | None = None  # points on the hull of its masks; None: there are no masks


LEGO = Scene(
    "lego",
    "the shipped scene at 200x200",
    SCENES_FOLDER / "lego_mini.yml",
    iterations=4000,
    paper={
        "data.image_size": 200,
        "init.num_points": 30_000,
        "model.sh_increase_every": 500,
        "densify.start": 300,
        "densify.stop": 2500,
        "densify.adc.white_background_reset": 300,
    },
    gaussians=50_000,
    carved=20_000,
)

FOX = Scene(
    "fox",
    "the photographs of the fox",
    SCENES_FOLDER / "fox.yml",
    iterations=2000,
    paper={
        "data.image_size": None,
        "init.num_points": 100_000,
        "model.sh_increase_every": 286,
        "densify.start": 143,
        "densify.stop": 1430,
        "densify.adc.white_background_reset": 143,
    },
    gaussians=45_000,
)

SCENES = (LEGO, FOX)
"""The paper's values there have the shortened schedule of fits before there was another recipe."""


def paper_config(scene: Scene) -> dict[str, object]:
    """Return all values of the paper's recipe on a scene."""
    numbers = {
        "densify.budget.gaussians": scene.gaussians,
        "densify.mcmc.gaussians": scene.gaussians,
    }
    return {**PAPER, **numbers, **scene.paper}


# ----------------------------------------------------------------------------------------------
# Ingredients
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ingredient:
    """A change of the paper's recipe, or of the whole new one."""

    name: str
    changes: Callable[[Scene], Values]  # empty where it makes no difference


def _start(scene: Scene) -> Values:
    if scene.carved is None:
        return {}
    return {"init.start": "masks", "init.num_points": scene.carved, "init.opacity": 0.3}


def _growth(scene: Scene) -> Values:
    """To a number that is larger than that of the points at the start."""
    start = {"init.num_points": round(0.4 * scene.gaussians)} if scene.carved is None else {}
    return {
        "densify.strategy": "budget",
        "densify.start": 200,
        "densify.stop": scene.iterations // 2,
        **start,
    }


def _harmonics(scene: Scene) -> Values:
    return {"optimizer.shN_lr": 1e-3, "model.sh_increase_every": scene.iterations // 40}


INGREDIENTS = (
    Ingredient(
        "antialiasing, low-pass 0.1",
        lambda scene: {"model.antialiased": True, "model.low_pass": 0.1},
    ),
    Ingredient("start on the masks' hull", _start),
    Ingredient("growth to a number", _growth),
    Ingredient(
        "higher rates that fall",
        lambda scene: {
            "optimizer.means_lr": 3.2e-4,
            "optimizer.means_lr_final": 3.2e-6,
            "optimizer.sh0_lr": 5e-3,
            "optimizer.scales_lr": 1e-2,
            "optimizer.quats_lr": 2e-3,
            "optimizer.decay": 0.1,
        },
    ),
    Ingredient("higher degrees early", _harmonics),
)
"""The parts of the whole recipe; no two change the same value."""

EXTRAS = (
    Ingredient(
        "half size for the first 35 %",
        lambda scene: {"coarse": [{"until": round(0.35 * scene.iterations), "factor": 2}]},
    ),
    Ingredient("steps of 4 views", lambda scene: {"optimizer.views": 4}),
    Ingredient(
        "a last phase down to 60 %",
        lambda scene: {"densify.prune.to": round(0.6 * scene.gaussians)},
    ),
    Ingredient("3D smoothing filter", lambda scene: {"model.smoothing": True}),
    Ingredient("mcmc instead of growth", lambda scene: {"densify.strategy": "mcmc"}),
)
"""Further changes that were tried in the whole recipe."""


# ----------------------------------------------------------------------------------------------
# Cases
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    """A recipe that is compared with another."""

    name: str
    ingredients: tuple[Ingredient, ...]  # later ones win
    reference: str | None = None  # the case that it is compared with
    varied: Ingredient | None = None  # what makes the difference to that; None: everything

    def differs_on(self, scene: Scene) -> bool:
        """Return whether it is another recipe than the one it is compared with."""
        return self.varied is None or bool(self.varied.changes(scene))


PAPERS = Case("the paper's", ())

WHOLE_RECIPE = Case("the whole", INGREDIENTS, PAPERS.name)

CASES = (
    PAPERS,
    WHOLE_RECIPE,
    *(Case(f"the paper's + {i.name}", (i,), PAPERS.name, i) for i in INGREDIENTS),
    *(
        Case(
            f"the whole without {i.name}",
            tuple(k for k in INGREDIENTS if k != i),
            WHOLE_RECIPE.name,
            i,
        )
        for i in INGREDIENTS
    ),
    *(Case(f"the whole + {i.name}", (*INGREDIENTS, i), WHOLE_RECIPE.name, i) for i in EXTRAS),
)


def config_of(case: Case, scene: Scene, data: Path | None = None) -> FitConfig:
    """Return a recipe's configuration on a scene; data: a folder instead of the default."""
    overrides = [] if data is None else [f"data.path={data}"]
    images = load_config(scene.config, overrides).data
    config = FitConfig.model_validate(
        {
            "data": images.model_dump(),
            "iterations": scene.iterations,
            "output": {"save_renders": False},
        }
    )
    values = paper_config(scene)
    for ingredient in case.ingredients:
        values.update(ingredient.changes(scene))
    return with_changes(config, values)


# ----------------------------------------------------------------------------------------------
# Steps of several views
# ----------------------------------------------------------------------------------------------

VIEWS_PER_STEP, COMPARED = (1, 2, 4, 8, 16), (4, 16)
"""Views a step with the rule that is built in, and with the others."""

RATES = ("means_lr", "means_lr_final", "sh0_lr", "shN_lr", "opacities_lr", "scales_lr", "quats_lr")


@dataclass(frozen=True)
class Rule:
    """Factor of the rates, and power of both beta, from the views a step, B."""

    name: str
    rate: Callable[[int], float]
    power: Callable[[int], float]


RULES = (
    Rule("rates x sqrt(B), beta^B", math.sqrt, float),
    Rule("rates x sqrt(B), beta", math.sqrt, lambda views: 1.0),
    Rule("rates x B, beta^B", float, float),
    Rule("rates and beta as they are", lambda views: 1.0, lambda views: 1.0),
)
"""The first one is built in."""


def batch_case(views: int, rule: Rule) -> Case:
    """Return the whole recipe with steps of several views."""

    def changes(scene: Scene) -> Values:
        optimizer = config_of(WHOLE_RECIPE, scene).optimizer
        rate, power = rule.rate(views) / math.sqrt(views), rule.power(views) / views
        return {
            "optimizer.views_per_step": views,
            **{f"optimizer.{name}": rate * getattr(optimizer, name) for name in RATES},
            **{f"optimizer.{n}": getattr(optimizer, n) ** power for n in ("beta_1", "beta_2")},
        }

    return Case(f"{views} a step: {rule.name}", (*INGREDIENTS, Ingredient(rule.name, changes)))


BATCH_CASES = (
    *(batch_case(views, RULES[0]) for views in VIEWS_PER_STEP),
    *(batch_case(views, rule) for views in COMPARED for rule in RULES[1:]),
)

# ----------------------------------------------------------------------------------------------
# Fits
# ----------------------------------------------------------------------------------------------


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


def fit_point(case: Case, scene: Scene, config: FitConfig, out: Path, threads: int | None) -> Point:
    """Fit a recipe, unless it is finished."""
    print(f"\n{scene.name}, {case.name}", flush=True)
    words = re.findall(r"\w+", case.name.replace("'", ""))
    metrics = fit(config, out / scene.name / "_".join(words), threads)
    model = ModelConfig.model_validate(metrics["config"]["model"])
    viewers = metrics["test"]["psnr"] if model.approximations.is_default else None
    return Point(
        scene=scene.name,
        case=case.name,
        seed=metrics["seed"],
        psnr=metrics["test"]["psnr"],
        ssim=metrics["test"]["ssim"],
        gaussians=metrics["num_gaussians"],
        iterations=metrics["iterations"],
        wall_s=metrics["wall_s"],
        viewers_psnr=metrics["viewers"]["psnr"] if "viewers" in metrics else viewers,
    )


def table(points: dict[str, Point]) -> str:
    """Format the fits of one scene, by case."""
    rows = []
    for case in (*CASES, *BATCH_CASES):
        if case.name not in points:
            continue
        p, reference = points[case.name], points.get(case.reference or "")
        papers = points.get(PAPERS.name)
        rows.append(
            [
                case.name,
                f"{p.psnr:.2f} dB",
                f"{p.psnr - reference.psnr:+.2f}" if reference else "",
                f"{p.ssim:.4f}",
                f"{p.gaussians:,}",
                f"{p.wall_s:.0f} s",
                f"{p.wall_s / papers.wall_s:.2f}" if papers else "",
                f"{p.viewers_psnr:.2f} dB" if p.viewers_psnr is not None else "",
            ]
        )
    header = ["recipe", "PSNR", "difference", "SSIM", "Gaussians", "time", "times the paper's"]
    return markdown_table([*header, "in usual viewers"], rows)


def write_plot(path: Path, points: dict[str, dict[str, Point]], quantity: str, label: str) -> None:
    """Plot PSNR over ``quantity``: a panel for each scene, a mark for each recipe.

    Stars are the two ends. An ingredient has one colour, and points up where it is added and down
    where it is taken away.
    """
    figure = new_figure(5 * len(points) + 4, 5)
    panels = figure.subplots(1, len(points), squeeze=False)[0]
    for panel, (title, found) in zip(panels, points.items(), strict=True):
        for number, case in enumerate(case for case in CASES if case.name in found):
            color, marker = f"C{number}", "o"
            if case.varied is None:
                color, marker = "black" if case == WHOLE_RECIPE else "tab:gray", "*"
            elif case.varied in INGREDIENTS:
                color = f"C{INGREDIENTS.index(case.varied)}"
                marker = "v" if case.reference == WHOLE_RECIPE.name else "^"
            point = found[case.name]
            style = {"color": color, "marker": marker, "linestyle": "none"}
            panel.plot([getattr(point, quantity)], [point.psnr], label=case.name, **style)
        panel.set(title=title, xlabel=label, ylabel="PSNR on the test views, dB")
        panel.grid(alpha=0.3)
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right upper", fontsize=8)
    write_figure(path, figure)


def main() -> None:
    """Fit; tables, a CSV file and plots."""
    parser = make_parser(__doc__, "recipes")
    parser.add_argument("--data", type=Path, metavar="DIR", help="the photographs of the fox")
    parser.add_argument("--batches", action="store_true", help="steps of several views instead")
    add_case_option(parser, [case.name for case in CASES])
    args = parser.parse_args()
    cases = BATCH_CASES if args.batches else [CASES[k - 1] for k in args.only]
    points: dict[str, dict[str, Point]] = {}
    for scene in SCENES:
        data = args.data if scene is FOX else None
        if not config_of(PAPERS, scene, data).data.path.is_dir():
            print(f"{scene.name} is left out; give its folder with --data DIR")
            continue
        for case in (case for case in cases if case.differs_on(scene)):
            config = config_of(case, scene, data)
            found = fit_point(case, scene, config, args.out, args.threads)
            points.setdefault(scene.title, {})[case.name] = found
    print(f"\n{machine()}")
    for title, found in points.items():
        print(f"\n{title}:\n\n{table(found)}")
    every = [point for found in points.values() for point in found.values()]
    rows = [list(vars(point).values()) for point in every]
    write_csv(args.out / "recipes.csv", list(Point.__dataclass_fields__), rows)
    if not args.batches:
        label = "time of all iterations, s"
        write_plot(args.out / "recipes_time.png", points, "wall_s", label)
        write_plot(args.out / "recipes_gaussians.png", points, "gaussians", "Gaussians")


if __name__ == "__main__":
    main()
