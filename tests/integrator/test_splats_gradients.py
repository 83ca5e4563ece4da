"""Derivatives of the ``splats`` integrator, against the float64 reference."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import NEAR_THRESHOLD, clear, relative_errors
from support.splats_checks import (
    ALL_PARAMETERS,
    GRADIENTS,
    STEP,
    XYZ,
    all_settings,
    assert_gradients_agree,
    assert_images_agree,
    both_color_spaces,
    fresh_image,
    random_directions,
    with_tangents,
)
from support.views import VIEWS, Scene, View, gradient, gradients_of, image_of, pose, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.integrator import film as exposure
from drgs.reference import splatting as reference
from drgs.splatting import rendering


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


# ----------------------------------------------------------------------------------------------
# Gradients
# ----------------------------------------------------------------------------------------------


@all_settings
def test_gradients_match_the_reference_for_any_setting(scene):
    """Gradients of all parameters, from random weights on colour and alpha."""
    scene = clear(scene)
    names = [n for n in ALL_PARAMETERS if n != "shN" or scene.degree > 0]
    actual = gradients_of(scene.load(), scene.weights(), names)
    assert_gradients_agree(actual, scene.gradients(scene.weights()))


@both_color_spaces
@pytest.mark.parametrize("view", [VIEWS[6], VIEWS[10], VIEWS[12]], ids=lambda view: view.name)
def test_gradients_match_the_reference_from_other_views(view, srgb_primitives):
    """A tall film, an off-centre principal point, a crop window."""
    scene = clear(Scene(view, srgb_primitives=srgb_primitives))
    actual = gradients_of(scene.load(), scene.weights())
    assert_gradients_agree(actual, scene.gradients(scene.weights()))


@both_color_spaces
def test_gradients_of_a_film_without_alpha(srgb_primitives):
    scene = clear(Scene(srgb_primitives=srgb_primitives))
    weights = scene.weights() * [1, 1, 1, 0]
    actual = gradients_of(scene.load(pixel_format="rgb"), weights[..., :3])
    assert_gradients_agree(actual, scene.gradients(weights))


@pytest.mark.parametrize(
    ("pixel_format", "matrix"), [("luminance", XYZ[1:2]), ("xyz", XYZ)], ids=["luminance", "xyz"]
)
def test_gradients_of_a_film_that_converts_colors(pixel_format, matrix):
    scene = clear(Scene(srgb_primitives=True))
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


def test_gradient_tests_detect_one_percent_errors():
    scene = clear(Scene())
    expected = scene.gradients(scene.weights())
    scaled = {name: 1.01 * expected[name] for name in ALL_PARAMETERS}
    errors = relative_errors(scaled, {name: expected[name] for name in ALL_PARAMETERS})
    assert min(errors.values()) > 10 * GRADIENTS


@pytest.mark.parametrize(
    "names", [("means",), ("background",), ("logit_opacities", "sh0"), ("shN", "quats")]
)
def test_only_enabled_parameters_receive_gradients(names):
    scene = Scene(srgb_primitives=True)
    loaded = scene.load()
    actual = gradients_of(loaded, scene.weights(), names)
    everything = gradients_of(scene.load(), scene.weights())
    for name in names:
        assert np.array_equal(actual[name], everything[name]), name
        assert np.abs(actual[name]).max() > 0
    params = mi.traverse(loaded)
    others = set(ALL_PARAMETERS) - set(names)
    assert not any(dr.grad_enabled(params[f"integrator.{name}"]) for name in others)


def test_image_without_enabled_parameters_is_detached():
    loaded = Scene().load()
    assert not dr.grad_enabled(mi.render(loaded, mi.traverse(loaded)))
    dr.enable_grad(mi.traverse(loaded)["integrator.means"])
    assert not dr.grad_enabled(mi.render(loaded))


def test_gradients_reach_the_inputs_of_parameters():
    """A shift of all means: its gradient is the sum of theirs."""
    scene = clear(Scene())
    loaded = scene.load()
    params = mi.traverse(loaded)
    shift = mi.Float(0.0)
    dr.enable_grad(shift)
    params["integrator.means"] = params["integrator.means"] + shift
    params.update()
    image = mi.render(loaded, params)
    dr.backward(dr.sum(image * mi.TensorXf(scene.weights().astype(np.float32)), axis=None))
    expected = scene.gradients(scene.weights())["means"]
    assert dr.grad(shift)[0] == pytest.approx(
        expected.sum(), abs=GRADIENTS * np.abs(expected).max()
    )


def test_gradients_accumulate():
    scene = Scene()
    loaded = scene.load()
    once = gradients_of(loaded, scene.weights())
    twice = gradients_of(loaded, scene.weights())
    for name in ALL_PARAMETERS:
        assert np.array_equal(twice[name], 2 * once[name]), name


@pytest.mark.parametrize("suspended", [False, True], ids=["as it is", "gradients suspended"])
def test_render_backward_may_be_called_directly(suspended):
    scene = Scene()
    expected = gradients_of(scene.load(), scene.weights())
    loaded = scene.load()
    params = mi.traverse(loaded)
    for name in ALL_PARAMETERS:
        dr.enable_grad(params[f"integrator.{name}"])
    weights = mi.TensorXf(scene.weights().astype(np.float32))
    with dr.suspend_grad(when=suspended):
        loaded.integrator().render_backward(loaded, params, weights, sensor=0)
    for name in ALL_PARAMETERS:
        assert np.array_equal(gradient(params[f"integrator.{name}"]), expected[name]), name


ASIDE_VIEW = View("aside", 31, 27, to_world=pose([0.3, -1.0, 0.5], 16, (0.6, -0.9, 0.9)))
"""Sees 26 of the 40 Gaussians before ``VIEWS[1]``."""


def reference_gradients_from(view, scene, weights) -> dict[str, np.ndarray]:
    """Gradients for the Gaussians of ``scene``, seen from ``view``."""
    background = np.array(scene.background)
    rendered = reference.render(
        scene.gaussians, view.camera, background, threshold_width=NEAR_THRESHOLD
    )
    assert not rendered.near_threshold.any(), "choose another view"
    return reference.render_gradients(
        scene.gaussians, view.camera, background, weights[..., :3], weights[..., 3]
    )


def test_two_views_before_one_backward_pass():
    """The second replaces the first's frame, which the backward pass has to render again."""
    scene, aside = clear(Scene()), mi.load_dict(ASIDE_VIEW.sensor())
    loaded = scene.load()
    params = mi.traverse(loaded)
    for name in ALL_PARAMETERS:
        dr.enable_grad(params[f"integrator.{name}"])
    first, third = scene.weights(1), scene.weights(3)
    second = np.random.default_rng(2).normal(0, 1, (27, 31, 4))
    loss = mi.Float(0)
    for weights, sensor in ((first, 0), (second, aside), (third, 0)):
        image = mi.render(loaded, params, sensor=sensor)
        loss += dr.sum(image * mi.TensorXf(weights.astype(np.float32)), axis=None).array
    dr.backward(loss)
    from_first = scene.gradients(first + third)
    from_aside = reference_gradients_from(ASIDE_VIEW, scene, second)
    actual = {name: gradient(params[f"integrator.{name}"]) for name in ALL_PARAMETERS}
    assert_gradients_agree(actual, {name: from_first[name] + from_aside[name] for name in actual})


