"""Derivatives of the ``splats`` integrator, against the float64 reference."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import clear
from support.splats_checks import ALL_PARAMETERS, XYZ, assert_gradients_agree, assert_images_agree
from support.views import VIEWS, Scene, View, gradient, gradients_of, image_of, pose, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.integrator import film as exposure
from drgs.reference import splatting as reference
from drgs.splatting import rendering

SETTINGS = {
    "degree 0": Scene(degree=0),
    "degree 1 of 3": Scene(degree=3, sh_degree=1),
    "degree 0 of 2": Scene(degree=2, sh_degree=0),
    "near": Scene(near=0.25),
    "near clip of the sensor": Scene(replace(VIEWS[1], near_clip=0.25)),
    "crop window": Scene(VIEWS[12]),
    "linear radiance": Scene(srgb_primitives=True),
    "linear radiance, antialiased, near": Scene(
        srgb_primitives=True, antialiased=True, degree=2, near=0.25
    ),
}


@pytest.mark.parametrize("name", SETTINGS)
def test_image_and_gradients_match_the_reference_for_any_setting(name):
    """Gradients of all parameters, from random weights on colour and alpha."""
    scene = clear(SETTINGS[name])
    names = [n for n in ALL_PARAMETERS if n != "shN" or scene.degree > 0]
    loaded = scene.load()
    assert_images_agree(image_of(loaded), scene.image())
    actual = gradients_of(loaded, scene.weights(), names)
    assert_gradients_agree(actual, scene.gradients(scene.weights()))


@pytest.mark.parametrize(
    ("pixel_format", "srgb_primitives", "matrix"),
    [
        ("rgb", False, np.eye(3)),
        ("rgb", True, np.eye(3)),
        ("luminance", True, XYZ[1:2]),
        ("xyz", True, XYZ),
    ],
)
def test_gradients_of_a_film_without_alpha(pixel_format, srgb_primitives, matrix):
    scene = clear(Scene(srgb_primitives=srgb_primitives))
    weights = scene.weights()[..., : len(matrix)]
    actual = gradients_of(scene.load(pixel_format=pixel_format), weights)
    of_rgba = np.concatenate([weights @ matrix, np.zeros_like(weights[..., :1])], axis=-1)
    assert_gradients_agree(actual, scene.gradients(of_rgba))


def test_nan_derivatives_reach_the_parameters():
    """Dr.Jit's derivative of a gather, such as of the film's pixels, would drop it."""
    scene = Scene()
    weights = scene.weights()
    weights[tuple(np.array(weights.shape[:2]) // 2)] = np.nan
    loaded = scene.load()
    actual = gradients_of(loaded, weights)
    assert not np.isfinite(actual["means"]).all()
    fault = rendering.decode_nonfinite(int(loaded.integrator().last.first_nonfinite[0]))
    assert fault is not None and fault[1] in PARAMETER_NAMES


def test_nonlinear_film_refuses_gradients(monkeypatch):
    scene = Scene()
    loaded = scene.load()
    develop = exposure.develop_pixels
    monkeypatch.setattr(exposure, "develop_pixels", lambda *args: dr.square(develop(*args)))
    with pytest.raises(Exception, match="does not map each pixel's channels linearly"):
        gradients_of(loaded, scene.weights())


@pytest.mark.parametrize("names", [("background",), ("shN", "quats")])
def test_only_enabled_parameters_receive_gradients(names):
    scene = Scene(srgb_primitives=True)
    loaded = scene.load()
    actual = gradients_of(loaded, scene.weights(), names)
    everything = gradients_of(scene.load(), scene.weights())
    for name in names:
        np.testing.assert_array_equal(actual[name], everything[name], err_msg=name)
    params = mi.traverse(loaded)
    others = set(ALL_PARAMETERS) - set(names)
    assert not any(dr.grad_enabled(params[f"integrator.{name}"]) for name in others)


def test_image_without_enabled_parameters_is_detached():
    loaded = Scene().load()
    assert not dr.grad_enabled(mi.render(loaded, mi.traverse(loaded)))
    dr.enable_grad(mi.traverse(loaded)["integrator.means"])
    assert not dr.grad_enabled(mi.render(loaded))


@pytest.mark.parametrize("suspended", [False, True], ids=["as it is", "gradients suspended"])
def test_render_backward_may_be_called_directly(suspended):
    """Derivatives are added to those of the call before."""
    scene = Scene()
    expected = gradients_of(scene.load(), scene.weights())
    loaded = scene.load()
    params = mi.traverse(loaded)
    for name in ALL_PARAMETERS:
        dr.enable_grad(params[f"integrator.{name}"])
    weights = mi.TensorXf(scene.weights().astype(np.float32))
    for count in (1, 2):
        with dr.suspend_grad(when=suspended):
            loaded.integrator().render_backward(loaded, params, weights, sensor=0)
        for name in ALL_PARAMETERS:
            actual = gradient(params[f"integrator.{name}"])
            np.testing.assert_array_equal(actual, count * expected[name], err_msg=name)


ASIDE_VIEW = View("aside", 31, 27, to_world=pose([0.3, -1.0, 0.5], 16, (0.6, -0.9, 0.9)))
"""Sees 26 of the 40 Gaussians before ``VIEWS[1]``."""


def test_last_provides_inputs_of_density_control():
    scene = clear(Scene())
    loaded = scene.load_with(ASIDE_VIEW.sensor())
    assert loaded.integrator().last is None
    weights = np.random.default_rng(2).normal(0, 1, (27, 31, 4))
    gradients_of(loaded, weights, ["means"])
    last = loaded.integrator().last
    actual = {"means2d": np.array(last.means2d_grad).astype(np.float64)}
    aside = replace(scene, view=ASIDE_VIEW)
    assert_gradients_agree(actual, aside.gradients(weights, scene.gaussians))

    # Visible: the box around the ellipse alpha = 1/255 holds a pixel's centre.
    splats = reference.project(scene.gaussians, ASIDE_VIEW.camera)
    k = 2 * np.log(np.maximum(splats.opacities / reference.ALPHA_CUT, 1))
    radius = np.sqrt(k[:, None] * np.diagonal(splats.cov2d, axis1=1, axis2=2))
    first = np.maximum(np.ceil(splats.means2d - radius - 0.5), 0)
    last_pixel = np.minimum(np.floor(splats.means2d + radius - 0.5), [30, 26])
    expected = splats.visible & (first <= last_pixel).all(axis=1)
    assert np.array_equal(np.array(last.visible), expected)
    assert expected.sum() == 26 and splats.visible.sum() == 38


@pytest.mark.parametrize("count", [80, 20])
def test_parameters_may_be_resized(count):
    loaded, resized = Scene().load(), clear(Scene(count=count))
    mi.render(loaded)
    params = mi.traverse(loaded)
    for name, value in tensors(resized.gaussians).items():
        params[f"integrator.{name}"] = value
    params.update()
    assert_images_agree(image_of(loaded), resized.image())
    weights = resized.weights()
    assert_gradients_agree(gradients_of(loaded, weights), resized.gradients(weights))
