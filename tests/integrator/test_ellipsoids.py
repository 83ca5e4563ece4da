"""Gaussians of Mitsuba's ellipsoids, rendered by ``splats``, against the float64 reference.

What a shape holds is converted here by numpy, in double precision, and rendered by the reference.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace

import drjit as dr
import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from scipy.spatial.transform import Rotation
from support.helpers import assert_arrays_agree, single
from support.kernels import drain_kernels, float_reductions
from support.views import VIEWS, Scene, clear, gradient, gradients_of, image_of, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator import ellipsoids as shapes_module
from drgs.reference import splatting as reference
from drgs.splatting import rendering

# As in test_splats: single precision, relative to the largest value of an array. Scales and
# opacities are converted with a relative error of 1e-7 each.
PICTURE, GRADIENTS = 1e-5, 1e-4

HELD = ("data", "opacities", "sh_coeffs")

KINDS = ("ellipsoids", "ellipsoidsmesh")

both_kinds = pytest.mark.parametrize("kind", KINDS)


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


# ----------------------------------------------------------------------------------------------
# What a shape holds
# ----------------------------------------------------------------------------------------------


def held_by(gaussians) -> dict[str, np.ndarray]:
    """Attributes of a shape, (N, ...), float32 values."""
    held = {
        "data": np.concatenate(
            [gaussians.means, np.exp(gaussians.log_scales), gaussians.quats[:, [1, 2, 3, 0]]], 1
        ),
        "opacities": reference.sigmoid(gaussians.logit_opacities)[:, None],
        "sh_coeffs": np.concatenate([gaussians.sh0, gaussians.shN], 1).reshape(
            len(gaussians.means), -1
        ),
    }
    return {name: single(values) for name, values in held.items()}


def gaussians_of(held) -> reference.Gaussians:
    """The conversion, in double precision."""
    data, opacities = held["data"], held["opacities"][:, 0]
    sh = held["sh_coeffs"].reshape(len(data), -1, 3)
    return reference.Gaussians(
        means=data[:, :3],
        quats=data[:, [9, 6, 7, 8]],
        log_scales=np.log(data[:, 3:6]),
        logit_opacities=np.log(opacities) - np.log1p(-opacities),
        sh0=sh[:, :1],
        shN=sh[:, 1:],
    )


def shape_of(held, kind="ellipsoids", **others) -> dict:
    """The dictionary for ``mi.load_dict``."""
    attributes = {name: mi.TensorXf(values.astype(np.float32)) for name, values in held.items()}
    return {"type": kind, **attributes, **others}


@dataclass(frozen=True)
class Held(Scene):
    """A scene whose Gaussians a shape holds; their numbers are what float32 makes of them there."""

    kind: str = "ellipsoids"

    @property
    def held(self) -> dict[str, np.ndarray]:
        return held_by(super().gaussians)

    @property
    def gaussians(self) -> reference.Gaussians:
        return gaussians_of(self.held)

    @property
    def shape(self) -> dict:
        return shape_of(self.held, self.kind)

    def load(self, settings=None, **shapes) -> mi.Scene:
        shapes = shapes or {"shape": self.shape}
        sensor = self.view.sensor()
        integrator = self.settings | (settings or {})
        return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **shapes})


def held_gradients(held, of_gaussians) -> dict[str, np.ndarray]:
    """Derivatives with respect to attributes, from those of the Gaussians.

    Each Gaussian is converted by itself, so that a column's central difference serves all rows.
    The conversion's third derivatives are at most 2 / x^3 at steps of 1e-6 x: errors of 1e-12.
    """
    gradients = {name: np.zeros_like(values) for name, values in held.items()}
    for name, values in held.items():
        for k in range(values.shape[1]):
            step = 1e-6 * np.abs(values[:, k])
            if name == "opacities":
                step = step * (1 - values[:, k])
            step[step == 0] = 1e-6
            moved = []
            for sign in (1, -1):
                changed = values.copy()
                changed[:, k] += sign * step
                moved.append(vars(gaussians_of(held | {name: changed})))
            for parameter in PARAMETER_NAMES:
                slope = (moved[0][parameter] - moved[1][parameter]).reshape(len(step), -1)
                weighted = slope * of_gaussians[parameter].reshape(len(step), -1)
                gradients[name][:, k] += weighted.sum(axis=1) / (2 * step)
    return gradients


def gradients_held(loaded, weights, prefix="shape") -> dict[str, np.ndarray]:
    """Gradients of sum(weights * image) for what a shape holds, flat."""
    params = mi.traverse(loaded)
    keys = {name: f"{prefix}.{name}" for name in HELD}
    for key in keys.values():
        dr.enable_grad(params[key])
    image = mi.render(loaded, params)
    dr.backward(dr.sum(image * mi.TensorXf(np.asarray(weights, np.float32)), axis=None))
    return {name: gradient(params[key]) for name, key in keys.items()}


def apart(arrays) -> dict[str, np.ndarray]:
    """With ``data`` in its parts, which differ in size: each has a largest value of its own."""
    data = arrays["data"].reshape(-1, 10)
    parts = {"means": data[:, :3], "scales": data[:, 3:6], "quats": data[:, 6:]}
    return parts | {name: arrays[name].ravel() for name in HELD if name != "data"}


def assert_held_agree(actual, expected):
    assert_arrays_agree(apart(actual), apart(expected), GRADIENTS)


def assert_images_agree(actual, expected, tolerance=PICTURE):
    assert_arrays_agree({"image": actual}, {"image": expected}, tolerance)


# ----------------------------------------------------------------------------------------------
# Pictures
# ----------------------------------------------------------------------------------------------


@both_kinds
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_shape_looks_as_the_reference_draws_its_gaussians(kind, degree):
    scene = clear(Held(degree=degree, kind=kind))
    loaded = scene.load()
    assert_images_agree(image_of(loaded), scene.image())
    assert loaded.integrator().sh_degree == degree
    assert f"  gaussians = 40,\n  sh_degree = {degree}," in str(loaded.integrator())


def write_model(path, gaussians):
    fields = {name: getattr(gaussians, name).astype(np.float32) for name in PARAMETER_NAMES}
    Gaussians(**fields).save(path)
    return str(path)


@both_kinds
@pytest.mark.parametrize("degree", [1, 3])
def test_a_file_looks_the_same_through_a_shape(kind, degree, tmp_path):
    """To what float32 makes of exp, log and the sigmoid."""
    scene = Scene(degree=degree)
    path = write_model(tmp_path / "model.ply", scene.gaussians)
    loaded = Held().load(shape={"type": kind, "filename": path})
    assert_images_agree(image_of(loaded), image_of(scene.load()))


# With these choices what is left is that volprim_rf_basic composites in the order in which a ray
# enters the ellipsoids, passes over those entered within 1e-4 behind another, and does not draw
# those that contain the camera: test_volprim.py measures each where it is alone. Of the mean
# of this picture they make 0.025. A tenth less of all opacities makes 0.07, quaternions read
# otherwise 0.2, coefficients in another order 0.5.
VOLPRIM = 0.04
AS_VOLPRIM = {
    "projection": "exact", "order": "pixel", "sh_direction": "pixel", "low_pass": 0.0,
    "extent": 3.0, "alpha_max": 0.9999, "alpha_cut": 0.0, "transmittance_stop": 0.01,
}  # fmt: skip


@both_kinds
def test_the_same_shapes_look_as_volprim_rf_basic_draws_them(kind):
    scene = Held(degree=2, count=60)
    held = scene.held
    held["data"][:, 6:] /= np.linalg.norm(held["data"][:, 6:], axis=1, keepdims=True)

    def picture(held, integrator, **settings):
        loaded = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": integrator, "srgb_primitives": False, **settings},
                "sensor": scene.view.sensor(pixel_format="rgb"),
                "shape": shape_of(held, kind),
            }
        )
        return image_of(loaded, spp=16)

    expected = picture(held, "volprim_rf_basic", max_depth=256)

    def error(**changes):
        actual = picture(held | changes, "splats", **AS_VOLPRIM)
        return np.abs(actual - expected).mean() / expected.mean()

    assert error() < VOLPRIM
    assert error(opacities=0.9 * held["opacities"]) > 1.5 * VOLPRIM
    assert error(data=held["data"] * np.repeat([1, -1, 1], [6, 3, 1])) > 4 * VOLPRIM


# ----------------------------------------------------------------------------------------------
# Merging
# ----------------------------------------------------------------------------------------------


def joined(*parts) -> reference.Gaussians:
    """All rows, coefficients padded with zeros."""
    width = max(part.shN.shape[1] for part in parts)
    fields = {
        name: np.concatenate([getattr(part, name) for part in parts])
        for name in PARAMETER_NAMES
        if name != "shN"
    }
    padded = [np.pad(p.shN, [(0, 0), (0, width - p.shN.shape[1]), (0, 0)]) for p in parts]
    return reference.Gaussians(**fields, shN=np.concatenate(padded))


@dataclass(frozen=True)
class Merged(Scene):
    """Gaussians of the integrator and of two shapes, of other degrees."""

    own_degree: int = 1
    degrees: tuple[int, int] = (2, 0)

    @property
    def own(self) -> reference.Gaussians:
        return replace(self._plain, degree=self.own_degree).gaussians

    @property
    def shapes(self) -> list[Held]:
        return [
            Held(self.view, degree=degree, count=count, seed=self.seed + 1000 * (i + 1))
            for i, (degree, count) in enumerate(zip(self.degrees, (12, 23), strict=True))
        ]

    @property
    def gaussians(self) -> reference.Gaussians:
        return joined(self.own, *(shape.gaussians for shape in self.shapes))

    @property
    def rendered_degree(self) -> int:
        highest = max(self.own_degree, *self.degrees)
        return highest if self.sh_degree is None else self.sh_degree

    @property
    def _plain(self) -> Scene:
        return Scene(self.view, count=self.count, seed=self.seed)

    def load(self, **settings) -> mi.Scene:
        """One shape of each kind, in the order in which Mitsuba lists them, then a mesh."""
        first, second = self.shapes
        integrator = self.settings | tensors(self.own) | settings
        return mi.load_dict(
            {
                "type": "scene",
                "integrator": integrator,
                "sensor": self.view.sensor(),
                "first": shape_of(first.held),
                "second": shape_of(second.held, "ellipsoidsmesh"),
            }
        )


MERGED = (
    Merged(),
    Merged(own_degree=3),
    Merged(own_degree=0, degrees=(0, 3)),
    Merged(own_degree=0, degrees=(0, 0)),
)


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
def test_a_degree_below_the_highest_may_be_asked_for(degree):
    scene = clear(Merged(sh_degree=degree))
    assert_images_agree(image_of(scene.load()), scene.image())


def test_gradients_of_merged_gaussians_reach_where_they_came_from():
    scene = clear(Merged())
    weights = scene.weights()
    loaded = scene.load()
    params = mi.traverse(loaded)
    keys = [f"{shape}.{name}" for shape in ("first", "second") for name in HELD]
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
        actual = {name: gradient(params[f"{prefix}.{name}"]) for name in HELD}
        assert_held_agree(actual, held_gradients(shape.held, of_gaussians))


def test_features_of_the_shapes_gaussians_are_zero():
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


def test_the_shapes_gaussians_have_no_smoothing_filter():
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


# ----------------------------------------------------------------------------------------------
# Gradients
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("srgb_primitives", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_gradients_equal_the_references(degree, srgb_primitives):
    scene = clear(Held(degree=degree, srgb_primitives=srgb_primitives))
    expected = held_gradients(scene.held, scene.gradients(scene.weights()))
    assert_held_agree(gradients_held(scene.load(), scene.weights()), expected)


def test_gradients_equal_the_references_for_a_mesh():
    scene = clear(Held(kind="ellipsoidsmesh"))
    expected = held_gradients(scene.held, scene.gradients(scene.weights()))
    assert_held_agree(gradients_held(scene.load(), scene.weights()), expected)


@pytest.mark.parametrize("name", HELD)
def test_only_what_is_enabled_receives_gradients(name):
    scene = Held()
    loaded = scene.load()
    params = mi.traverse(loaded)
    dr.enable_grad(params[f"shape.{name}"])
    image = mi.render(loaded, params)
    dr.backward(dr.sum(image * mi.TensorXf(scene.weights().astype(np.float32)), axis=None))
    everything = gradients_held(scene.load(), scene.weights())
    np.testing.assert_array_equal(gradient(params[f"shape.{name}"]), everything[name])
    assert not any(dr.grad_enabled(params[f"shape.{other}"]) for other in HELD if other != name)


def test_gradients_reach_what_a_shapes_parameters_were_computed_from():
    scene = clear(Held())
    loaded = scene.load()
    params = mi.traverse(loaded)
    factor = mi.Float(1.0)
    dr.enable_grad(factor)
    params["shape.sh_coeffs"] = params["shape.sh_coeffs"] * factor
    params.update()
    image = mi.render(loaded, params)
    dr.backward(dr.sum(image * mi.TensorXf(scene.weights().astype(np.float32)), axis=None))
    expected = held_gradients(scene.held, scene.gradients(scene.weights()))
    terms = expected["sh_coeffs"] * scene.held["sh_coeffs"]
    assert dr.grad(factor)[0] == pytest.approx(terms.sum(), abs=GRADIENTS * np.abs(terms).max())


STEP = 1e-7


def directions_of(held) -> dict[str, np.ndarray]:
    """Of opacities so small that they stay within 0..1; of scales and others as their values."""
    rng = np.random.default_rng(7)
    directions = {name: rng.normal(0, 1, v.shape) * np.abs(v) for name, v in held.items()}
    directions["opacities"] *= 1 - held["opacities"]
    return {name: single(values) for name, values in directions.items()}


def forward_image(loaded, directions, prefix="shape") -> np.ndarray:
    params = mi.traverse(loaded)
    for name, direction in directions.items():
        parameter = params[f"{prefix}.{name}"]
        dr.enable_grad(parameter)
        dr.set_grad(parameter, mi.Float(direction.ravel().astype(np.float32)))
    return np.array(dr.forward_to(mi.render(loaded, params))).astype(np.float64)


@pytest.mark.parametrize("names", [*((name,) for name in HELD), HELD], ids="+".join)
def test_forward_mode_equals_central_differences(names):
    """STEP: as in test_splats."""
    scene = clear(Held(degree=2))
    directions = {name: directions_of(scene.held)[name] for name in names}

    def moved(step):
        changed = {name: scene.held[name] + step * v for name, v in directions.items()}
        gaussians = gaussians_of(scene.held | changed)
        return scene.image(reference.render(gaussians, scene.camera, np.zeros(3), 2))

    expected = (moved(STEP) - moved(-STEP)) / (2 * STEP)
    assert_images_agree(forward_image(scene.load(), directions), expected, GRADIENTS)


@pytest.mark.parametrize("scene", [MERGED[0], MERGED[3]], ids=["1, 2, 0", "0, 0, 0"])
def test_forward_and_backward_mode_are_transposed_for_merged_gaussians(scene):
    """<J v, w> = <v, J^T w>, for a shape that was turned and one with Gaussians before it."""
    settings = {"shapes_to_world_first": transform()}
    directions = directions_of(scene.shapes[0].held)
    image = forward_image(scene.load(**settings), directions, "first")
    gradients = gradients_held(scene.load(**settings), scene.weights(), "first")
    terms = [np.sum(directions[name].ravel() * gradients[name]) for name in HELD]
    forward = np.sum(image * scene.weights())
    assert forward == pytest.approx(sum(terms), abs=1e-5 * np.abs(terms).max())


def test_the_gradient_tests_would_notice_one_percent():
    scene = clear(Held())
    expected = apart(held_gradients(scene.held, scene.gradients(scene.weights())))
    for name, values in expected.items():
        with pytest.raises(AssertionError):
            assert_arrays_agree({name: 1.01 * values}, {name: values}, GRADIENTS)


def test_backward_passes_give_the_same_bytes_and_add_nothing_atomically():
    scene = Merged()
    first = gradients_held(scene.load(), scene.weights(), "first")
    again = {}
    loaded = scene.load(shapes_to_world=transform())

    def turned():
        again.update(gradients_held(loaded, scene.weights(), "first"))

    found, count = float_reductions(turned)
    assert not found and count > 5
    again = gradients_held(scene.load(), scene.weights(), "first")
    assert all(first[name].tobytes() == again[name].tobytes() for name in HELD)


def test_adam_reduces_the_loss():
    """Every parameter starts somewhat off; the picture it had is the target."""
    scene = Held()
    loaded = scene.load()
    target = mi.TensorXf(image_of(loaded).astype(np.float32))
    params = mi.traverse(loaded)
    rng = np.random.default_rng(4)
    optimizer = mi.ad.Adam(lr=0.003)
    for name in HELD:
        factors = rng.uniform(0.9, 1.1, scene.held[name].size).astype(np.float32)
        optimizer[f"shape.{name}"] = params[f"shape.{name}"] * mi.Float(factors)
    losses = []
    for _ in range(25):
        params.update(optimizer)
        loss = dr.mean(dr.square(mi.render(loaded, params) - target), axis=None)
        dr.backward(loss)
        optimizer.step()
        losses.append(float(loss.array[0]))
    assert losses[-1] < 0.3 * losses[0]


# ----------------------------------------------------------------------------------------------
# to_world
# ----------------------------------------------------------------------------------------------

ROTATION = Rotation.from_rotvec([0.7, -0.4, 1.1]).as_matrix()
SCALE, TRANSLATION = 1.5, np.array([0.5, -0.25, 1.0])


def transform() -> mi.ScalarTransform4f:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = SCALE * ROTATION, TRANSLATION
    return mi.ScalarTransform4f(matrix)


def follower(view):
    """The view, moved with a model that ``transform`` moves."""
    matrix = np.array(view.to_world)
    turned = matrix.copy()
    turned[:3, :3] = ROTATION @ matrix[:3, :3]
    turned[:3, 3] = SCALE * ROTATION @ matrix[:3, 3] + TRANSLATION
    return replace(view, to_world=tuple(map(tuple, single(turned))), near_clip=view.near_clip * 1.5)


def scene_with(integrator, view, **others) -> mi.Scene:
    settings = {"type": "splats", "srgb_primitives": False, **integrator}
    return mi.load_dict(
        {"type": "scene", "integrator": settings, "sensor": view.sensor(), **others}
    )


@both_kinds
@pytest.mark.parametrize("names", ["shapes_to_world", "shapes_to_world_shape"])
def test_a_model_looks_the_same_moved_by_the_integrator_a_shape_or_the_camera(
    kind, names, tmp_path
):
    """In single precision: positions of 4 units, rounded to 2e-7, at 40 px to a unit: 1e-5 px."""
    path = write_model(tmp_path / "model.ply", Scene(degree=3).gaussians)
    view = VIEWS[1]
    unmoved = image_of(scene_with({"filename": path}, view))
    moved = {"filename": path, "to_world": transform()}
    shape = {"type": kind, **moved}
    away = follower(view)
    ours = image_of(scene_with(moved, away))
    theirs = image_of(scene_with({names: transform()}, away, shape=shape))
    unturned = image_of(scene_with({}, away, shape=shape))
    assert_images_agree(ours, unmoved, 3 * PICTURE)
    assert_images_agree(theirs, unmoved, 3 * PICTURE)
    assert np.abs(unturned - unmoved).max() > 0.02


def test_each_shape_may_have_a_to_world_of_its_own(tmp_path):
    path = write_model(tmp_path / "model.ply", Scene(degree=3).gaussians)
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
    assert_images_agree(actual, expected, 3 * PICTURE)


def test_tensors_are_moved_as_a_file_is(tmp_path):
    scene = Scene(degree=2)
    path = write_model(tmp_path / "model.ply", scene.gaussians)
    from_file = mi.load_dict({"type": "splats", "filename": path, "to_world": transform()})
    from_tensors = mi.load_dict(
        {"type": "splats", **tensors(scene.gaussians), "to_world": transform()}
    )
    for name in PARAMETER_NAMES:
        np.testing.assert_array_equal(
            np.array(getattr(from_file, name)), np.array(getattr(from_tensors, name))
        )
    assert not np.array_equal(np.array(from_file.shN), np.float32(scene.gaussians.shN))


def test_gradients_of_turned_coefficients_are_those_of_the_unturned_before_a_turned_camera(
    tmp_path,
):
    """The pictures are the same functions of the coefficients."""
    scene = Scene(degree=3)
    path = write_model(tmp_path / "model.ply", scene.gaussians)
    shape = {"type": "ellipsoids", "filename": path}
    view = VIEWS[1]
    expected = gradients_held(scene_with({}, view, shape=shape), scene.weights())
    moved = scene_with(
        {"shapes_to_world": transform()}, follower(view), shape=shape | {"to_world": transform()}
    )
    actual = gradients_held(moved, scene.weights())
    for name in ("sh_coeffs", "opacities"):
        assert_arrays_agree({name: actual[name]}, {name: expected[name]}, GRADIENTS)


def test_another_rotation_needs_no_other_kernel(tmp_path):
    path = write_model(tmp_path / "model.ply", Scene(degree=3).gaussians)
    shape = {"type": "ellipsoids", "filename": path}

    def kernels(degrees):
        turn = {"shapes_to_world": mi.ScalarTransform4f().rotate([0, 0, 1], degrees)}
        loaded = scene_with(turn, VIEWS[1], shape=shape)
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            dr.eval(mi.render(loaded))
            return drain_kernels()

    assert kernels(20) == kernels(130)


# ----------------------------------------------------------------------------------------------
# Numbers at the border
# ----------------------------------------------------------------------------------------------


def picture_of(scene, **changes) -> np.ndarray:
    """Of the scene's shape with some numbers changed: name = (row, column, value)."""
    return image_of(scene.load(shape=shape_of(changed(scene.held, **changes))))


