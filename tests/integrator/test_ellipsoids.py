"""Gaussians of Mitsuba's ellipsoids, rendered by ``splats``, against the float64 reference.

What a shape holds is converted here by numpy, in double precision, and rendered by the reference.
"""

from __future__ import annotations

from dataclasses import replace

import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from support.ellipsoids import (
    GRADIENTS,
    IMAGE,
    ROTATION,
    SCALE,
    TRANSLATION,
    EllipsoidsCase,
    assert_images_agree,
    gradients_held,
    joined,
    scene_with,
    shape_of,
    transform,
    write_model,
)
from support.helpers import assert_arrays_agree, clear, single
from support.views import VIEWS, Scene, image_of, tensors

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians

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


@both_kinds
@pytest.mark.parametrize("degree", [1, 3])
def test_file_renders_the_same_through_a_shape(kind, degree, tmp_path):
    """To what float32 makes of exp, log and the sigmoid."""
    scene = Scene(degree=degree)
    path = write_model(tmp_path / "model.ply", scene.gaussians)
    loaded = EllipsoidsCase().load(shape={"type": kind, "filename": path})
    assert_images_agree(image_of(loaded), image_of(scene.load()))


# With these approximations what is left is that volprim_rf_basic composites in the order in which a
# ray enters the ellipsoids, passes over those entered within 1e-4 behind another, and does not draw
# those that contain the camera: test_volprim.py measures each where it is alone. Of the mean
# of this image they make 0.025. A tenth less of all opacities makes 0.07, quaternions read
# otherwise 0.2, coefficients in another order 0.5.
VOLPRIM = 0.04


VOLPRIM_APPROXIMATIONS = {
    "projection": "exact", "order": "pixel", "sh_direction": "pixel", "low_pass": 0.0,
    "extent": 3.0, "alpha_max": 0.9999, "alpha_cut": 0.0, "transmittance_stop": 0.01,
}  # fmt: skip


@both_kinds
def test_shapes_match_volprim_rf_basic(kind):
    scene = EllipsoidsCase(degree=2, count=60)
    held = scene.held
    held["data"][:, 6:] /= np.linalg.norm(held["data"][:, 6:], axis=1, keepdims=True)

    def rendered(held, integrator, **settings):
        loaded = mi.load_dict(
            {
                "type": "scene",
                "integrator": {"type": integrator, "srgb_primitives": False, **settings},
                "sensor": scene.view.sensor(pixel_format="rgb"),
                "shape": shape_of(held, kind),
            }
        )
        return image_of(loaded, spp=16)

    expected = rendered(held, "volprim_rf_basic", max_depth=256)

    def error(**changes):
        actual = rendered(held | changes, "splats", **VOLPRIM_APPROXIMATIONS)
        return np.abs(actual - expected).mean() / expected.mean()

    assert error() < VOLPRIM
    assert error(opacities=0.9 * held["opacities"]) > 1.5 * VOLPRIM
    assert error(data=held["data"] * np.repeat([1, -1, 1], [6, 3, 1])) > 4 * VOLPRIM


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
    path = write_model(tmp_path / "model.ply", Scene(degree=3).gaussians)
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
    assert_images_agree(actual, expected, 3 * IMAGE)


def test_tensors_are_moved_like_a_file(tmp_path):
    scene = Scene(degree=2)
    path = write_model(tmp_path / "model.ply", scene.gaussians)
    from_file = mi.load_dict({"type": "splats", "filename": path, "to_world": transform()})
    from_tensors = mi.load_dict(
        {"type": "splats", **tensors(scene.gaussians), "to_world": transform()}
    )
    moved, same = from_file.gaussians.numpy(), from_tensors.gaussians.numpy()
    for name in PARAMETER_NAMES:
        np.testing.assert_array_equal(getattr(moved, name), getattr(same, name))
    assert not np.array_equal(moved.shN, np.float32(scene.gaussians.shN))


def test_gradients_of_rotated_sh_match_unrotated_sh_with_a_rotated_camera(
    tmp_path,
):
    """The images are the same functions of the coefficients."""
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


@pytest.mark.slow
def test_shipped_scene_is_compared_with_volprim(monkeypatch, tmp_path, capsys):
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
