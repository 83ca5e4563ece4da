"""Ellipsoids at the border of what can be drawn, and those that are refused."""

from __future__ import annotations

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.ellipsoids import (
    EllipsoidsCase,
    Merged,
    gradients_held,
    scene_with,
    shape_of,
    transform,
)
from support.helpers import clear
from support.splats_checks import assert_images_agree, write_gaussians
from support.views import VIEWS, Scene, image_of, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.core.errors import UnsupportedError

# ----------------------------------------------------------------------------------------------
# Numbers at the border
# ----------------------------------------------------------------------------------------------

LARGE_SPLAT_ROW = 3
"""The large splat of ``views.splats_before``."""


def load(scene, name, column, value, **settings) -> mi.Scene:
    """The scene with one number of the large splat changed."""
    held = scene.held
    held[name][LARGE_SPLAT_ROW, column] = value
    return scene.load_with(objects={"shape": shape_of(held)}, **settings)


def test_an_opacity_of_one_is_the_largest_below_one():
    scene = EllipsoidsCase()
    largest, less = (image_of(load(scene, "opacities", 0, v)) for v in (1 - 2.0**-24, 0.9))
    for value in (1.0, 1.5, np.inf):
        np.testing.assert_array_equal(image_of(load(scene, "opacities", 0, value)), largest)
    assert np.abs(largest - less).max() > 0.01


@pytest.mark.parametrize("alpha_cut", [1 / 255, 0.0])
@pytest.mark.parametrize(
    ("name", "column", "value"),
    [
        *(("opacities", 0, value) for value in (0.0, -0.5, np.nan)),
        *(("data", 4, value) for value in (0.0, -0.0, np.nan)),
    ],
)
def test_invisible_gaussians_leave_the_image_unchanged(name, column, value, alpha_cut):
    scene = EllipsoidsCase()
    others = {k: np.delete(values, LARGE_SPLAT_ROW, axis=0) for k, values in scene.held.items()}
    loaded = load(scene, name, column, value, alpha_cut=alpha_cut)
    expected = scene.load_with(objects={"shape": shape_of(others)}, alpha_cut=alpha_cut)
    np.testing.assert_array_equal(image_of(loaded), image_of(expected))
    for derivative in gradients_held(loaded, scene.weights()).values():
        rows = derivative.reshape(40, -1)
        assert np.isfinite(rows).all() and (rows[LARGE_SPLAT_ROW] == 0).all() and rows.any()


def test_the_sign_of_a_standard_deviation_is_ignored():
    """Derivatives change theirs."""
    scene = EllipsoidsCase()
    loaded = scene.load()
    other = load(scene, "data", 4, -scene.held["data"][LARGE_SPLAT_ROW, 4])
    np.testing.assert_array_equal(image_of(other), image_of(loaded))
    plain, negated = (
        gradients_held(each, scene.weights())["data"].reshape(-1, 10)[LARGE_SPLAT_ROW]
        for each in (loaded, other)
    )
    np.testing.assert_array_equal(negated, plain * np.repeat([1, -1, 1], [4, 1, 5]))
    assert plain[4] != 0


def test_mirroring_to_world_gives_the_mirror_image(tmp_path):
    """Before a camera that is mirrored with it: of degree 0, the same image."""
    path = write_gaussians(tmp_path / "model.ply", Scene(degree=0).gaussians)
    shape = {"type": "ellipsoids", "filename": path}
    mirror = mi.ScalarTransform4f().scale([-1, 1, 1])
    view = VIEWS[1]
    reflected = np.diag([-1.0, 1, 1, 1]) @ np.array(view.to_world)
    image = image_of(scene_with({}, view, shape=shape))
    other = replace(view, to_world=tuple(map(tuple, reflected)))
    mirrored = image_of(scene_with({}, other, shape=shape | {"to_world": mirror}))
    assert_images_agree(mirrored, image)


def test_derivative_at_opacity_one_is_the_one_sided_limit():
    """A splat behind all others, its peak beside the film: images are linear in its opacity."""
    settings = {"alpha_cut": 0.0, "transmittance_stop": 0.0, "extent": 3.0}
    scene = EllipsoidsCase(degree=0)
    camera, held = scene.camera, scene.held
    held["data"][LARGE_SPLAT_ROW, :3] = camera.center + [7, 0, 9] @ camera.rotation
    held["data"][LARGE_SPLAT_ROW, 3:6] = 2.5

    def derivative(opacity):
        held["opacities"][LARGE_SPLAT_ROW] = opacity
        loaded = scene.load_with(objects={"shape": shape_of(held)}, **settings)
        return gradients_held(loaded, scene.weights())["opacities"][LARGE_SPLAT_ROW]

    expected = derivative(0.9)
    assert derivative(1.0) == pytest.approx(expected, rel=1e-4) and abs(expected) > 0.1
    assert derivative(1.001) == 0


# ----------------------------------------------------------------------------------------------
# Degrees
# ----------------------------------------------------------------------------------------------


def test_degree_of_shapes_may_be_chosen():
    """When loaded, later, and still after a parameter of the integrator's own has changed."""
    scene = clear(Merged(own_degree=0, degrees=(0, 3), sh_degree=2))
    expected = scene.image()
    assert_images_agree(image_of(scene.load()), expected)
    loaded = replace(scene, sh_degree=None).load()
    assert np.abs(image_of(loaded) - expected).max() > 1e-3
    loaded.integrator().sh_degree = 2
    params = mi.traverse(loaded)
    params["integrator.means"] = mi.TensorXf(params["integrator.means"])
    params.update()
    assert_images_agree(image_of(loaded), expected)