def changed(held, **changes):
    held = {name: values.copy() for name, values in held.items()}
    for name, (row, column, value) in changes.items():
        held[name][row, column] = value
    return held


SEEN = 3
"""The large splat of ``views.splats_before``."""


def test_an_opacity_of_one_is_the_largest_below_one():
    scene = Held()
    largest = picture_of(scene, opacities=(SEEN, 0, 1 - 2.0**-24))
    for value in (1.0, 1.5, np.inf):
        np.testing.assert_array_equal(picture_of(scene, opacities=(SEEN, 0, value)), largest)
    assert np.abs(largest - picture_of(scene, opacities=(SEEN, 0, 0.9))).max() > 0.01


@pytest.mark.parametrize(
    "changes",
    [
        *({"opacities": (SEEN, 0, value)} for value in (0.0, -0.5, np.nan)),
        *({"data": (SEEN, 4, value)} for value in (0.0, -0.0, np.nan)),
    ],
    ids=str,
)
def test_what_cannot_be_seen_leaves_the_picture_of_the_others(changes):
    """With any least alpha."""
    scene = Held()
    others = {name: np.delete(values, SEEN, axis=0) for name, values in scene.held.items()}
    for settings in ({}, {"alpha_cut": 0.0}):
        loaded = scene.load(settings, shape=shape_of(changed(scene.held, **changes)))
        expected = scene.load(settings, shape=shape_of(others))
        np.testing.assert_array_equal(image_of(loaded), image_of(expected))
        derivatives = gradients_held(loaded, scene.weights())
        for name, width in (("data", 10), ("opacities", 1), ("sh_coeffs", 12)):
            rows = derivatives[name].reshape(40, width)
            assert np.isfinite(rows).all() and (rows[SEEN] == 0).all() and rows.any()


