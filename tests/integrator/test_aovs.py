"""Normals and named features behind the colours, against compositing by the float64 reference."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import clear
from support.views import VIEWS, Scene, image_of

import drgs  # noqa: F401  (registers the plugin)
from drgs.reference import splatting as reference

# Tolerances of test_splats: single precision, relative to the largest value of an array.
IMAGE = 1e-5


def normals_of(gaussians, camera) -> np.ndarray:
    """(N, 3): the shortest axis, towards the camera."""
    rotations = reference.quat_to_rotation(gaussians.quats)
    shortest = np.argmin(gaussians.log_scales, axis=1)
    normals = rotations[np.arange(len(shortest)), :, shortest]
    away = np.sum(normals * (gaussians.means - camera.center), axis=1) > 0
    return np.where(away[:, None], -normals, normals)


def composited(gaussians, camera, columns) -> np.ndarray:
    """(H, W, C): columns (N, C) of numbers, each weighted by its share in the pixel."""
    splats = reference.project(gaussians, camera)
    planes = []
    for column in columns.T:
        colors = np.repeat(column[:, None], 3, 1)
        rendered = reference.composite(splats, colors, np.zeros(3), camera.width, camera.height)
        planes.append(rendered.image[..., 0])
    return np.stack(planes, axis=-1)


def features_of(scene, channels=4) -> np.ndarray:
    rng = np.random.default_rng(3)
    return rng.normal(0, 1, (scene.count, channels)).astype(np.float32).astype(np.float64)


def with_aovs(scene, aovs="n:normal, f:feature_mine, z:depth, a:alpha", sensor=None, **others):
    feature = {} if "feature" not in aovs else {"feature_mine": mi.TensorXf(features_of(scene))}
    return scene.load_with(sensor, aovs=aovs, **feature | others)


def channels_of(scene) -> np.ndarray:
    """(H, W, 9): normal, features, depth, alpha."""
    gaussians, camera = scene.gaussians, scene.camera
    depths = reference.project(gaussians, camera).depths[:, None]
    columns = normals_of(gaussians, camera), features_of(scene), depths, np.ones_like(depths)
    columns = np.concatenate(columns, axis=1)
    return composited(gaussians, camera, columns)[scene.view.window]


@pytest.mark.parametrize("pixel_format", ["rgb", "rgba"])
@pytest.mark.parametrize("view", [VIEWS[1], VIEWS[3], VIEWS[13]], ids=lambda view: view.name)
@pytest.mark.parametrize("srgb_primitives", [False, True])
def test_channels_are_composited_behind_the_colors(view, srgb_primitives, pixel_format):
    """Not converted as colours are; as they are listed, under Mitsuba's names."""
    scene = clear(Scene(view, srgb_primitives=srgb_primitives))
    loaded = with_aovs(scene, sensor=view.sensor(pixel_format))
    (*image,) = np.moveaxis(image_of(loaded), -1, 0)
    colors, channels = image[: len(pixel_format)], np.stack(image[len(pixel_format) :], axis=-1)
    plain = image_of(scene.load(pixel_format=pixel_format))
    np.testing.assert_array_equal(np.stack(colors, axis=-1), plain)
    expected = channels_of(scene)
    np.testing.assert_allclose(channels, expected, atol=IMAGE * np.abs(expected).max())
    names = ["n.X", "n.Y", "n.Z", "f.0", "f.1", "f.2", "f.3", "z.T", "a.I"]
    assert loaded.integrator().aov_names() == names
    film = loaded.sensors()[0].film()
    assert [c.name for c in film.bitmap().struct_()] == [*pixel_format.upper(), *names]


def test_gaussian_with_nonfinite_feature_is_not_drawn():
    """Neither a pixel nor another row is affected, as with other parameters."""
    scene = clear(Scene())
    spoiled = features_of(scene)
    row = int(np.argmax(np.abs(scene.gradients(scene.weights())["logit_opacities"])))
    spoiled[row, 1] = np.nan
    image = image_of(with_aovs(scene, "f:feature_mine", feature_mine=mi.TensorXf(spoiled)))
    hidden = scene.gaussians.logit_opacities.copy()
    hidden[row] = -30
    gone = replace(scene.gaussians, logit_opacities=hidden)
    expected = composited(gone, scene.camera, features_of(scene))[scene.view.window]
    np.testing.assert_allclose(image[..., 4:], expected, atol=IMAGE * np.abs(expected).max())


def test_several_samples_average_the_channels():
    """Depth and alpha of each sample; the alpha of the film is the same number."""
    scene = Scene()
    sampled, alone = (
        image_of(with_aovs(scene, "z:depth, a:alpha", scene.view.sensor(samples=n)), seed=2)
        for n in (4, 1)
    )
    # The mean of the samples' transmittances, subtracted from one before or after.
    np.testing.assert_allclose(sampled[..., 5], sampled[..., 3], atol=1e-6)
    assert np.abs(sampled - alone)[..., 4].max() > 0.01


def test_unused_channels_cost_nothing():
    """The planes of the frame are those of the features."""
    for aovs, count in (("", 4), ("a:alpha", 4), ("z:depth", 5)):
        loaded = with_aovs(Scene(), aovs)
        mi.render(loaded)
        frames = loaded.integrator().state.cache.kept["frames 0"].value
        assert len(frames[0][0].planes()) == count
