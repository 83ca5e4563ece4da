"""Several splat objects in one scene: nested ``splats``, each with a place of its own."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from support.ellipsoids import joined
from support.splats_checks import write_gaussians
from support.views import Scene, gradients_of, image_of, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians

SCENE = Scene(degree=1)
MODELS = {
    name: Scene(degree=d, count=20 + d, seed=d).gaussians for name, d in (("lego", 2), ("fox", 0))
}


def load(objects, *own, **settings) -> mi.Scene:
    """Nested objects, and Gaussians of the integrator's own."""
    integrator = SCENE.settings | (tensors(joined(*own)) if own else {}) | settings
    integrator |= {name: {"type": "splats"} | each for name, each in objects.items()}
    sensor = SCENE.view.sensor()
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})


def nested(**others) -> dict:
    return {name: tensors(model) | others.get(name, {}) for name, model in MODELS.items()}


@pytest.mark.parametrize("own", [None, SCENE.gaussians], ids=["objects alone", "own besides"])
def test_objects_are_sorted_together(own):
    """The same bytes as of one file with all Gaussians, and the same derivatives."""
    own = [own] if own else []
    together, apart = load(nested(), *own), load({}, *own, *MODELS.values())
    np.testing.assert_array_equal(image_of(together), image_of(apart))
    assert together.integrator().sh_degree == 2
    names = [f"{name}.{p}" for name in MODELS for p in PARAMETER_NAMES if p != "shN"]
    found = gradients_of(together, SCENE.weights(), names)
    expected = gradients_of(apart, SCENE.weights(), PARAMETER_NAMES)
    start = len(own[0].means) if own else 0
    for name, model in MODELS.items():
        end = start + len(model.means)
        for p in PARAMETER_NAMES[:-1]:
            np.testing.assert_array_equal(found[f"{name}.{p}"], expected[p][start:end])
        start = end


def test_each_object_has_its_own_to_world(tmp_path):
    place = mi.ScalarTransform4f().translate([0.2, 0, 0.1]).rotate([0, 1, 0], 25)
    later = mi.ScalarTransform4f().translate([-0.1, 0.1, 0])
    files = {
        name: {"filename": write_gaussians(tmp_path / f"{name}.ply", model)}
        for name, model in MODELS.items()
    }
    files["lego"]["to_world"] = place
    scene = load(files)
    assert scene.integrator().gaussians.num_gaussians == 42
    params = mi.traverse(scene)
    assert {"integrator.lego.to_world", "integrator.lego.means", "integrator.fox.sh0"} <= set(
        params.keys()
    )
    assert "integrator.lego.background" not in params and "integrator.to_world" not in params
    params["integrator.fox.to_world"] = mi.Transform4f(later)
    params.update()
    parts = [
        load({}, model, to_world=to_world).integrator().gaussians.numpy()
        for model, to_world in zip(MODELS.values(), (place, later), strict=True)
    ]
    np.testing.assert_array_equal(image_of(scene), image_of(load({}, *parts)))
    assert "objects = lego, fox" in str(scene.integrator())


def test_xml_names_objects_by_their_ids(tmp_path):
    paths = {
        name: write_gaussians(tmp_path / f"{name}.ply", model) for name, model in MODELS.items()
    }
    objects = "".join(
        f'<integrator type="splats" id="{name}">'
        f'<string name="filename" value="{path}"/></integrator>'
        for name, path in paths.items()
    )
    scene = mi.load_string(
        f'<scene version="3.0.0"><integrator type="splats" id="all">{objects}</integrator></scene>'
    )
    assert list(scene.integrator().objects) == ["lego", "fox"]
    assert "all.lego.to_world" in mi.traverse(scene)


