"""Derivatives of images with surfaces between splats; what runs, and when."""

import gc
import weakref
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import bitwise
from support.views import (
    gradient,
    gradients_of,
    image_of,
    tensors,
)
from support.wall_scenes import GRADIENTS, IMAGE, SCENE, Wall, apart, blob, expected, load, rgba

import drgs  # noqa: F401  (registers the plugins)
from drgs.core.errors import UnsupportedError
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference

STEP = 1e-6


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


# ----------------------------------------------------------------------------------------------
# Derivatives
# ----------------------------------------------------------------------------------------------


RADIANCE_KEY = "wall.emitter.radiance.value"


def weights_of(scene, seed=1) -> np.ndarray:
    return scene.weights(seed)


@pytest.mark.parametrize("srgb_primitives", [False, True])
def test_gradients_equal_differences_of_the_reference(srgb_primitives):
    """Along a random direction of each parameter; the wall stays."""
    scene = apart(replace(SCENE, srgb_primitives=srgb_primitives))
    weights = weights_of(scene)
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


def test_gradient_of_wall_radiance_is_its_transmittance():
    scene = replace(apart(SCENE), srgb_primitives=True)
    weights = weights_of(scene)
    loaded = load(scene)
    params = mi.traverse(loaded)
    dr.enable_grad(params[RADIANCE_KEY])
    image = mi.render(loaded, params)
    dr.backward(dr.sum(image * mi.TensorXf(weights.astype(np.float32)), axis=None))
    share = expected(scene)["share"]
    terms = share[..., None] * weights[..., :3]
    np.testing.assert_allclose(
        gradient(params[RADIANCE_KEY]), terms.sum(axis=(0, 1)), atol=GRADIENTS * np.abs(terms).sum()
    )


@pytest.mark.parametrize("srgb_primitives", [False, True])
def test_forward_mode_is_the_transpose_of_the_gradients(srgb_primitives):
    """Parameters: the splats, the wall's colour, and the environment past its edges."""
    scene = apart(replace(SCENE, srgb_primitives=srgb_primitives))
    weights = weights_of(scene)
    keys = [f"integrator.{name}" for name in PARAMETER_NAMES]
    keys += [RADIANCE_KEY, "sky.radiance.value"]
    wall = Wall(half=0.5)

    def attached():
        loaded = load(scene, wall=wall, sky=True, nested_spp=16)
        params = mi.traverse(loaded)
        for key in keys:
            dr.enable_grad(params[key])
        return loaded, params

    loaded, params = attached()
    image = mi.render(loaded, params, seed=1, seed_grad=2)
    dr.backward(dr.sum(image * mi.TensorXf(weights.astype(np.float32)), axis=None))
    gradients = {key: gradient(params[key]) for key in keys}

    rng = np.random.default_rng(7)
    loaded, params = attached()
    total = size = 0.0
    for key in keys:
        direction = rng.normal(0, 1, gradients[key].shape).astype(np.float32)
        dr.set_grad(params[key], type(params[key])(direction))
        terms = gradients[key] * direction
        assert np.abs(terms).sum() > 0, key
        total, size = total + terms.sum(), size + np.abs(terms).sum()
    # Forward mode's own seed is seed_grad as well.
    tangent = dr.forward_to(mi.render(loaded, params, seed=1, seed_grad=2))
    tangent = np.array(tangent).astype(np.float64)
    assert np.sum(tangent * weights) == pytest.approx(total, abs=GRADIENTS * size)


SENSORS = {
    "perspective": (
        {"type": "perspective"},
        ["to_world", "x_fov", "principal_point_offset_x", "principal_point_offset_y"],
    ),
    "thinlens": (
        {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 2.0},
        ["to_world", "aperture_radius", "focus_distance"],
    ),
    "orthographic": ({"type": "orthographic"}, ["to_world"]),
    "calibrated": (
        {"type": "calibrated", "fx": 8.0, "lens": "opencv", "k1": 0.01},
        ["to_world", "fx", "cx", "k1"],
    ),
    "batch": (
        {
            "type": "batch",
            "left": {"type": "perspective"},
            "right": {"type": "perspective", "fov": 50},
        },
        ["left.to_world", "right.x_fov"],
    ),
}
"""With parameters that can be differentiated where there are no surfaces."""

NESTED = {
    "the default": {},
    "path": {"nested": {"type": "path"}},
    "prb": {"nested": {"type": "prb"}},
    "splatpath": {"nested": {"type": "splatpath"}},
    "rays": {"light": "rays"},
    "probe": {"light": "probe", "probes": "wall"},
}


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["backward", "forward"])
@pytest.mark.parametrize("nested", NESTED)
def test_camera_derivatives_with_surfaces_are_refused_by_name(nested, mode):
    check_refused("perspective", ["to_world"], NESTED[nested], mode)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SENSORS)
def test_camera_derivatives_with_surfaces_are_refused_for_every_sensor(kind):
    check_refused(kind, SENSORS[kind][1], {}, "backward")


def check_refused(kind, keys, settings, mode):
    film = {"type": "hdrfilm", "width": 8, "height": 4, "rfilter": {"type": "box"}}
    loaded = load(SCENE, wall=Wall(), **settings)
    for key in keys:
        sensor = mi.load_dict({**SENSORS[kind][0], "film": film, "id": "eye"})
        params = mi.traverse(sensor)
        dr.enable_grad(params[key])
        image = mi.render(loaded, params, sensor=sensor)
        derivative = dr.backward if mode == "backward" else dr.forward_to
        with pytest.raises(UnsupportedError, match=rf"^splats: eye\.{key} is not differentiated"):
            derivative(image)


