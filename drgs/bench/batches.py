"""``python -m drgs.bench batches``: what steps of several views cost in quality.

The whole recipe of ``drgs.bench.recipes`` with 1 to 16 views a step, which all see as many views;
and the rule by which rates and decays follow from the views a step (``optimizer.views_per_step``)
against others. Each fit is a run of ``drgs.fit`` in a process and a folder of its own. Interrupted
fits go on, finished ones are not repeated.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from drgs.bench.ingredients import (
    INGREDIENTS,
    SCENES,
    WHOLE,
    Case,
    Ingredient,
    Scene,
    Values,
    config_of,
)
from drgs.bench.output import add_out, machine, markdown_table, write_csv
from drgs.bench.recipes import (
    Point,
    add_scenes,
    fit_in_own_process,
    iterations_of,
    planned,
    points_of,
    usable,
)
from drgs.cli.commands import CommandParser
from drgs.config.schema import OptimizerConfig

VIEWS = (1, 2, 4, 8, 16)
"""A step."""

COMPARED = (4, 16)
"""With which rules are compared."""

FOLDER = "batches"

RATES = ("means_lr", "means_lr_final", "sh0_lr", "shN_lr", "opacities_lr", "scales_lr", "quats_lr")


@dataclass(frozen=True)
class Rule:
    """How rates and decays follow from the views a step, B."""

    name: str
    rate: Callable[[int], float]  # factor
    power: Callable[[int], float]  # of beta_1 and beta_2

    def values(self, optimizer: OptimizerConfig, views: int) -> Values:
        """What makes it of the rule that is built in."""
        rate = self.rate(views) / math.sqrt(views)
        power = self.power(views) / views
        return {
            **{f"optimizer.{name}": rate * getattr(optimizer, name) for name in RATES},
            **{f"optimizer.{n}": getattr(optimizer, n) ** power for n in ("beta_1", "beta_2")},
        }


RULES = (
    Rule("rates x sqrt(B), beta^B", math.sqrt, float),
    Rule("rates x sqrt(B), beta", math.sqrt, lambda views: 1.0),
    Rule("rates x B, beta^B", float, float),
    Rule("rates and beta as they are", lambda views: 1.0, lambda views: 1.0),
)
"""The first one is built in."""


def cases() -> list[Case]:
    """By the views a step, then by rule."""
    found = [_case(views, RULES[0]) for views in VIEWS]
    return found + [_case(views, rule) for views in COMPARED for rule in RULES[1:]]


def _case(views: int, rule: Rule) -> Case:
    def changes(scene: Scene) -> Values:
        values: Values = {"optimizer.views_per_step": views}
        if rule is RULES[0]:
            return values
        return values | rule.values(config_of(WHOLE, scene).optimizer, views)

    return Case(f"{views} a step: {rule.name}", (*INGREDIENTS, Ingredient(rule.name, changes)))


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.show_examples("%(prog)s --scenes lego", "%(prog)s --data DIR")
    add_out(parser, run, f"{FOLDER}/batches.csv")
    add_scenes(parser)
    parser.add_argument("--threads", type=int, metavar="N", help="(default: one a core)")


def run(args: argparse.Namespace) -> None:
    """Fit what is not finished; a table and a CSV file of all that is."""
    out = args.out / FOLDER
    for scene in usable(SCENES, args.scenes, args.data):
        for case in cases():
            print(f"\n{scene.name}, {case.name}")
            fit_in_own_process(case, scene, planned(case, scene, args, 0), out, args.threads)
    points = [
        point
        for scene in SCENES
        for case in cases()
        for point in points_of(case, scene, iterations_of(scene, args.quick), out)
    ]
    print(f"\n{machine()}\n\n{table(points)}\n")
    rows = [list(vars(point).values()) for point in points]
    write_csv(out / "batches.csv", Point.__dataclass_fields__, rows)
    print(f"written: {out / 'batches.csv'}")


def table(points: Sequence[Point]) -> str:
    """A row for each case, columns for each scene: PSNR of test views."""
    scenes = [scene for scene in SCENES if any(p.scene == scene.name for p in points)]
    rows = []
    for case in cases():
        views, rule = case.name.split(" a step: ")
        found = {p.scene: p for p in points if p.case == case.name}
        cells = [f"{found[s.name].psnr:.2f} dB" if s.name in found else "" for s in scenes]
        rows.append([views, rule, *cells])
    return markdown_table(["views a step", "rule", *(scene.title for scene in scenes)], rows)
