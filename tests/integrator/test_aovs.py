"""Normals and named features behind the colours, against compositing by the float64 reference."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import assert_arrays_agree, clear
from support.views import VIEWS, Scene, gradients_of, image_of, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference

# Tolerances of test_splats: single precision, relative to the largest value of an array.
IMAGE, GRADIENTS = 1e-5, 1e-4

STEP = 1e-7


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


# ----------------------------------------------------------------------------------------------
# The reference
# ----------------------------------------------------------------------------------------------


def normals_of(gaussians, camera, log_scales) -> np.ndarray:
    """(N, 3): the shortest axis by ``log_scales``, towards the camera."""
    rotations = reference.quat_to_rotation(gaussians.quats)
    shortest = np.argmin(log_scales, axis=1)
    normals = rotations[np.arange(len(shortest)), :, shortest]
    away = np.sum(normals * (gaussians.means - camera.center), axis=1) > 0
    return np.where(away[:, None], -normals, normals)


def composited(gaussians, camera, columns) -> np.ndarray:
    """(H, W, C): columns (N, C) of numbers, each weighted by its share in the pixel."""
    splats = reference.project(gaussians, camera)
    planes = []
    for k in range(columns.shape[1]):
        rendered = reference.composite(
            splats.means2d, splats.conics, splats.opacities, np.repeat(columns[:, k : k + 1], 3, 1),
            splats.depths, splats.visible, np.zeros(3), camera.width, camera.height,
        )  # fmt: skip
        planes.append(rendered.image[..., 0])
    return np.stack(planes, axis=-1)


def features_of(scene, channels=4) -> np.ndarray:
    rng = np.random.default_rng(3)
    return rng.normal(0, 1, (scene.count, channels)).astype(np.float32).astype(np.float64)


def load(scene, aovs, sensor=None, **others):
    integrator = scene.settings | tensors(scene.gaussians) | {"aovs": aovs} | others
    sensor = sensor or scene.view.sensor()
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})


def with_features(scene, aovs="n:normal, f:feature_mine, z:depth", **others):
    return load(scene, aovs, feature_mine=mi.TensorXf(features_of(scene)), **others)


def channels_of(scene, gaussians=None, features=None) -> np.ndarray:
    """(H, W, 8): normal, features, depth. Which axis is the shortest does not change."""
    gaussians, camera = gaussians or scene.gaussians, scene.camera
    depths = reference.project(gaussians, camera).depths[:, None]
    features = features_of(scene) if features is None else features
    normals = normals_of(gaussians, camera, scene.gaussians.log_scales)
    columns = np.concatenate([normals, features, depths], axis=1)
    return composited(gaussians, camera, columns)[scene.view.window]


# ----------------------------------------------------------------------------------------------
# Images
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("view", [VIEWS[1], VIEWS[3], VIEWS[13]], ids=lambda view: view.name)
@pytest.mark.parametrize("srgb_primitives", [False, True])
def test_normals_and_features_are_composited_without_colour_conversion(view, srgb_primitives):
    """Not converted as colours are; under Mitsuba's names."""
    scene = clear(Scene(view, srgb_primitives=srgb_primitives))
    loaded = with_features(scene)
    image = image_of(loaded)
    expected = channels_of(scene)
    np.testing.assert_allclose(image[..., 4:], expected, atol=IMAGE * np.abs(expected).max())
    names = ["n.X", "n.Y", "n.Z", "f.0", "f.1", "f.2", "f.3", "z.T"]
    assert loaded.integrator().aov_names() == names
    film = loaded.sensors()[0].film()
    assert [c.name for c in film.bitmap().struct_()] == [*"RGBA", *names]


def test_aovs_leave_colors_unchanged():
    scene = Scene()
    np.testing.assert_array_equal(
        image_of(with_features(scene))[..., :4], image_of(load(scene, ""))
    )


