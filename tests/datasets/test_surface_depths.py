"""Positions of points in images, and depths of views from meshes and point clouds, in numpy."""

from dataclasses import replace

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from support.datasets import dataset_of, view_at, write_points
from support.lens_scenes import LENSES, PINHOLE, kernel_lens, points_at
from support.small_capture import make_dataset, reference_camera, write_dataset

from drgs.cameras.viewpoints import CameraMotion
from drgs.config.load import config_from
from drgs.config.schema import DataConfig
from drgs.core.errors import UserError
from drgs.core.registry import temporary_registrations
from drgs.datasets import load_dataset
from drgs.datasets.film import to_camera, to_film
from drgs.datasets.reader import READERS
from drgs.datasets.types import all_views

with temporary_registrations():
    from examples.surface_depths import SurfaceDepths, SurfaceDepthsSection, with_depths_from

LENSES = {"pinhole": PINHOLE, **LENSES}


def write_mesh(path, vertices, faces, corners=3):
    vertex = np.array([tuple(v) for v in vertices], [(axis, "f4") for axis in "xyz"])
    face = np.empty(len(faces), [("vertex_indices", "i4", (corners,))])
    face["vertex_indices"] = faces
    PlyData([PlyElement.describe(vertex, "vertex"), PlyElement.describe(face, "face")]).write(path)
    return path


def soup(count=60, seed=0):
    """Random triangles (N, 3, 3) around the origin, in single precision."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform(-1.2, 1.2, (count, 1, 3)) + rng.normal(0, 0.5, (count, 3, 3))
    return corners.astype(np.float32).astype(np.float64)


def first_hits(origin, directions, triangles):
    """(R, T) distances along rays, in lengths of ``directions``, and the least barycentric.

    By Cramer's rule: o + t d = a + u (b - a) + v (c - a). Missed triangles are at infinity.
    """
    a, edges = triangles[:, 0], triangles[:, 1:] - triangles[:, :1]
    matrices = np.stack(
        np.broadcast_arrays(-directions[:, None], edges[None, :, 0], edges[None, :, 1]), axis=-1
    )
    t, u, v = np.moveaxis(np.linalg.solve(matrices, (origin - a)[None, :, :, None])[..., 0], -1, 0)
    least = np.minimum(np.minimum(u, v), 1 - u - v)
    return np.where((least >= 0) & (t > 0), t, np.inf), least


def lens_view(name):
    lens = LENSES[name]
    host = None if lens is PINHOLE else kernel_lens(lens)
    return lens, replace(view_at((3, -2, 1), (0.25, 0, 0)), lens=host, fy=35.0, cx=17.0)


@pytest.mark.parametrize("name", ["pinhole", "rational", "fisheye", "thin prism"])
def test_projected_points_match_the_reference(name):
    lens, view = lens_view(name)
    camera = reference_camera(view, near=1e-9)
    points = np.random.default_rng(0).uniform(-6, 6, (500, 3))
    points[0] = view.center + 2 * view.camera_to_world[:3, 2]  # on the optical axis
    position = (points - view.center) @ view.camera_to_world[:3, :3]
    actual = to_camera(view, points.T)
    np.testing.assert_allclose(np.stack(actual, axis=1), position, atol=1e-12)
    u, v, depth = to_film(view, actual)
    assert (u[0], v[0], depth[0]) == pytest.approx((17, 15, 2))
    seen = lens.is_seen(camera, position)
    np.testing.assert_array_equal(depth > 0, seen)
    assert 100 < seen.sum() < 500 and np.isfinite([u, v]).all()
    np.testing.assert_allclose(depth[seen], lens.depths(camera, position)[seen], rtol=1e-12)
    expected = lens.film_points(camera, position)[seen]
    np.testing.assert_allclose(np.stack([u, v], axis=1)[seen], expected, rtol=1e-9, atol=1e-9)


def depth_from(path, *views):
    return [view.depth for view in with_depths_from(path, dataset_of(views), all_views).train]


@pytest.mark.parametrize("name", ["pinhole", "rational", "fisheye", "thin prism"])
def test_depths_of_a_mesh_are_where_rays_meet_triangles(tmp_path, name):
    lens, view = lens_view(name)
    triangles, camera = soup(), reference_camera(view, near=1e-9)
    path = write_mesh(tmp_path / "a.ply", triangles.reshape(-1, 3), np.arange(180).reshape(-1, 3))
    (depth,) = depth_from(path, view)
    assert depth.shape == (30, 40) and depth.dtype == np.float32
    row, column = np.indices(depth.shape).reshape(2, -1)
    rays = points_at(lens, camera, np.stack([column, row], axis=1) + 0.5, np.ones(len(row)))
    is_ray = np.isfinite(rays).all(axis=1)
    rays = np.where(is_ray[:, None], rays, [0, 0, 1])
    distances, least = first_hits(view.center, rays @ view.camera_to_world[:3, :3].T, triangles)
    nearest = distances.min(axis=1)
    met = is_ray & np.isfinite(nearest)
    points = rays * np.where(met, nearest, 1)[:, None]
    expected = np.where(met, lens.depths(camera, points), 0)
    clear = np.abs(least).min(axis=1) > 1e-4  # rays that pass an edge are decided by rounding
    assert 200 < met[clear].sum() < 1000 and clear.mean() > 0.9
    np.testing.assert_allclose(depth.ravel()[clear], expected[clear], rtol=1e-5)


def test_points_give_depths_where_nothing_hides_them(tmp_path):
    """Cameras see the nearer one of two parallel walls of points, on its own pixels."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(-0.6, 0.6, 61)] * 2))
    near, far = (np.column_stack([x, y, np.full(x.size, z)]) for z in (0.5, -0.5))
    path = tmp_path / "points.ply"
    write_points(path, np.concatenate([near, far]), np.zeros((2 * x.size, 3)))
    view = replace(view_at((0.1, 0, 3), (0.1, 0.001, 0)), width=60, height=60)
    (depth,) = depth_from(path, view)
    position = (near - view.center) @ view.camera_to_world[:3, :3]
    places = np.floor(view.fx * position[:, :2] / position[:, 2:] + [view.cx, view.cy]).astype(int)
    on_film = ((places >= 0) & (places < 60)).all(axis=1)
    expected = np.zeros((60, 60))
    for (column, row), z in zip(places[on_film], position[on_film, 2], strict=True):
        expected[row, column] = min(z, expected[row, column] or np.inf)
    np.testing.assert_allclose(depth, expected, rtol=1e-6)
    assert (depth > 0).sum() > 300


