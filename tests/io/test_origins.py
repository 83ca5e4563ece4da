"""Coordinates far from the origin, from files and to files."""

from dataclasses import replace

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from scipy.spatial.transform import Rotation
from support.formats import distance_of_ellipsoids, refusal
from support.small_capture import blobs

from drgs.core.errors import UserNote
from drgs.core.origin import MAX_SCENE_SIZES, WORLD, choose_origin
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.similarity import Similarity, shortest_rotation
from drgs.io.ply import read_points

EARTH = (4200000.0, 170000.5, -4780000.25)


def world(gaussians: Gaussians) -> np.ndarray:
    return gaussians.means.astype(np.float64) + gaussians.origin


@pytest.mark.parametrize(
    ("center", "size", "origin"),
    [
        ((0.9 * MAX_SCENE_SIZES * 4.8, 0, 0), 4.8, WORLD),
        ((1.1 * MAX_SCENE_SIZES * 4.8, 0, 0), 4.8, (1.1 * MAX_SCENE_SIZES * 4.8, 0, 0)),
        ((4200003.21, 170000.6, 1e-9), 4.8, (4200003.0, 170001.0, 0.0)),
        ((4.2e6, 17, 0), 480.0, (4200000.0, 0.0, 0.0)),
        ((-5.4321e-3, 0, 0), 1.3e-7, (-5.4321e-3, 0.0, 0.0)),
    ],
)
def test_only_far_scenes_get_an_origin_with_few_digits(center, size, origin):
    assert choose_origin(center, size) == origin


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".glb"])
def test_origin_survives_a_round_trip(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    replace(blobs(), origin=EARTH, rendered_with={"low_pass": 0.1}).save(path)
    read = Gaussians.load(path)
    assert (read.origin, read.rendered_with) == (EARTH, {"low_pass": 0.1})
    blobs().save(path)
    near = Gaussians.load(path)
    assert near.origin == WORLD
    np.testing.assert_array_equal(read.means, near.means)


@pytest.mark.parametrize("suffix", [".spz", ".splat"])
@pytest.mark.filterwarnings("ignore:.*harmonics")
def test_a_format_without_an_origin_is_noted(tmp_path, suffix):
    with pytest.warns(UserNote, match=r"origin \(4200000, 170000.5, -4780000.25\)"):
        replace(blobs(), origin=EARTH).save(tmp_path / f"a{suffix}")


def test_a_small_translation_of_a_gltf_node_is_added_to_the_means(tmp_path):
    path = tmp_path / "a.glb"
    replace(blobs(), origin=(0.5, -1.5, 2.0)).save(path)
    assert b'"translation":[0.5,2.0,1.5]' in path.read_bytes()  # its y axis is our z axis
    read = Gaussians.load(path)
    assert read.origin == WORLD
    np.testing.assert_allclose(read.means, blobs().means + np.array([0.5, -1.5, 2.0]), atol=1e-6)


def test_usd_has_the_origin_as_the_translation_of_its_prim(tmp_path):
    pxr = pytest.importorskip("pxr.UsdGeom")
    usd = pytest.importorskip("drgs.io.usd")
    replace(blobs(), origin=EARTH).save(tmp_path / "a.usdc")
    stage = pytest.importorskip("pxr.Usd").Stage.Open(str(tmp_path / "a.usdc"))
    to_world = pxr.Xformable(stage.GetPrimAtPath(usd.PRIM)).GetLocalTransformation()
    assert tuple(to_world.ExtractTranslation()) == EARTH


@pytest.mark.parametrize("offset", [EARTH, (0, 0, 0)])
def test_far_positions_of_float64_are_kept_to_the_last_digit(tmp_path, offset):
    path = tmp_path / "a.ply"
    blobs().save(path)
    rows = PlyData.read(str(path))["vertex"].data
    rows = rows.astype([(name, "<f8" if name in "xyz" else "<f4") for name in rows.dtype.names])
    for axis, distance in zip("xyz", offset, strict=True):
        rows[axis] += distance
    PlyData([PlyElement.describe(rows, "vertex")]).write(str(path))
    read = Gaussians.load(path)
    np.testing.assert_allclose(world(read), blobs().means + np.array(offset), rtol=0, atol=1e-6)
    assert np.abs(read.means).max() < 10
    assert (read.origin == WORLD) == (offset != EARTH)


def test_points_of_a_file_with_an_origin_are_in_world_coordinates(tmp_path):
    replace(blobs(), origin=EARTH).save(tmp_path / "a.ply")
    positions, _ = read_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(positions, blobs().means.astype(np.float64) + EARTH)


@pytest.mark.parametrize("x", [None, "a", 1e13, True])
def test_origin_must_be_three_numbers(tmp_path, x):
    values = {"origin_y": 170000.5, "origin_z": 0.0} | ({} if x is None else {"origin_x": x})
    replace(blobs(), rendered_with=values).save(tmp_path / "a.ply")
    message = "origin_x, origin_y, origin_z must be three numbers of at most 1e+12 in size, got "
    assert refusal(tmp_path / "a.ply").startswith(message)


def test_rotation_applies_to_origin_means_and_quats():
    far = replace(blobs(), origin=EARTH)
    turn = shortest_rotation(np.array([0.0, -1, 0]), np.array([0.0, 0, 1]))
    turned = Similarity(1.0, turn, np.zeros(3)).of_gaussians(far)
    rotation = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # -y becomes z
    np.testing.assert_allclose(world(turned), world(far) @ rotation.T, atol=1e-5)
    before = Rotation.from_quat(far.quats, scalar_first=True)
    expected = (Rotation.from_matrix(rotation) * before).as_quat(scalar_first=True)
    assert distance_of_ellipsoids(expected, turned.quats).max() < 1e-6
