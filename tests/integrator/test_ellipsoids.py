"""Gaussians of Mitsuba's ellipsoids, rendered by ``splats``, against the float64 reference.

What a shape holds is converted here by numpy, in double precision, and rendered by the reference.
"""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from support.ellipsoids import (
    MERGED,
    ROTATION,
    SCALE,
    SHAPE_ATTRIBUTES,
    TRANSLATION,
    EllipsoidsCase,
    Merged,
    assert_held_agree,
    gradients_held,
    held_gradients,
    joined,
    scene_with,
    shape_of,
    transform,
)
from support.helpers import assert_arrays_agree, clear, single
from support.kernels import float_reductions
from support.splats_checks import GRADIENTS, IMAGE, assert_images_agree, write_gaussians
from support.views import VIEWS, Scene, gradient, gradients_of, image_of, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator import parts
from drgs.splatting import rendering

KINDS = ("ellipsoids", "ellipsoidsmesh")

both_kinds = pytest.mark.parametrize("kind", KINDS)


# ----------------------------------------------------------------------------------------------
# Images
# ----------------------------------------------------------------------------------------------


@both_kinds
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_shape_matches_the_reference(kind, degree):
    scene = clear(EllipsoidsCase(degree=degree, kind=kind))
    loaded = scene.load()
    assert_images_agree(image_of(loaded), scene.image())
    assert loaded.integrator().sh_degree == degree
    assert f"  gaussians = 40,\n  sh_degree = {degree}," in str(loaded.integrator())


# ----------------------------------------------------------------------------------------------
# to_world
# ----------------------------------------------------------------------------------------------


def follower(view):
    """The view, moved with a model that ``transform`` moves."""
    matrix = np.array(view.to_world)
    turned = matrix.copy()
    turned[:3, :3] = ROTATION @ matrix[:3, :3]
    turned[:3, 3] = SCALE * ROTATION @ matrix[:3, 3] + TRANSLATION
    return replace(view, to_world=tuple(map(tuple, single(turned))), near_clip=view.near_clip * 1.5)


@both_kinds
@pytest.mark.parametrize("names", ["shapes_to_world", "shapes_to_world_shape"])
def test_moving_integrator_shape_or_camera_gives_the_same_image(kind, names, tmp_path):
    """In single precision: positions of 4 units, rounded to 2e-7, at 40 px to a unit: 1e-5 px."""
    path = write_gaussians(tmp_path / "model.ply", Scene(degree=3).gaussians)
    view = VIEWS[1]
    unmoved = image_of(scene_with({"filename": path}, view))
    moved = {"filename": path, "to_world": transform()}
    shape = {"type": kind, **moved}
    away = follower(view)
    ours = image_of(scene_with(moved, away))
    theirs = image_of(scene_with({names: transform()}, away, shape=shape))
    unturned = image_of(scene_with({}, away, shape=shape))
    assert_images_agree(ours, unmoved, 3 * IMAGE)
    assert_images_agree(theirs, unmoved, 3 * IMAGE)
    assert np.abs(unturned - unmoved).max() > 0.02


def test_each_shape_may_have_its_own_to_world(tmp_path):
    path = write_gaussians(tmp_path / "model.ply", Scene(degree=3).gaussians)
    half = mi.ScalarTransform4f().rotate([0, 0, 1], 180).scale(0.5)
    far = mi.ScalarTransform4f().translate([0.25, 0, 0.5])
    placed = {"a": transform(), "b": half, "c": far}
    shapes = {
        name: {"type": "ellipsoids", "filename": path, "to_world": to_world}
        for name, to_world in placed.items()
    }
    turns = {"shapes_to_world": transform(), "shapes_to_world_b": half, "shapes_to_world_c": far}
    view = follower(VIEWS[1])
    actual = image_of(scene_with(turns, view, **shapes))
    parts = [
        mi.load_dict({"type": "splats", "filename": path, "to_world": to_world}).gaussians.numpy()
        for to_world in placed.values()
    ]
    expected = image_of(scene_with(tensors(joined(*parts)), view))
    assert_images_agree(actual, expected, 3 * IMAGE)


# ----------------------------------------------------------------------------------------------
# Several shapes, and the integrator's own Gaussians
# ----------------------------------------------------------------------------------------------


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


def test_last_has_a_row_for_each_gaussian():
    loaded = Merged().load()
    gradients_held(loaded, Merged().weights(), "first")
    last = loaded.integrator().last
    assert last.means2d_grad.shape == (75, 2) and dr.width(last.visible) == 75


# ----------------------------------------------------------------------------------------------
# The shipped scene
# ----------------------------------------------------------------------------------------------


SCENES = REPOSITORY / "scenes"


def test_shipped_model_is_the_output_of_its_program(monkeypatch):
    """To rounding: sines and inverse matrices may differ between machines."""
    monkeypatch.syspath_prepend(SCENES)
    import knot

    made, shipped = knot.knot(), Gaussians.load(REPOSITORY / "scenes" / "shapes" / "knot.ply")
    for name in PARAMETER_NAMES:
        if name != "quats":  # either sign is the same rotation
            np.testing.assert_allclose(getattr(made, name), getattr(shipped, name), atol=1e-5)
    cosines = np.sum(made.quats * shipped.quats, axis=1)
    np.testing.assert_allclose(np.abs(cosines), 1, atol=1e-5)


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