def test_own_coefficients_may_be_of_lower_degree_than_those_of_shapes():
    """The highest degree is still that of a shape."""
    loaded = Merged().load()
    before = image_of(loaded)
    params = mi.traverse(loaded)
    params["integrator.shN"] = dr.zeros(mi.TensorXf, (40, 0, 3))
    params.update()
    after = image_of(loaded)
    assert loaded.integrator().sh_degree == 2 and np.abs(after - before).max() > 1e-3


# ----------------------------------------------------------------------------------------------
# Errors
# ----------------------------------------------------------------------------------------------


def refusal(loaded) -> str:
    with pytest.raises(ValueError) as caught:
        loaded.integrator().render(loaded)
    return str(caught.value)


def with_zeros(name, width):
    return lambda held: held | {name: np.zeros((40, width))}


REFUSED_SHAPES = {
    "no attributes": (
        lambda held: {"data": held["data"], "albedo": held["data"][:, :3]},
        "splats: the shape 'shape' (ellipsoids) must have the attributes opacities and sh_coeffs; "
        "missing: opacities, sh_coeffs; it has: data, albedo",
    ),
    "no opacities": (
        lambda held: {"data": held["data"], "sh_coeffs": held["sh_coeffs"]},
        "missing: opacities; it has: ",
    ),
    "coefficients of no degree": (
        with_zeros("sh_coeffs", 15),
        "splats: the shape 'shape' (ellipsoids) must have sh_coeffs of shape (40, 3) or (40, 12) "
        "or (40, 27) or (40, 48), got 600 numbers",
    ),
    "two opacities": (
        with_zeros("opacities", 2),
        "must have opacities of shape (40, 1), got 80 numbers",
    ),
}


@pytest.mark.parametrize(("change", "message"), REFUSED_SHAPES.values(), ids=REFUSED_SHAPES)
def test_shapes_with_missing_attributes_are_refused(change, message):
    scene = EllipsoidsCase()
    assert message in refusal(scene.load_with(objects={"shape": shape_of(change(scene.held))}))


@pytest.mark.parametrize("others", [{}, {"ball": {"type": "sphere"}}], ids=str)
def test_a_scene_without_gaussians_is_refused(others):
    assert refusal(scene_with({}, VIEWS[1], **others)) == (
        "splats: there are no Gaussians: give the integrator 'filename' or tensors means, "
        "quats, log_scales, logit_opacities, sh0, shN, or the scene a shape of type "
        "ellipsoids or ellipsoidsmesh"
    )


def test_settings_that_do_not_fit_the_shapes_are_refused():
    degree = EllipsoidsCase(degree=1).load_with(sh_degree=2)
    assert "integer from 0 to 1, the degree of the Gaussians, got 2" in refusal(degree)
    settings = {"shapes_to_world_chair": transform()}
    assert refusal(EllipsoidsCase().load_with(**settings)) == (
        "splats: shapes_to_world_chair must end with the id of a shape of type ellipsoids or "
        "ellipsoidsmesh, ids are: 'shape'"
    )
    own = scene_with(settings | tensors(Scene().gaussians), VIEWS[1])
    assert refusal(own).endswith("ids are: none")


# ----------------------------------------------------------------------------------------------
# Instances
# ----------------------------------------------------------------------------------------------


def instanced(kind="ellipsoids", **settings) -> mi.Scene:
    """A scene whose Gaussians are in a group, beside a ball that stands alone."""
    scene = EllipsoidsCase(kind=kind)
    integrator = {**tensors(Scene(count=8).gaussians), **settings}
    objects = {
        "ball": {"type": "sphere", "radius": 0.1},
        "herd": {"type": "shapegroup", "id": "herd", "cow": scene.shape},
        "one": {"type": "instance", "herd": {"type": "ref", "id": "herd"}},
    }
    return scene_with(integrator, scene.view, **objects)


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("ellipsoids", {}),
        ("ellipsoidsmesh", {}),
        ("ellipsoids", {"light": "rays"}),
        ("ellipsoids", {"shadows": "ball"}),
        ("ellipsoids", {"aovs": "d:depth"}),
    ],
    ids=str,
)
def test_instances_of_gaussians_are_refused_in_every_route(kind, settings):
    loaded = instanced(kind, **settings)
    integrator, grad = loaded.integrator(), mi.TensorXf(np.zeros((23, 37, 4), np.float32))
    message = "^splats: shape group 'herd' holds Gaussians .shape 'cow'., whose instances are not"
    routes = [
        lambda: integrator.render(loaded),
        lambda: integrator.render_backward(loaded, None, grad),
        lambda: integrator.render_forward(loaded, None),
        lambda: integrator.summary(loaded),
        lambda: integrator.render(loaded),  # the refusal is no result that is kept
    ]
    for route in routes:
        with pytest.raises(UnsupportedError, match=message):
            route()


def test_instances_of_surfaces_are_rendered():
    objects = {
        "herd": {"type": "shapegroup", "id": "herd", "cow": {"type": "sphere", "radius": 0.3}},
        "one": {"type": "instance", "herd": {"type": "ref", "id": "herd"}},
        "sky": {"type": "constant"},
    }
    scene = Scene(count=8)
    loaded = scene_with(tensors(scene.gaussians), scene.view, **objects)
    mi.render(loaded, spp=1)
    with pytest.raises(UnsupportedError, match="shape group 'herd' holds Gaussians"):
        loaded.integrator().render(instanced())