def test_the_sign_of_a_standard_deviation_means_nothing():
    """Derivatives change theirs."""
    scene = Held()
    loaded = scene.load()
    width = scene.held["data"][SEEN, 4]
    other = scene.load(shape=shape_of(changed(scene.held, data=(SEEN, 4, -width))))
    np.testing.assert_array_equal(image_of(other), image_of(loaded))
    plain, negated = (
        gradients_held(each, scene.weights())["data"].reshape(-1, 10)[SEEN]
        for each in (loaded, other)
    )
    np.testing.assert_array_equal(negated, plain * np.repeat([1, -1, 1], [4, 1, 5]))
    assert plain[4] != 0


def test_a_to_world_that_mirrors_makes_the_mirror_image(tmp_path):
    """Before a camera that is mirrored with it: of degree 0, the same picture."""
    path = write_model(tmp_path / "model.ply", Scene(degree=0).gaussians)
    shape = {"type": "ellipsoids", "filename": path}
    mirror = mi.ScalarTransform4f().scale([-1, 1, 1])
    view = VIEWS[1]
    reflected = np.diag([-1.0, 1, 1, 1]) @ np.array(view.to_world)
    image = image_of(scene_with({}, view, shape=shape))
    other = replace(view, to_world=tuple(map(tuple, reflected)))
    mirrored = image_of(scene_with({}, other, shape=shape | {"to_world": mirror}))
    assert_images_agree(mirrored, image)