def test_moving_cameras_get_none_and_the_data_its_own_origin(tmp_path):
    view = view_at((3, 0, 0), (0, 0, 0))
    moving = replace(view, motion=CameraMotion(view.camera_to_world, "global"), depth=np.ones(1))
    path = write_mesh(tmp_path / "a.ply", 4 * soup(8).reshape(-1, 3), np.arange(24).reshape(-1, 3))
    first, second = depth_from(path, view, moving)
    assert first.any() and second is None
    shifted = dataset_of([view]).relative_to((0.5, -0.25, 1.0))
    found = with_depths_from(path, shifted, all_views)
    np.testing.assert_allclose(found.train[0].depth, first, rtol=1e-4)
    assert found.description == "; depth of 1 of 1 training views from the mesh of a.ply"
    assert found.train[0].files == {"depth": path}


@pytest.fixture
def photographs(tmp_path):
    write_dataset(tmp_path / "data", make_dataset(train=3, test=1))
    return tmp_path


CORNERS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)

REFUSED = {
    "missing": "{path}: cannot read the file: No such file or directory",
    "text": "{path}: not a valid PLY file: the header must end with end_header",
    "quads": "surface_depths.surface: {path}: must be triangles, and complete: ",
    "index": "surface_depths.surface: {path}: faces must name vertices 0 to 3, got 4",
    "cut": "surface_depths.surface: {path}: must be triangles, and complete: ",
    "nan": "{path}: element vertex, row 0: x must be finite, got nan",
    "few": "surface_depths.surface: {path}: at least 4 points, got 3",
    "elsewhere": "surface_depths.surface: {path}: no training camera that stands still",
    "points elsewhere": "surface_depths.surface: {path}: no training camera",
}


@pytest.mark.parametrize("case", REFUSED)
def test_files_that_give_no_depth_are_refused(photographs, case):
    path = photographs / "a.ply"
    if case == "text":
        path.write_text("no mesh")
    elif case in ("few", "points elsewhere"):
        points = CORNERS[:3] if case == "few" else CORNERS + 1000
        write_points(path, points, np.zeros((len(points), 3)))
    elif case != "missing":
        faces = {"index": [[0, 1, 4]], "quads": [[0, 1, 2, 3]]}
        vertices = CORNERS + (1000 if case == "elsewhere" else 0)
        vertices[0] = np.nan if case == "nan" else vertices[0]
        given = faces.get(case, [[0, 1, 2]])
        write_mesh(path, vertices, given, corners=len(given[0]))
        if case == "cut":
            path.write_bytes(path.read_bytes()[:-4])
    with pytest.raises(UserError) as refusal:
        reader = SurfaceDepths(SurfaceDepthsSection(surface=str(path)))
        reader.load(DataConfig(path=photographs / "data"))
    assert str(refusal.value).startswith(REFUSED[case].format(path=path)), refusal.value


def test_a_configuration_names_the_surface(photographs):
    path = write_mesh(photographs / "a.ply", soup().reshape(-1, 3), np.arange(180).reshape(-1, 3))
    with temporary_registrations():
        READERS.register("surface_depths", section=SurfaceDepthsSection)(SurfaceDepths)
        values = {"data": {"path": str(photographs / "data"), "type": "surface_depths"}}
        config = config_from({**values, "surface_depths": {"surface": str(path)}}, "test")
        dataset = load_dataset(config.data, sections=config.sections)
    expected = depth_from(path, *load_dataset(photographs / "data").train)
    for view, depth in zip(dataset.train, expected, strict=True):
        np.testing.assert_array_equal(view.depth, depth)
    assert any(depth.any() for depth in expected)
