"""The table docs/derivatives.csv of what is differentiated, cell by cell.

Scenes are continuous in the parameter: no silhouette or edge of a shadow moves in the image.

    python tests/integrator/test_derivative_table.py

prints it anew.
"""

from __future__ import annotations

import csv
import gc
import sys
import types
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from support.lit_scenes import camera
from support.reference_lenses import gaussians_at

import drgs  # noqa: F401  (registers the plugins)
from drgs.core.errors import UnsupportedError

SPLATPATH = {"nested": {"type": "splatpath", "max_depth": 3}}
ROUTES = {
    "no surfaces": {},
    "`path`": {"nested": {"type": "path", "max_depth": 3}},
    "`prb`": {"nested": {"type": "prb", "max_depth": 3}},
    "`splatpath`": SPLATPATH,
    "`rays`": {"light": "rays", **SPLATPATH},
    "`probe`": {"light": "probe", "probes": "panel", **SPLATPATH},
    "`shadows`": {"shadows": "panel", **SPLATPATH},
}
"""Settings of the integrator, by the heading of their column."""

ALONE = "no surfaces"

REFUSED, IN_PART = "refused", "in part"

BOUNDS = (1, 2, 5, 10)
"""Per cent, that the table has."""


@dataclass(frozen=True)
class Case:
    """A parameter of a scene with a panel of a material under a lamp."""

    key: str  # as mi.traverse has it
    bsdf: dict[str, Any] = field(default_factory=lambda: DIFFUSE)
    others: dict[str, Any] = field(default_factory=dict)  # objects besides; None: not there
    move: Callable[[Any, mi.Float], Any] = lambda value, theta: value + theta
    step: float = 0.01
    is_seen_alone: bool = False  # where there are no surfaces
    spp: int = 512  # of the nested integrator


def rgb(*value):
    return {"type": "rgb", "value": list(value) if len(value) > 1 else value[0]}


def random_direction(value, theta):
    """A tensor or a buffer, along a direction of its own."""
    numbers = np.random.default_rng(dr.width(value)).normal(size=dr.width(value))
    moved = value.array if isinstance(value, mi.TensorXf) else value
    moved = moved + mi.Float(numbers.astype(np.float32)) * theta
    return mi.TensorXf(moved, value.shape) if isinstance(value, mi.TensorXf) else moved


def translate(x, y, z):
    return lambda to_world, theta: (
        mi.Transform4f().translate(mi.Point3f(x, y, z) * theta) @ to_world
    )


def rotate(x, y, z):
    return lambda to_world, theta: to_world @ mi.Transform4f().rotate(mi.Vector3f(x, y, z), theta)


DIFFUSE = {"type": "diffuse", "reflectance": rgb(0.6)}
METAL = {"type": "roughconductor", "alpha": 0.4}
COPPER = {"eta": rgb(0.2, 0.9, 1.1), "k": rgb(3.9, 2.4, 2.1)}
MIRROR = {"type": "conductor", "specular_reflectance": rgb(0.6, 0.5, 0.4), **COPPER}
GLASS = {"specular_reflectance": rgb(0.6), "specular_transmittance": rgb(0.7)}
PLASTIC = {"diffuse_reflectance": rgb(0.4), "specular_reflectance": rgb(0.8)}
NO_SKY = {"sky": None}


def spot():
    to_world = mi.ScalarTransform4f().look_at([1, 3, 0], [0, 0, 0.3], [0, 0, 1])
    return {"type": "spot", "to_world": to_world, "cutoff_angle": 80.0, "beam_width": 5.0}


def sky():
    """Brighter on one side, without edges."""
    angle = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    texels = np.broadcast_to((1.5 + np.cos(angle))[None, :, None], (8, 16, 3))
    return {"type": "envmap", "bitmap": mi.Bitmap(texels.astype(np.float32))}


def area_lamp():
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f().translate([0, 4, -4]).rotate([1, 0, 0], 45),
        "emitter": {"type": "area", "radiance": rgb(3.0)},
        "bsdf": {"type": "diffuse", "reflectance": rgb(0.0)},
    }