def test_the_derivative_at_an_opacity_of_one_is_that_of_the_inside():
    """A splat behind all others, its peak beside the film: pictures are linear in its opacity."""
    settings = {"alpha_cut": 0.0, "transmittance_stop": 0.0, "extent": 3.0}
    scene = Held(degree=0)
    camera = scene.camera
    held = {name: values.copy() for name, values in scene.held.items()}
    held["data"][SEEN, :3] = camera.center + [7, 0, 9] @ camera.rotation
    held["data"][SEEN, 3:6] = 2.5

    def derivative(opacity):
        loaded = scene.load(settings, shape=shape_of(changed(held, opacities=(SEEN, 0, opacity))))
        return gradients_held(loaded, scene.weights())["opacities"][SEEN]

    expected = derivative(0.9)
    assert derivative(1.0) == pytest.approx(expected, rel=1e-4) and abs(expected) > 0.1
    assert derivative(1.001) == 0


# ----------------------------------------------------------------------------------------------
# What is kept from one rendering to the next
# ----------------------------------------------------------------------------------------------


@pytest.fixture
def counted(monkeypatch):
    """Two lists: a growing one for each frame that is rendered, and for each conversion."""
    frames, conversions = [], []
    render, convert = rendering.render, shapes_module.Conversion.gaussians

    def counting_render(*arguments):
        frames.append(arguments)
        return render(*arguments)

    def counting_convert(self):
        conversions.append(self)
        return convert(self)

    monkeypatch.setattr(rendering, "render", counting_render)
    monkeypatch.setattr(shapes_module.Conversion, "gaussians", counting_convert)
    return frames, conversions


