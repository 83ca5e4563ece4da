"""Derivatives of what shapes of ellipsoids hold."""

from __future__ import annotations

import mitsuba as mi
import numpy as np
import pytest
from support.ellipsoids import (
    SHAPE_ATTRIBUTES,
    EllipsoidsCase,
    Merged,
    assert_held_agree,
    gradients_held,
    held_gradients,
    shape_of,
)
from support.helpers import clear
from support.kernels import float_reductions
from support.views import image_of

import drgs  # noqa: F401  (registers the plugin)
from drgs.integrator import parts
from drgs.splatting import rendering

# ----------------------------------------------------------------------------------------------
# Gradients
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "scene",
    [
        *(EllipsoidsCase(degree=degree) for degree in (0, 1, 3)),
        EllipsoidsCase(degree=3, srgb_primitives=True),
        EllipsoidsCase(kind="ellipsoidsmesh"),
    ],
    ids=["degree 0", "degree 1", "degree 3", "linear", "mesh"],
)
def test_gradients_match_the_reference(scene):
    scene = clear(scene)
    expected = held_gradients(scene.held, scene.gradients(scene.weights()))
    assert_held_agree(gradients_held(scene.load(), scene.weights()), expected)


def test_backward_passes_give_the_same_bytes_without_float_atomics():
    scene = Merged()

    def backward():
        return gradients_held(scene.load(), scene.weights(), "first")

    found, count = float_reductions(backward)
    assert not found and count > 5
    first, again = backward(), backward()
    assert all(first[name].tobytes() == again[name].tobytes() for name in SHAPE_ATTRIBUTES)


# ----------------------------------------------------------------------------------------------
# Caching between renderings
# ----------------------------------------------------------------------------------------------


@pytest.fixture
def counted(monkeypatch):
    """Names of what is called: for each frame that is rendered, and for each conversion."""
    calls = []

    def count(owner, name):
        function = getattr(owner, name)

        def counting(*arguments):
            calls.append(name)
            return function(*arguments)

        monkeypatch.setattr(owner, name, counting)

    count(rendering, "render")
    count(parts.Conversion, "gaussians")
    return calls


def test_backward_pass_reuses_the_frame_and_converts_shapes_again(counted):
    scene = EllipsoidsCase()
    loaded = scene.load()
    gradients_held(loaded, scene.weights())
    image_of(loaded)
    assert sorted(counted) == ["gaussians", "gaussians", "render"]


@pytest.mark.parametrize("name", [*SHAPE_ATTRIBUTES, "all, and the number of rows"])
def test_a_changed_parameter_is_rendered_again(name, counted):
    scene = EllipsoidsCase()
    loaded = scene.load()
    before = image_of(loaded)
    others = EllipsoidsCase(count=60, seed=9).held
    held = scene.held | {name: scene.held[name] * 0.75} if name in scene.held else others
    params = mi.traverse(loaded)
    for key in SHAPE_ATTRIBUTES if held is others else [name]:
        params[f"shape.{key}"] = mi.Float(held[key].ravel().astype(np.float32))
    params.update()
    after = image_of(loaded)
    assert sorted(counted) == ["gaussians"] * 2 + ["render"] * 2
    assert np.abs(after - before).max() > 0.01
    np.testing.assert_array_equal(
        after, image_of(scene.load_with(objects={"shape": shape_of(held)}))
    )
