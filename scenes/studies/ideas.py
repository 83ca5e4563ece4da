"""Fit what was thought of to show test views better, or in less time; takes hours.

Each idea is added to the recipe that the study ended with, or, if it is a part of that one, left
out of it: on the shipped scene and the original Lego at 200x200, and on photographs. ``--data``
names the folder of those that are not shipped. Results: ``ideas.md``.

An idea is other values, or a change of a trainer between its iterations. Those of the second kind
are here alone, because none of them helped. The recipe is written out, so that later defaults do
not change the comparison.
"""

from __future__ import annotations

import csv
import importlib
import json
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

import drgs  # noqa: F401  first: finds libLLVM
import drjit as dr
import mitsuba as mi
import numpy as np
from drgs.accuracy.pipeline import pipeline_of
from drgs.bench.output import machine, markdown_table, write_rows
from drgs.cameras.camera import Camera
from drgs.cli.execution import select_variant
from drgs.config.changes import with_changes
from drgs.config.load import load_config
from drgs.config.schema import FitConfig
from drgs.core.adam import LeanAdam, NesterovAdam
from drgs.core.constants import SH_C0
from drgs.core.types import Float, UInt32
from drgs.datasets import load_dataset
from drgs.datasets.types import View, evenly_spaced
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.initialization.defaults import resolve_defaults
from drgs.initialization.start import initial_gaussians
from drgs.results.folder import HISTORY
from drgs.results.metrics import psnr
from drgs.splatting.rendering import color_features, depth_feature, render
from drgs.training.density.budget import GROWTH_SHARE, GrowthToNumber
from drgs.training.density.strategy import DensityReport, StepInfo
from drgs.training.losses import Loss, LossTerm, PhotometricLoss
from drgs.training.optimizer import Population
from drgs.training.steps import ResolutionPhase
from drgs.training.trainer import Trainer
from fits import SCENES as SCENES_FOLDER
from fits import add_case_option, make_parser, write_curves
from scipy.ndimage import distance_transform_edt
from scipy.special import expit, logit
from typing_extensions import override

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Values = Mapping[str, object]
Correction = Callable[[np.ndarray], np.ndarray]
"""Values of a configuration, by names such as ``densify.every``."""

ITERATIONS, NUM_TRAINING_VIEWS = 2000, 15
"""Of a fit; and training views that its training PSNR is measured on."""

RECIPE: Values = {
    "optimizer.means_lr": 3.2e-4,
    "optimizer.means_lr_final": 3.2e-6,
    "optimizer.sh0_lr": 5e-3,
    "optimizer.shN_lr": 1e-3,
    "optimizer.opacities_lr": 0.05,
    "optimizer.quats_lr": 2e-3,
    "optimizer.decay": 0.03,
    "optimizer.decay_from": 0.75,
    "densify.every": 100,
    "densify.budget.prune_opacity": 0.05,
}
"""The recipe of the study; what is not given follows from the scene, as do the scales' rates."""

SCALES_LR_CUT_OUT, SCALES_LR = 2e-2, 1e-2


# ----------------------------------------------------------------------------------------------
# Scenes
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Scene:
    """A dataset, at a size that an idea can be tried at in minutes."""

    name: str
    title: str
    config: str  # for its data
    size: int  # px
    folder: str | None = None  # in that of ``--data``; None: shipped


SHIPPED = Scene("shipped", "the shipped scene", "lego_mini.yml", 200)
LEGO = Scene("lego", "the original Lego", "lego.yml", 200, "nerf_synthetic/lego")
FOX = Scene("fox", "the fox", "fox.yml", 160, "fox")
HEAD = Scene("head", "the robot head", "photos.yml", 160, "colmap_robothead")

OUTDOOR = Scene("outdoor", "the landscape", "photos.yml", 320, "outdoor")
ROOM = Scene("room", "the room", "photos.yml", 320, "room")

THREE, PHOTOGRAPHS, ALL = (SHIPPED, LEGO, FOX), (FOX, HEAD), (SHIPPED, LEGO, FOX, HEAD)
MADE = (OUTDOOR, ROOM)  # by ``made_sets.py``
WITH_MADE, NOT_CUT_OUT = (*ALL, *MADE), (*PHOTOGRAPHS, *MADE)


# ----------------------------------------------------------------------------------------------
# Changes of a fit
# ----------------------------------------------------------------------------------------------


class Change:
    """A change of a fit; subclasses define some of the methods."""

    def values(self, config: FitConfig) -> Values:
        """Return other values, given a configuration without open ones."""
        return {}

    def views(self, config: FitConfig, views: Sequence[View]) -> Sequence[View]:
        """Return other training views."""
        return views

    def attach(self, trainer: Trainer) -> None:
        """Change a trainer before its first iteration."""

    def before(self, trainer: Trainer, iteration: int) -> None:
        """Called before each iteration."""

    def after(self, trainer: Trainer, iteration: int) -> None:
        """Called after each iteration."""

    def correction(self, trainer: Trainer, views: Sequence[View]) -> Correction:
        """Return what a rendered image (H, W, 3) becomes before it is compared; views: trained."""
        return lambda image: image


@dataclass(frozen=True)
class Given(Change):
    """Other values; functions of the configuration compute those that depend on it."""

    given: Mapping[str, object]

    @override
    def values(self, config: FitConfig) -> Values:
        return {k: v(config) if callable(v) else v for k, v in self.given.items()}


class CompactFalloff(Given):
    """The falloff of ``examples/compact_falloff.py``."""

    @override
    def values(self, config: FitConfig) -> Values:
        sys.path.insert(0, str(SCENES_FOLDER.parent / "examples"))
        importlib.import_module("compact_falloff")
        return super().values(config)


