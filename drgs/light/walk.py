"""Splats along rays: their radiance, and their transmittance.

A ray o + t d, |d| = 1, meets a Gaussian at its peak (Moenne-Loccoz et al. 2024, "3D Gaussian Ray
Tracing", section 4): with o' = W (o - m) and d' = W d in coordinates of the unit Gaussian,

    t = -(o' . d') / |d'|^2,   alpha = min(alpha_max, opacity exp(-|o' + t d'|^2 / 2)).

A segment 0 < t < far composites the Gaussians whose peaks lie on it, in the order of their peaks,
with the cut-offs of the pipeline and colours seen along the ray. Rays find them in a grid
(:mod:`drgs.light.grid`). In a cell, a ray reads the list, keeps the :data:`WINDOW_PEAKS` nearest
peaks that it has not composited yet, composites them, and reads the list again if there were more:
the order is exact.

Nothing here is differentiated.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import drjit as dr

from drgs.core.arrays import Rows, types_of
from drgs.core.constants import COLOR_MIN
from drgs.core.types import Array3f, Bool, Float, Scalar, UInt32
from drgs.gaussians.parameters import quat_to_rotation
from drgs.gaussians.sh import num_coefficients, sh_basis
from drgs.light.grid import Ellipsoids, SplatGrid, build_grid
from drgs.splatting.footprint import Cutoffs
from drgs.splatting.projection import GaussianRows
from drgs.splatting.rasterize import composite_step

WINDOW_PEAKS = 8  # peaks that a ray sorts before it composites them
ENTRIES_PER_TURN = 16  # after which a ray waits for others of its vector to find their next cell
MAX_RANDOM_WORD = 2.0**32 - 2**8  # bound for the probability 1: the largest float32 of 32 bits
MAX_DISTANCE = 1e18  # of Gaussians from the origin, world units: larger squares overflow
SHAPE_WIDTH = 13  # numbers of a record: mean, rows of W, base-2 logarithm of the opacity


@dataclass(frozen=True)
class Segment:
    """Segments of rays."""

    origin: Array3f  # world
    direction: Array3f  # unit
    far: Float  # world units
    active: Bool


@dataclass(frozen=True)
class RaySplats:
    """Gaussians prepared for rays."""

    shapes: Rows  # by Gaussian: see SHAPE_WIDTH
    colors: Rows  # by Gaussian: coefficients of the harmonics, three colours each
    grid: SplatGrid
    sh_degree: int
    cutoffs: Cutoffs

    @staticmethod
    def from_gaussians(rows: GaussianRows, sh_degree: int, cutoffs: Cutoffs) -> RaySplats:
        """Copy the Gaussians and sort them into a grid. The host waits for the device.

        rows: detached; those not finite, or beyond :data:`MAX_DISTANCE`, are left out.
        """
        t = types_of(type(rows.logit_opacities))
        rotation, scales = quat_to_rotation(rows.quats), dr.exp(rows.log_scales)
        opacity = 1 / (1 + dr.exp(-rows.logit_opacities))
        if rows.opacity_compensation is not None:
            opacity = opacity * rows.opacity_compensation
        log2_opacity = dr.log2(opacity)
        exponent = log2_opacity - cutoffs.log2_floor(log2_opacity)
        reach = dr.sqrt(2 * math.log(2) * dr.select(exponent > 0, exponent, 0))
        axes = [t.Array3f([rotation[row, column] for row in range(3)]) for column in range(3)]
        whitening = [axis / scale for axis, scale in zip(axes, scales, strict=True)]
        numbers = [*rows.means, *(value for row in whitening for value in row), log2_opacity]
        sh = [value for coefficient in rows.sh for value in coefficient]
        half_axes = [axis * (scale * reach) for axis, scale in zip(axes, scales, strict=True)]
        total = sum([*numbers, *sh, *(value for axis in half_axes for value in axis)], t.Float(0))
        exists = (exponent > 0) & dr.isfinite(total)
        ellipsoids = Ellipsoids(t.Array3f(rows.means), half_axes, exists)
        exists &= dr.max(dr.abs(ellipsoids.centers) + ellipsoids.half_sizes()) < MAX_DISTANCE
        shapes = Rows.from_columns([*numbers, *[t.Float(0)] * (16 - SHAPE_WIDTH)])
        colors = Rows.from_columns(sh)
        ellipsoids = replace(ellipsoids, exist=exists)
        dr.eval(shapes, colors, ellipsoids)
        return RaySplats(shapes, colors, build_grid(ellipsoids), sh_degree, cutoffs)

    def composite_segment(self, segment: Segment) -> tuple[Array3f, Float]:
        """Return the sum of w_i c_i, display space, in order of the peaks, and transmittance."""
        walk = _Walk.from_segment(self, segment)
        t = types_of(self.shapes.Float)
        basis = sh_basis(walk.direction, self.sh_degree)

        def body(at: _Place, last: list, T: Float, color: list) -> tuple:
            at, window, overflows = walk.nearest(at, last, T)
            T, color, last = walk.composite(window, basis, T, color)
            # Peaks that did not fit are behind the composited ones, in the same list.
            last = [dr.select(overflows, last[0], -dr.inf), last[1]]
            at = replace(at, entry=dr.select(overflows, at.first, at.entry))
            return at, last, T, color

        size = dr.width(walk.origin)
        nothing = [dr.full(t.Float, -dr.inf, size), dr.zeros(t.UInt32, size)]
        black = [dr.zeros(t.Float, size) for _ in range(3)]
        state = walk.begin(), nothing, dr.select(segment.active, t.Float(1), -1), black
        _, _, T, color = dr.while_loop(
            state, lambda at, last, T, color: (T > 0) & walk.should_continue(at), body
        )
        return t.Array3f(color), dr.abs(T)

    def sample_splats(
        self, segment: Segment, seed: UInt32, count: int
    ) -> tuple[list[Array3f], list[Bool], Float]:
        """Draw ``count`` splats that segments show, with their weights.

        A splat stops light with the probability alpha; the first that does is drawn (Enderton et
        al. 2010, "Stochastic Transparency"; Sun et al. 2025, "Stochastic Ray Tracing of Transparent
        3D Gaussians"): with the probability w_i, and none with T. That needs no order: a later
        splat of the list that also stops light replaces the last one if it is nearer. See
        :class:`_Draw` for rays that no splat stops.

        seed: of each ray; count: at least 1. Return colours of independent draws, display space;
        whether each exists, independent of them, with the probability 1 - T; and an estimate of T,
        independent of the colours.
        """
        walk = _Walk.from_segment(self, segment)
        t = types_of(self.shapes.Float)

        def offer(
            coverage: Float, draws: list, row: UInt32, peak: Float, log2_alpha: Float
        ) -> tuple:
            chances = _Chances.from_alpha(walk.alpha(log2_alpha), coverage)
            words = _hashes(row, seed, count)
            drawn = [one.offer(row, peak, chances, u) for one, u in zip(draws, words, strict=True)]
            return chances.coverage, drawn

        def choose(at: _Place, coverage: Float, draws: list) -> tuple:
            at, row, peak, log2_alpha = walk.read_entry(at)
            return at, *dr.if_stmt(
                args=(coverage, draws, row, peak, log2_alpha),
                cond=(log2_alpha > -dr.inf) & (peak < _farthest(draws)),
                true_fn=offer,
                false_fn=lambda coverage, draws, *_: (coverage, draws),
            )

        def should_continue(at: _Place, coverage: Float, draws: list) -> Bool:
            # Later cells are behind the splats drawn in this one.
            more = (at.entry < at.last) | ((_farthest(draws) == dr.inf) & (at.end < walk.stop))
            return segment.active & more

        size = dr.width(walk.origin)
        row, peak = dr.zeros(t.UInt32, size), dr.full(t.Float, dr.inf, size)
        draws = [_Draw(row, peak, dr.full(t.Bool, False, size)) for _ in range(count)]
        state = walk.begin(), dr.zeros(t.Float, size), draws
        _, coverage, draws = walk.read_lists(state, should_continue, choose)
        basis = sh_basis(walk.direction, self.sh_degree)
        found = [self._color(one.row, basis, one.peak < dr.inf) for one in draws]
        # Russian roulette: with the probability A^n, all draws are stopped, and the walk has ended.
        # Else T is (1 - A) / (1 - A^n), the inverse of a sum of powers.
        powers = t.Float(1)
        for _ in range(count - 1):
            powers = dr.fma(powers, coverage, 1)
        T = dr.select(_farthest(draws) < dr.inf, 0, 1 / powers)
        return [t.Array3f(color) for color in found], [one.is_stopped for one in draws], T

    def _color(self, row: UInt32, basis: list[Scalar], active: Bool) -> list[Float]:
        t = types_of(self.shapes.Float)
        numbers = self.colors.load(row, active)[: 3 * num_coefficients(self.sh_degree)]
        color = []
        for k in range(3):
            value = t.Float(0.5)
            for function, coefficient in zip(basis, numbers[k::3], strict=True):
                value = dr.fma(coefficient, function, value)
            color.append(dr.select(value > COLOR_MIN, value, COLOR_MIN))
        return color

    def transmittance(self, segment: Segment, least: Float) -> Float:
        """Return the transmittance; where it is below ``least``, any value below ``least``."""
        walk = _Walk.from_segment(self, segment)
        t = types_of(self.shapes.Float)

        def weaken(at: _Place, T: Float) -> tuple:
            at, _, _, log2_alpha = walk.read_entry(at)
            return at, dr.fma(-walk.alpha(log2_alpha), T, T)

        _, T = walk.read_lists(
            (walk.begin(), dr.select(segment.active, t.Float(1), 0)),
            lambda at, T: (least <= T) & walk.should_continue(at),
            weaken,
            lambda at, T: (least <= T) & at.has_entry(),
        )
        return T


@dataclass
class _Place:
    """The place of rays: a cell and an entry of its list. Not frozen: Dr.Jit assigns to it."""

    start: Float  # where the ray enters the cell
    end: Float  # where it leaves it
    entry: UInt32  # next entry of the list
    first: UInt32  # first entry of the list
    last: UInt32  # one past the list's end
    turn: UInt32  # entries since rays of a vector waited for each other

    def has_entry(self) -> Bool:
        """Return whether the list has entries, and other rays need not find another cell first."""
        return (self.entry < self.last) & (self.turn < ENTRIES_PER_TURN)


@dataclass(frozen=True)
class _Walk:
    """Rays through the grid, from where they enter it."""

    splats: RaySplats
    origin: Array3f  # where a ray enters, or starts
    direction: Array3f
    stop: Float  # where it ends, or leaves the grid

    @staticmethod
    def from_segment(splats: RaySplats, segment: Segment) -> _Walk:
        start, end = splats.grid.span(segment.origin, segment.direction)
        start = dr.select(start > 0, start, 0)
        end = dr.select(end < segment.far, end, segment.far)
        origin = segment.origin + segment.direction * dr.select(start < end, start, 0)
        return _Walk(splats, origin, segment.direction, end - start)

    def begin(self) -> _Place:
        """Return the place before the first cell."""
        t, size = types_of(type(self.stop)), dr.width(self.origin)
        start = dr.zeros(t.Float, size)
        return _Place(start, t.Float(start), *(dr.zeros(t.UInt32, size) for _ in range(4)))

    def read_lists(
        self,
        state: tuple,
        cond: Callable[..., Bool],
        visit: Callable[..., tuple],
        reads_on: Callable[..., Bool] = lambda at, *state: at.has_entry(),
    ) -> tuple:
        """Visit the entries of lists, cell after cell; return the last state.

        state: a place, and more; cond: whether to go on; visit: maps a state to that after the next
        entry; reads_on: whether to go on in the list that was found.
        """

        def body(at: _Place, *others: Any) -> tuple:
            return dr.while_loop(state=(self.find(at), *others), cond=reads_on, body=visit)

        return dr.while_loop(state=state, cond=cond, body=body)

    def should_continue(self, at: _Place) -> Bool:
        """Return whether there is another entry or cell."""
        return (at.entry < at.last) | (at.end < self.stop)

    def find(self, at: _Place) -> _Place:
        """Return the place, moved to the next cell with a list where this list is at its end."""
        grid = self.splats.grid

        def body(at: _Place) -> tuple[_Place]:
            first, last, leaves = grid.cell(self.origin, self.direction, at.end)
            return (_Place(at.end, leaves, first, first, last, at.turn),)

        (at,) = dr.while_loop(
            state=(at,), cond=lambda at: (at.entry == at.last) & (at.end < self.stop), body=body
        )
        return replace(at, turn=type(at.turn)(0))

    def read_entry(self, at: _Place) -> tuple[_Place, UInt32, Float, Float]:
        """Return the place after the next entry, its Gaussian, the peak and log2 of its alpha."""
        UInt32 = type(at.entry)
        row = dr.gather(UInt32, self.splats.grid.rows, at.entry)
        peak, log2_alpha = self.meet(row, True)
        here = (peak >= at.start) & (peak < at.end) & (peak > 0) & (peak < self.stop)
        log2_alpha = dr.select(here, log2_alpha, -dr.inf)
        return replace(at, entry=at.entry + 1, turn=at.turn + 1), row, peak, log2_alpha

    def meet(self, row: UInt32, active: Bool | bool) -> tuple[Float, Float]:
        """Return the peak of a Gaussian on a ray, and log2 of its alpha, -inf outside."""
        Array3f = types_of(self.splats.shapes.Float).Array3f
        numbers = self.splats.shapes.load(row, active)
        mean, log2_opacity = Array3f(numbers[:3]), numbers[SHAPE_WIDTH - 1]
        W, offset = [Array3f(numbers[k : k + 3]) for k in (3, 6, 9)], self.origin - mean
        o = Array3f([dr.dot(row, offset) for row in W])
        d = Array3f([dr.dot(row, self.direction) for row in W])
        peak = -dr.dot(o, d) / dr.squared_norm(d)
        squared = dr.squared_norm(dr.fma(d, peak, o))
        log2_alpha = dr.fma(squared, -0.5 * math.log2(math.e), log2_opacity)
        shows = log2_alpha >= self.splats.cutoffs.log2_floor(log2_opacity)
        return peak, dr.select(shows, log2_alpha, -dr.inf)

    def alpha(self, log2_alpha: Float) -> Float:
        alpha, most = dr.exp2(log2_alpha), self.splats.cutoffs.alpha_max
        return dr.select(alpha < most, alpha, most)

    def nearest(self, at: _Place, last: list, T: Float) -> tuple[_Place, list[list], Bool]:
        """Find the next peaks, and whether the list that was read last has more.

        Rays read lists while at least half of the window is free and its peaks let light through. A
        peak has its distance (inf: none), Gaussian and log2 of alpha. last: distance and Gaussian
        of the last composited peak; T: transmittance before the window.
        """
        t = types_of(self.splats.shapes.Float)

        def insert(at: _Place, window: list, overflows: Bool) -> tuple:
            at, row, peak, log2_alpha = self.read_entry(at)
            behind = (peak > last[0]) | ((peak == last[0]) & (row > last[1]))
            peak = dr.select(behind & (log2_alpha > -dr.inf), peak, dr.inf)
            item, kept = [peak, row, log2_alpha], []
            # Equal peaks stay in the order of the list, by Gaussian.
            for place in window:
                before = item[0] < place[0]
                kept.append(dr.select(before, item, place))
                item = dr.select(before, place, item)
            return at, kept, overflows | (item[0] < dr.inf)

        def goes_on(at: _Place, window: list, overflows: Bool) -> Bool:
            through = T
            for peak, _, log2_alpha in window:
                alpha = dr.select(peak < dr.inf, self.alpha(log2_alpha), 0)
                through = dr.fma(-alpha, through, through)
            more = (window[WINDOW_PEAKS // 2][0] == dr.inf) & (through >= stop)
            return self.should_continue(at) & ((at.entry < at.last) | more)

        size, stop = dr.width(at.first), self.splats.cutoffs.transmittance_stop
        empty = [dr.full(t.Float, dr.inf, size), dr.zeros(t.UInt32, size), dr.zeros(t.Float, size)]
        window = [[type(x)(x) for x in empty] for _ in range(WINDOW_PEAKS)]
        return self.read_lists((at, window, dr.full(t.Bool, False, size)), goes_on, insert)

    def composite(
        self, window: list[list], basis: list[Scalar], T: Float, color: list[Float]
    ) -> tuple[Float, list[Float], list]:
        """Composite the window; return T, negative for finished rays, colour, last peak."""
        t = types_of(self.splats.shapes.Float)

        def body(window: list, T: Float, color: list, last: list) -> tuple:
            (peak, row, log2_alpha), *others = window
            active = peak < dr.inf
            stop = self.splats.cutoffs.transmittance_stop
            weight, T, _ = composite_step(T, self.alpha(log2_alpha), stop)
            seen = self.splats._color(row, basis, active)
            shown = [dr.fma(weight, c, total) for c, total in zip(seen, color, strict=True)]
            gone = [dr.full(t.Float, dr.inf, dr.width(peak)), row, log2_alpha]
            return [*others, gone], T, shown, [peak, row]

        size = dr.width(T)
        nothing = [dr.full(t.Float, -dr.inf, size), dr.zeros(t.UInt32, size)]
        state = window, T, color, nothing
        return dr.while_loop(
            state, lambda window, T, *others: (window[0][0] < dr.inf) & (T > 0), body
        )[1:]


@dataclass
class _Draw:
    """A splat that rays draw. Not frozen: Dr.Jit assigns a loop's state.

    A splat of the list stops a draw with the probability alpha. A draw that is not stopped still
    has a splat, drawn as if one had stopped it: all draws have splats as soon as there are any,
    and whether they are stopped is independent of the splats drawn.
    """

    row: UInt32
    peak: Float  # inf: no splat
    is_stopped: Bool

    def offer(self, row: UInt32, peak: Float, chances: _Chances, u: UInt32) -> _Draw:
        """Return the draw after another splat; u: a random number."""
        replaces = u < dr.select(self.is_stopped, 0, chances.replaces)
        competes = u < dr.select(self.is_stopped, chances.stops, chances.competes)
        takes = replaces | (competes & (peak < self.peak))
        row, peak = dr.select(takes, row, self.row), dr.select(takes, peak, self.peak)
        return _Draw(row, peak, self.is_stopped | (u < chances.stops))


@dataclass(frozen=True)
class _Chances:
    """Probabilities of a splat in draws, as bounds of random numbers of 2^32.

    With A and A' the coverage by the list before and after the splat, it is the first to stop light
    with the probability v = (1 - A) alpha; given that any does, with v / A'. A draw that is not
    stopped is decided anew by that, as in reservoir sampling.
    """

    stops: UInt32  # alpha
    replaces: UInt32  # the last splat of a draw that was not stopped: it stops it, or is the first
    competes: UInt32  # that, or it stops light too: of those, the nearest is drawn
    coverage: Float  # A'

    @staticmethod
    def from_alpha(alpha: Float, coverage: Float) -> _Chances:
        """Compute the probabilities of a splat; coverage: before it."""
        t = types_of(type(alpha))

        def bound(probability: Float) -> UInt32:
            return t.UInt32(t.Float(probability) * MAX_RANDOM_WORD)

        stopped = (1 - coverage) * alpha
        after = coverage + stopped
        is_first = stopped * dr.rcp(dr.select(after > 0, after, 1))
        replaces = dr.fma(1 - alpha, is_first, alpha)
        competes = dr.fma(1 - replaces, alpha, replaces)
        return _Chances(bound(alpha), bound(replaces), bound(competes), after)


def _farthest(draws: list[_Draw]) -> Float:
    """Return the farthest peak; inf while not all draws are stopped."""
    peaks = [dr.select(one.is_stopped, one.peak, dr.inf) for one in draws]
    return reduce(lambda a, b: dr.select(a > b, a, b), peaks)


def _hashes(row: UInt32, seed: UInt32, count: int) -> list[UInt32]:
    """Return random words by PCG's output function (O'Neill 2014), and with halves exchanged."""
    UInt32 = type(row)
    numbers, state = [], row ^ seed
    for _ in range(-(-count // 2)):
        state = state * UInt32(747796405) + UInt32(2891336453)
        word = ((state >> ((state >> 28) + 4)) ^ state) * UInt32(277803737)
        word = (word >> 22) ^ word
        state = state ^ seed
        numbers += [word, (word << 16) | (word >> 16)]
    return numbers[:count]