def test_missing_features_of_objects_are_zero():
    values = np.random.default_rng(2).normal(0, 1, (22, 2)).astype(np.float32)
    scene = load(nested(lego={"feature_x": mi.TensorXf(values)}), aovs="x:feature_x")
    whole = mi.TensorXf(np.pad(values, [(0, 20), (0, 0)]))
    expected = load({}, *MODELS.values(), feature_x=whole, aovs="x:feature_x")
    np.testing.assert_array_equal(image_of(scene), image_of(expected))


def test_a_nested_integrator_of_another_kind_renders_surfaces():
    integrator = load(nested() | {"inner": {"type": "path", "max_depth": 2}}).integrator()
    assert integrator.state.nested.class_name() == "PathIntegrator"
    assert list(integrator.objects) == ["lego", "fox"]


IN_ANOTHER = "splats: lego is nested in another splats integrator, .* got {}, which holds"
REFUSED = {
    **{
        name: (lambda name=name, value=value: nested(lego={name: value}), IN_ANOTHER.format(name))
        for name, value in {
            "background": [1, 1, 1],
            "aovs": "d:depth",
            "light": "none",
            "low_pass": 0.1,
            "sh_degree": 0,
            "srgb_primitives": True,
        }.items()
    },
    "two other integrators": (
        lambda: nested() | {"inner": {"type": "path"}, "another": {"type": "path"}},
        "at most one integrator can be nested besides splats, got 2",
    ),
    "an object without Gaussians": (
        lambda: {"lego": {}},
        "splats: lego is nested .* must be given Gaussians by filename, .* nothing",
    ),
    "an object in an object": (
        lambda: nested(lego={"deeper": {"type": "splats"} | tensors(MODELS["fox"])}),
        "got deeper, which holds for all: give it to the outer one",
    ),
    "a place that is no similarity": (
        lambda: nested(fox={"to_world": mi.ScalarTransform4f().scale([1, 1, 2])}),
        "splats: to_world must be made of rotations",
    ),
    "features of other widths": (
        lambda: nested(
            lego={"feature_x": mi.TensorXf(np.zeros((22, 2), np.float32))},
            fox={"feature_x": mi.TensorXf(np.zeros((20, 3), np.float32))},
        ),
        r"fox\.feature_x must have the 2 columns of the other",
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_invalid_objects_are_refused(name):
    objects, message = REFUSED[name]
    with pytest.raises(RuntimeError, match=message):
        load(objects())


def test_files_with_different_headers_require_a_property(tmp_path):
    paths = {}
    for name, said in (("lego", {"low_pass": 0.1}), ("fox", None)):
        arrays = {n: getattr(MODELS[name], n).astype(np.float32) for n in PARAMETER_NAMES}
        paths[name] = {"filename": str(tmp_path / f"{name}.ply")}
        Gaussians(**arrays, rendered_with=said).save(paths[name]["filename"])
    message = r"made for the same low_pass, got 0.1 \(.*lego.ply\), 0.3.* \(.*fox.ply\); give the"
    with pytest.raises(Exception, match=message):
        load(paths)
    given = {n: {"type": "splats"} | p for n, p in paths.items()} | {"low_pass": 0.2}
    assert mi.load_dict({"type": "splats", **given}).state.approximations.low_pass == 0.2
    agreeing = mi.load_dict({"type": "splats", "a": {"type": "splats"} | paths["lego"]})
    assert agreeing.state.approximations.low_pass == 0.1
    assert list(agreeing.state.header) == ["low_pass"]


def test_object_used_twice_receives_both_derivatives():
    lego = mi.load_dict({"type": "splats"} | tensors(MODELS["lego"]))
    integrator = SCENE.settings | {"a": lego, "b": lego}
    twice = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": SCENE.view.sensor()})
    apart = load({}, MODELS["lego"], MODELS["lego"])
    np.testing.assert_array_equal(image_of(twice), image_of(apart))
    found = gradients_of(twice, SCENE.weights(), ["a.means"])["a.means"]
    both = gradients_of(apart, SCENE.weights(), ["means"])["means"]
    expected = both[: len(found)] + both[len(found) :]
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(both).max())
