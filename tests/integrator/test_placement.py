"""Splat objects that a ``to_world`` places, against the float64 reference of moved Gaussians."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.ellipsoids import ROTATION, SCALE, TRANSLATION
from support.helpers import clear, single
from support.splats_checks import IMAGE, assert_images_agree, ball_lamp_and_sky
from support.views import Scene, image_of, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.gaussians.rotation import rotate_gaussians
from drgs.gaussians.similarity import Similarity
from drgs.reference import splatting as reference

MATRIX = np.eye(4)
MATRIX[:3, :3], MATRIX[:3, 3] = SCALE * ROTATION, TRANSLATION
MATRIX = single(MATRIX)

KEY = "integrator.to_world"


def moved_by(matrix, gaussians) -> reference.Gaussians:
    """Gaussians moved in double precision."""
    place = Similarity.from_matrix(matrix, "the test's matrix")
    means, quats, shN = rotate_gaussians(
        gaussians.means, gaussians.quats, gaussians.shN, place.rotation
    )
    return replace(
        gaussians,
        means=place.scale * means + place.translation,
        quats=quats,
        log_scales=gaussians.log_scales + np.log(place.scale),
        shN=shN,
    )


@cache
def scene_and_object(**settings) -> tuple[Scene, reference.Gaussians]:
    """A view, and float32 Gaussians that :data:`MATRIX` moves before it."""
    scene = clear(Scene(degree=3, **settings))
    model = moved_by(np.linalg.inv(MATRIX), scene.gaussians)
    return scene, reference.Gaussians(**{n: single(getattr(model, n)) for n in PARAMETER_NAMES})


def load(scene, model, matrix=MATRIX, **settings) -> mi.Scene:
    if matrix is not None:
        settings["to_world"] = mi.ScalarTransform4f(matrix)
    return scene.load_with(gaussians=model, **settings)


def rendered(scene, gaussians) -> np.ndarray:
    return scene.image(reference.render(gaussians, scene.camera, np.zeros(3), 3))


def test_moved_object_matches_the_reference():
    scene, model = scene_and_object()
    expected = rendered(scene, moved_by(MATRIX, model))
    given = load(scene, model)
    assert_images_agree(image_of(given), expected, 3 * IMAGE)
    assert np.abs(expected - rendered(scene, model)).max() > 0.1
    later = load(scene, model, matrix=None)
    params = mi.traverse(later)
    params[KEY] = mi.Transform4f(MATRIX)
    params.update()
    np.testing.assert_array_equal(image_of(later), image_of(given))
    for name in PARAMETER_NAMES:
        own = np.array(params[f"integrator.{name}"]).astype(np.float64)
        np.testing.assert_array_equal(own, getattr(model, name))


def test_moved_object_matches_a_file_saved_after_moving(tmp_path):
    """With its smoothing filter."""
    scene, model = scene_and_object()
    filters = np.linspace(0.005, 0.05, len(model.means), dtype=np.float32)
    arrays = {n: getattr(model, n).astype(np.float32) for n in PARAMETER_NAMES}
    stored = Gaussians(**arrays, smoothing=filters)
    stored.save(tmp_path / "object.ply")
    Similarity.from_matrix(MATRIX, "it").of_gaussians(stored).save(tmp_path / "moved.ply")

    def rendered(name, **settings):
        settings = scene.settings | {"filename": str(tmp_path / name)} | settings
        return image_of(scene.load(), integrator=mi.load_dict(settings))

    expected = rendered("moved.ply")
    place = mi.ScalarTransform4f(MATRIX)
    assert_images_agree(rendered("object.ply", to_world=place), expected, 3 * IMAGE)
    unfiltered = rendered("moved.ply", ignore="smoothing")
    assert np.abs(unfiltered - expected).max() > 0.02


@pytest.mark.parametrize("later", [False, True])
def test_identity_transform_costs_nothing(later):
    """Given, or set after another place: the arrays that are rendered are the integrator's own."""
    scene, model = scene_and_object()
    loaded = load(scene, model, MATRIX if later else np.eye(4))
    if later:
        params = mi.traverse(loaded)
        image_of(loaded)
        params[KEY] = mi.Transform4f()
        params.update()
    np.testing.assert_array_equal(image_of(loaded), image_of(load(scene, model, None)))
    integrator = loaded.integrator()
    for name in PARAMETER_NAMES:
        assert getattr(integrator.gaussians, name) is getattr(integrator.state.own.gaussians, name)


ROUTES = {
    "normals and depths": {"aovs": "n:normal, z:depth, a:alpha"},
    "rays of surfaces": {"light": "rays", "nested_spp": 4},
    "shadows": {"shadows": "ball", "nested_spp": 4},
}


@pytest.mark.parametrize("route", ROUTES)
def test_every_light_route_sees_the_moved_object(route):
    """The same bytes as of the Gaussians that the integrator says it renders."""
    scene, model = scene_and_object()
    objects = {"sensor": scene.view.sensor()}
    objects |= (
        {}
        if "aovs" in ROUTES[route]
        else ball_lamp_and_sky(scene.camera, 2.5, {"type": "conductor"})
    )
    place = {"to_world": mi.ScalarTransform4f(MATRIX)}
    moved = mi.load_dict(scene.settings | tensors(model) | place).gaussians.numpy()

    def rendered(gaussians, **settings):
        integrator = scene.settings | tensors(gaussians) | ROUTES[route] | settings
        return image_of(mi.load_dict({"type": "scene", "integrator": integrator, **objects}), spp=1)

    actual = rendered(model, **place)
    np.testing.assert_array_equal(actual, rendered(moved))
    assert np.abs(actual - rendered(model)).max() > 0.1


def gradient_of_matrix(loaded, weights) -> np.ndarray:
    params = mi.traverse(loaded)
    dr.enable_grad(params[KEY])
    image = mi.render(loaded, params)
    dr.backward(dr.sum(image * mi.TensorXf(weights.astype(np.float32)), axis=None))
    return np.array(dr.grad(params[KEY]).matrix).astype(np.float64)[:, :, 0]


def test_setting_a_matrix_that_is_no_similarity_is_refused():
    scene, model = scene_and_object()
    loaded = load(scene, model)
    params = mi.traverse(loaded)
    params[KEY] = mi.Transform4f().scale([1, 1, 2])
    message = "splats: to_world must be made of rotations, translations and scales that are"
    with pytest.raises(ValueError, match=message):
        params.update()
    with pytest.raises(ValueError, match=message):
        loaded.integrator().render(loaded)
    params[KEY] = mi.Transform4f(MATRIX)
    params.update()
    np.testing.assert_array_equal(image_of(loaded), image_of(load(scene, model)))


def test_gaussians_that_overflow_float32_are_refused():
    scene, model = scene_and_object()
    means = model.means.copy()
    means[2] = 3e38
    loaded = load(scene, replace(model, means=means))
    with pytest.raises(ValueError, match="splats: to_world moves Gaussian 2 beyond the end of flo"):
        loaded.integrator().render(loaded)


def test_nan_gaussians_do_not_contribute_to_derivatives():
    scene, model = scene_and_object()
    means, shN = model.means.copy(), model.shN.copy()
    means[5], shN[6] = np.nan, np.inf
    loaded = load(scene, replace(model, means=means, shN=shN))
    assert np.isfinite(gradient_of_matrix(loaded, scene.weights())).all()
