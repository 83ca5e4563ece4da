"""The cheapest approximations whose images stay within an error, found by measuring a few views.

The error of an image is its root mean square difference from the most accurate image, over pixels
and channels in display space: the best projection, an order per pixel, colours along each pixel's
ray, and almost no cut-offs.

Each approximation is measured alone, as the difference of two images that differ in nothing else.
They are nearly independent, so that the squares of their errors add. What takes no order per pixel
is measured on whole views; orders are, in a window of each (:class:`MeasuredView`). There, the
cheapest combination within the budget is also compared with the most accurate image, which corrects
the sum. Where all views are measured and small, nothing is estimated: windows are whole views, and
choices are compared with the most accurate image, from the cheapest on.

The most accurate image has an order within a window of splats: its own error, which is extrapolated
from the windows before it, and among large splats measured along rays, is part of all errors.

Costs are typical ones, not measured: the choice is the same in every run.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import Any, NamedTuple

import drjit as dr
import numpy as np
from scipy.stats import t as student_t

from drgs.cameras.camera import Camera
from drgs.cameras.lens import Pinhole
from drgs.cameras.motion import MotionBlur
from drgs.config.approximations import FALLOFFS, ORDERS, PROJECTIONS, Approximations
from drgs.core.arrays import types_of
from drgs.core.constants import ALPHA_CUT, MAX_SHUTTER_SAMPLES, TRANSMITTANCE_STOP

MIN_VIEWS, MAX_VIEWS = 3, 6  # that are measured, if there are so many
MAX_PIXELS = 4_000_000  # of them together, unless they are the fewest
MAX_WHOLE_PIXELS = 1_000_000  # of all views together, for which nothing is estimated
WINDOW_PX = 100  # side of a window, at most about
AREA_SHARE = 0.2  # of the probability of a cell, by its area; the rest by its error
CONFIDENCE = 0.95  # share of the views that shall be within the budget
TYPICAL_SPREAD = 0.15  # of the logarithm of the errors of a file's views
CLEARLY = 0.9  # of the error or the time of a choice, the next one's at most
FEWEST_ORDERS = 3  # windows of splats that are measured at least; more where budgets ask for them
SPREAD_VIEWS = 3  # views that TYPICAL_SPREAD counts for
SLACK = 1.5  # of predicted errors over the budget, up to which a choice is measured
NEGLIGIBLE = 0.25  # of the budget: error of the most accurate image that is not worth a word

SAMPLES = "shutter_samples"

Changes = dict[str, Any]
"""Values of approximations by name, and of :data:`SAMPLES`."""

Window = tuple[int, int, int, int]
"""A part of the film: x, y, width and height, px."""


@dataclass(frozen=True)
class Level:
    """Values of approximations that are chosen together, with their typical cost."""

    changes: Changes
    cost: float  # relative to the first levels of all others, ordered by the means' depths
    cost_ordered: float = 0.0  # ordered at each pixel; 0: the same

    def factor(self, is_ordered: bool) -> float:
        """Return the factor of the time of an image."""
        return self.cost_ordered if is_ordered and self.cost_ordered else self.cost


CENTER = Level({"order": "center"}, 1)
WINDOWED = tuple(
    Level({"order": "pixel", "order_window": window}, cost)
    for window, cost in ((1, 3.3), (4, 4.4), (8, 7), (16, 12), (32, 22), (64, 42))
)
"""Costs are those of ``docs/results/accuracy.md``, rounded, as are those of the others."""

DIRECTIONS = (Level({"sh_direction": "mean"}, 1), Level({"sh_direction": "pixel"}, 3, 1.6))
CUT_OFFS = (
    Level({"alpha_cut": 1 / 64, "transmittance_stop": 1e-2}, 0.87, 0.8),
    Level({"alpha_cut": ALPHA_CUT, "transmittance_stop": TRANSMITTANCE_STOP}, 1),
    Level({"alpha_cut": 1 / 2048, "transmittance_stop": 1e-6}, 1.25, 1.45),
)
FINEST_CUT_OFFS = {"alpha_cut": 1e-5, "transmittance_stop": 1e-7}


def projections(cameras: Sequence[Camera]) -> tuple[Level, ...]:
    """Return the projections that the cameras' lenses allow, the most accurate one last."""
    ewa, unscented = Level({"projection": "ewa"}, 1), Level({"projection": "unscented"}, 1.05, 1.01)
    if any(camera.shutter is not None and camera.shutter.reads_rows for camera in cameras):
        return ewa, unscented, Level({"projection": "exact"}, 3.6, 1.8)
    if all(isinstance(camera.lens, Pinhole) for camera in cameras):
        return ewa, Level({"projection": "exact"}, 1.2, 1.05)
    if all(camera.lens.parallel for camera in cameras):
        # Along parallel rays, projected Gaussians are Gaussians.
        return (ewa,)
    return ewa, unscented, Level({"projection": "exact"}, 2.4, 1.6)


