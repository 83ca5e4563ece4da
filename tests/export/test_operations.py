"""The operations of ``drgs export``, in the order of the command line."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.commands import assert_ends_well
from support.formats import gaussians_within_ranges
from support.small_capture import blobs, make_dataset

import drgs
from drgs.export import __main__ as export
from drgs.export.operations import PROPERTIES, properties_of
from drgs.export.source import ExportSource, merge_sources
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians

ANGLES, FACTOR, VECTOR = (20.0, -130.0, 75.0), 2.5, (0.5, -3.0, 4.0)


@pytest.fixture
def model(tmp_path):
    gaussians_within_ranges(80, degree=2).save(tmp_path / "model.ply")
    return tmp_path / "model.ply"


def exported(model, *options):
    out = model.with_name("out.ply")
    assert_ends_well(export.main, model, *options, "--out", out)
    return Gaussians.load(out)


def test_moved_gaussians_look_alike_from_a_moved_camera(tmp_path):
    """x' = s R x + t for both; the harmonics turn with them."""
    g, view = blobs(40), make_dataset(1, 1).train[0]
    shN = np.random.default_rng(0).normal(0, 0.3, (40, 15, 3)).astype(np.float32)
    g = replace(g, shN=shN)
    g.save(tmp_path / "model.ply")
    moves = ["--rotate", *ANGLES, "--scale", FACTOR, "--translate", *VECTOR]
    moved = exported(tmp_path / "model.ply", *moves)
    x, y, z = (Rotation.from_rotvec(a * np.eye(3)[i], degrees=True) for i, a in enumerate(ANGLES))
    pose = np.eye(4)
    pose[:3, :3] = (z * y * x).as_matrix() @ view.camera_to_world[:3, :3]
    pose[:3, 3] = FACTOR * (z * y * x).apply(view.center) + VECTOR

    def render(gaussians, camera):
        given = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities)
        size, K = (camera.width, camera.height), camera.K[None]
        image = drgs.rasterization(
            *given, gaussians.sh, camera.viewmat[None], K, *size, sh_degree=3
        )[0]
        return np.array(image)

    expected = render(g, view)
    assert expected.std() > 0.05
    found = render(moved, replace(view, camera_to_world=pose, motion=None))
    np.testing.assert_allclose(found, expected, atol=1e-3)  # positions of 10 units, in float32
    back = [
        "--translate",
        *(-np.array(VECTOR)),
        "--scale",
        1 / FACTOR,
        "--rotate",
        0,
        0,
        -ANGLES[2],
    ]
    back += ["--rotate", 0, -ANGLES[1], 0, "--rotate", -ANGLES[0], 0, 0]
    (tmp_path / "out.ply").rename(tmp_path / "moved.ply")
    again = exported(tmp_path / "moved.ply", *back)
    for name in ("means", "log_scales", "shN"):
        np.testing.assert_allclose(getattr(again, name), getattr(g, name), atol=1e-5)


def test_operations_have_the_order_of_the_command_line(model):
    g = Gaussians.load(model)
    box = ["--crop", 0, -9, -9, 9, 9, 9]
    before = exported(model, *box, "--translate", 1, 0, 0)
    after = exported(model, "--translate", 1, 0, 0, *box)
    assert before.num_gaussians == np.count_nonzero(g.means[:, 0] >= 0)
    assert after.num_gaussians == np.count_nonzero(g.means[:, 0] >= -1)


def test_a_translation_to_the_end_of_the_world_keeps_the_model(model):
    moved = exported(model, "--translate", 4e6, 1e6, "-1e3")
    expected = Gaussians.load(model).means + np.array([4e6, 1e6, -1e3])
    np.testing.assert_allclose(moved.means + np.array(moved.origin), expected, rtol=0, atol=1e-6)


def test_rotated_fits_are_not_turned_upright(model):
    out = model.with_name("a.glb")
    assert_ends_well(export.main, model, "--rotate", 90, 0, 0, "--out", out)
    g = Gaussians.load(model)
    np.testing.assert_allclose(Gaussians.load(out).means[:, 2], g.means[:, 1], atol=1e-5)


@pytest.mark.parametrize("name", PROPERTIES)
def test_a_filter_keeps_what_its_comparison_says(model, name):
    values = properties_of(Gaussians.load(model))[name]
    middle = float(f"{np.median(values):.4f}")
    found = exported(model, "--filter-value", f"{name},lt,{middle}")
    assert found.num_gaussians == np.count_nonzero(values < middle) > 0


def test_several_files_are_merged(model):
    other = gaussians_within_ranges(30, degree=3, seed=1)
    other.save(model.with_name("other.ply"))
    g, out = Gaussians.load(model), model.with_name("out.ply")
    assert_ends_well(export.main, model, model.with_name("other.ply"), "--out", out)
    found = Gaussians.load(out)
    for name in set(PARAMETER_NAMES) - {"shN"}:
        parts = [getattr(g, name), getattr(other, name)]
        np.testing.assert_array_equal(getattr(found, name), np.concatenate(parts))
    np.testing.assert_array_equal(found.shN[:80, :8], g.shN)
    assert not found.shN[:80, 8:].any()
    far = replace(other, origin=(10.0, 0.0, 0.0), rendered_with={"low_pass": 0.1})
    with pytest.warns(UserWarning, match="made to be rendered otherwise"):
        merged = merge_sources([ExportSource(g, model), ExportSource(far, out)]).gaussians
    np.testing.assert_allclose(merged.means[80:, 0], other.means[:, 0] + 10, rtol=1e-6)


def test_statistics_are_printed_at_their_place_as_text_or_json(model):
    g = Gaussians.load(model)
    outcome = assert_ends_well(export.main, model, "--info", "--sh-degree", 0, "--info", "--json")
    first, second = map(json.loads, outcome.stdout.splitlines())
    assert (first["sh_degree"], second["sh_degree"]) == (2, 0)
    assert [path.name for path in model.parent.iterdir()] == ["model.ply"]
    np.testing.assert_array_equal(exported(model, "--sh-degree", 1).shN, g.shN[:, :3])
    assert first["gaussians"] == 80 and "80 Gaussians" in outcome.stderr
    assert first["properties"]["x"]["greatest"] == pytest.approx(g.means[:, 0].max())
    text = assert_ends_well(export.main, model, "--info").stdout
    assert "gaussians: 80\n" in text and len(text.splitlines()) == 6 + len(PROPERTIES)


def test_training_cameras_see_the_moved_model_as_before():
    """Rotated, scaled and moved far away: each mean stays at its pixel."""
    g, view = blobs(20), make_dataset(train=1, test=1).train[0]
    source = ExportSource(g, Path("a.ply"), cameras=[view])
    turn = Rotation.from_euler("xyz", [20, -40, 70], degrees=True).as_matrix()
    moved = source.move(turn, 2.5).translate([1e5, -3, 7])
    pixels = []
    for camera, means in ((view, g.means), (moved.cameras[0], moved.gaussians.means)):
        x, y, z = camera.K @ (camera.viewmat[:3, :3] @ means.T + camera.viewmat[:3, 3:])
        pixels.append([x / z, y / z])
    # float32 positions, a few units before the camera: pixels to 1e-5 of some 30.
    np.testing.assert_allclose(pixels[1], pixels[0], rtol=0, atol=1e-3)