def test_a_flat_splat_shows_its_normal():
    """One that covers the film, tilted; whichever way its quaternion turns it."""
    scene = Scene()
    camera = scene.camera
    tilted = camera.rotation.T @ np.array([0.6, 0.0, -0.8])  # towards the camera
    for sign in (1, -1):
        axis = np.cross([0, 0, 1], sign * tilted)
        quat = np.array([1 + sign * tilted[2], *axis])
        one = reference.Gaussians(
            means=[camera.center + 2 * camera.rotation[2]],
            quats=[quat],
            log_scales=np.log([[5.0, 4.0, 0.01]]),
            logit_opacities=[3.0],
            sh0=np.zeros((1, 1, 3)),
            shN=np.zeros((1, 0, 3)),
        )
        integrator = {"type": "splats", "aovs": "n:normal, a:alpha", **tensors(one)}
        loaded = mi.load_dict({"type": "scene", "integrator": integrator})
        image = image_of(loaded, sensor=mi.load_dict(scene.view.sensor()))
        row, column = image.shape[0] // 2, image.shape[1] // 2
        *_, x, y, z, alpha = image[row, column]
        np.testing.assert_allclose(np.array([x, y, z]) / alpha, tilted, atol=1e-5)


def test_a_feature_of_ones_is_alpha():
    scene = Scene()
    ones = mi.TensorXf(np.ones((scene.count, 1), np.float32))
    image = image_of(load(scene, "f:feature_ones, a:alpha", feature_ones=ones))
    np.testing.assert_allclose(image[..., 4], image[..., 5], atol=2e-6)


def test_an_unused_feature_costs_nothing():
    scene = Scene()
    loaded = load(scene, "", feature_mine=mi.TensorXf(features_of(scene)))
    mi.render(loaded)
    (frame,) = loaded.integrator().state.cache.kept["frames 0"].value[0]
    assert len(frame.planes()) == 4 and loaded.integrator().gaussians.features is None


def test_gaussian_with_nonfinite_feature_is_not_drawn():
    """Neither a pixel nor another row is affected, as with other parameters."""
    scene = clear(Scene())
    spoiled = features_of(scene)
    row = int(np.argmax(np.abs(scene.gradients(scene.weights())["logit_opacities"])))
    spoiled[row, 1] = np.nan
    loaded = load(scene, "f:feature_mine", feature_mine=mi.TensorXf(spoiled))
    image = image_of(loaded)
    hidden = scene.gaussians.logit_opacities.copy()
    hidden[row] = -30
    gone = replace(scene.gaussians, logit_opacities=hidden)
    expected = composited(gone, scene.camera, features_of(scene))[scene.view.window]
    np.testing.assert_allclose(image[..., 4:], expected, atol=IMAGE * np.abs(expected).max())


# ----------------------------------------------------------------------------------------------
# Derivatives
# ----------------------------------------------------------------------------------------------

NAMES = (*PARAMETER_NAMES, "feature_mine")


@pytest.mark.slow
def test_gradients_equal_differences_of_the_reference():
    """Along a random direction of each parameter, with weights on the extra channels alone."""
    scene = clear(Scene())
    rng = np.random.default_rng(5)
    weights = np.zeros((*scene.weights().shape[:2], 12))
    weights[..., 4:] = rng.normal(0, 1, (*weights.shape[:2], 8))
    actual = gradients_of(with_features(scene), weights, NAMES)
    values = vars(scene.gaussians) | {"feature_mine": features_of(scene)}
    for name in NAMES:
        direction = rng.normal(0, 1, values[name].shape)
        both = []
        for sign in (1, -1):
            moved = dict(values)
            moved[name] = values[name] + sign * STEP * direction
            features = moved.pop("feature_mine")
            both.append(channels_of(scene, reference.Gaussians(**moved), features))
        expected = np.sum(weights[..., 4:] * (both[0] - both[1])) / (2 * STEP)
        terms = actual[name].reshape(direction.shape) * direction
        assert terms.sum() == pytest.approx(expected, abs=GRADIENTS * np.abs(terms).sum()), name
        if name not in ("sh0", "shN"):
            assert np.abs(terms).sum() > 0


