"""Caches of the ``splats`` integrator, its parameters, and that its bytes repeat."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.splats_checks import assert_images_agree, fresh_image
from support.views import VIEWS, Scene, gradients_of, image_of, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.splatting import rendering


def test_traverse_lists_the_documented_parameters_as_differentiable():
    gaussians = Scene().gaussians
    params = mi.traverse(mi.load_dict({"type": "splats", **tensors(gaussians)}))
    assert list(params.keys()) == [*PARAMETER_NAMES, "to_world", "background"]
    for name in PARAMETER_NAMES:
        assert tuple(params[name].shape) == getattr(gaussians, name).shape
    assert {type(params[name]) for name in PARAMETER_NAMES} == {mi.TensorXf, mi.Float}
    for name in params.keys():  # noqa: SIM118
        assert params.flags(name) == mi.ParamFlags.Differentiable.value, name


def test_a_model_of_degree_zero_has_no_empty_parameter():
    """An empty parameter could not be optimized."""
    params = mi.traverse(Scene(degree=0).load())
    ours = [key for key in params.keys() if key.startswith("integrator.")]  # noqa: SIM118
    names = [*(name for name in PARAMETER_NAMES if name != "shN"), "to_world", "background"]
    assert ours == [f"integrator.{name}" for name in names]


@pytest.fixture
def renderings(monkeypatch):
    """A list that grows with each frame that is rendered and not reused."""
    calls = []
    original = rendering.render

    def counting(*arguments):
        calls.append(arguments)
        return original(*arguments)

    monkeypatch.setattr(rendering, "render", counting)
    return calls


POSE = VIEWS[2].to_world

SENSOR_CHANGES = {
    "to_world": (lambda: mi.ScalarTransform4f(np.array(POSE)), {"to_world": POSE}),
    "x_fov": (lambda: 60.0, {"fov": 60.0}),
    "principal_point_offset_x": (lambda: 0.125, {"offset": (0.125, 0.0)}),
    "near_clip": (lambda: 0.25, {"near_clip": 0.25}),
    "film.size": (lambda: [29, 19], {"width": 29, "height": 19}),
    "film.crop_offset": (lambda: [15, 9], {"crop": (15, 9, 29, 18)}),
}


@pytest.mark.parametrize("name", SENSOR_CHANGES)
def test_a_changed_sensor_is_rendered_again(name, renderings):
    value, changes = SENSOR_CHANGES[name]
    scene = Scene(VIEWS[12] if name == "film.crop_offset" else VIEWS[1])
    loaded = scene.load()
    before = image_of(loaded)
    params = mi.traverse(loaded)
    params[f"sensor.{name}"] = value()
    params.update()
    assert len(renderings) == 1
    after = image_of(loaded)
    assert len(renderings) == 2
    view = replace(scene.view, **changes)
    assert_images_agree(after, image_of(scene.load_with(view.sensor())))
    assert after.shape != before.shape or np.abs(after - before).max() > 0.05


@pytest.mark.parametrize("name", PARAMETER_NAMES)
def test_a_changed_parameter_is_rendered_again(name, renderings):
    scene = Scene()
    loaded = scene.load()
    before = image_of(loaded)
    params = mi.traverse(loaded)
    params[f"integrator.{name}"] = params[f"integrator.{name}"] + 0.25
    params.update()
    after = image_of(loaded)
    assert len(renderings) == 2 and np.abs(after - before).max() > 0.01
    value = type(params[f"integrator.{name}"])(params[f"integrator.{name}"])
    assert np.array_equal(after, image_of(scene.load_with(**{name: value})))


def test_a_parameter_written_in_place_is_rendered_again():
    """Through a view of its memory, announced as Mitsuba asks for: no variable's index changes."""
    scene = Scene()
    loaded = scene.load()
    before = image_of(loaded)
    params = mi.traverse(loaded)
    memory = params["integrator.logit_opacities"].numpy()
    memory += 1
    params.set_dirty("integrator.logit_opacities")
    params.update()
    after = image_of(loaded)
    value = mi.TensorXf(scene.gaussians.logit_opacities.astype(np.float32) + 1)
    expected = image_of(scene.load_with(logit_opacities=value))
    assert np.abs(after - before).max() > 0.01 and np.array_equal(after, expected)


def test_a_changed_background_needs_no_new_frame(renderings):
    scene = Scene(srgb_primitives=True)
    loaded = scene.load()
    mi.render(loaded)
    params = mi.traverse(loaded)
    params["integrator.background"] = [0.375, 0.875, 0.0625]
    params.update()
    after = image_of(loaded)
    assert len(renderings) == 1
    changed = replace(scene, background=(0.375, 0.875, 0.0625))
    assert np.array_equal(after, fresh_image(changed))


def test_backward_pass_leaves_no_autodiff_graph():
    """The film would hold it until the next rendering."""
    scene = Scene()
    loaded = scene.load()
    gradients_of(loaded, scene.weights())
    assert not dr.grad_enabled(loaded.sensors()[0].film().develop())
    params = mi.traverse(loaded)
    dr.set_grad(params["integrator.means"], 1)
    dr.forward_to(mi.render(loaded, params))
    assert not dr.grad_enabled(loaded.sensors()[0].film().develop())
