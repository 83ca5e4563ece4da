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


@pytest.mark.parametrize(
    "scene",
    [*MERGED, Merged(sh_degree=1)],
    ids=["1, 2, 0", "3, 2, 0", "0, 0, 3", "0, 0, 0", "at most 1"],
)
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


@pytest.mark.parametrize(
    ("name", "values", "settings"),
    [
        ("feature_mine", np.linspace(-1, 1, 80).reshape(40, 2), {"aovs": "f:feature_mine"}),
        ("smoothing", np.full(40, 0.05), {}),
    ],
    ids=["features", "smoothing"],
)
def test_numbers_that_shapes_do_not_hold_are_zero_there(name, values, settings):
    """A smoothing filter of 0 is none."""
    scene = Merged()
    settings["srgb_primitives"] = False
    kind = mi.Float if values.ndim == 1 else mi.TensorXf
    values = values.astype(np.float32)
    padded = np.concatenate([values, np.zeros_like(values[:35])])
    loaded = scene.load_with(**{name: kind(values)}, **settings)
    own = scene.settings | tensors(scene.gaussians) | settings | {name: kind(padded)}
    alone = mi.load_dict({"type": "scene", "sensor": scene.view.sensor()})
    expected = image_of(alone, integrator=mi.load_dict(own))
    assert_images_agree(image_of(loaded), expected)
    others = image_of(scene.load())
    assert others.shape != expected.shape or np.abs(expected - others).max() > 0.01


def test_features_beside_shapes_have_derivatives():
    feature = mi.TensorXf(np.ones((40, 2), np.float32))
    loaded = Merged().load_with(feature_mine=feature, aovs="f:feature_mine")
    weights = np.ones((23, 37, 6))
    derivative = gradients_of(loaded, weights, ["feature_mine"])["feature_mine"]
    assert derivative.shape == (40, 2) and np.abs(derivative).max() > 0


def test_last_has_a_row_for_each_gaussian():
    loaded = Merged().load()
    gradients_held(loaded, Merged().weights(), "first")
    last = loaded.integrator().last
    assert last.means2d_grad.shape == (75, 2) and dr.width(last.visible) == 75