def test_a_backward_pass_reuses_the_frame_and_converts_nothing(counted):
    scene = Held()
    loaded = scene.load()
    gradients_held(loaded, scene.weights())
    image_of(loaded)
    assert [len(calls) for calls in counted] == [1, 1]


@pytest.mark.parametrize("name", HELD)
def test_a_changed_parameter_is_rendered_again(name, counted):
    scene = Held()
    loaded = scene.load()
    before = image_of(loaded)
    params = mi.traverse(loaded)
    params[f"shape.{name}"] = params[f"shape.{name}"] * 0.75
    params.update()
    after = image_of(loaded)
    assert [len(calls) for calls in counted] == [2, 2] and np.abs(after - before).max() > 0.01
    halved = scene.held | {name: scene.held[name] * 0.75}
    np.testing.assert_array_equal(after, image_of(scene.load(shape=shape_of(halved))))


def test_a_shape_may_be_given_other_gaussians(counted):
    scene, other = Held(), Held(count=60, seed=9)
    loaded = scene.load()
    image_of(loaded)
    params = mi.traverse(loaded)
    for name, values in other.held.items():
        params[f"shape.{name}"] = mi.Float(values.ravel().astype(np.float32))
    params.update()
    np.testing.assert_array_equal(image_of(loaded), image_of(other.load()))