def test_gradients_are_the_same_to_the_last_bit():
    scene = apart(SCENE)
    runs = [gradients_of(load(scene), weights_of(scene), PARAMETER_NAMES) for _ in range(2)]
    assert bitwise(list(runs[0].values())) == bitwise(list(runs[1].values()))


# ----------------------------------------------------------------------------------------------
# Runs of the nested integrator
# ----------------------------------------------------------------------------------------------


def counting():
    """``path``, that counts its images."""

    class Counting(mi.SamplingIntegrator):
        def __init__(self, props):
            super().__init__(props)
            self.path = mi.load_dict({"type": "path"})
            self.count = 0

        def render(self, *arguments, **named):
            self.count += 1
            return self.path.render(*arguments, **named)

    mi.register_integrator("counting", lambda props: Counting(props))
    return mi.load_dict({"type": "counting"})


def test_a_scene_without_surfaces_never_runs_the_nested_integrator():
    nested = counting()
    scene = load(SCENE, wall=None, sky=True, nested=nested)
    image_of(scene)
    assert nested.count == 0
    image_of(load(SCENE, nested=nested))
    assert nested.count == 1


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


def test_nested_samples_are_independent_of_the_splats():
    """Whatever the nested integrator writes into the sensor's sampler."""
    scene, weights = apart(SCENE), weights_of(SCENE)
    loaded = load(scene, nested_spp=16)
    images = [image_of(loaded) for _ in range(2)]
    np.testing.assert_array_equal(*images)
    gradients = [gradients_of(loaded, weights, ["means"])["means"] for _ in range(2)]
    np.testing.assert_array_equal(gradients[1], 2 * gradients[0])  # they are accumulated
    assert loaded.sensors()[0].sampler().sample_count() == 1


@pytest.mark.parametrize("mode", ["backward", "forward"])
def test_surface_derivatives_keep_the_sample_count(mode):
    loaded = load(apart(SCENE), nested_spp=16)
    params = mi.traverse(loaded)
    dr.enable_grad(params[RADIANCE_KEY])
    dr.set_grad(params[RADIANCE_KEY], 1)
    image = mi.render(loaded, params)
    derivative = dr.backward if mode == "backward" else dr.forward_to
    derivative(image)
    assert loaded.sensors()[0].sampler().sample_count() == 1


def test_nested_integrator_can_be_set():
    """``direct`` does not see a light by way of another surface."""
    scene = load(apart(SCENE), nested=mi.load_dict({"type": "direct"}))
    np.testing.assert_allclose(
        image_of(scene), image_of(load(apart(SCENE))), rtol=0, atol=IMAGE * 2
    )
    assert "nested = " in str(scene.integrator())


@pytest.mark.parametrize("spp", [0, 4], ids=["its sampler's", "given"])
def test_nested_integrator_keeps_its_own_sample_count(spp):
    """Mitsuba's integrators leave their count with the sampler: the next image is the same."""
    loaded = load(apart(SCENE), wall=Wall(half=0.5), nested_spp=16)
    first = image_of(loaded, spp=spp, seed=3)
    assert loaded.sensors()[0].sampler().sample_count() == 1
    loaded.integrator().state.cache.forget("frames")
    np.testing.assert_array_equal(image_of(loaded, spp=spp, seed=3), first)


def test_gradients_match_the_image_for_any_nested_samples():
    """Splats at the centres of pixels, before a wall that covers the film and has no noise."""
    scene, weights = apart(SCENE), weights_of(SCENE)
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
    scene, weights = apart(SCENE), weights_of(SCENE)
    loaded = load(scene)
    expected = gradients_of(loaded, weights, ["means"])["means"]
    loaded, other = load(scene), load(scene, wall=Wall(z=2.9))
    params = mi.traverse(loaded)
    dr.enable_grad(params["integrator.means"])
    image = mi.render(loaded, params)
    mi.render(other, integrator=loaded.integrator())
    dr.backward(dr.sum(image * mi.TensorXf(weights.astype(np.float32)), axis=None))
    np.testing.assert_array_equal(gradient(params["integrator.means"]), expected)


def test_gaussians_of_shapes_are_not_surfaces():
    """They equal the integrator's own, and the nested image does not show them."""
    scene = apart(SCENE)
    center = scene.camera.rotation.T @ [0, 0, 1.5] + scene.camera.center
    one = {
        "means": center,
        "quats": [1, 0, 0, 0],
        "log_scales": np.log([0.3] * 3),
        "logit_opacities": np.log(3),
        "sh0": np.ones((1, 3)),
        "shN": np.zeros((3, 3)),
    }
    together = {n: np.concatenate([v, [one[n]]]) for n, v in vars(scene.gaussians).items()}
    image = image_of(load(scene, shapes={"blob": blob(center)}))
    expected = image_of(load(scene, **tensors(reference.Gaussians(**together))))
    np.testing.assert_allclose(image, expected, atol=IMAGE * expected.max())
    assert np.abs(image - image_of(load(scene))).max() > 0.1
