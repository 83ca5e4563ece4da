"""Binning against brute force in float64: every pair that compositing needs, in order."""

from dataclasses import dataclass

import drjit as dr
import numpy as np
import pytest
from support.hard_cases import FAMILIES
from support.helpers import (
    Case,
    bin_splats,
    both_precisions,
    device_camera,
    device_gaussians,
    rows,
    stacked_scene,
)

from drgs.reference import splatting as reference
from drgs.splatting import tiles
from drgs.splatting.grid import GRID, MICRO, MICROS, TILE, TileGrid
from drgs.splatting.projection import compensated_opacity, load_rows, plain_opacity, project
from drgs.splatting.tiles import WORD

CASES = [
    Case("37x29", 37, 29, 0),
    Case("antialiased", 40, 70, 0, count=200, antialiased=True, seed=1),
    Case("one pixel", 1, 1, 0, count=40, seed=2),
    Case("5x3", 5, 3, 0, count=40, seed=3),
    Case("whole tiles", 64, 48, 0, count=300, seed=4),
    Case("stacked", 37, 29, 0, count=70, recipe=stacked_scene, seed=5),
    Case("one splat", 20, 20, 0, count=1, seed=6),
    FAMILIES["needles of ratio 1e6"],
]
all_cases = pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)


@dataclass(frozen=True)
class Binned:
    """``TileBins`` on the host, padding included, and what it was made of."""

    case: Case
    projected: object
    bins: object

    def __getattr__(self, name):
        return np.array(getattr(self.bins, name)).astype(np.int64)

    @property
    def count(self) -> int:
        return self.bins.num_entries

    @property
    def visible(self) -> np.ndarray:
        return np.array(self.projected.visible)

    def mask_table(self) -> np.ndarray:
        """(N, tiles): the mask of each (Gaussian, tile), 0 where there is no entry."""
        table = np.zeros((len(self.order), self.bins.grid.num_tiles), dtype=np.int64)
        table[self.splats[: self.count], self.tiles[: self.count]] = self.masks[: self.count]
        return table


def bin_case(case, precision) -> Binned:
    gaussians = device_gaussians(case.gaussians, precision)
    rule = compensated_opacity if case.antialiased else plain_opacity
    splats = project(load_rows(gaussians, 0), device_camera(case.camera, precision), 0, rule)
    dr.eval(splats)
    return Binned(case, splats, bin_splats(splats, TileGrid(case.width, case.height)))


def quadratic_form(factor, dx, dy) -> np.ndarray:
    """|U d|^2 with U = [[p, r], [0, s]], base e: twice the negative exponent."""
    p, r, s = factor
    return (p * dx + r * dy) ** 2 + (s * dy) ** 2


@both_precisions
@all_cases
def test_masks_equal_a_brute_force_ellipse_test(precision, case):
    """The smallest exponent over each micro-tile's rectangle of pixel centres.

    A quadratic's minimum over a rectangle that does not hold its centre lies on the border: here
    all four sides are tried. ``cull_margin`` (base 2) is the documented margin; beyond it a
    rounding error of a tenth is allowed for float32.
    """
    binned = bin_case(case, precision)
    grid = binned.bins.grid
    table = binned.mask_table()
    splat = dr.arange(dr.llvm.ad.UInt32, len(binned.visible))
    geometry = np.stack([np.array(v, float) for v in binned.bins.rows.load(splat)], axis=1)
    undecided = total = 0
    tile = np.arange(grid.num_tiles)[:, None]
    micro = np.arange(MICROS)[None, :]
    left = tile % grid.columns * TILE + micro % GRID * MICRO + 0.5
    top = tile // grid.columns * TILE + micro // GRID * MICRO + 0.5
    for splat in np.flatnonzero(binned.visible):
        mean_x, mean_y, p, r, s, log2_opacity = geometry[splat]
        x0, y0 = left - mean_x, top - mean_y
        x1, y1 = x0 + MICRO - 1, y0 + MICRO - 1
        candidates = []
        for dx in (x0, x1):
            dy = np.clip(-p * r * dx / (r * r + s * s), y0, y1)
            candidates.append(quadratic_form((p, r, s), dx, dy))
        for dy in (y0, y1):
            dx = np.clip(-r * dy / p, x0, x1)
            candidates.append(quadratic_form((p, r, s), dx, dy))
        inside = (x0 <= 0) & (x1 >= 0) & (y0 <= 0) & (y1 >= 0)
        smallest = np.where(inside, 0, np.min(candidates, axis=0))
        reach = log2_opacity - np.log2(reference.ALPHA_CUT)

        actual = (table[splat][:, None] >> micro & 1).astype(bool)
        slack = grid.cull_margin
        must_not = smallest > reach + slack * 1.1
        assert not (actual & must_not).any(), f"splat {splat}: bits outside the ellipse"
        # A micro-tile that reaches over the border may be touched off the film only: then the
        # box, which ends at the film's last pixel, need not list its tile. Whole ones must be.
        whole = (left + MICRO <= case.width + 0.5) & (top + MICRO <= case.height + 0.5)
        must = (smallest <= reach) & whole
        assert actual[must].all(), f"splat {splat}: missing bits"
        undecided += ((smallest > reach) & ~must_not).sum()
        total += must.sum()
    assert undecided <= 2 + 1e-2 * total, "the margin decides too much"


