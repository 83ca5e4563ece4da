"""What the plugins' tables of parameters say is what there is."""

import ast
import re
from dataclasses import dataclass, fields
from fractions import Fraction
from itertools import chain

import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from support.views import Scene, tensors

import drgs  # noqa: F401  (registers the plugins)
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cameras.thin_prism_fisheye import ThinPrismFisheye
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


# ----------------------------------------------------------------------------------------------
# Tables of parameters
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Row:
    """Of a table in Mitsuba's format; it may hold several names."""

    names: tuple[str, ...]
    kind: str
    text: str
    flags: frozenset[str]

    @property
    def defaults(self) -> dict[str, str]:
        """By name, as they are written; one for all, or one each."""
        found = re.search(r"\(Default: ([^)]*)\)", self.text)
        words = found[1].split(", ") if found else []
        words = words * len(self.names) if len(words) == 1 else words
        return dict(zip(self.names, words, strict=False))


def source(plugin) -> str:
    return (REPOSITORY / "plugins" / f"{plugin}.py").read_text()


def table(plugin) -> list[Row]:
    documentation = source(plugin).split(".. pluginparameters::")[1].split("    This ")[0]
    rows = []
    for item in re.split(r"\n     \* - ", documentation)[1:]:
        names, kind, text, *flags = item.split("\n       - ")
        flags = re.findall(r"\|(\w+)\|", flags[0]) if flags else []
        rows.append(Row(tuple(names.split(", ")), kind, " ".join(text.split()), frozenset(flags)))
    return rows


def names_read(plugin) -> set[str]:
    """Every name that the code asks a property set for, itself or through a function."""
    names = set()
    reading = [source(plugin)]
    if plugin == "splats":
        reading.append((REPOSITORY / "drgs" / "integrator" / "properties.py").read_text())
    for node in chain.from_iterable(ast.walk(ast.parse(text)) for text in reading):
        if isinstance(node, ast.Call):
            of_props = isinstance(node.func, ast.Attribute) and _is_props(node.func.value)
            found = node.args[:1] if of_props else []
            if node.args and _is_props(node.args[0]):
                found = node.args[1:2]
        elif isinstance(node, ast.Subscript) and _is_props(node.value):
            found = [node.slice]
        elif isinstance(node, ast.Compare) and _is_props(node.comparators[0]):
            found = [node.left]
        else:
            continue
        names |= {n.value for n in found if isinstance(n, ast.Constant)}
    return names


def _is_props(node) -> bool:
    return isinstance(node, ast.Name) and node.id == "props"


NESTED = "(Nested plugin)"
OTHERS = {
    # Read by name lists and prefixes.
    "splats": {*PARAMETER_NAMES, *(field.name for field in fields(Approximations))}
    | {NESTED, "feature_...", "shapes_to_world", "shapes_to_world_..."},
    # Coefficients; and what Mitsuba's base class reads.
    "calibrated": {
        *RadialTangential.coefficient_names(),
        *ThinPrismFisheye.coefficient_names(),
        "to_world",
        "shutter_open",
    },
}

both_plugins = pytest.mark.parametrize("plugin", ["splats", "calibrated"])


@both_plugins
def test_the_table_lists_every_name_that_is_read(plugin):
    listed = [name for row in table(plugin) for name in row.names]
    assert len(listed) == len(set(listed))
    assert set(listed) == names_read(plugin) | OTHERS[plugin]


def loaded(plugin) -> list[mi.Object]:
    """Which, together, have all that can be exposed."""
    if plugin == "splats":
        gaussians = tensors(Scene(count=8).gaussians)
        feature = mi.TensorXf(np.zeros((8, 2), np.float32))
        nested = {"type": "path"}
        settings = {"type": "splats", **gaussians, "feature_own": feature, "inner": nested}
        return [mi.load_dict(settings)]
    common = {
        "type": "calibrated",
        "to_world_close": mi.ScalarTransform4f().translate([1, 0, 0]),
        "film": {"type": "hdrfilm", "width": 32, "height": 32},
    }
    lenses = (RadialTangential, ThinPrismFisheye)
    return [
        mi.load_dict({**common, "lens": lens.kind, **dict.fromkeys(lens.coefficient_names(), 0.0)})
        for lens in lenses
    ]


@both_plugins
def test_the_table_marks_what_is_exposed_and_differentiable(plugin):
    found = {}

    class Callback:
        """Only what the plugin itself hands over."""

        def put(self, name, value, flags):
            del value
            found[name] = flags

    things = loaded(plugin)
    if plugin == "splats":
        things[0].traverse(Callback())
        found[NESTED], found["feature_..."] = found.pop("nested"), found.pop("feature_own")
    else:
        of_mitsuba = ("shutter_open", "shutter_open_time")
        found = {
            name: params.flags(name)
            for params in map(mi.traverse, things)
            for name in params.keys()  # noqa: SIM118
            if "." not in name and name not in of_mitsuba
        }
    differentiable = mi.ParamFlags.Differentiable.value
    expected = {
        name: frozenset(
            {"exposed"} | ({"differentiable"} if int(flags) == differentiable else set())
        )
        for name, flags in ((k, getattr(v, "value", v)) for k, v in found.items())
    }
    actual = {name: row.flags for row in table(plugin) for name in row.names if row.flags}
    assert actual == expected


KINDS = {bool: "|bool|", int: "|int|", float: "|float|", str: "|string|"}


def default_of(plugin, name):
    """What the loaded plugin has where nothing is given; None where that is not one value."""
    if plugin == "splats":
        if name in {field.name for field in fields(Approximations)} - {"extent"}:
            return getattr(Approximations(), name)
        known = {"hide_emitters", "near", "nested_spp", "srgb_primitives"}
        integrator = mi.load_dict({"type": "splats", **tensors(Scene(count=8).gaussians)})
        return getattr(integrator.state, name) if name in known else None
    sensor = mi.load_dict({"type": "calibrated"})
    known = {"lens": "pinhole", "near_clip": sensor.near_clip(), "far_clip": sensor.far_clip()}
    known |= {"shutter": sensor.shutter, "shutter_samples": sensor.shutter_samples}
    assert type(sensor.lens).__name__.lower() == known["lens"]
    return known.get(name)


def written(text):
    """The value of a default as the table has it."""
    text = text.strip("`|")
    if text in ("true", "false"):
        return text == "true"
    if re.fullmatch(r"[\d.e/-]+", text):
        return float(Fraction(text)) if "/" in text else float(text)
    return text


@both_plugins
def test_defaults_and_types_are_those_of_the_table(plugin):
    checked = set()
    for row in table(plugin):
        for name in row.names:
            value = default_of(plugin, name)
            if value is None:
                continue
            assert row.kind == KINDS[type(value)], name
            if name != "nested_spp":  # in words: as many as of the splats
                assert written(row.defaults[name]) == pytest.approx(value), name
            checked.add(name)
    assert len(checked) == {"splats": 14, "calibrated": 5}[plugin]


def test_every_row_has_a_default_or_is_one_of_several_ways_to_give_gaussians():
    without = {name for p in ("splats", "calibrated") for r in table(p) for name in r.names}
    without -= {name for p in ("splats", "calibrated") for r in table(p) for name in r.defaults}
    ways = {"filename", *PARAMETER_NAMES, "feature_..."}
    assert {name for name in without if "(Default" not in row_text(name)} == ways


def row_text(name) -> str:
    return next(row.text for p in ("splats", "calibrated") for row in table(p) if name in row.names)