def test_a_changed_parameter_of_the_integrators_own_is_rendered_again():
    scene = Merged()
    loaded = scene.load()
    image_of(loaded)
    params = mi.traverse(loaded)
    params["integrator.means"] = params["integrator.means"] + 0.25
    params.update()
    moved = replace(scene.own, means=single(scene.own.means + 0.25))
    expected = image_of(scene.load(**tensors(moved)))
    np.testing.assert_array_equal(image_of(loaded), expected)


def test_an_integrator_shows_the_shapes_of_the_scene_that_it_renders():
    first, second = Held(), Held(seed=9)
    scenes = [scene.load() for scene in (first, second)]
    expected = [image_of(loaded) for loaded in scenes]
    integrator = mi.load_dict(first.settings)
    for _ in range(2):
        for loaded, image in zip(scenes, expected, strict=True):
            np.testing.assert_array_equal(image_of(loaded, integrator=integrator), image)


KERNELS = """
import json, sys
sys.path.insert(0, "tests")
blocked = {blocked!r}
for name in blocked:
    sys.modules["drgs." + name] = None  # importing it raises ImportError
import drgs, drjit as dr, mitsuba as mi
mi.set_variant("llvm_ad_rgb")
from drgs.gaussians.parameters import PARAMETER_NAMES
from support.helpers import FLOAT32, device_gaussians
from support.kernels import drain_kernels
from support.views import Scene

scene = Scene(degree=3)
gaussians = device_gaussians(scene.gaussians, FLOAT32)
loaded = mi.load_dict(
    {{
        "type": "scene",
        "integrator": scene.settings | {{n: getattr(gaussians, n) for n in PARAMETER_NAMES}},
        "sensor": scene.view.sensor(),
        "ball": {{"type": "sphere"}},
    }}
)
params = mi.traverse(loaded)
dr.enable_grad(params["integrator.means"])
with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
    dr.backward(mi.render(loaded, params))
    dr.eval(dr.grad(params["integrator.means"]))
    kernels = drain_kernels()
loaded_modules = [name for name in {modules!r} if "drgs." + name in sys.modules]
print(json.dumps([kernels, [] if blocked else loaded_modules]))
"""

