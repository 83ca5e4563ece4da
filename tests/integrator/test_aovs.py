"""Normals and named features behind the colours, against compositing by the float64 reference."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import clear
from support.views import VIEWS, Scene, gradients_of, image_of, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference

# Tolerances of test_splats: single precision, relative to the largest value of an array.
IMAGE, GRADIENTS = 1e-5, 1e-4

STEP = 1e-7


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