def test_gradients_of_features_are_compositing_weights():
    """Row by row: they are linear."""
    scene = clear(Scene())
    rng = np.random.default_rng(6)
    weights = rng.normal(0, 1, (*scene.weights().shape[:2], 12))
    actual = gradients_of(with_features(scene), weights, ["feature_mine"])["feature_mine"]
    expected = np.zeros((scene.count, 4))
    for row in range(scene.count):
        unit = np.zeros((scene.count, 1))
        unit[row] = 1
        share = composited(scene.gaussians, scene.camera, unit)[scene.view.window][..., 0]
        expected[row] = np.einsum("hw,hwc->c", share, weights[..., 7:11])
    assert_arrays_agree({"features": actual}, {"features": expected}, GRADIENTS)


def test_forward_mode_is_the_transpose_of_the_gradients():
    scene = clear(Scene())
    rng = np.random.default_rng(7)
    weights = rng.normal(0, 1, (*scene.weights().shape[:2], 12))
    gradients = gradients_of(with_features(scene), weights, NAMES)
    loaded = with_features(scene)
    params = mi.traverse(loaded)
    total = size = 0.0
    for name in NAMES:
        value = params[f"integrator.{name}"]
        direction = rng.normal(0, 1, value.shape).astype(np.float32)
        dr.enable_grad(value)
        dr.set_grad(value, type(value)(direction))
        terms = gradients[name].reshape(direction.shape) * direction
        total, size = total + terms.sum(), size + np.abs(terms).sum()
    tangent = np.array(dr.forward_to(mi.render(loaded, params))).astype(np.float64)
    assert np.sum(tangent * weights) == pytest.approx(total, abs=GRADIENTS * size)


@pytest.mark.slow
def test_features_are_trained():
    """Until they show what they are to show; the image stays."""
    scene = clear(Scene())
    target = image_of(with_features(scene))[..., 7:11].astype(np.float32)
    zeros = mi.TensorXf(np.zeros((scene.count, 4), np.float32))
    loaded = load(scene, "f:feature_mine", feature_mine=zeros)
    params = mi.traverse(loaded)
    key = "integrator.feature_mine"
    optimizer = mi.ad.Adam(lr=0.1, params={key: params[key]})
    losses = []
    for _ in range(60):
        params.update(optimizer)
        shown = mi.render(loaded, params)[:, :, 4:]
        loss = dr.mean(dr.square(shown - mi.TensorXf(target)), axis=None)
        dr.backward(loss)
        optimizer.step()
        losses.append(float(loss.array[0]))
    assert losses[-1] < 0.02 * losses[0]


def test_several_samples_average_the_channels():
    scene = Scene()
    sensor = scene.view.sensor(samples=4)
    image = image_of(with_features(scene, sensor=sensor), spp=4, seed=2)
    ones = mi.TensorXf(np.ones((scene.count, 1), np.float32))
    alpha = image_of(load(scene, "f:feature_ones", sensor, feature_ones=ones), spp=4, seed=2)
    np.testing.assert_allclose(alpha[..., 4], alpha[..., 3], atol=2e-6)
    assert np.abs(image[..., 4:] - image_of(with_features(scene))[..., 4:]).max() > 0.01


# ----------------------------------------------------------------------------------------------
# Errors
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("aovs", "shape", "message"),
    [
        ("f:feature_other", (40, 2), "types of depth, alpha, normal, feature_mine, got"),
        ("f:feature_mine", (39, 2), r"feature_mine must have the shape \(N, C\), with N = 40"),
        ("f:feature_mine", (40,), r"got \(40,\)"),
        ("f:feature_mine", (40, 2, 2), r"got \(40, 2, 2\)"),
    ],
)
def test_wrong_features_are_refused(aovs, shape, message):
    tensor = mi.TensorXf(np.zeros(shape, np.float32))
    with pytest.raises((ValueError, RuntimeError), match=message):
        load(Scene(), aovs, feature_mine=tensor)
