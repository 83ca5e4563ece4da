"""Fusing depths into a surface: against numpy, and against spheres."""

import json
import sys
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.commands import assert_refused
from support.small_capture import blobs

from drgs.cameras.orbits import rings_around
from drgs.cameras.viewpoints import Viewpoint, look_at, pinhole
from drgs.core import memory
from drgs.core.errors import UserError
from drgs.export import __main__ as export
from drgs.export.mesh import (
    TRUNCATION,
    DepthImage,
    encode_glb,
    encode_ply,
    fuse,
    mesh_of,
    volume_of,
)
from drgs.io.ply import read_points

BALLS = np.array([[0.0, 0, 0, 1.0], [1.6, 0.2, 0.1, 0.03]])  # centre and radius: one is small


def depth_of(view: Viewpoint, balls=BALLS) -> np.ndarray:
    """Camera z of the balls at pixel centres; inf beside them."""
    row, column = np.indices((view.height, view.width))
    rays = [(column + 0.5 - view.cx) / view.fx, (row + 0.5 - view.cy) / view.fy, np.ones(row.shape)]
    rays = np.stack(rays, axis=-1) @ view.camera_to_world[:3, :3].T
    nearest = np.full(row.shape, np.inf)
    for *center, radius in balls:
        offset = view.center - center
        a, b = (rays**2).sum(axis=-1), rays @ offset
        discriminant = b**2 - a * (offset @ offset - radius**2)
        z = np.where(discriminant > 0, (-b - np.sqrt(np.maximum(discriminant, 0))) / a, np.inf)
        nearest = np.minimum(nearest, z)
    return nearest.astype(np.float32)


def views_of_balls(count=14, size=96):
    """Views from all sides (a Fibonacci sphere)."""
    k = np.arange(count) + 0.5
    height, turn = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    ring = np.sqrt(1 - height**2)
    centers = 5 * np.stack([ring * np.cos(turn), ring * np.sin(turn), height], axis=1)
    return [
        pinhole(f"{i}", look_at(c, 0 * c, (0, 0, 1)), size, size, 40.0)
        for i, c in enumerate(centers)
    ]


def images_of_balls(views):
    images = []
    for view in views:
        depth = depth_of(view)
        color = np.broadcast_to(np.float32([0.8, 0.4, 0.2]), (*depth.shape, 3))
        images.append(DepthImage(view, color * np.isfinite(depth)[..., None], depth))
    return images


def test_fused_distances_match_numpy():
    rng = np.random.default_rng(0)
    images = images_of_balls(views_of_balls(5, 24))
    images = [
        replace(i, colors=rng.uniform(size=i.colors.shape).astype(np.float32)) for i in images
    ]
    corner, voxel, shape = volume_of(images, 24)
    distance, colors, seen = (
        v.reshape(np.prod(shape), -1) for v in fuse(images, corner, voxel, shape)
    )
    distance, seen = distance[:, 0], seen[:, 0]
    index = np.indices(shape).reshape(3, -1).T
    centers = corner + (index + 0.5) * voxel
    total, weight = np.zeros(len(index)), np.zeros(len(index))
    color, colored = np.zeros((len(index), 3)), np.zeros(len(index))
    unclear = np.zeros(len(index), bool)
    for image in images:
        view = image.view
        p = (centers - view.center) @ view.camera_to_world[:3, :3]
        place = view.fx * p[:, :2] / p[:, 2:] + [view.cx, view.cy]
        unclear |= (np.abs(place - np.rint(place)) < 1e-3).any(axis=1)
        column, row = np.clip(np.floor(place).astype(int), 0, 23).T
        d = (image.depth[row, column] - p[:, 2]) / (TRUNCATION * voxel)
        is_seen = (place >= 0).all(axis=1) & (place < 24).all(axis=1) & (d > -1) & np.isfinite(d)
        unclear |= (np.abs(d + 1) < 1e-3) | (np.abs(d - 1) < 1e-3)
        total += np.where(is_seen, np.minimum(d, 1), 0)
        weight += is_seen
        color += np.where((is_seen & (d < 1))[:, None], image.colors[row, column], 0)
        colored += is_seen & (d < 1)
    clear = ~unclear
    assert clear.mean() > 0.9 and 0.1 < (weight == 0).mean() < 0.9
    np.testing.assert_array_equal(seen[clear], weight[clear] > 0)
    np.testing.assert_allclose(distance[clear], (total / np.maximum(weight, 1))[clear], atol=2e-4)
    expected = 255 * color / np.maximum(colored, 1)[:, None]
    np.testing.assert_allclose(colors[clear], expected[clear], atol=0.501)  # rounded


def test_mesh_of_a_ball_is_closed_coloured_and_has_no_small_parts():
    pytest.importorskip("skimage", reason="the extra mesh is not installed")
    pytest.importorskip("trimesh", reason="the extra mesh is not installed")
    images = images_of_balls(views_of_balls())
    mesh, voxel = mesh_of(images, 64), volume_of(images, 64)[1]
    radii = np.linalg.norm(mesh.vertices, axis=1)
    # Rays that graze the ball are longer than the distances to it.
    assert np.abs(radii - 1).max() < 1.5 * voxel and np.abs(radii - 1).mean() < 0.25 * voxel
    edges = np.sort(np.concatenate([mesh.faces[:, k] for k in ([0, 1], [1, 2], [2, 0])]), axis=1)
    assert (np.unique(edges, axis=0, return_counts=True)[1] == 2).all()
    volume = np.linalg.det(mesh.vertices[mesh.faces]).sum() / 6  # positive: seen from outside
    assert volume == pytest.approx(4 / 3 * np.pi, rel=0.03)
    colors = mesh.visual.vertex_colors[:, :3] / 255
    np.testing.assert_allclose(colors, np.broadcast_to([0.8, 0.4, 0.2], colors.shape), atol=0.01)