def blend(material):
    return {"type": "blendbsdf", "weight": 0.4, "first": DIFFUSE, "second": material}


def of_panel(name, *given, **more) -> Case:
    """A parameter of the panel's material."""
    return Case(f"panel.bsdf.{name}", *given, **more)


def cases() -> dict[str, Case]:
    """Return cases by the parameter's name in the table."""
    bumps = np.random.default_rng(0).uniform(0, 1, (8, 8, 3)).astype(np.float32)
    texture = {"type": "bitmap", "raw": True, "bitmap": mi.Bitmap(bumps)}
    only, masked = {"sky": None, "lamp": None}, {"type": "mask", "opacity": 0.6, "bsdf": DIFFUSE}
    return {
        "Gaussians' `sh0`": Case("integrator.sh0", move=random_direction, is_seen_alone=True),
        "Gaussians' `means`": Case(
            "integrator.means", move=random_direction, step=1e-3, is_seen_alone=True
        ),
        "`background`": Case(
            "integrator.background",
            others={"sky": None, "panel": {"type": "sphere", "radius": 0.5, "bsdf": DIFFUSE}},
            is_seen_alone=True,
        ),
        "camera's `to_world`": Case("sensor.to_world", move=translate(1, 0, 0), is_seen_alone=True),
        "camera's `x_fov`": Case("sensor.x_fov", step=0.1, is_seen_alone=True),
        "`constant` `radiance`": Case("sky.radiance.value", is_seen_alone=True),
        "`envmap` `data`": Case("env.data", others={**only, "env": sky()}, is_seen_alone=True),
        "`envmap` `to_world`": Case(
            "env.to_world", METAL, {**only, "env": sky()}, rotate(0, 1, 0), 1.0, is_seen_alone=True
        ),
        "`point` `intensity`": Case("lamp.intensity.value"),
        "`point` `position`": Case(
            "lamp.position", move=lambda p, theta: p + mi.Point3f(1, 1, 0) * theta
        ),
        "`spot` `to_world`": Case(
            "spot.to_world", others={**only, "spot": spot()}, move=translate(1, 0, 0)
        ),
        "`directional` `to_world`": Case(
            "sun.to_world",
            METAL,
            {**only, "sun": {"type": "directional", "to_world": spot()["to_world"]}},
            rotate(1, 0, 0),
            1.0,
        ),
        "`area` `radiance`": Case(
            "area.emitter.radiance.value", others={**only, "area": area_lamp()}
        ),
        "`to_world` of an `area` lamp": Case(
            "area.to_world", others={**only, "area": area_lamp()}, move=translate(0, 1, 0)
        ),
        "`diffuse` `reflectance`": of_panel("reflectance.value"),
        "`conductor` `specular_reflectance`": of_panel("specular_reflectance.value", MIRROR),
        "`conductor` `eta`, `k`": of_panel("k.value", MIRROR),
        "`roughconductor` `alpha`": of_panel("alpha.value", METAL, NO_SKY),
        "`dielectric` `specular_...`": of_panel(
            "specular_reflectance.value", {"type": "dielectric", **GLASS}
        ),
        "`roughdielectric` `alpha`": of_panel(
            "alpha.value", {"type": "roughdielectric", "alpha": 0.4}, NO_SKY, spp=4096
        ),
        "`roughdielectric` `eta`": of_panel("eta", {"type": "roughdielectric"}),
        "`thindielectric` `specular_reflectance`": of_panel(
            "specular_reflectance.value", {"type": "thindielectric", **GLASS}
        ),
        "`thindielectric` `eta`, `specular_transmittance`": of_panel(
            "eta", {"type": "thindielectric", **GLASS}
        ),
        "`plastic` `diffuse_reflectance`": of_panel(
            "diffuse_reflectance.value", {"type": "plastic", **PLASTIC}
        ),
        "`plastic` `specular_reflectance`": of_panel(
            "specular_reflectance.value", {"type": "plastic", **PLASTIC}
        ),
        "`roughplastic` `..._reflectance`": of_panel(
            "diffuse_reflectance.value", {"type": "roughplastic", "alpha": 0.4, **PLASTIC}
        ),
        "`roughplastic` `alpha`, `eta`": of_panel("alpha", {"type": "roughplastic"}),
        "`principled` `roughness`": of_panel(
            "roughness.value", {"type": "principled", "roughness": 0.6, "metallic": 0.8}, NO_SKY
        ),
        "`mask` `opacity`": of_panel("opacity.value", masked),
        "material in `mask`": of_panel("nested_bsdf.reflectance.value", masked),
        "`blendbsdf` `weight`, rough": of_panel("weight.value", blend(METAL), NO_SKY),
        "`blendbsdf` `weight`, with a mirror": of_panel("weight.value", blend(MIRROR)),
        "`normalmap` `normalmap`": of_panel(
            "normalmap.data",
            {"type": "normalmap", "normalmap": texture, "bsdf": DIFFUSE},
            move=random_direction,
        ),
        "`to_world`, diffuse": Case(
            "panel.to_world", others={"sky": None}, move=translate(0, 1, 0), step=0.005
        ),
        "`to_world`, rough": Case(
            "panel.to_world", METAL, {"sky": None}, translate(0, 1, 0), step=0.005
        ),
        "`to_world`, mirror or glass": Case("panel.to_world", MIRROR, move=translate(0, 1, 0)),
    }


