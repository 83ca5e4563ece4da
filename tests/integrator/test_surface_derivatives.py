"""Derivatives of images with surfaces between splats; what runs, and when."""

import gc
import weakref
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import bitwise
from support.views import gradient, gradients_of, image_of
from support.wall_scenes import GRADIENTS, IMAGE, SCENE, Wall, apart, blob, load, rgba

import drgs  # noqa: F401  (registers the plugins)
from drgs.core.errors import UnsupportedError
from drgs.gaussians.parameters import PARAMETER_NAMES

STEP = 1e-6


RADIANCE_KEY = "wall.emitter.radiance.value"


@pytest.mark.parametrize("srgb_primitives", [False, True])
def test_gradients_equal_differences_of_the_reference(srgb_primitives):
    """Along a random direction of each parameter; the wall stays."""
    scene = apart(replace(SCENE, srgb_primitives=srgb_primitives))
    weights = scene.weights()
    actual = gradients_of(load(scene), weights, PARAMETER_NAMES)
    rng = np.random.default_rng(5)
    for name in PARAMETER_NAMES:
        value = getattr(scene.gaussians, name)
        direction = rng.normal(0, 1, value.shape)
        losses = []
        for sign in (1, -1):
            moved = replace(scene.gaussians, **{name: value + sign * STEP * direction})
            losses.append(np.sum(weights * rgba(scene, gaussians=moved)))
        terms = actual[name].reshape(direction.shape) * direction
        size = np.abs(terms).sum()
        assert size > 0
        difference = (losses[0] - losses[1]) / (2 * STEP)
        assert terms.sum() == pytest.approx(difference, abs=GRADIENTS * size), name


PERSPECTIVE = {"type": "perspective"}
OF_CAMERAS = {
    "perspective": (PERSPECTIVE, ("to_world", "x_fov", "principal_point_offset_x"), {}),
    "thinlens": (
        {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 2.0},
        ("to_world", "aperture_radius", "focus_distance"),
        {},
    ),
    "orthographic": ({"type": "orthographic"}, ("to_world",), {}),
    "calibrated": (
        {"type": "calibrated", "fx": 8.0, "lens": "opencv", "k1": 0.01},
        ("to_world", "fx", "cx", "k1"),
        {},
    ),
    "batch": (
        {"type": "batch", "left": PERSPECTIVE, "right": {"type": "perspective", "fov": 50}},
        ("left.to_world", "right.x_fov"),
        {},
    ),
    "prb": (PERSPECTIVE, ("to_world",), {"nested": {"type": "prb"}}),
    "splatpath": (PERSPECTIVE, ("to_world",), {"nested": {"type": "splatpath"}}),
    "rays": (PERSPECTIVE, ("to_world",), {"light": "rays"}),
    "probe": (PERSPECTIVE, ("to_world",), {"light": "probe", "probes": "wall"}),
}
"""Sensors, parameters that have derivatives without surfaces, and settings."""


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [dr.backward, dr.forward_to])
@pytest.mark.parametrize("name", OF_CAMERAS)
def test_camera_derivatives_with_surfaces_are_refused_by_name(name, derivative):
    sensor, keys, settings = OF_CAMERAS[name]
    film = {"type": "hdrfilm", "width": 8, "height": 4, "rfilter": {"type": "box"}}
    loaded = load(SCENE, wall=Wall(), **settings)
    for key in keys:
        eye = mi.load_dict({**sensor, "film": film, "id": "eye"})
        params = mi.traverse(eye)
        dr.enable_grad(params[key])
        image = mi.render(loaded, params, sensor=eye)
        with pytest.raises(UnsupportedError, match=rf"^splats: eye\.{key} is not differentiated"):
            derivative(image)


def test_gradients_are_the_same_to_the_last_bit():
    scene = apart(SCENE)
    runs = [gradients_of(load(scene), scene.weights(), PARAMETER_NAMES) for _ in range(2)]
    assert bitwise(list(runs[0].values())) == bitwise(list(runs[1].values()))