def shutter_samples(cameras: Sequence[Camera]) -> tuple[Level, ...]:
    """Return numbers of times of an open shutter, by relative cost; twice the last is exact."""
    shutters = [one.shutter for one in cameras]
    own = max((one.samples for one in shutters if isinstance(one, MotionBlur)), default=0)
    counts = sorted({max(1, own // 4), max(1, own // 2), own, 2 * own}) if own else []
    return tuple(Level({SAMPLES: n}, n / own) for n in counts if n <= MAX_SHUTTER_SAMPLES)


@dataclass(frozen=True)
class Choice:
    """Approximations, with their error and time."""

    approximations: Approximations
    changes: Changes  # those of an error budget among them
    error: float  # that CONFIDENCE of the views do not exceed; 0..1
    cost: float  # typical time relative to that of the default

    @property
    def shutter_samples(self) -> int | None:
        """Times of an open shutter; None: no camera has one."""
        return self.changes.get(SAMPLES)

    @property
    def words(self) -> str:
        """The values that differ from the default, as they are set."""
        default = Approximations()
        others = {k: v for k, v in self.changes.items() if v != getattr(default, k, None)}
        if others.get("order") == "pixel":
            others["order_window"] = self.changes["order_window"]
        words = [f"{k}={v if isinstance(v, str) else f'{v:.2g}'}" for k, v in others.items()]
        return " ".join(words) or "the default"


@dataclass(frozen=True)
class BudgetReport:
    """The choice for an error budget, with its neighbours."""

    budget: float
    chosen: Choice  # its error was measured against the most accurate image
    errors: tuple[float, ...]  # of the measured views
    better: Choice | None  # next choice with a clearly smaller error; None: there is none
    faster: Choice | None  # next choice that is clearly faster
    most_accurate: Changes = field(default_factory=dict)  # of the images that errors refer to
    uncertainty: float = 0.0  # error of these images themselves, part of all errors
    stale: str = ""  # names of what has changed since; "": nothing

    def line(self) -> str:
        """Return one line for the user."""
        low, high = min(self.errors), max(self.errors)
        errors = f"{low:.2g} to {high:.2g} at {len(self.errors)} views"
        line = (
            f"error at most {self.budget:.2g}: {self.chosen.words}: "
            f"{errors if len(self.errors) > 1 else f'{high:.2g} at 1 view'}, about "
            f"{self.chosen.cost:.2g} times the time of the default"
        )
        for other in (self.faster, self.better):
            if other is not None:
                line += f"; {other.cost:.2g} times for {other.error:.2g} ({other.words})"
        if self.uncertainty > NEGLIGIBLE * self.budget:
            line += f"; the most accurate image is itself within {self.uncertainty:.2g} only"
        return f"{line}; measured before a change of {self.stale}" if self.stale else line

    def record(self) -> dict[str, Any]:
        """Return the numbers to be recorded beside images, for JSON."""

        def numbers(choice: Choice | None) -> dict[str, Any] | None:
            if choice is None:
                return None
            return {**choice.changes, "error": choice.error, "cost": choice.cost / self.chosen.cost}

        return {
            "budget": self.budget,
            "chosen": numbers(self.chosen),
            "measured_errors": list(self.errors),
            "time_relative_to_default": self.chosen.cost,
            "next_better": numbers(self.better),
            "next_faster": numbers(self.faster),
            "error_of_most_accurate": self.uncertainty,
            "stale": self.stale,
        }


@dataclass(frozen=True)
class MeasuredView:
    """A view that is measured, and the window in which orders are."""

    camera: Camera
    window: Window
    share: float = 1.0  # probability with which the window was drawn

    @staticmethod
    def draw(camera: Camera, one: np.ndarray, other: np.ndarray, place: float) -> MeasuredView:
        """Return a view with a window; place: 0..1, of the window among the cells of the film.

        Cells are drawn in proportion to the difference of two images of the view, of orders, and to
        a part to their area: the mean over places of the errors of cells, divided by their shares,
        is the error of the image.
        """
        error = np.square(one - other, dtype=np.float64).sum(axis=-1)
        rows, columns = (np.arange(0, size, _cell_size(size)) for size in error.shape)
        shares = AREA_SHARE * _sums(np.ones_like(error), rows, columns)
        shares = (shares + (1 - AREA_SHARE) * _sums(error, rows, columns)).ravel()
        shares /= shares.sum()
        order = np.argsort(-shares, kind="stable")
        cell = order[min(np.searchsorted(np.cumsum(shares[order]), place), shares.size - 1)]
        (y, x), (height, width) = divmod(int(cell), len(columns)), error.shape
        y, x = int(rows[y]), int(columns[x])
        end_y, end_x = min(y + _cell_size(height), height), min(x + _cell_size(width), width)
        return MeasuredView(camera, (x, y, end_x - x, end_y - y), float(shares[cell]))

    def mean_square(self, one: np.ndarray, other: np.ndarray) -> float:
        """Return the mean square difference of the view from images (H, W, 3) of its window."""
        total = float(np.square(one - other, dtype=np.float64).sum())
        return total / self.share / (3 * self.camera.width * self.camera.height)


@dataclass(frozen=True)
class Renderer:
    """Renders views with approximations that differ from given ones."""

    draw: Callable[[Camera, Window | None, Approximations, int], np.ndarray]
    """Returns the image (H, W, 3) float32 of a view or its window, in display space, not clamped;
    the last argument is the number of times of an open shutter."""

    given: Approximations  # their filters and falloff are kept
    residual: Callable[[Camera, Window, Approximations], float]
    """Returns the mean square error of the most accurate image, as far as it is known; or 0."""

    def image(self, camera: Camera, *changes: Changes, window: Window | None = None) -> np.ndarray:
        """Return the image of a view, or a window of it."""
        values = {k: v for change in changes for k, v in change.items()}
        samples = values.pop(SAMPLES, 1)
        return self.draw(camera, window, replace(self.given, **values), samples)


def _sums(values: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the sums of cells, relative to that of all; rows, columns: where cells begin."""
    sums = np.add.reduceat(np.add.reduceat(values, rows), columns, axis=1)
    return sums / max(sums.sum(), 1e-30)


def _cell_size(size: int) -> int:
    """Return the side of cells along a side of the film, px."""
    return 4 * math.ceil(size / math.ceil(size / WINDOW_PX) / 4)


def crop(camera: Camera, x: int, y: int, width: int, height: int) -> Camera:
    """Return the camera of a window of the film."""
    t = types_of(type(camera.near))
    offset = t.Array2f(dr.opaque(t.Float, x), dr.opaque(t.Float, y))
    places = ("principal", "film_start", "film_end")
    moved = {name: getattr(camera, name) - offset for name in places}
    return replace(camera, width=width, height=height, **moved)


def bound(errors: Sequence[float] | np.ndarray) -> float:
    """Return the error that :data:`CONFIDENCE` of all views do not exceed, from those of some.

    Above their root mean square, errors are log-normal. Their spread is that of the views above it,
    and a typical one's: views that are nearly exact say nothing of the others.
    """
    center = max(math.sqrt(np.mean(np.square(errors))), 1e-9)
    above = np.log(np.maximum(errors, center) / center)
    freedom, count = len(errors) - 1 + SPREAD_VIEWS, len(errors)
    variance = (2 * np.square(above).sum() + SPREAD_VIEWS * TYPICAL_SPREAD**2) / freedom
    width = student_t.ppf(CONFIDENCE, freedom) * math.sqrt(variance * (1 + 1 / count))
    return center * math.exp(width)


def measured_places(num_views: int, pixels: int) -> list[int]:
    """Return the places of the views that are measured, evenly among all; pixels: of a view."""
    count = min(num_views, max(MIN_VIEWS, min(MAX_VIEWS, MAX_PIXELS // pixels)))
    return [int((k + 0.5) * num_views / count) for k in range(count)]


class LevelSquares(NamedTuple):
    """The mean square errors of a level alone."""

    level: Level
    of_views: np.ndarray  # (V,)
    in_windows: np.ndarray  # (V,): those of the views, as their windows tell


class Combination(NamedTuple):
    """A combination of levels; its squares are the sums of those of the levels."""

    choice: Choice  # with a predicted error
    of_views: np.ndarray
    in_windows: np.ndarray


class Search:
    """Combinations of levels for some cameras, their predicted errors, and those measured."""

    def __init__(self, renderer: Renderer, cameras: Sequence[Camera], least: float = 0.0) -> None:
        """Measure each level alone on some views, and predict the errors of all combinations.

        least: budget below which none is asked for, so that orders need not be more accurate.
        """
        for registry in (PROJECTIONS, FALLOFFS, ORDERS):
            if (value := getattr(renderer.given, registry.kind)) not in registry.shipped_names:
                raise ValueError(
                    f"cannot be met with the {registry.kind} '{value}', which is not drgs's own: "
                    "what is accurate, is not known; leave one of them out"
                )
        self._renderer = renderer
        pixels = [camera.width * camera.height for camera in cameras]
        places = measured_places(len(cameras), max(pixels))
        measured = [cameras[k] for k in places]
        is_complete = len(places) == len(cameras) and sum(pixels) <= MAX_WHOLE_PIXELS
        self.bound: Callable[[np.ndarray], float] = max if is_complete else bound
        """The error of all views, from those of the measured ones."""
        self._images: dict[tuple, np.ndarray] = {}
        projected = projections(measured)
        first = projected[0], CENTER, DIRECTIONS[0], CUT_OFFS[1]
        self._start = {k: v for level in first for k, v in level.changes.items()}
        self._views = [MeasuredView(one, (0, 0, one.width, one.height)) for one in measured]
        if not is_complete:
            self._views = [
                MeasuredView.draw(
                    camera,
                    self._image(k, {}, True),
                    self._image(k, WINDOWED[0].changes, True),
                    (k + 0.5) / len(measured),
                )
                for k, camera in enumerate(measured)
            ]
        self._projection = projected[-1].changes
        for count in range(FEWEST_ORDERS, len(WINDOWED) + 1):
            last = projected[-1], WINDOWED[count - 1], DIRECTIONS[-1]
            self._best = {k: v for one in last for k, v in one.changes.items()} | FINEST_CUT_OFFS
            limit = (NEGLIGIBLE * least) ** 2 if count < len(WINDOWED) else math.inf
            self._orders = self._squares_of_orders(WINDOWED[:count], limit)
            if self._unordered.max() <= limit:
                break
        squares = [
            self._orders,
            self._squares(projected, projected[-1].changes),
            self._squares(DIRECTIONS, DIRECTIONS[-1].changes),
            self._squares(CUT_OFFS, FINEST_CUT_OFFS),
        ]
        samples = shutter_samples(measured)
        self._most_samples = {SAMPLES: 2 * samples[-1].changes[SAMPLES]} if samples else {}
        if samples:
            found = [(one, self._squares_of_samples(one.changes)) for one in samples]
            squares.append([LevelSquares(one, each, each) for one, each in found])
        self.front = self._front(squares)
        """Combinations that no other one beats in cost and predicted error, by cost."""

    def _image(self, k: int, changes: Changes, is_whole: bool) -> np.ndarray:
        """Return view k or its window, with the cheapest approximations but for ``changes``."""
        values, view = {**self._start, **changes}, self._views[k]
        key, images = (k, frozenset(values.items())), self._images
        if is_whole or self.bound is max or key in images:
            if key not in images:
                images[key] = self._renderer.image(view.camera, values)
            x, y, width, height = view.window
            return images[key] if is_whole else images[key][y : y + height, x : x + width]
        key = (*key, view.window)
        if key not in images:
            images[key] = self._renderer.image(view.camera, values, window=view.window)
        return images[key]

    def _differences(self, changes: Changes, target: Changes, step: int = 1) -> np.ndarray:
        """Return the mean square differences (V,) of views, from those of their windows."""
        found = [
            view.mean_square(self._image(k, changes, False), self._image(k, target, False))
            for k, view in enumerate(self._views)
            if k % step == 0
        ]
        return np.array(found)

    def _squares(self, levels: Sequence[Level], finest: Changes) -> list[LevelSquares]:
        """Return those of levels, of every other view for two unless nothing is estimated."""
        count, found = len(self._views), []
        step = 1 if self.bound is max else 2
        for level in levels:
            squares = [
                np.square(self._image(k, level.changes, True) - self._image(k, finest, True)).mean()
                for k in range(0, count, step)
            ]
            pair = squares, self._differences(level.changes, finest, step)
            found.append(LevelSquares(level, *(np.repeat(each, step)[:count] for each in pair)))
        return found

    def _squares_of_orders(self, windowed: Sequence[Level], limit: float) -> list[LevelSquares]:
        """Return those of orders, with the best projection; all contain the best image's errors.

        These are extrapolated from two windows of splats; within a limit, not below the renderer's.
        """
        levels, target = (CENTER, *windowed), self._projection | windowed[-1].changes
        squares = [self._differences(self._projection | level.changes, target) for level in levels]
        *_, before, last, _ = squares
        rest, values = last / np.maximum(before, 1e-20), replace(self._renderer.given, **self._best)
        self._unordered = last * np.minimum(rest, 0.5)
        if self._unordered.max() <= limit:
            found = [self._renderer.residual(one.camera, one.window, values) for one in self._views]
            self._unordered = np.maximum(self._unordered, found)
        sums = [each + self._unordered for each in squares]
        return [LevelSquares(level, each, each) for level, each in zip(levels, sums, strict=True)]

    def _squares_of_samples(self, changes: Changes) -> np.ndarray:
        order = self._projection | WINDOWED[0].changes  # orders change in time
        return self._differences(order | changes, order | self._most_samples)

    def _front(self, squares: Sequence[Sequence[LevelSquares]]) -> list[Combination]:
        found = []
        for levels in product(*squares):
            changes = {k: v for each in levels for k, v in each.level.changes.items()}
            is_ordered = changes["order"] != "center"
            cost = math.prod(each.level.factor(is_ordered) for each in levels)
            of_views = np.sum([each.of_views for each in levels], axis=0)
            in_windows = np.sum([each.in_windows for each in levels], axis=0)
            values = {k: v for k, v in changes.items() if k != SAMPLES}
            approximations = replace(self._renderer.given, **values)
            choice = Choice(approximations, changes, self.bound(np.sqrt(of_views)), cost)
            found.append(Combination(choice, of_views, in_windows))
        front: list[Combination] = []
        for one in sorted(found, key=lambda one: (one.choice.cost, one.choice.error)):
            if not front or one.choice.error < front[-1].choice.error:
                front.append(one)
        return front

    def choose(self, budget: float) -> BudgetReport:
        """Return the cheapest approximations within ``budget``; ValueError if there are none."""
        place, of_views, errors = self.cheapest(budget)
        pairs = zip(self.front, errors, strict=True)
        front = [replace(one.choice, error=error) for one, error in pairs]
        chosen = front[place]
        better = next((one for one in front[place:] if one.error < CLEARLY * chosen.error), None)
        faster = next((one for one in front[place::-1] if one.cost < CLEARLY * chosen.cost), None)
        best, uncertainty = self._best | self._most_samples, math.sqrt(self._unordered.max())
        return BudgetReport(budget, chosen, tuple(of_views), better, faster, best, uncertainty)

    def measure(self, place: int) -> np.ndarray:
        """Return the measured square errors (V,) of a choice in the windows; place: in ``front``.

        The errors of the most accurate image, and of the times of a shutter, are added. In windows
        of the views, the last but one order is accurate enough for those before it.
        """
        candidate, best, rest = self.front[place], self._best, self._unordered
        changes = {k: v for k, v in candidate.choice.changes.items() if k != SAMPLES}
        *_, other, last = self._orders
        is_before = all(changes != changes | one.level.changes for one in (other, last))
        if self.bound is not max and is_before:
            best, rest = best | other.level.changes, other.in_windows
        measured = self._differences(changes, best) + rest
        if self._most_samples:
            measured += self._squares_of_samples({SAMPLES: candidate.choice.changes[SAMPLES]})
        return measured

    def cheapest(self, budget: float) -> tuple[int, list[float], list[float]]:
        """Return the place in ``front`` of the cheapest choice within a budget.

        Also the errors of its views, and those of all of ``front``. Sums are corrected by what was
        measured, of other choices by what was measured last. ValueError if none is.
        """
        found: dict[int, np.ndarray] = {}  # of this budget: the choice depends on no other one
        correction, last = 1.0, len(self.front) - 1
        slack = SLACK if self.bound is max else 1.0
        while True:
            squares = [found.get(k, correction * c.of_views) for k, c in enumerate(self.front)]
            errors = [self.bound(np.sqrt(each)) for each in squares]
            limits = (budget if k in found else slack * budget for k in range(last + 1))
            pairs = enumerate(zip(errors, limits, strict=True))
            place = next((k for k, (error, limit) in pairs if error <= limit), last)
            if place not in found:
                measured, predicted = self.measure(place), self.front[place]
                correction = float(measured.sum() / max(predicted.in_windows.sum(), 1e-30))
                found[place] = measured if slack > 1 else correction * predicted.of_views
            elif errors[place] <= budget:
                return place, np.sqrt(found[place]).tolist(), errors
            else:
                digits = 1 - math.floor(math.log10(errors[place]))
                least = math.ceil(errors[place] * 10**digits) / 10**digits  # two, rounded up
                raise ValueError(
                    f"{budget:.2g} cannot be met here: the most accurate choice is within {least:g}"
                )
