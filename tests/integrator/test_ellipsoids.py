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
    IMAGE,
    ROTATION,
    SCALE,
    TRANSLATION,
    EllipsoidsCase,
    assert_images_agree,
    joined,
    scene_with,
    transform,
    write_model,
)
from support.helpers import clear, single
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
    loaded = EllipsoidsCase().load_with(objects={"shape": {"type": kind, "filename": path}})
    assert_images_agree(image_of(loaded), image_of(scene.load()))


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