def test_backward_pass_differentiates_the_current_parameters():
    """Mitsuba's other integrators do the same, since they know only the scene. Documented."""
    before, after = clear(Scene()), clear(Scene(seed=100))
    loaded = before.load()
    params = mi.traverse(loaded)
    dr.enable_grad(params["integrator.means"])
    image = mi.render(loaded, params)
    for name, value in tensors(after.gaussians).items():
        params[f"integrator.{name}"] = value
    dr.enable_grad(params["integrator.means"])
    params.update()
    dr.backward(dr.sum(image * mi.TensorXf(before.weights().astype(np.float32)), axis=None))
    actual = {"means": gradient(params["integrator.means"])}
    assert_gradients_agree(actual, after.gradients(before.weights()))


def test_last_provides_inputs_of_density_control():
    scene = clear(Scene())
    loaded = mi.load_dict(
        {
            "type": "scene",
            "integrator": scene.settings | tensors(scene.gaussians),
            "sensor": ASIDE_VIEW.sensor(),
        }
    )
    assert loaded.integrator().last is None
    weights = np.random.default_rng(2).normal(0, 1, (27, 31, 4))
    gradients_of(loaded, weights, ["means"])
    last = loaded.integrator().last
    actual = {"means2d": np.array(last.means2d_grad).astype(np.float64)}
    assert_gradients_agree(actual, reference_gradients_from(ASIDE_VIEW, scene, weights))

    # Visible: the box around the ellipse alpha = 1/255 holds a pixel's centre.
    splats = reference.project(scene.gaussians, ASIDE_VIEW.camera)
    k = 2 * np.log(np.maximum(splats.opacities / reference.ALPHA_CUT, 1))
    radius = np.sqrt(k[:, None] * np.diagonal(splats.cov2d, axis1=1, axis2=2))
    first = np.maximum(np.ceil(splats.means2d - radius - 0.5), 0)
    last_pixel = np.minimum(np.floor(splats.means2d + radius - 0.5), [30, 26])
    expected = splats.visible & (first <= last_pixel).all(axis=1)
    assert np.array_equal(np.array(last.visible), expected)
    assert expected.sum() == 26 and splats.visible.sum() == 38