def tetrahedron():
    trimesh = pytest.importorskip("trimesh", reason="the extra mesh is not installed")
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], float)
    colors = np.array([[0, 0, 0], [255, 128, 64], [5, 10, 15], [255, 255, 255]], np.uint8)
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    return trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)


ORIGIN = (500_000.0, -20.0, 4_000_000.25)


def test_ply_is_read_by_mitsuba_and_by_point_clouds(tmp_path):
    path, mesh = tmp_path / "a.ply", tetrahedron()
    path.write_bytes(encode_ply(mesh, ORIGIN))
    parameters = mi.traverse(mi.load_dict({"type": "ply", "filename": str(path)}))
    np.testing.assert_array_equal(parameters["faces"], mesh.faces.ravel())
    np.testing.assert_array_equal(parameters["vertex_positions"], mesh.vertices.ravel())
    points, colors = read_points(path)
    np.testing.assert_array_equal(points, mesh.vertices + ORIGIN)
    np.testing.assert_allclose(255 * colors, mesh.visual.vertex_colors[:, :3], atol=1e-4)


def test_glb_has_y_up_and_linear_unlit_colours():
    """Read by the specification: a part in JSON with its length at byte 12, then the numbers."""
    mesh = tetrahedron()
    content = encode_glb(mesh, ORIGIN)
    length = int.from_bytes(content[12:16], "little")
    document, binary = json.loads(content[20 : 20 + length]), content[28 + length :]
    (primitive,) = document["meshes"][0]["primitives"]
    (material,) = document["materials"]
    assert primitive["material"] == 0 and "KHR_materials_unlit" in material["extensions"]
    assert document["extensionsUsed"] == ["KHR_materials_unlit"]

    def values(index, kind, width):
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        count = accessor["count"] * {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        return np.frombuffer(binary, kind, count, start).reshape(-1, width)

    (matrix,) = [np.reshape(n["matrix"], (4, 4)).T for n in document["nodes"] if "matrix" in n]
    points = values(primitive["attributes"]["POSITION"], "<f4", 3) @ matrix[:3, :3].T
    x, y, z = (mesh.vertices + ORIGIN).T
    np.testing.assert_allclose(points + matrix[:3, 3], np.stack([x, z, -y], axis=1), rtol=1e-12)
    np.testing.assert_array_equal(values(primitive["indices"], "<u4", 3), mesh.faces)
    c = mesh.visual.vertex_colors[:, :3] / 255
    linear = np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)
    found = values(primitive["attributes"]["COLOR_0"], "u1", 4)
    np.testing.assert_allclose(found[:, :3], 255 * linear, atol=0.5001)


def test_rings_of_cameras_show_the_whole_model():
    gaussians = blobs(30)
    views = rings_around(gaussians, np.array([0.0, 0.0, 1.0]), 24, 500)
    middle = np.median(gaussians.means, axis=0)
    directions = np.stack([view.center - middle for view in views])
    assert len(views) == 96 and directions[:, 2].min() < 0 < directions[:, 2].max()
    for view in views:
        p = (gaussians.means - view.center) @ view.camera_to_world[:3, :3]
        place = view.fx * p[:, :2] / p[:, 2:] + [view.cx, view.cy]
        assert ((place > 0) & (place < view.width)).mean() > 0.9


REFUSED = [
    (("--mesh-size", 8), "argument --mesh-size: must be a whole number >= 16, got 8"),
    (("--mesh-size", 4096), "argument --mesh-size: must be at most 2,048, got 4096"),
    (("--out", "a.spz"), "--out a.spz: the name of a mesh file must end in .ply or .glb, got that"),
    (("--out", "a.obj"), "--out a.obj: the name of a mesh file must end in .ply or .glb, got that"),
    (("--out", "a.compressed.ply"), "the name of a mesh file must end in .ply or .glb, got that "),
    (("--format", "spz", "--mesh-size", 64), "--mesh-size: needs --format mesh; add that, or"),
    (("--min-opacity", 1), "nothing is left of 20 Gaussians"),
    ((), "--format mesh: needs skimage, which is not installed; pip install 'drgs[mesh]'"),
]


@pytest.mark.parametrize(("options", "message"), REFUSED)
def test_unusable_options_are_refused(tmp_path, monkeypatch, options, message):
    blobs(20).save(tmp_path / "model.ply")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, "skimage.measure", None)
    given = [tmp_path / "model.ply", "--format", "mesh", *options]
    if "--out" not in options:
        given += ["--out", tmp_path / ("a.spz" if "spz" in options else "a.ply")]
    assert_refused(export.main, *given, folder=tmp_path, message=message)


def test_images_without_a_surface_are_refused():
    images = [
        replace(image, depth=image.depth + np.inf) for image in images_of_balls(views_of_balls(3))
    ]
    with pytest.raises(
        UserError, match="there is no surface: none of 3 views shows anything of an"
    ):
        volume_of(images, 32)


def test_a_volume_that_memory_cannot_hold_is_refused(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 10**9)
    with pytest.raises(UserError, match=r"--mesh-size 600: a volume of [\d,]+ voxels takes about"):
        volume_of(images_of_balls(views_of_balls(3)), 600)
