"""A lens that another package registers is as good as a shipped one, wherever lenses are named."""

import json
from dataclasses import replace

import drjit as dr
import drjit.llvm.ad as llvm
import mitsuba as mi
import numpy as np
import pytest
from support.datasets import view_at

from drgs.cameras.camera import Camera
from drgs.cameras.lens import LENSES, Lens, Pinhole
from drgs.core.errors import UserError
from drgs.core.registry import ExtensionError, reporting_extensions, temporary_registrations
from drgs.datasets.camera_file import cameras_json, read_viewpoints
from drgs.datasets.film import to_film
from drgs.testing import Case, laws_of

with temporary_registrations():
    from examples.unified_camera import UnifiedCamera

XI = 0.75
K = np.array([[30.0, 0, 17], [0, 32, 13], [0, 0, 1]])


@pytest.fixture(autouse=True)
def registered():
    with temporary_registrations():
        LENSES.register("unified")(UnifiedCamera)
        yield


def camera_with(lens, Float=llvm.Float64):
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(3, 3)))[0]
    return Camera.create(Float, turn, np.ones(3), K, 40, 30, near=0.1, lens=lens)


def points(number=64):
    """In front of, beside and behind the camera, camera axes."""
    return np.random.default_rng(1).normal(size=(3, number)) + np.array([[0], [0], [0.5]])


def test_ray_through_a_projected_point_meets_the_point():
    camera = camera_with(UnifiedCamera(XI))
    seen, position, _ = camera.lens.visibility(camera, llvm.Array3f64(points()))
    film = camera.lens.project_point(camera, position)
    for ray in (UnifiedCamera.ray, Lens.ray):  # its own, and by Newton's method
        direction = dr.normalize(ray(camera.lens, camera, film.x, film.y))
        missed = dr.norm(direction - dr.normalize(position))
        assert dr.all(~seen | (missed < 1e-12))
    assert 32 < dr.count(seen)[0] < 64


CASE = Case("unified", lens=UnifiedCamera(XI), count=10, width=13, height=9, focal=10.0)


@pytest.mark.slow
@pytest.mark.parametrize("law", laws_of(CASE))
def test_laws_hold(law):
    law(CASE)


def test_newton_ray_has_the_derivatives_of_the_closed_form():
    """In the place, and in the coefficient."""
    found = []
    for ray in (UnifiedCamera.ray, Lens.ray):
        camera = camera_with(UnifiedCamera(XI))
        x = llvm.Float64([10.0, 17.0, 33.0])
        dr.enable_grad(x, camera.lens.xi)
        direction = dr.normalize(ray(camera.lens, camera, x, llvm.Float64([5.0, 13.0, 21.0])))
        dr.backward(dr.dot(direction, llvm.Array3f64(0.5, -0.25, 0.125)))
        found.append([*dr.grad(x), *dr.grad(camera.lens.xi)])
    np.testing.assert_allclose(*found, rtol=1e-10)


def scene_with(lens, **coefficients):
    """Twenty splats in front of a calibrated sensor, whose order does not depend on the lens."""
    rng = np.random.default_rng(2)
    means = np.column_stack([rng.uniform(-0.5, 0.5, (20, 2)), 3 + np.arange(20) / 4])
    splats = {
        "type": "splats", "means": means,
        "quats": rng.normal(size=(20, 4)), "log_scales": rng.normal(size=(20, 3)) - 2,
        "logit_opacities": rng.normal(size=20), "sh0": rng.normal(size=(20, 1, 3)),
    }  # fmt: skip
    film = {"type": "hdrfilm", "width": 40, "height": 30, "rfilter": {"type": "box"}}
    sensor = {"type": "calibrated", "fx": 30.0, "lens": lens, "film": film, **coefficients}
    splats = {k: v if k == "type" else mi.TensorXf(v) for k, v in splats.items()}
    return mi.load_dict({"type": "scene", "integrator": splats, "sensor": sensor})


def test_sensor_takes_lens_by_name_and_exposes_its_coefficients():
    mi.set_variant("llvm_ad_rgb")
    pinhole, plain = scene_with("pinhole"), scene_with("unified", xi=0.0)
    assert "sensor.xi" in mi.traverse(plain).keys()  # noqa: SIM118
    expected, image = (np.array(mi.render(scene)) for scene in (pinhole, plain))
    # xi = 0 is a pinhole: in single precision, by other formulas.
    assert expected.max() > 0.1 and np.abs(image - expected).max() < 2e-3
    params = mi.traverse(plain)
    params["sensor.xi"] = XI
    params.update()
    dr.enable_grad(params["sensor.xi"])
    assert np.abs(np.array(dr.detach(mi.render(plain, params))) - expected).max() > 0.05
    dr.backward(dr.sum(mi.render(plain, params), axis=None))
    assert np.isfinite(dr.grad(params["sensor.xi"])[0]) and dr.grad(params["sensor.xi"])[0] != 0


def test_lens_in_a_file_survives_a_round_trip(tmp_path):
    pose = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 4], [0, 0, 0, 1]]
    frames = [
        {"file_path": "a.png", "transform_matrix": pose},
        {"file_path": "b.png", "transform_matrix": pose, "xi": 0.25},
    ]
    meta = {"camera_model": "unified", "xi": XI, "fl_x": 30.0, "w": 40, "h": 30, "frames": frames}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(meta))
    first, second = read_viewpoints(path, None)
    assert first.lens == UnifiedCamera(XI) and second.lens == UnifiedCamera(0.25)
    view = view_at((0, -2, 0), (0, 0, 0))
    content = cameras_json([replace(view, lens=first.lens)], (0.0, 0.0, 0.0))
    path.write_text(json.dumps(content))
    (again,) = read_viewpoints(path, None)
    assert again.lens == first.lens


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"xi": "far"}, 'xi must be a finite number, got "far"'),
        ({"xi": 1e9}, "camera_model: xi must be a coefficient of at most 1e\\+06 in size"),
        (
            {"camera_model": "unifed"},
            'or a lens: .*unified; others come with installed packages .*"drgs"',
        ),
    ],
)
def test_invalid_file_is_refused_with_file_and_key(tmp_path, values, message):
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    meta = {"camera_model": "unified", "fl_x": 30.0, "w": 40, "h": 30, "frames": [frame]}
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps(meta | values))
    with pytest.raises(UserError, match=f"^{path}: .*{message}"):
        read_viewpoints(path, None)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_start_points_are_projected_with_the_lens(dtype):
    view = view_at((0, -2, 0), (0, 0, 0))
    view = replace(view, lens=UnifiedCamera(XI))
    x, y, z = points().astype(dtype)
    u, v, depth = to_film(view, (x, y, z))
    distance = np.sqrt(x * x + y * y + z * z)
    seen = z > -0.99 * XI * distance
    np.testing.assert_array_equal(depth > 0, seen)
    expected = view.fx * x / (z + XI * distance) + view.cx
    np.testing.assert_allclose(u[seen], expected[seen], rtol=100 * np.finfo(dtype).eps, atol=1e-4)
    assert np.isfinite([u, v]).all()


def test_errors_of_a_lens_contain_its_name():
    @LENSES.register("broken")
    class Broken(Pinhole):
        def project_point(self, camera, position):
            raise KeyError("focal")

    message = r'lens "broken" \(.*\): KeyError: .focal.'
    with pytest.raises(ExtensionError, match=message), reporting_extensions():
        Broken().project_point(None, None)
