"""Depth and alpha beside the colours of the ``splats`` integrator."""

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import clear
from support.splats_checks import (
    assert_gradients_agree,
    assert_images_agree,
    both_color_spaces,
)
from support.views import VIEWS, Scene, gradients_of, image_of, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference


def with_channels(scene, aovs="z:depth, a:alpha", sensor=None):
    """The scene with an integrator that puts out more than colours."""
    integrator = scene.settings | tensors(scene.gaussians) | {"aovs": aovs}
    sensor = sensor or scene.view.sensor()
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})


@pytest.mark.slow
@both_color_spaces
@pytest.mark.parametrize("pixel_format", ["rgb", "rgba"])
def test_depth_and_alpha_follow_the_colors(pixel_format, srgb_primitives):
    """In the order in which they are asked for, as linear numbers."""
    scene = clear(Scene(VIEWS[13], srgb_primitives=srgb_primitives))
    sensor = scene.view.sensor(pixel_format=pixel_format)
    loaded = with_channels(scene, "a:alpha, z:depth", sensor)
    *colors, alpha, depth = np.moveaxis(image_of(loaded), -1, 0)
    plain = image_of(scene.load(pixel_format=pixel_format))
    np.testing.assert_array_equal(np.stack(colors, axis=-1), plain)
    assert_images_agree(alpha, scene.rendered.alpha[scene.view.window])
    assert_images_agree(depth, scene.rendered.depth[scene.view.window])
    names = [channel.name for channel in loaded.sensors()[0].film().bitmap().struct_()]
    assert names == [*pixel_format.upper(), "a.I", "z.T"]
    assert loaded.integrator().aov_names() == ["a.I", "z.T"]


@both_color_spaces
def test_gradients_of_depth_and_alpha_match_the_reference(srgb_primitives):
    """With those of the colours, from random weights on all channels."""
    scene = clear(Scene(srgb_primitives=srgb_primitives))
    weights = scene.weights()
    rng = np.random.default_rng(9)
    of_depth, of_alpha = (rng.normal(0, 1, weights.shape[:2]) for _ in range(2))
    actual = gradients_of(
        with_channels(scene),
        np.concatenate([weights, of_depth[..., None], of_alpha[..., None]], -1),
    )
    expected = scene.gradients(weights)
    others = reference.render_gradients(
        scene.gaussians, scene.camera, np.zeros(3), np.zeros((*of_depth.shape, 3)), of_alpha,
        of_depth, scene.rendered_degree, scene.antialiased,
    )  # fmt: skip
    total = {n: expected[n] + others.get(n, 0) for n in PARAMETER_NAMES}
    assert_gradients_agree(actual, total | {"background": expected["background"]})
    assert all(
        np.abs(others[n]).max() > 0.1 * np.abs(expected[n]).max() for n in ("means", "quats")
    )


def test_several_samples_average_the_channels():
    """Depth and alpha of each sample; the alpha of the film is the same number."""
    scene = Scene()
    sensor = scene.view.sensor(samples=4)
    image = image_of(with_channels(scene, sensor=sensor), spp=4, seed=2)
    # The mean of the samples' transmittances, subtracted from one before or after.
    np.testing.assert_allclose(image[..., 5], image[..., 3], atol=1e-6)
    single_sample = image_of(with_channels(scene), spp=1)
    assert np.abs(image[..., 4] - single_sample[..., 4]).max() > 0.01


def test_unused_channels_cost_nothing():
    """The planes of the frame are those of the features."""
    scene = Scene()
    for aovs, count in (("", 4), ("a:alpha", 4), ("z:depth", 5)):
        loaded = with_channels(scene, aovs)
        mi.render(loaded)
        frames = loaded.integrator().state.cache.kept["frames 0"].value
        assert len(frames[0][0].planes()) == count