MODULES = ("integrator.ellipsoids", "gaussians.similarity", "gaussians.sh_rotation")


def test_without_such_shapes_nothing_of_this_is_imported_and_kernels_are_the_same(run_python):
    results = [
        run_python(KERNELS.format(blocked=blocked, modules=MODULES)) for blocked in ((), MODULES)
    ]
    assert [r.returncode for r in results] == [0, 0], results[1].stderr
    (whole, imported), (reduced, _) = (json.loads(r.stdout) for r in results)
    assert whole == reduced and len(whole) > 10 and imported == []


# ----------------------------------------------------------------------------------------------
# Errors
# ----------------------------------------------------------------------------------------------


def refusal(loaded) -> str:
    with pytest.raises(Exception) as caught:
        mi.render(loaded)
    error = caught.value
    while error.__cause__ or error.__context__:
        error = error.__cause__ or error.__context__
    assert isinstance(error, ValueError)
    return str(error)


def without(held, *names):
    return {name: values for name, values in held.items() if name not in names}


def wide(held, name, width):
    return held | {name: np.zeros((len(held["data"]), width))}


REFUSED = {
    "no attributes": (
        lambda held: {"data": held["data"], "albedo": held["data"][:, :3]},
        "splats: the shape 'shape' (ellipsoids) must have the attributes opacities and sh_coeffs; "
        "missing: opacities, sh_coeffs; it has: data, albedo",
    ),
    "no coefficients": (lambda held: without(held, "sh_coeffs"), "missing: sh_coeffs; it has: "),
    "no opacities": (lambda held: without(held, "opacities"), "missing: opacities; it has: "),
    "coefficients of no degree": (
        lambda held: wide(held, "sh_coeffs", 15),
        "splats: the shape 'shape' (ellipsoids) must have sh_coeffs of shape (40, 3) or (40, 12) "
        "or (40, 27) or (40, 48), got 600 numbers",
    ),
    "two opacities": (
        lambda held: wide(held, "opacities", 2),
        "must have opacities of shape (40, 1), got 80 numbers",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_shapes_without_what_is_needed_are_refused(case):
    make, expected = REFUSED[case]
    scene = Held()
    assert expected in refusal(scene.load(shape=shape_of(make(scene.held))))


def test_a_scene_without_gaussians_is_refused():
    for others in ({}, {"ball": {"type": "sphere"}}):
        loaded = scene_with({}, VIEWS[1], **others)
        assert refusal(loaded) == (
            "splats: there are no Gaussians: give the integrator 'filename' or tensors means, "
            "quats, log_scales, logit_opacities, sh0, shN, or the scene a shape of type "
            "ellipsoids or ellipsoidsmesh"
        )


def test_a_degree_above_that_of_the_shapes_is_refused():
    assert "integer from 0 to 1, the degree of the Gaussians, got 2" in refusal(
        Held(degree=1).load({"sh_degree": 2})
    )


def test_a_degree_that_only_shapes_have_may_be_asked_for():
    """When loaded, later, and still after a parameter of the integrator's own has changed."""
    scene = clear(Merged(own_degree=0, degrees=(0, 3), sh_degree=2))
    loaded = scene.load()
    expected = scene.image()
    assert_images_agree(image_of(loaded), expected)
    loaded = replace(scene, sh_degree=None).load()
    assert np.abs(image_of(loaded) - expected).max() > 1e-3
    loaded.integrator().sh_degree = 2
    params = mi.traverse(loaded)
    params["integrator.means"] = mi.TensorXf(params["integrator.means"])
    params.update()
    assert_images_agree(image_of(loaded), expected)


def test_own_coefficients_may_be_fewer_than_those_of_shapes_were():
    """The highest degree is still that of a shape."""
    loaded = Merged().load()
    before = image_of(loaded)
    params = mi.traverse(loaded)
    params["integrator.shN"] = dr.zeros(mi.TensorXf, (40, 0, 3))
    params.update()
    after = image_of(loaded)
    assert loaded.integrator().sh_degree == 2 and np.abs(after - before).max() > 1e-3


def test_a_to_world_for_a_shape_that_is_not_there_is_refused():
    settings = {"shapes_to_world_chair": transform()}
    assert refusal(Held().load(settings)) == (
        "splats: shapes_to_world_chair must end with the id of a shape of type ellipsoids or "
        "ellipsoidsmesh, ids are: 'shape'"
    )
    own = scene_with(settings | tensors(Scene().gaussians), VIEWS[1])
    assert refusal(own).endswith("ids are: none")


WRONG_PROPERTIES = {
    "to_world of nothing": (
        lambda: {"to_world": transform()},
        "PluginError: splats: give 'filename', or the Gaussians as tensors",
    ),
    "to_world, scales": (
        lambda: tensors(Scene().gaussians) | {"to_world": mi.ScalarTransform4f().scale([1, 2, 1])},
        "PluginError: splats: to_world must be made of rotations, translations and scales",
    ),
    "to_world, text": (
        lambda: tensors(Scene().gaussians) | {"to_world": "up"},
        "PluginTypeError: splats: to_world must be a transform, got str",
    ),
    "shapes_to_world, mirror": (
        lambda: {"shapes_to_world_a": mi.ScalarTransform4f().scale([-1, 1, 1])},
        "PluginError: splats: shapes_to_world_a must be made of rotations, translations and scales",
    ),
    "sh_degree": (lambda: {"sh_degree": 4}, "splats: sh_degree must be an integer from 0 to 3"),
}


@pytest.mark.parametrize("case", WRONG_PROPERTIES)
def test_wrong_properties_are_refused(case):
    make, expected = WRONG_PROPERTIES[case]
    with pytest.raises(RuntimeError) as caught:
        mi.load_dict({"type": "splats", **make()})
    assert expected in str(caught.value).strip().splitlines()[-1]


# ----------------------------------------------------------------------------------------------
# The shipped scene
# ----------------------------------------------------------------------------------------------

SCENES = REPOSITORY / "scenes"


def test_the_shipped_model_is_what_its_program_makes(monkeypatch):
    """To rounding: sines and inverse matrices may differ between machines."""
    monkeypatch.syspath_prepend(SCENES)
    import knot

    made, shipped = knot.knot(), Gaussians.load(knot.FILE)
    for name in PARAMETER_NAMES:
        if name != "quats":  # either sign is the same rotation
            np.testing.assert_allclose(getattr(made, name), getattr(shipped, name), atol=1e-5)
    cosines = np.sum(made.quats * shipped.quats, axis=1)
    np.testing.assert_allclose(np.abs(cosines), 1, atol=1e-5)


def test_the_shipped_scene_is_compared(monkeypatch, tmp_path, capsys):
    """On a film so small that the low-pass of 0.3 px^2 shows: 24 dB; a mirrored one has 10."""
    monkeypatch.syspath_prepend(SCENES)
    import compare_shapes

    monkeypatch.setattr(compare_shapes, "REPEATS", {"volprim_rf_basic": 1, "splats": 1})
    model = str(SCENES / "shapes" / "knot.ply")
    for arguments in ([], [model]):
        options = [*arguments, "--size", "48", "--out", str(tmp_path / "shapes.png")]
        monkeypatch.setattr("sys.argv", ["compare_shapes.py", *options])
        compare_shapes.main()
        lines = capsys.readouterr().out.splitlines()
        assert [line.partition(":")[0] for line in lines[1:4]] == [
            "volprim_rf_basic",
            "splats",
            "ratio of the times",
        ]
        assert float(lines[4].removesuffix(" dB").rpartition(" ")[2]) > 20
        assert iio.imread(tmp_path / "shapes.png").shape[:2] > (300, 600)
