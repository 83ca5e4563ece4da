"""What ``drgs.bench.recipes`` compares: the paper's recipe, and what a better one is made of.

Both ends are written out here, value by value, and not taken from the defaults of configurations:
those may change, and the comparison shall not. What an ingredient is called by stands in tables.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from drgs.config.changes import changed, with_iterations
from drgs.config.load import load_config
from drgs.config.schema import FitConfig

SCENES_FOLDER = Path(__file__).parents[2] / "scenes"

Values = Mapping[str, object]
"""Of a configuration, by names such as ``densify.every``."""


# ----------------------------------------------------------------------------------------------
# The paper's recipe
# ----------------------------------------------------------------------------------------------

PAPER: Values = {
    "init.start": "random",
    "init.opacity": 0.1,
    "init.scale": 1.0,
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
    "optimizer.epsilon": 1e-15,
    "loss.dssim_weight": 0.2,
    "loss.window": 11,
    "loss.sigma": 1.5,
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
    "densify.prune.to": None,
    "coarse": [],
}
"""``scenes/lego_paper.yml``, but for what depends on the scene or on the number of iterations."""


@dataclass(frozen=True)
class Scene:
    """What is fitted, and the numbers that suit it."""

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


def paper_of(scene: Scene) -> dict[str, object]:
    """Every value of the paper's recipe on a scene."""
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
"""Of the whole recipe; no two change the same value."""

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
"""What else was tried in the whole recipe."""


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

    def concerns(self, scene: Scene) -> bool:
        """Whether it is another recipe than the one it is compared with."""
        return self.varied is None or bool(self.varied.changes(scene))


PAPERS = Case("the paper's", ())

WHOLE = Case("the whole", INGREDIENTS, PAPERS.name)

CASES = (
    PAPERS,
    WHOLE,
    *(Case(f"the paper's + {i.name}", (i,), PAPERS.name, i) for i in INGREDIENTS),
    *(
        Case(f"the whole without {i.name}", tuple(k for k in INGREDIENTS if k != i), WHOLE.name, i)
        for i in INGREDIENTS
    ),
    *(Case(f"the whole + {i.name}", (*INGREDIENTS, i), WHOLE.name, i) for i in EXTRAS),
)


def config_of(case: Case, scene: Scene, data: Path | None = None) -> FitConfig:
    """The configuration of a recipe on a scene; data: its folder, if not the configuration's."""
    overrides = [] if data is None else [f"data.path={data}"]
    pictures = load_config(scene.config, overrides).data
    config = FitConfig.model_validate(
        {
            "data": pictures.model_dump(),
            "iterations": scene.iterations,
            "output": {"save_renders": False},
        }
    )
    values = paper_of(scene)
    for ingredient in case.ingredients:
        values.update(ingredient.changes(scene))
    return changed(config, values)


def shortened(config: FitConfig, iterations: int) -> FitConfig:
    """The same recipe in fewer iterations, to see that it works."""
    return with_iterations(config, min(iterations, config.iterations))