@cache
def splats():
    rng = np.random.default_rng(1)
    means = rng.uniform(-1, 1, (10, 3)) * [1, 0.5, 1] + [0, 0.9, -0.5]
    colors = rng.uniform(0.2, 0.9, (10, 3))
    found = gaussians_at(means, 0.3, 0.5, colors)
    return {name: mi.TensorXf(v.astype(np.float32)) for name, v in vars(found).items()}


def load(case: Case, route: str) -> mi.Scene:
    objects = {
        "sensor": camera([0, 2, 3], [0, 0, 0], size=8, fov=30),
        "panel": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], -90).scale(8),
            "bsdf": case.bsdf,
        },
        "sky": {"type": "constant", "radiance": rgb(0.3, 0.4, 0.5)},
        "lamp": {"type": "point", "position": [1, 2, 0], "intensity": rgb(5.0)},
        **case.others,
    }
    if route == ALONE:
        objects["panel"] = None
    objects["integrator"] = {
        "type": "splats",
        "nested_spp": case.spp,
        "alpha_cut": 0.0,
        "extent": 6.0,
        "transmittance_stop": 0.0,
        **splats(),
        **ROUTES[route],
    }
    objects = {name: value for name, value in objects.items() if value is not None}
    return mi.load_dict({"type": "scene", **objects})


class Loss:
    """An image's weighted mean by a route, as a function of theta."""

    def __init__(self, case: Case, route: str) -> None:
        self.case, self.scene = case, load(case, route)
        self.params = mi.traverse(self.scene)
        base = dr.detach(self.params[case.key])
        self.base = type(base)(base)
        y, x = np.mgrid[:8, :8]
        weights = 1 + 0.5 * np.sin(0.7 * x + 0.4 * y)
        self.weights = mi.TensorXf(np.repeat(weights[..., None], 3, axis=2).astype(np.float32))

    def at(self, theta, **seeds):
        self.params[self.case.key] = self.case.move(self.base, theta)
        self.params.update()
        image = mi.render(self.scene, self.params, spp=1, **seeds)
        return dr.mean(image * self.weights, axis=None)

    def derivative(self, is_forward=False) -> float:
        theta = mi.Float(0)
        dr.enable_grad(theta)
        loss = self.at(theta, seed=5, seed_grad=6)
        if is_forward:
            dr.set_grad(theta, 1.0)
            return float(np.array(dr.forward_to(loss)).ravel()[0])
        dr.backward(loss)
        return float(dr.grad(theta)[0])

    def difference(self) -> float:
        """The same paths on both sides, the mean of two seeds."""
        above, below = (
            np.mean([np.array(self.at(dr.opaque(mi.Float, s), seed=k)).ravel()[0] for k in (0, 1)])
            for s in (self.case.step, -self.case.step)
        )
        return (above - below) / (2 * self.case.step)


