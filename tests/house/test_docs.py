"""The plugins' tables of parameters agree with the plugins."""

import re
import sys
from dataclasses import fields
from fractions import Fraction

import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from drgs.plugins import PLUGINS
from plugin_parameters import parameters_of
from support.views import Scene, tensors

import drgs  # noqa: F401  (registers the plugins)
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cameras.thin_prism_fisheye import ThinPrismFisheye
from drgs.config.approximations import Approximations
from drgs.integrator.properties import KNOWN

# ----------------------------------------------------------------------------------------------
# Tables of parameters
# ----------------------------------------------------------------------------------------------


def defaults(row) -> dict[str, str]:
    """Return defaults as written, by name; one for all names, or one each."""
    words = row.default.split(", ") if row.default else []
    words = words * len(row.names) if len(words) == 1 else words
    return dict(zip(row.names, words, strict=False))


NESTED = "(Nested plugin)"
PREFIXED = {"feature_...", "shapes_to_world_..."}

both_plugins = pytest.mark.parametrize("plugin", ["splats", "calibrated"])


def known(plugin) -> set[str]:
    module = sys.modules[f"drgs.plugins.llvm_ad_rgb.{plugin}"]
    return {
        "splats": {*KNOWN, *PREFIXED},
        "splatpath": set(getattr(module, "PROPERTIES", ())),
        "calibrated": set(getattr(module, "KNOWN", ())),
    }[plugin]


@pytest.mark.parametrize("plugin", ["splats", "splatpath", "calibrated"])
def test_table_lists_every_property(plugin):
    listed = [name for row in parameters_of(plugin) for name in row.names]
    assert len(listed) == len(set(listed))
    assert set(listed) - {NESTED} == known(plugin)


@pytest.mark.parametrize("plugin", PLUGINS)
def test_every_plugin_has_a_page_with_its_table(plugin):
    assert parameters_of(plugin)
    source = (REPOSITORY / "plugins" / f"{plugin}.py").read_text()
    registered = re.search(r'mi\.register_\w+\("(\w+)"', source)[1]
    page = (REPOSITORY / "docs" / "plugins" / f"{registered}.md").read_text()
    assert f"```{{plugin-parameters}} {plugin}\n```" in page
    assert f"(`{registered}`)" in page.splitlines()[0]


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
def test_table_marks_exposed_and_differentiable_parameters(plugin):
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
    rows = [row for row in parameters_of(plugin) if row.flags]
    actual = {name: frozenset(row.flags) for row in rows for name in row.names}
    assert actual == expected


KINDS = {bool: "bool", int: "int", float: "float", str: "string"}


def default_of(plugin, name):
    """Return the loaded plugin's value where nothing is given; None where that is not one value."""
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
def test_defaults_and_types_match_the_table(plugin):
    checked = set()
    for row in parameters_of(plugin):
        for name in row.names:
            value = default_of(plugin, name)
            if value is None:
                continue
            assert row.type == KINDS[type(value)], name
            if name != "nested_spp":  # in words: as many as of the splats
                assert written(defaults(row)[name]) == pytest.approx(value), name
            checked.add(name)
    assert len(checked) == {"splats": 14, "calibrated": 5}[plugin]


def test_every_property_has_a_default():
    rows = [row for plugin in PLUGINS for row in parameters_of(plugin)]
    assert [row.names for row in rows if not row.default] == [("filename",)]  # of splats_minimal