def test_a_scene_without_surfaces_never_runs_the_nested_integrator():
    counts, path = [], mi.load_dict({"type": "path"})

    class Counting(mi.SamplingIntegrator):
        def render(self, *arguments, **named):
            counts.append(1)
            return path.render(*arguments, **named)

    nested = Counting(mi.Properties())
    image_of(load(SCENE, wall=None, sky=True, nested=nested))
    assert not counts
    image_of(load(SCENE, nested=nested))
    assert counts == [1]


@pytest.mark.slow
@pytest.mark.parametrize("use", ["an image", "a gradient", "an image with gradients"])
@pytest.mark.parametrize("with_shapes", [False, True])
def test_unreferenced_scene_is_freed(use, with_shapes):
    """Though its integrator keeps what it saw of it."""
    loaded = load(SCENE, sky=True, shapes={"blob": blob([0, 0, 0])} if with_shapes else {})
    params = mi.traverse(loaded)
    if use != "an image":
        dr.enable_grad(params["integrator.means"], params[RADIANCE_KEY])
    image = mi.render(loaded, params)
    if use == "a gradient":
        dr.backward(dr.mean(image, axis=None))
    integrator = weakref.ref(loaded.integrator())
    del loaded, params, image
    gc.collect()
    assert integrator() is None


@pytest.mark.parametrize("spp", [0, 4], ids=["its sampler's", "given"])
def test_nested_samples_are_independent_of_the_splats(spp):
    """Whatever the nested integrator and its derivatives write into the sensor's sampler."""
    loaded = load(apart(SCENE), wall=Wall(half=0.5), nested_spp=16)
    first = image_of(loaded, spp=spp, seed=3)
    loaded.integrator().state.cache.forget("frames")
    np.testing.assert_array_equal(image_of(loaded, spp=spp, seed=3), first)
    params = mi.traverse(loaded)
    for derivative in (dr.backward, dr.forward_to):
        dr.enable_grad(params[RADIANCE_KEY])
        dr.set_grad(params[RADIANCE_KEY], 1)
        derivative(mi.render(loaded, params))
        assert loaded.sensors()[0].sampler().sample_count() == 1


def test_nested_integrator_can_be_set():
    """``direct`` does not see a light by way of another surface."""
    scene = load(apart(SCENE), nested=mi.load_dict({"type": "direct"}))
    np.testing.assert_allclose(
        image_of(scene), image_of(load(apart(SCENE))), rtol=0, atol=IMAGE * 2
    )
    assert "nested = " in str(scene.integrator())


def test_gradients_match_the_image_for_any_nested_samples():
    """Splats at the centres of pixels, before a wall that covers the film and has no noise."""
    scene, weights = apart(SCENE), SCENE.weights()
    alone = gradients_of(load(scene), weights, ["means"])["means"]
    with_more = gradients_of(load(scene, nested_spp=16), weights, ["means"])["means"]
    np.testing.assert_allclose(with_more, alone, rtol=0, atol=GRADIENTS * np.abs(alone).max())


def test_moved_wall_is_rendered_at_its_new_place():
    scene = apart(SCENE)
    loaded = load(scene)
    image_of(loaded)
    params = mi.traverse(loaded)
    other = mi.load_dict(Wall(z=2.9).shape(scene.camera))
    params["wall.to_world"] = mi.traverse(other)["to_world"]
    params.update()
    np.testing.assert_array_equal(image_of(loaded), image_of(load(scene, wall=Wall(z=2.9))))


def test_rendering_another_image_keeps_gradients():
    scene, weights = apart(SCENE), SCENE.weights()
    loaded = load(scene)
    expected = gradients_of(loaded, weights, ["means"])["means"]
    loaded, other = load(scene), load(scene, wall=Wall(z=2.9))
    params = mi.traverse(loaded)
    dr.enable_grad(params["integrator.means"])
    image = mi.render(loaded, params)
    mi.render(other, integrator=loaded.integrator())
    dr.backward(dr.sum(image * mi.TensorXf(weights.astype(np.float32)), axis=None))
    np.testing.assert_array_equal(gradient(params["integrator.means"]), expected)