def times_gaussians(factor: float) -> Callable[[FitConfig], int]:
    """Return a value that is a multiple of the number of Gaussians."""
    return lambda config: round(factor * (config.densify.budget.gaussians or 0))


@dataclass(frozen=True)
class GrowthByPower(Change):
    """The number of Gaussians grows with a power of the time."""

    power: float

    @override
    def attach(self, trainer: Trainer) -> None:
        power = self.power

        class Growth(GrowthToNumber):
            def _uncapped_goal(self, iteration: int) -> int:
                start, stop = self.config.start, self.config.stop
                u = min(max((iteration - start) / max(GROWTH_SHARE * (stop - start), 1), 0), 1)
                return super()._uncapped_goal(
                    start + round(u**power * GROWTH_SHARE * (stop - start))
                )

        replace_strategy(trainer, Growth)


def replace_strategy(trainer: Trainer, kind: type[GrowthToNumber]) -> None:
    """Give a trainer another variant of its strategy."""
    phases = getattr(trainer.density, "phases", [trainer.density])
    former = phases[0]
    assert isinstance(former, GrowthToNumber), "the study's fits have this one"
    phases[0] = kind(former.config, former.settings, former.coarse)
    if len(phases) == 1:
        trainer.density = phases[0]
    trainer.density.begin(trainer.population)


@dataclass
class RecoveryAwarePruning(Change):
    """Opacities are halved at times; three changes later, the least opaque fifth is replaced.

    From Improved-GS (Deng et al. 2025).
    """

    every: int = 5  # changes

    @override
    def attach(self, trainer: Trainer) -> None:
        every = self.every

        class Pruning(GrowthToNumber):
            @override
            def refine(self, population: Population, iteration: int) -> DensityReport:
                config, turn = self.config, iteration // self.config.every % every
                if turn == 3 and iteration > every * config.every:
                    fifth = expit(np.quantile(population.host("logit_opacities"), 0.2))
                    budget = config.budget.model_copy(update={"prune_opacity": float(fifth)})
                    self.config = config.model_copy(update={"budget": budget})
                report = super().refine(population, iteration)
                self.config = config
                if turn == 0 and iteration + 3 * config.every <= config.stop:
                    value = population.value("logit_opacities")
                    opacities = 0.5 / (1 + dr.exp(-flat(value)))
                    logits = dr.log(opacities / (1 - opacities))
                    population.set_values("logit_opacities", like(value, logits))
                return report

        replace_strategy(trainer, Pruning)


class CountedViews(Change):
    """Errors count by views: the sum of a view is a multiple of the mean one, and at most four.

    After FastGS (Ren et al. 2025), which splits where many views have a high error.
    """

    @override
    def attach(self, trainer: Trainer) -> None:
        class Counting(GrowthToNumber):
            @override
            def update_statistics(self, step: StepInfo) -> None:
                sums = step.weighted_sums["errors"]
                seen = dr.select(step.visible & (sums > 0), type(sums)(1), 0)
                mean = dr.sum(sums) / dr.maximum(dr.sum(seen), 1)
                self.errors = self.errors + dr.minimum(sums / mean, 4)
                dr.eval(self.errors)

        replace_strategy(trainer, Counting)


@dataclass(frozen=True)
class PlacedAtErrors(Change):
    """A share of the new Gaussians is placed at pixels of high error, as wide as a pixel.

    After ConeGS (Baranowski et al. 2026), with the mean depth of what is there; where there is
    nothing, that of the nearest pixel with something.
    """

    share: float
    num_views: int = 8
    opacity: float = 0.3

    @override
    def attach(self, trainer: Trainer) -> None:
        change = self

        class Placing(GrowthToNumber):
            @override
            def refine(self, population: Population, iteration: int) -> DensityReport:
                goal = self.goal(iteration)
                keep = expit(population.host("logit_opacities")) >= self.settings.prune_opacity
                placed = round(change.share * max(0, goal - int(keep.sum())))
                self.reserved = placed
                report = super().refine(population, iteration)
                self.reserved = 0
                if placed:
                    rows = change.rows(trainer, placed, iteration)
                    population.edit(population.row_numbers(), rows)
                    self.begin(population)
                return replace(report, num_gaussians=population.num_rows)

            @override
            def goal(self, iteration: int) -> int:
                return super().goal(iteration) - getattr(self, "reserved", 0)

        replace_strategy(trainer, Placing)

    def rows(self, trainer: Trainer, count: int, iteration: int) -> dict[str, np.ndarray]:
        """Return new rows of every parameter."""
        rng = np.random.default_rng([trainer.config.seed, iteration])
        views = trainer.dataset.train
        pixels = [
            (index, *_errors_and_depths(trainer, views[index]))
            for index in rng.permutation(len(views))[: self.num_views]
        ]
        errors = np.concatenate([error.ravel() for _, error, _ in pixels])
        chosen = rng.choice(len(errors), count, p=errors / errors.sum())
        means, sizes, colors, first = [], [], [], 0
        for index, error, depth in pixels:
            view, at = views[index], chosen[(first <= chosen) & (chosen < first + error.size)]
            row, column = np.unravel_index(at - first, error.shape)
            first += error.size
            x, y = (column + 0.5 - view.cx) / view.fx, (row + 0.5 - view.cy) / view.fy
            points = np.column_stack([x, y, np.ones_like(x)]) * depth[row, column, None]
            means.append(points @ view.camera_to_world[:3, :3].T + view.center)
            sizes.append(depth[row, column] / view.fx)
            colors.append(np.asarray(view.image)[row, column])
        scales = np.log(np.concatenate(sizes))[:, None].repeat(3, axis=1)
        new = {
            "means": np.concatenate(means),
            "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
            "log_scales": scales,
            "logit_opacities": np.full(count, logit(self.opacity)),
            "sh0": ((np.concatenate(colors) - 0.5) / SH_C0)[:, None],
        }
        if "shN" in trainer.optimizer.state:
            new["shN"] = np.zeros((count, *trainer.population.value("shN").shape[1:]))
        return {name: values.astype(np.float32) for name, values in new.items()}