def test_adam_reduces_the_loss():
    """Every parameter starts somewhat off; the image it had is the target."""
    scene = Scene(srgb_primitives=True)
    target = mi.TensorXf(fresh_image(scene).astype(np.float32))
    rng = np.random.default_rng(4)
    loaded = scene.load()
    params = mi.traverse(loaded)
    optimizer = mi.ad.Adam(lr=0.02)
    for name in ALL_PARAMETERS:
        key = f"integrator.{name}"
        noise = rng.normal(0, 0.1, np.array(params[key]).shape).astype(np.float32)
        optimizer[key] = params[key] + type(params[key])(noise)
    losses = []
    for _ in range(25):
        params.update(optimizer)
        loss = dr.mean(dr.square(mi.render(loaded, params) - target), axis=None)
        dr.backward(loss)
        optimizer.step()
        losses.append(float(loss.array[0]))
    assert losses[-1] < 0.3 * losses[0]


@pytest.mark.parametrize("count", [80, 20, 1], ids=["more", "fewer", "one"])
def test_parameters_may_be_resized(count):
    """The image and the gradients are those of a scene that was loaded with the new ones."""
    loaded = Scene().load()
    mi.render(loaded)
    resized = clear(Scene(count=count) if count >= 4 else Scene(count=4, seed=1))
    values = {name: value[-count:] for name, value in vars(resized.gaussians).items()}
    params = mi.traverse(loaded)
    for name, value in tensors(reference.Gaussians(**values)).items():
        params[f"integrator.{name}"] = value
    params.update()
    actual = {"image": image_of(loaded), **gradients_of(loaded, resized.weights())}

    fresh = mi.load_dict(
        {
            "type": "scene",
            "integrator": resized.settings | tensors(reference.Gaussians(**values)),
            "sensor": resized.view.sensor(),
        }
    )
    expected = {"image": image_of(fresh), **gradients_of(fresh, resized.weights())}
    assert all(np.array_equal(actual[name], expected[name]) for name in expected)
    assert actual["means"].shape == (count, 3)
    if count >= 4:
        assert_images_agree(actual["image"], resized.image())


# ----------------------------------------------------------------------------------------------
# Forward mode
# ----------------------------------------------------------------------------------------------


def moved(scene, directions, step) -> np.ndarray:
    """The reference's image (H, W, 4) of the scene, moved along the directions."""
    values = dict(vars(scene.gaussians))
    background = np.array(scene.background)
    for name, direction in directions.items():
        if name == "background":
            background = background + step * direction
        else:
            values[name] = values[name] + step * direction
    rendered = reference.render(
        reference.Gaussians(**values), scene.camera, np.zeros(3), scene.rendered_degree,
        scene.antialiased,
    )  # fmt: skip
    return replace(scene, background=tuple(background)).image(rendered)


@pytest.mark.parametrize(
    "names", [*((name,) for name in ALL_PARAMETERS), ALL_PARAMETERS], ids=lambda n: "+".join(n)
)
@both_color_spaces
def test_forward_mode_equals_central_differences(names, srgb_primitives):
    scene = clear(Scene(VIEWS[12], srgb_primitives=srgb_primitives))
    directions = random_directions(scene, names)
    loaded = scene.load()
    params = with_tangents(loaded, directions)
    image = mi.render(loaded, params)
    actual = np.array(dr.forward_to(image)).astype(np.float64)
    expected = (moved(scene, directions, STEP) - moved(scene, directions, -STEP)) / (2 * STEP)
    assert_images_agree(actual, expected, GRADIENTS)


def test_forward_mode_without_higher_coefficients():
    scene = clear(Scene(degree=0, antialiased=True))
    names = [name for name in ALL_PARAMETERS if name != "shN"]
    directions = random_directions(scene, names)
    loaded = scene.load()
    image = mi.render(loaded, with_tangents(loaded, directions))
    expected = (moved(scene, directions, STEP) - moved(scene, directions, -STEP)) / (2 * STEP)
    assert_images_agree(np.array(dr.forward_to(image)), expected, GRADIENTS)


@both_color_spaces
def test_forward_and_backward_mode_are_transposed(srgb_primitives):
    """<J v, w> = <v, J^T w>."""
    scene = clear(Scene(srgb_primitives=srgb_primitives, degree=2, antialiased=True))
    directions = random_directions(scene, ALL_PARAMETERS)
    loaded = scene.load()
    image = mi.render(loaded, with_tangents(loaded, directions))
    forward = np.sum(np.array(dr.forward_to(image)).astype(np.float64) * scene.weights())
    gradients = gradients_of(scene.load(), scene.weights())
    terms = [np.sum(directions[name] * gradients[name]) for name in ALL_PARAMETERS]
    assert forward == pytest.approx(sum(terms), abs=1e-5 * np.abs(terms).max())
