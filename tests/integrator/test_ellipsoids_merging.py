"""Several shapes of ellipsoids, and the integrator's own Gaussians, in one image."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.ellipsoids import (
    GRADIENTS,
    MERGED,
    SHAPE_ATTRIBUTES,
    Merged,
    assert_held_agree,
    assert_images_agree,
    gradients_held,
    held_gradients,
)
from support.helpers import assert_arrays_agree, clear
from support.views import gradient, gradients_of, image_of, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


@pytest.mark.parametrize("scene", MERGED, ids=["1, 2, 0", "3, 2, 0", "0, 0, 3", "0, 0, 0"])
def test_several_shapes_and_tensors_merge(scene):
    scene = clear(scene)
    loaded = scene.load()
    assert [shape.id() for shape in loaded.shapes()] == ["first", "second"]
    assert_images_agree(image_of(loaded), scene.image())
    gaussians = loaded.integrator().gaussians
    assert gaussians.num_gaussians == 75
    expected = scene.gaussians
    for name in PARAMETER_NAMES:
        np.testing.assert_allclose(
            np.array(getattr(gaussians, name)), getattr(expected, name), rtol=1e-5, atol=1e-5
        )


@pytest.mark.parametrize("degree", [0, 1])
def test_degree_below_the_highest_may_be_chosen(degree):
    scene = clear(Merged(sh_degree=degree))
    assert_images_agree(image_of(scene.load()), scene.image())


def test_gradients_of_merged_gaussians_reach_their_sources():
    scene = clear(Merged())
    weights = scene.weights()
    loaded = scene.load()
    params = mi.traverse(loaded)
    keys = [f"{shape}.{name}" for shape in ("first", "second") for name in SHAPE_ATTRIBUTES]
    for key in keys:
        dr.enable_grad(params[key])
    own = gradients_of(loaded, weights)
    expected = scene.gradients(weights)
    rows = np.split(np.arange(75), [40, 52])
    for_own = {name: expected[name][rows[0]] for name in PARAMETER_NAMES}
    for_own |= {"shN": for_own["shN"][:, :3], "background": expected["background"]}
    assert_arrays_agree(own, for_own, GRADIENTS)
    for prefix, shape, part in zip(("first", "second"), scene.shapes, rows[1:], strict=True):
        of_gaussians = {name: expected[name][part] for name in PARAMETER_NAMES}
        of_gaussians["shN"] = of_gaussians["shN"][:, : shape.gaussians.shN.shape[1]]
        actual = {name: gradient(params[f"{prefix}.{name}"]) for name in SHAPE_ATTRIBUTES}
        assert_held_agree(actual, held_gradients(shape.held, of_gaussians))


def test_features_of_gaussians_of_shapes_are_zero():
    scene = Merged()
    feature = np.random.default_rng(3).normal(0, 1, (40, 2)).astype(np.float32)
    settings = {"aovs": "f:feature_mine, z:depth"}
    loaded = scene.load(feature_mine=mi.TensorXf(feature), **settings)
    everything = {"type": "splats", **tensors(scene.gaussians), **settings}
    padded = np.concatenate([feature, np.zeros((35, 2), np.float32)])
    all_own = mi.load_dict(
        {**everything, "feature_mine": mi.TensorXf(padded), "srgb_primitives": False}
        | {"background": list(scene.background)}
    )
    alone = mi.load_dict({"type": "scene", "sensor": scene.view.sensor()})
    assert_images_agree(image_of(loaded), image_of(alone, integrator=all_own))
    params = mi.traverse(loaded)
    dr.enable_grad(params["integrator.feature_mine"])
    dr.backward(dr.sum(mi.render(loaded, params), axis=None))
    derivative = gradient(params["integrator.feature_mine"])
    assert derivative.shape == (40, 2) and np.abs(derivative).max() > 0


def test_gaussians_of_shapes_have_no_smoothing_filter():
    scene = Merged()
    filters = np.full(40, 0.05, np.float32)
    loaded = scene.load(smoothing=mi.Float(filters))
    padded = np.concatenate([filters, np.zeros(35, np.float32)])
    everything = scene.settings | tensors(scene.gaussians)
    all_own = mi.load_dict(everything | {"smoothing": mi.Float(padded)})
    alone = mi.load_dict({"type": "scene", "sensor": scene.view.sensor()})
    expected = image_of(alone, integrator=all_own)
    assert_images_agree(image_of(loaded), expected)
    assert np.abs(expected - image_of(scene.load())).max() > 0.01


def test_last_has_a_row_for_each_gaussian():
    loaded = Merged().load()
    gradients_held(loaded, Merged().weights(), "first")
    last = loaded.integrator().last
    assert last.means2d_grad.shape == (75, 2) and dr.width(last.visible) == 75