def _errors_and_depths(trainer: Trainer, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean absolute error and the mean depth of each pixel (H, W) of a pinhole."""
    config = trainer.config.model
    tensors = {name: trainer.population.value(name) for name in PARAMETER_NAMES}
    pipeline = pipeline_of(
        config.approximations,
        trainer.sh_degree_at(max(1, trainer.iteration)),
        (color_features, depth_feature),
    )
    size = view.width, view.height, config.near_plane
    axes = view.camera_to_world[:3, :3].T
    camera = Camera.create(mi.Float, axes, view.center, view.K, *size)
    planes = render(Gaussians(**tensors), camera, pipeline).planes()
    behind, *color, depth = (np.array(plane).reshape(view.height, view.width) for plane in planes)
    background = trainer.dataset.background
    image = np.stack(color, axis=-1) + behind[..., None] * background
    error = np.abs(image - np.asarray(view.image)).mean(axis=-1)
    if view.mask is not None:
        error *= np.asarray(view.mask)
    empty = behind > 0.5
    depth /= np.maximum(1 - behind, 1e-6)
    nearest = distance_transform_edt(empty, return_distances=False, return_indices=True)
    return error, depth[tuple(nearest)] if not empty.all() else np.ones_like(depth)


@dataclass(frozen=True)
class NoNeedles(Change):
    """The longest axis is at most so many times the middle one."""

    ratio: float

    @override
    def after(self, trainer: Trainer, iteration: int) -> None:
        if iteration % 20:
            return
        value = trainer.population.value("log_scales")
        axes = dr.unravel(mi.Vector3f, flat(value))
        middle = dr.sum(axes) - dr.max(axes) - dr.min(axes)
        cut = dr.minimum(axes, middle + math.log(self.ratio))
        trainer.population.set_values("log_scales", like(value, dr.ravel(cut)))


# ----------------------------------------------------------------------------------------------
# Changes of the optimizer's steps
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class State:
    """A parameter, flat and detached, and its moments."""

    value: Float
    first: Float
    second: Float


class StepChange(Change):
    """Changes Adam's steps of some parameters."""

    names: ClassVar[Sequence[str]] = (
        *("means", "quats", "log_scales", "logit_opacities"),
        *("sh0", "shN"),
    )

    def changed(self, trainer: Trainer, name: str, old: State, new: State, grad: Float) -> State:
        """Return the state after a step in place of ``new``, Adam's."""
        raise NotImplementedError

    @override
    def attach(self, trainer: Trainer) -> None:
        change = self

        class Changed(NesterovAdam):
            def _update(self, key: str, rates: object) -> list[dr.ArrayBase]:
                if key not in change.names:
                    return super()._update(key, rates)
                value, *_, (_, first, second, _) = self.state[key]
                old, grad = State(flat(value), type(first)(first), type(second)(second)), value.grad
                super()._update(key, rates)
                value, promoted, rate, (count, first, second, _) = self.state[key]
                new = State(flat(value), first, second)
                new = change.changed(trainer, key, old, new, flat(grad))
                value = like(value, new.value)
                dr.enable_grad(value)
                self.state[key] = value, promoted, rate, (count, new.first, new.second, None)
                return [new.value, new.first, new.second]

        trainer.optimizer.__class__ = Changed


def flat(value: dr.ArrayBase) -> Float:
    """Return the numbers of a tensor or an array, detached."""
    value = dr.detach(value)
    return value.array if dr.is_tensor_v(value) else value


def like(value: dr.ArrayBase, numbers: Float) -> dr.ArrayBase:
    """Return ``numbers`` in the shape of ``value``."""
    return type(value)(numbers, value.shape) if dr.is_tensor_v(value) else type(value)(numbers)


class AdamsMomentum(Change):
    """Steps along the first moment as it is."""

    @override
    def attach(self, trainer: Trainer) -> None:
        trainer.optimizer.__class__ = LeanAdam


@dataclass(frozen=True)
class FartherAhead(StepChange):
    """Steps along the first moment after further steps with the same gradient, to first order."""

    steps: float  # besides that of Nesterov's momentum

    @override
    def changed(self, trainer: Trainer, name: str, old: State, new: State, grad: Float) -> State:
        beta = trainer.optimizer.beta_1
        ahead = beta * new.first + (1 - beta) * grad
        farther = 1 + self.steps * (1 - beta) * (grad - new.first) / ahead
        factor = dr.select(dr.abs(ahead) > 1e-30, farther, 1)
        return replace(new, value=old.value + factor * (new.value - old.value))


class CautiousSteps(StepChange):
    """No step of a number whose gradient has the opposite sign (Liang et al. 2024)."""

    @override
    def changed(self, trainer: Trainer, name: str, old: State, new: State, grad: Float) -> State:
        is_downhill = (new.value - old.value) * grad <= 0
        return replace(new, value=dr.select(is_downhill, new.value, old.value))


class UnseenRowsRest(StepChange):
    """Numbers without a gradient keep their value and their moments."""

    @override
    def changed(self, trainer: Trainer, name: str, old: State, new: State, grad: Float) -> State:
        moves = grad != 0
        pairs = zip(vars(new).values(), vars(old).values(), strict=True)
        return State(*(dr.select(moves, after, before) for after, before in pairs))


@dataclass(frozen=True)
class OtherPower(StepChange):
    """Steps of m / v^(1/2 + p) in place of Adam's m / v^(1/2), within a tenth and ten times those.

    The gradient of an L1 loss is J^T s with signs s, so that v estimates the diagonal of J^T J: the
    step of Gauss and Newton has p = 1/2.
    """

    power: float
    names = ("means", "log_scales", "quats")

    @override
    def changed(self, trainer: Trainer, name: str, old: State, new: State, grad: Float) -> State:
        is_known = new.second > 1e-25
        logarithm = dr.log(dr.maximum(new.second, 1e-25))
        total = dr.sum(dr.select(is_known, logarithm, 0))
        mean = total / dr.maximum(dr.sum(dr.select(is_known, type(total)(1), 0)), 1)
        factor = dr.clip(dr.exp(self.power * (mean - logarithm)), 0.1, 10)
        return replace(new, value=old.value + factor * (new.value - old.value))


class StepsInSigmas(StepChange):
    """Steps of the means in proportion to the root of the Gaussian's largest scale."""

    names = ("means",)

    @override
    def changed(self, trainer: Trainer, name: str, old: State, new: State, grad: Float) -> State:
        scales, number = flat(trainer.optimizer["log_scales"]), type(old.value)
        first = dr.arange(dr.uint32_array_t(number), dr.width(scales)) // 3 * 3
        largest = dr.gather(number, scales, first)
        for k in (1, 2):
            largest = dr.maximum(largest, dr.gather(number, scales, first + k))
        factor = dr.clip(dr.exp(0.5 * (largest - dr.mean(largest))), 0.2, 5)
        return replace(new, value=old.value + factor * (new.value - old.value))


class DecayOfHarmonics(StepChange):
    """Decoupled decay of the higher degrees, by their rate a step (AdamW)."""

    names = ("shN",)

    @override
    def changed(self, trainer: Trainer, name: str, old: State, new: State, grad: Float) -> State:
        rate = dr.opaque(type(old.value), trainer.rates(trainer.iteration)[name])
        return replace(new, value=new.value - rate * old.value)


@dataclass(frozen=True)
class HarmonicsInTurns(Change):
    """Harmonics above degree 0 have derivatives, and move, in one of a few iterations."""

    every: int

    @override
    def attach(self, trainer: Trainer) -> None:
        class Changed(NesterovAdam):
            def _update(self, key: str, rates: object) -> list[dr.ArrayBase]:
                is_due = dr.grad_enabled(self.state[key][0])
                return super()._update(key, rates) if is_due else []

        trainer.optimizer.__class__ = Changed

    @override
    def before(self, trainer: Trainer, iteration: int) -> None:
        value = trainer.optimizer.state["shN"][0]
        (dr.enable_grad if iteration % self.every == 0 else dr.disable_grad)(value)


@dataclass
class MeanOfIterates(Change):
    """The mean of the iterates of the last iterations, with rates that do not fall as far."""

    share: float  # of the iterations
    decay: float
    sums: dict[str, Float] = field(default_factory=dict)

    @override
    def values(self, config: FitConfig) -> Values:
        return {"optimizer.decay": self.decay}

    @override
    def after(self, trainer: Trainer, iteration: int) -> None:
        last = trainer.config.iterations
        if iteration <= (1 - self.share) * last:
            return
        for name in PARAMETER_NAMES:
            value = flat(trainer.population.value(name))
            self.sums[name] = self.sums[name] + value if name in self.sums else type(value)(value)
        dr.eval(self.sums)
        if iteration == last:
            for name, total in self.sums.items():
                value = trainer.population.value(name)
                count = last - math.floor((1 - self.share) * last)
                trainer.population.set_values(name, like(value, total / count))


# ----------------------------------------------------------------------------------------------
# Changes of what is rendered
# ----------------------------------------------------------------------------------------------

SETTLED_SHARE = 0.85  # of the iterations, after which nothing is left out


@dataclass
class GaussiansLeftOut(Change):
    """A random share of the Gaussians is transparent in an iteration (DropGaussian)."""

    share: float
    offset: Float | None = None

    @override
    def before(self, trainer: Trainer, iteration: int) -> None:
        config = trainer.config
        self.offset = None
        if iteration > SETTLED_SHARE * config.iterations or trainer.density.is_due(iteration):
            return
        random = np.random.default_rng([config.seed, iteration])
        left_out = random.random(trainer.num_gaussians) < self.share
        self.offset = type(trainer.population.zeros())(np.float32(20) * left_out)
        self._move(trainer, -self.offset)

    @override
    def after(self, trainer: Trainer, iteration: int) -> None:
        if self.offset is not None:
            self._move(trainer, self.offset)

    def _move(self, trainer: Trainer, offset: Float) -> None:
        value = trainer.population.value("logit_opacities")
        trainer.population.set_values("logit_opacities", like(value, flat(value) + offset))


@dataclass(frozen=True)
class DegreesLeftOut(Change):
    """A lower degree of the harmonics in a random share of the iterations (DropAnSH-GS)."""

    share: float

    @override
    def attach(self, trainer: Trainer) -> None:
        degree_at, config = trainer.sh_degree_at, trainer.config

        def random_degree_at(iteration: int) -> int:
            degree = degree_at(iteration)
            random = np.random.default_rng([config.seed, iteration])
            if iteration > SETTLED_SHARE * config.iterations or random.random() >= self.share:
                return degree
            return int(random.integers(0, max(degree, 1)))

        trainer.sh_degree_at = random_degree_at  # type: ignore[method-assign]


class EverySecondAtHalfSize(Change):
    """Half the image size in every second of the first 70 % of the iterations."""

    @override
    def values(self, config: FitConfig) -> Values:
        return {"coarse": [{"until": 1, "factor": 2}]}

    @override
    def attach(self, trainer: Trainer) -> None:
        coarse, full = trainer.phases
        plan, end = trainer.plan, 0.7 * trainer.config.iterations
        trainer.phases = [_Kept(**vars(phase)) for phase in (coarse, full)]
        coarse, full = trainer.phases

        def alternating(iteration: int) -> object:
            step = plan(iteration)
            phase = coarse if iteration % 2 == 1 and iteration < end else full
            views = tuple(replace(v, view=phase.views[v.view.index]) for v in step.views)
            return replace(step, phase=phase, views=views)

        trainer.plan = alternating  # type: ignore[method-assign]
        replace_strategy(trainer, GrowthToNumber)
        trainer.density.coarse = ()


class _Kept(ResolutionPhase):
    """A phase that keeps its targets when another one begins."""

    @override
    def end(self) -> None:
        pass


class EachHalf(Change):
    """The upper and the lower half of each image are views of their own."""

    @override
    def views(self, config: FitConfig, views: Sequence[View]) -> Sequence[View]:
        halves = []
        for view in views:
            middle = view.height // 2
            for name, rows in (("upper", slice(0, middle)), ("lower", slice(middle, view.height))):
                planes = {
                    plane: np.ascontiguousarray(np.asarray(pixels)[rows])
                    for plane in ("image", "alpha", "mask")
                    if (pixels := getattr(view, plane)) is not None
                }
                height = len(planes["image"])
                frame = {"height": height, "cy": view.cy - rows.start, "files": {}}
                halves.append(replace(view, name=f"{view.name}_{name}", **frame, **planes))
        return halves


class PixelsAsTheyAre(Change):
    """Images that cannot be shifted."""

    @override
    def views(self, config: FitConfig, views: Sequence[View]) -> Sequence[View]:
        return [replace(view, image=np.asarray(view.image)) for view in views]


class VignettingAndResponse(Change):
    """A camera's vignetting and response: the curves of each channel change with the radius.

    They are found after the fit, by least squares over the training views: polynomials of degree 4
    in the value, times those of degree 3 in the squared distance from the centre.
    """

    @override
    def correction(self, trainer: Trainer, views: Sequence[View]) -> Correction:
        images = list(trainer.images(views))
        photographs = np.concatenate([np.asarray(v.image).reshape(-1, 3) for v in views])
        coefficients = []
        for channel in range(3):
            terms = np.concatenate([self._terms(image[..., channel]) for image in images])
            coefficients.append(np.linalg.lstsq(terms, photographs[:, channel], rcond=None)[0])

        def corrected(image: np.ndarray) -> np.ndarray:
            values = [self._terms(image[..., c]) @ coefficients[c] for c in range(3)]
            return np.stack(values, axis=1).reshape(image.shape).clip(0, 1)

        return corrected

    @staticmethod
    def _terms(values: np.ndarray) -> np.ndarray:
        """Return (pixels, 20) terms of the values (H, W) and their places."""
        height, width = values.shape
        y, x = np.mgrid[:height, :width] + 0.5
        squared = (x - width / 2) ** 2 + (y - height / 2) ** 2
        radius = 4 * squared.ravel() / (width**2 + height**2)  # 1 in the corners
        both = np.vander(values.ravel(), 5)[:, :, None] * np.vander(radius, 4)[:, None]
        return both.reshape(len(radius), -1)


class ViewsApart(Change):
    """Each view is one that few of the last ones are close to."""

    @override
    def attach(self, trainer: Trainer) -> None:
        from drgs.training import steps

        centers = np.array([view.center for view in trainer.dataset.train])
        centers = (centers - centers.mean(axis=0)) / centers.std()
        closeness = np.exp(-2 * np.sum((centers[:, None] - centers) ** 2, axis=-1))
        rounds: list[list[int]] = []

        def order(number: int, seed: int) -> list[int]:
            while len(rounds) <= number:
                recent = np.zeros(len(centers))
                for view in rounds[-1][-10:] if rounds else []:
                    recent = 0.9 * recent + closeness[view]
                random = np.random.default_rng([seed, len(rounds)])
                left, views = list(random.permutation(len(centers))), []
                while left:
                    views.append(min(left, key=lambda view: recent[view]))
                    left.remove(views[-1])
                    recent = 0.9 * recent + closeness[views[-1]]
                rounds.append(views)
            return rounds[number]

        def view_of(iteration: int, num_views: int, seed: int, views_per_step: int = 1) -> int:
            number, place = divmod(iteration - 1, num_views)
            return int(order(number, seed)[place])

        steps.view_of = view_of


# ----------------------------------------------------------------------------------------------
# Changes of the loss
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class HuberLoss(Loss):
    """The photometric loss, quadratic in differences below a width."""

    width: float

    @override
    def __call__(self, image: mi.TensorXf, target: object) -> Float:
        return self.with_squared_error(image, target)[0]

    @override
    def with_squared_error(self, image: mi.TensorXf, target: object) -> tuple[Float, Float]:
        loss, error = PhotometricLoss(0.2).with_squared_error(image, target)
        x = dr.abs(image.array - target.image.array)
        excess = dr.select(x < self.width, dr.square(x) / (2 * self.width) - x, -self.width / 2)
        return loss + 0.8 * dr.mean(excess), error


@dataclass(frozen=True)
class OtherLoss(Change):
    """Another loss of images."""

    loss: Loss

    @override
    def attach(self, trainer: Trainer) -> None:
        trainer.loss = self.loss


class SmallAndTransparent(LossTerm):
    """Terms of MCMC's loss: mean opacity and mean scale, in scene extents."""

    @override
    def of_gaussians(self, parameters: Mapping[str, dr.ArrayBase], num_rows: int) -> Float:
        opacities = parameters["logit_opacities"]
        if dr.is_tensor_v(opacities):
            opacities = opacities.array
        scales = dr.exp(parameters["log_scales"].array)
        transparency = dr.sum(1 / (1 + dr.exp(-opacities)))
        return (0.005 * transparency + 0.005 * dr.sum(scales)) / num_rows


@dataclass(frozen=True)
class SmallHarmonics(LossTerm):
    """Mean over the Gaussians of the sum of squares of the harmonics above degree 0, weighted."""

    weight: float

    @override
    def of_gaussians(self, parameters: Mapping[str, dr.ArrayBase], num_rows: int) -> Float | None:
        if "shN" not in parameters:
            return None
        return self.weight * dr.sum(dr.square(parameters["shN"].array)) / num_rows


@dataclass(frozen=True)
class OtherTerms(Change):
    """A further term of the loss."""

    term: LossTerm = field(default_factory=SmallAndTransparent)

    @override
    def attach(self, trainer: Trainer) -> None:
        trainer.terms = [*trainer.terms, self.term]


# ----------------------------------------------------------------------------------------------
# Changes of the population
# ----------------------------------------------------------------------------------------------


class InheritedMoments(Change):
    """Halves take over the second moments of the Gaussian that is split."""

    @override
    def attach(self, trainer: Trainer) -> None:
        class Inheriting(Population):
            def take(self, rows: UInt32) -> dict[str, dr.ArrayBase]:
                self.__dict__["parents"] = rows
                return super().take(rows)

            def edit(self, keep: UInt32, append: Mapping[str, dr.ArrayBase] | None = None) -> None:
                state = self.optimizer.state
                before = {name: (value.shape[1:], m[2]) for name, (value, _, _, m) in state.items()}
                super().edit(keep, append)
                for name, (shape, second) in before.items() if append is not None else ():
                    width, number = math.prod(shape), type(second)
                    rows = dr.repeat(self.__dict__["parents"], width) * width
                    element = dr.arange(type(rows), dr.width(rows))
                    inherited = dr.gather(number, second, rows + element % width)
                    value, promoted, rate, (count, m, v, _) = state[name]
                    dr.scatter(v, inherited, element + dr.width(keep) * width)
                    state[name] = value, promoted, rate, (count, m, v, None)

        trainer.population = Inheriting(*vars(trainer.population).values())
        trainer.density.begin(trainer.population)


# ----------------------------------------------------------------------------------------------
# Ideas
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Idea:
    """What was thought of, and what became of it."""

    name: str
    change: Change
    why: str  # it was kept, or not
    is_kept: bool = False  # in the recipe: the change takes it out
    scenes: Sequence[Scene] = THREE
    iterations: int = ITERATIONS


FORMER: Values = {
    "optimizer.scales_lr": 1e-2,
    "optimizer.decay": 0.1,
    "optimizer.decay_from": 0.5,
    "densify.budget.prune_opacity": 0.005,
}

IDEAS = (
    Idea("the recipe", Change(), "", scenes=WITH_MADE),
    Idea(
        "Gaussians less opaque than 0.05 are replaced, not 0.005",
        Given({"densify.budget.prune_opacity": 0.005}),
        "they are where they help more",
        is_kept=True,
        scenes=ALL,
    ),
    Idea(
        "rates fall in the last quarter, to 0.03, not in the second half, to 0.1",
        Given({"optimizer.decay": 0.1, "optimizer.decay_from": 0.5}),
        "the fit learns fast for longer",
        is_kept=True,
        scenes=ALL,
    ),
    Idea(
        "scales of cut-out objects have twice their former rate",
        Given({"optimizer.scales_lr": 1e-2}),
        "halves adapt sooner",
        is_kept=True,
        scenes=(SHIPPED, LEGO),
    ),
    Idea(
        "the number grows in proportion to the time, not to its root",
        GrowthByPower(0.5),
        "less time, as good",
        is_kept=True,
    ),
    Idea(
        "files of twice the size are halved with shifted pixels, four ways in turn",
        PixelsAsTheyAre(),
        "learns fewer pixels by heart; not for photographs",
        is_kept=True,
        scenes=(SHIPPED, LEGO),
    ),
    Idea(
        "scales of photographs too",
        Given({"optimizer.scales_lr": 2e-2}),
        "harms the robot head",
        scenes=PHOTOGRAPHS,
    ),
    Idea("... to the square of the time", GrowthByPower(2), "worse"),
    Idea("all of these values", Given(FORMER), "", is_kept=True, scenes=ALL),
    # Against memorising.
    Idea("no Gaussian below 0.12", Given({"densify.budget.prune_opacity": 0.12}), "no better"),
    Idea("a tenth of the Gaussians left out at random", GaussiansLeftOut(0.1), "trains less"),
    Idea("lower degrees at random, in 30 %", DegreesLeftOut(0.3), "trains less"),
    Idea("harmonics of degree 2", Given({"model.sh_degree": 2}), "trains less"),
    Idea("decoupled decay of the harmonics", DecayOfHarmonics(), "trains less"),
    Idea("harmonics at half of the rate", Given({"optimizer.shN_lr": 5e-4}), "trains less"),
    Idea("opacities and scales in the loss", OtherTerms(), "no better"),
    Idea("low-pass of 0.2 px^2", Given({"model.low_pass": 0.2}), "worse"),
    Idea("opacities halved at times, a fifth replaced", RecoveryAwarePruning(), "no better"),
    Idea(
        "the mean of the last tenth, of faster rates",
        MeanOfIterates(0.1, 0.1),
        "little, for a copy of all parameters",
    ),
    # Fewer iterations.
    Idea("towards Gauss-Newton: v^0.65", OtherPower(0.15), "worse"),
    Idea("away from it: v^0.35", OtherPower(-0.15), "no better"),
    Idea("steps of means in sigmas", StepsInSigmas(), "no better"),
    Idea("unseen rows rest", UnseenRowsRest(), "no better"),
    Idea("halves inherit second moments", InheritedMoments(), "much worse: new rows have to move"),
    Idea("beta_2 of 0.9997", Given({"optimizer.beta_2": 0.9997}), "no better"),
    Idea("opacities at twice the rate", Given({"optimizer.opacities_lr": 0.1}), "no better"),
    Idea(
        "means: five times the final rate", Given({"optimizer.means_lr_final": 1.6e-5}), "no better"
    ),
    Idea("a Huber loss of width 0.05", OtherLoss(HuberLoss(0.05)), "little, for a kernel more"),
    Idea("each view far from the last ones", ViewsApart(), "no better"),
    # Less work.
    Idea(
        "half an image each, 1.5 times the iterations",
        EachHalf(),
        "worse",
        iterations=ITERATIONS * 3 // 2,
    ),
    Idea("harmonics move in every second iteration", HarmonicsInTurns(2), "trains less"),
    Idea("every second image at half size, until 70 %", EverySecondAtHalfSize(), "worse"),
    Idea(
        "twice as many Gaussians, three quarters of the iterations",
        Given({"densify.budget.gaussians": times_gaussians(2)}),
        "as good in the same time, but larger files",
        iterations=ITERATIONS * 3 // 4,
    ),
    Idea("splats end at an alpha of 3/255", Given({"model.alpha_cut": 3 / 255}), "worse"),
    Idea("changes every 50 iterations", Given({"densify.every": 50}), "no better"),
    Idea("errors in every fifth view", Given({"densify.budget.error_every": 5}), "no better"),
    # More exact.
    Idea(
        "peaks along rays",
        Given({"model.projection": "exact"}),
        "no better",
        scenes=(SHIPPED, LEGO),  # pinholes
    ),
    Idea("order per pixel", Given({"model.order": "pixel"}), "no better, three times the time"),
    # Photographs.
    Idea(
        "a colour transform each",
        Given({"colors.lr": 0.02}),
        "worse: test views have none",
        scenes=PHOTOGRAPHS,
    ),
    Idea(
        "refined cameras",
        Given({"cameras.optimise": True}),
        "worse: the poses are good",
        scenes=PHOTOGRAPHS,
    ),
    Idea(
        "vignetting and a response curve, found after the fit",
        VignettingAndResponse(),
        "these cameras have none to speak of",
        scenes=PHOTOGRAPHS,
    ),
    Idea("random start", Given({"init.start": "random"}), "much worse", scenes=(HEAD,)),
    # Where Gaussians are.
    Idea(
        "points of a plane sweep where there are none",
        Given({"init.start": "random"}),
        "photographs without points start where COLMAP's would be",
        is_kept=True,
        scenes=(FOX,),
    ),
    Idea(
        "... in place of COLMAP's",
        Given({"init.start": "sweep"}),
        "less exact than COLMAP's",
        scenes=(HEAD,),
    ),
    Idea(
        "a dome of sky",
        Given({"init.sky": False}),
        "unseen views: +3.3 dB, from afar +0.9",
        is_kept=True,
        scenes=(OUTDOOR,),
    ),
    Idea(
        "half of the new ones at pixels of high error",
        PlacedAtErrors(0.5),
        "learns photographs by heart",
        scenes=PHOTOGRAPHS,
    ),
    Idea("errors count by views", CountedViews(), "worse where it matters", scenes=PHOTOGRAPHS),
    Idea("no needles beyond 4 to 1", NoNeedles(4), "no better", scenes=PHOTOGRAPHS),
    Idea(
        "a falloff without exp",
        CompactFalloff({"model.falloff": "compact"}),
        "no better on the whole; needs kernels of its own to save time",
        scenes=(*ALL, ROOM),
    ),
    # Harmonics and steps.
    Idea(
        "a degree of harmonics more every 15 % of the iterations, not 2.5 %",
        Given({"model.sh_increase_every": ITERATIONS // 40}),
        "early harmonics learn noise",
        is_kept=True,
        scenes=WITH_MADE,
    ),
    Idea(
        "... every 20 %",
        Given({"model.sh_increase_every": ITERATIONS // 5}),
        "no better",
        scenes=ALL,
    ),
    Idea("Nesterov's momentum", AdamsMomentum(), "moves sooner", is_kept=True, scenes=WITH_MADE),
    Idea("... one step farther ahead", FartherAhead(1), "no better", scenes=(LEGO, HEAD)),
    Idea("cautious steps", CautiousSteps(), "worse", scenes=(SHIPPED,)),
    Idea("beta_2 of 0.99", Given({"optimizer.beta_2": 0.99}), "no better", scenes=(SHIPPED,)),
    Idea("beta_1 of 0.95", Given({"optimizer.beta_1": 0.95}), "no better", scenes=(SHIPPED,)),
    Idea(
        "harmonics' squares in the loss, times 0.01",
        OtherTerms(SmallHarmonics(0.01)),
        "harms the robot head",
        scenes=(*PHOTOGRAPHS, ROOM),
    ),
    Idea(
        "harmonics at a quarter of the rate",
        Given({"optimizer.shN_lr": 2.5e-4}),
        "harms the robot head",
        scenes=(*PHOTOGRAPHS, ROOM),
    ),
    Idea("a smoothing filter", Given({"model.smoothing": True}), "no better", scenes=(ROOM,)),
)


# ----------------------------------------------------------------------------------------------
# Fits
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Point:
    """A finished fit."""

    scene: str
    idea: str
    psnr: float  # dB, test views
    train_psnr: float  # dB, of some training views
    seconds: float  # of a core
    gaussians: int


def fit_point(scene: Scene, idea: Idea, data: Path | None) -> Point:
    """Fit with one thread."""
    select_variant("llvm_ad_rgb")
    dr.set_thread_count(1)
    overrides = [f"data.image_size={scene.size}", f"iterations={idea.iterations}"]
    if scene.folder is not None and data is not None:
        overrides.append(f"data.path={data / scene.folder}")
    config = load_config(SCENES_FOLDER / scene.config, overrides)
    dataset = load_dataset(config.data)
    config = resolve_defaults(with_changes(config, RECIPE), dataset)
    by_case = {
        "optimizer.scales_lr": SCALES_LR if scene in NOT_CUT_OUT else SCALES_LR_CUT_OUT,
        "densify.start": idea.iterations // 20,
        "densify.stop": idea.iterations * 3 // 4,
    }
    config = with_changes(config, by_case)
    config = with_changes(config, idea.change.values(config))
    gaussians = initial_gaussians(config, dataset)
    dataset = replace(dataset, train=tuple(idea.change.views(config, dataset.train)))
    trainer = Trainer(config, dataset, gaussians)
    idea.change.attach(trainer)
    start = time.process_time()
    for iteration in range(1, config.iterations + 1):
        idea.change.before(trainer, iteration)
        trainer.step()
        idea.change.after(trainer, iteration)
    trainer.check()  # waits for the device
    seconds = time.process_time() - start
    trainer.sync_scene()
    correct = idea.change.correction(trainer, dataset.train)
    some = evenly_spaced(dataset.train, NUM_TRAINING_VIEWS)
    return Point(
        scene=scene.name,
        idea=idea.name,
        psnr=mean_psnr(trainer, dataset.test, correct),
        train_psnr=mean_psnr(trainer, some, correct),
        seconds=seconds,
        gaussians=trainer.num_gaussians,
    )


def mean_psnr(trainer: Trainer, views: tuple[View, ...], correct: Correction) -> float:
    """Return the mean PSNR of rendered views, dB."""
    pairs = zip(trainer.images(views), views, strict=True)
    return float(np.mean([psnr(correct(image), view.image, view.mask) for image, view in pairs]))


def finished_point(scene: Scene, idea: Idea, data: Path | None, out: Path) -> Point:
    """Fit in a process of its own, unless that is done."""
    number = str(IDEAS.index(idea) + 1)
    path = out / scene.name / f"{re.sub('[^a-z0-9]+', '_', idea.name.lower()).strip('_')}.json"
    if not path.is_file():
        print(f"{scene.name}: {idea.name}", flush=True)
        words = [sys.executable, __file__, "--fit", scene.name, number]
        words += ["--data", str(data)] if data is not None else []
        done = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True)
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(done.stdout.splitlines()[-1])
    return Point(**json.loads(path.read_text()))


def table(points: Sequence[Point]) -> str:
    """Format all fits, a row for each idea: what it gives, in test and training views, dB."""
    found = {(p.idea, p.scene): p for p in points}
    rows = []
    for idea in IDEAS:
        cells, ratios = [], []
        for scene in WITH_MADE:
            point = found.get((idea.name, scene.name))
            recipe = found.get((IDEAS[0].name, scene.name))
            if point is None or recipe is None:
                cells.append("")
            elif point is recipe:
                cells.append(f"{point.psnr:.2f} / {point.train_psnr:.2f} dB, {point.seconds:.0f} s")
            else:
                sign = -1 if idea.is_kept else 1  # of taking it out
                test = sign * (point.psnr - recipe.psnr)
                train = sign * (point.train_psnr - recipe.train_psnr)
                cells.append(f"{test:+.2f} / {train:+.2f}")
                ratios.append((point.seconds / recipe.seconds) ** sign)
        time_ratio = f"{float(np.mean(ratios)):.2f}" if ratios else ""
        kept = ("yes" if idea.is_kept else "no") if ratios else ""
        rows.append([idea.name, *cells, time_ratio, kept, idea.why])
    header = ["test / training views", *(scene.title for scene in WITH_MADE), "time", "kept", "why"]
    return markdown_table(header, rows)


def draw_histories(axes: Axes, fits: Sequence[Sequence[str]]) -> None:
    """Draw PSNR over time of finished fits: before, dashed, and after, for each title."""
    for k, (title, *folders) in enumerate(fits):
        for when, style, folder in zip(("before", "after"), ("--", "-"), folders, strict=True):
            with (Path(folder) / HISTORY).open(newline="") as file:
                rows = [row for row in csv.DictReader(file) if row["test_psnr"]]
            x, y = ([float(row[name]) for row in rows] for name in ("wall_s", "test_psnr"))
            axes.plot(x, y, style, color=f"C{k}", marker=".", label=f"{title}, {when}")


def main() -> None:
    """Fit, and print a table."""
    parser = make_parser(__doc__, "ideas")
    parser.add_argument("--data", type=Path, metavar="DIR", help="folder of the other datasets")
    parser.add_argument("--fit", nargs=2, metavar=("SCENE", "K"), help="one fit, as JSON")
    parser.add_argument(
        "--histories",
        nargs=3,
        action="append",
        metavar=("TITLE", "BEFORE", "AFTER"),
        help="only draw curves of finished fits, from two folders for each title",
    )
    add_case_option(parser, [idea.name for idea in IDEAS])
    args = parser.parse_args()
    if args.fit:
        (scene,) = (scene for scene in WITH_MADE if scene.name == args.fit[0])
        print(json.dumps(asdict(fit_point(scene, IDEAS[int(args.fit[1]) - 1], args.data))))
        return
    if args.histories:
        draw = partial(draw_histories, fits=args.histories)
        write_curves(args.out / "ideas.png", "seconds", "PSNR of some test views [dB]", draw)
        return
    cases = [
        (scene, IDEAS[k - 1])
        for k in args.only
        for scene in IDEAS[k - 1].scenes
        if scene.folder is None or args.data is not None
    ]
    with ThreadPoolExecutor(args.threads or os.cpu_count()) as pool:
        points = list(pool.map(lambda case: finished_point(*case, args.data, args.out), cases))
    write_rows(args.out / "ideas.csv", Point, points)
    print(f"\n{machine()}, one thread a fit\n\n{table(points)}")


if __name__ == "__main__":
    main()