@both_precisions
@all_cases
def test_entries_are_sorted_by_tile_then_depth(precision, case):
    binned = bin_case(case, precision)
    count, visible = binned.count, binned.visible
    # The visible ones by depth, ties by index; then the others.
    depths = rows(binned.projected.depths)
    expected = np.argsort(np.where(visible, depths, np.inf), kind="stable")
    np.testing.assert_array_equal(binned.order, expected)
    reference_order = reference.depth_order(
        reference.project(case.gaussians, case.camera).depths, visible
    )
    np.testing.assert_array_equal(binned.order[: visible.sum()], reference_order)

    rank = np.argsort(binned.order)
    key = binned.tiles[:count] * len(depths) + rank[binned.splats[:count]]
    assert (np.diff(key) > 0).all(), "sorted by (tile, rank), each pair once"
    assert binned.bins.grid.num_tiles > binned.tiles[:count].max(initial=0)


@both_precisions
@all_cases
def test_tile_start_and_sources_and_padding(precision, case):
    binned = bin_case(case, precision)
    count, num_tiles = binned.count, binned.bins.grid.num_tiles
    np.testing.assert_array_equal(
        binned.tile_start, np.searchsorted(binned.tiles[:count], np.arange(num_tiles + 1))
    )
    padded = -(-max(count, 1) // WORD) * WORD
    assert {len(getattr(binned, n)) for n in ("source", "splats", "tiles", "masks")} == {padded}
    assert not binned.masks[count:].any()
    np.testing.assert_array_equal(np.sort(binned.source[:count]), np.arange(count))
    # An entry's source lies in the run of its splat.
    run = np.searchsorted(binned.first_entry, binned.source[:count], side="right") - 1
    np.testing.assert_array_equal(run, binned.splats[:count])


def round_splats(precision, means2d, sigma=1.0, depths=None, opacities=0.5, visible=True):
    """Isotropic splats of ``sigma`` px."""
    means2d = np.asarray(means2d, dtype=float).reshape(-1, 2)
    n = len(means2d)
    ones = np.ones(n)
    return tiles.Splats2D(
        means2d=precision.vectors(means2d),
        conic_factor=precision.vectors(np.outer(1 / (sigma * ones), [1, 0, 1])),
        depths=precision.array(ones if depths is None else depths),
        opacities=precision.array(opacities * ones),
        colors=precision.vectors(np.ones((n, 3))),
        variances=precision.vectors(np.outer((sigma * ones) ** 2, [1, 1])),
        visible=dr.llvm.ad.Bool(np.full(n, visible)),
    )


WHOLE = np.full(63 * 19, 0xFFFF)
RADIUS = 3.11
"""px; that of an opacity of 0.5 is sqrt(2 ln(0.5 * 255)) = 3.114."""

CORNERS = {
    "left of the film": ((64, 48), {"means2d": (-30, 10)}, [], []),
    "below the film": ((64, 48), {"means2d": (10, 60)}, [], []),
    "far right of the film": ((64, 48), {"means2d": (1e30, 10)}, [], []),
    "far left above the film": ((64, 48), {"means2d": (-1e30, -1e30)}, [], []),
    "far below the film": ((64, 48), {"means2d": (10, 3e9)}, [], []),
    "a little too far right": ((64, 48), {"means2d": (63.5 + 3.12, 10)}, [], []),
    "as far as the cut": ((64, 48), {"means2d": (63.5 + RADIUS, 10)}, [3], [1 << (2 * GRID + 3)]),
    "invisible": ((64, 48), {"means2d": np.full((40, 2), 20.0), "visible": False}, [], []),
    "the corner of four tiles": (
        *((40, 40), {"means2d": (16, 16)}),
        *([0, 1, 3, 4], [1 << 15, 1 << 12, 1 << 3, 1 << 0]),
    ),
    **{
        f"a giant of {sigma:.0e} px": (
            *((1000, 300), {"means2d": (90, 40), "sigma": sigma, "opacities": 0.99}),
            *(np.arange(63 * 19), WHOLE),
        )
        for sigma in (1e3, 1e6)
    },
}
"""Film, round splats, and the tiles and masks of their entries."""


@both_precisions
@pytest.mark.parametrize("name", CORNERS)
def test_round_splats_have_entries_in_the_tiles_they_touch(precision, name):
    film, splats, expected_tiles, expected_masks = CORNERS[name]
    bins, count = (
        bin_splats(round_splats(precision, **splats), TileGrid(*film)),
        len(expected_tiles),
    )
    assert bins.num_entries == count
    np.testing.assert_array_equal(np.array(bins.tiles)[:count], expected_tiles)
    np.testing.assert_array_equal(np.array(bins.masks)[:count], expected_masks)
    assert not np.array(bins.masks)[count:].any() and np.array(bins.tile_start)[-1] == count
