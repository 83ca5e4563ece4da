"""The table of docs/mitsuba.md that tells what is differentiated, cell by cell.

    python tests/integrator/test_derivative_table.py

prints it anew.
"""

import drjit as dr
import mitsuba as mi
import pytest
from conftest import REPOSITORY
from support.derivative_table import (
    ALONE,
    IN_PART,
    ROUTES,
    Case,
    cases,
    identity,
    load,
    measure,
    read_table,
    rgb,
    translate,
    written_table,
)

import drgs  # noqa: F401  (registers the plugins)

TABLE = read_table((REPOSITORY / "docs" / "mitsuba.md").read_text())

CELLS = [(row, route) for row, of_row in TABLE.items() for route, cell in of_row.items() if cell]

CORE = [
    ("Gaussians' `sh0`", "`rays`"),
    ("camera's `to_world`", "`path`"),
    ("camera's `to_world`", "`prb`"),
    ("camera's `to_world`", "`rays`"),
    ("`point` `position`", "`splatpath`"),
    ("`conductor` `specular_reflectance`", "`prb`"),
    ("`conductor` `specular_reflectance`", "`splatpath`"),
    ("`conductor` `eta`, `k`", "`rays`"),
    ("`plastic` `specular_reflectance`", "`splatpath`"),
    ("`mask` `opacity`", "`splatpath`"),
    ("`to_world`, rough", "`splatpath`"),
    ("`to_world`, mirror or glass", "`rays`"),
]
"""Cells that are not marked slow."""

MODES = 1e-3
"""Difference of forward from reverse mode: both add up the same numbers, in another order."""


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def check(row, route):
    found, cell = measure(cases()[row], route), TABLE[row][route]
    assert found.fits(cell), (cell, found)
    assert found.modes <= MODES, found


@pytest.mark.slow
@pytest.mark.parametrize("row, route", CORE)
def test_cells_equal_the_measured_errors(row, route):
    check(row, route)


@pytest.mark.slow
@pytest.mark.parametrize("row, route", [cell for cell in CELLS if cell not in CORE])
def test_other_cells_equal_the_measured_errors(row, route):
    check(row, route)


def test_the_table_has_all_parameters_and_routes():
    mi.set_variant("llvm_ad_rgb")
    assert list(TABLE) == list(cases())
    for row, case in cases().items():
        empty = [route for route, cell in TABLE[row].items() if not cell]
        assert list(TABLE[row]) == list(ROUTES)
        assert empty == ([] if case.is_seen_alone else [ALONE])


def test_only_poses_lit_by_splats_are_partly_differentiated():
    rows = {row for row, route in CELLS if TABLE[row][route] == IN_PART}
    assert rows == {"`to_world`, diffuse", "`to_world`, rough"}


@pytest.mark.slow
def test_poses_lit_by_other_surfaces_are_differentiated():
    """Along the rays that find it, which see it in the same solid angle."""
    to_world = identity().translate([0, 3, -3]).rotate([1, 0, 0], 45).scale(30)
    bsdf = {"type": "diffuse", "reflectance": rgb(0.7)}  # or Mitsuba would merge it with the panel
    others = {"sky": None, "wall": {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}}
    case = Case("wall.to_world", others=others, move=translate(0, 0, 1), spp=2**15)
    assert measure(case, "`splatpath`").error < 0.01


def test_hair_is_rendered_despite_a_parameter_without_value():
    """Mitsuba cannot list its parameters with their values."""
    scene = load(Case("lamp.intensity.value", {"type": "hair"}, spp=16), "`splatpath`")
    assert dr.mean(mi.render(scene), axis=None) > 0


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    print(written_table())