@dataclass(frozen=True)
class Found:
    """The contents of a cell."""

    is_refused: bool
    error: float = 0.0  # of reverse mode, relative to the difference
    modes: float = 0.0  # difference of forward from reverse mode, likewise

    @property
    def text(self) -> str:
        """For the table; errors are rounded up, with room for another processor's rounding."""
        if self.is_refused:
            return REFUSED
        return next((f"{b} %" for b in BOUNDS if 130 * self.error <= b), IN_PART)

    def fits(self, cell: str) -> bool:
        """Whether this is what the table has."""
        if self.is_refused or cell == REFUSED:
            return self.text == cell
        if cell == IN_PART:
            return True
        return 100 * self.error <= float(cell.removesuffix(" %"))


def measure(case: Case, route: str) -> Found:
    loss = Loss(case, route)
    try:
        backward = loss.derivative()
    except UnsupportedError as error:
        lit = {"light": "none", "shadows": ""} | ROUTES[route]
        of_all = (
            f"with light '{lit['light']}' and shadows '{lit['shadows']}', the Gaussians are not"
        )
        is_named = case.key in str(error) or of_all in str(error)
        assert str(error).startswith("splats: ") and is_named, error
        return Found(is_refused=True)
    difference = loss.difference()
    try:
        forward = Loss(case, route).derivative(is_forward=True)
    except UnsupportedError as refused:
        assert "forward mode" in str(refused) and case.key in str(refused), refused
        forward = backward
    scale = abs(difference)
    return Found(False, abs(backward - difference) / scale, abs(backward - forward) / scale)


def measured_rows() -> list[list[str]]:
    """The rows of the table as the page has them, measured."""
    rows = [["parameter", *ROUTES]]
    for name, case in cases().items():
        cells = [
            "" if route == ALONE and not case.is_seen_alone else measure(case, route).text
            for route in ROUTES
        ]
        rows.append([name, *cells])
    return rows


with (REPOSITORY / "docs" / "derivatives.csv").open(newline="") as file:
    TABLE = {row.pop("parameter"): row for row in csv.DictReader(file)}
"""Cells by row and by column."""

CELLS = [(row, route) for row, of_row in TABLE.items() for route, cell in of_row.items() if cell]


@pytest.mark.slow
@pytest.mark.parametrize("row, route", CELLS)
def test_cells_equal_the_measured_errors(row, route):
    found, cell = measure(cases()[row], route), TABLE[row][route]
    assert found.fits(cell), (cell, found)
    # Both modes add up the same numbers, in another order.
    assert found.modes <= 1e-3, found


def test_the_table_has_all_parameters_and_routes():
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
    to_world = mi.ScalarTransform4f().translate([0, 3, -3]).rotate([1, 0, 0], 45).scale(30)
    bsdf = {"type": "diffuse", "reflectance": rgb(0.7)}  # or Mitsuba would merge it with the panel
    others = {"sky": None, "wall": {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}}
    case = Case("wall.to_world", others=others, move=translate(0, 0, 1), spp=2**15)
    assert measure(case, "`splatpath`").error < 0.01


@pytest.mark.slow
def test_scenes_are_freed_although_a_layer_does_not_depend_on_the_parameter():
    """Not by a later collection: during a trace, Dr.Jit would end the program."""
    case, is_enabled = cases()["`thindielectric` `specular_reflectance`"], gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        Loss(replace(case, spp=4), "`path`").derivative()
        gc.set_debug(gc.DEBUG_SAVEALL)
        gc.collect()
        assert not any(isinstance(one, types.FrameType) for one in gc.garbage)
    finally:
        gc.set_debug(0)
        gc.garbage.clear()
        if is_enabled:
            gc.enable()


def test_hair_is_rendered_despite_a_parameter_without_value():
    """Mitsuba cannot list its parameters with their values."""
    scene = load(Case("lamp.intensity.value", {"type": "hair"}, spp=16), "`splatpath`")
    assert dr.mean(mi.render(scene), axis=None) > 0


if __name__ == "__main__":
    mi.set_variant("llvm_ad_rgb")
    csv.writer(sys.stdout, lineterminator="\n").writerows(measured_rows())
