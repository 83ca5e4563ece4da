"""Cameras of other programs: points land where the program's own equations put them."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from support.datasets import load, load_noting, refusal, views_by_name

from drgs.config.load import config_from
from drgs.core.errors import UserError
from drgs.effects.cameras import REFINED_CAMERAS
from drgs.initialization.defaults import resolve_defaults
from drgs.initialization.start import start_of
from drgs.results.folder import CAMERAS
from drgs.results.refined_cameras import write_pinholes, write_views

WIDTH, HEIGHT, NAMES = 64, 48, ("a.png", "b.png", "c.png", "d.png")
POINTS = np.random.default_rng(5).uniform(-0.5, 0.5, (20, 3))


def poses():
    """(3, 3) world to camera in OpenCV's axes, and centres, that look at the origin."""
    for rotation in Rotation.random(len(NAMES), rng=np.random.default_rng(3)).as_matrix():
        yield rotation, -4 * rotation[2]


def photographs(folder, names=NAMES, below="images"):
    (folder / below).mkdir()
    for name in names:
        Image.new("RGB", (WIDTH, HEIGHT), (90, 30, 10)).save(folder / below / name)
    return folder


def brown(x, y, k1=0.0, k2=0.0, k3=0.0, p1=0.0, p2=0.0):
    """OpenCV's distortion of slopes."""
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    tangential = 2 * p1 * x * y + p2 * (r2 + 2 * x * x), p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return x * radial + tangential[0], y * radial + tangential[1]


def fisheye(x, y, k1=0.0, k2=0.0, k3=0.0, k4=0.0):
    """OpenCV's fisheye, of slopes."""
    r = np.hypot(x, y)
    angle = np.arctan(r)
    powers = sum(k * angle ** (2 * i + 2) for i, k in enumerate((k1, k2, k3, k4)))
    return x / r * angle * (1 + powers), y / r * angle * (1 + powers)


def pixels_of(view):
    """POINTS in a view that was read, px."""
    x, y, z = view.camera_to_world[:3, :3].T @ (POINTS - view.center).T
    x, y = x / z, y / z
    if view.lens is not None:
        kind = {"opencv": brown, "fisheye": fisheye}[view.lens.kind]
        x, y = kind(x, y, **view.lens.coefficients())
    return np.column_stack([view.fx * x + view.cx, view.fy * y + view.cy])


def write_llff(folder):
    rows, pixels = [], []
    for rotation, center in poses():
        right, down, forward = rotation
        block = np.column_stack([down, right, -forward, center, [HEIGHT, WIDTH, 70.0]])
        rows.append([*block.ravel(), 0.5, 9.0])
        x, y, z = rotation @ (POINTS - center).T
        pixels.append(np.column_stack([70 * x / z + WIDTH / 2, 70 * y / z + HEIGHT / 2]))
    np.save(folder / "poses_bounds.npy", rows)
    return "LLFF", pixels


def write_3dgs(folder):
    cameras, pixels = [], []
    for name, (rotation, center) in zip(NAMES, poses(), strict=True):
        numbers = {"id": len(cameras), "img_name": name[:-4], "width": WIDTH, "height": HEIGHT}
        numbers |= {"position": center.tolist(), "rotation": rotation.T.tolist()}
        cameras.append({**numbers, "fx": 70.0, "fy": 75.0})
        x, y, z = rotation @ (POINTS - center).T
        pixels.append(np.column_stack([70 * x / z + WIDTH / 2, 75 * y / z + HEIGHT / 2]))
    (folder / "cameras.json").write_text(json.dumps(cameras))
    return "3DGS", pixels


BROWN = {"focal_x": 1.1, "focal_y": 1.2, "c_x": 0.02, "c_y": -0.03, "k1": -0.1, "k2": 0.02}
BROWN |= {"projection_type": "brown", "p1": 0.003, "p2": -0.002, "k3": 0.01}
OPENSFM = {
    "brown": BROWN,
    "perspective": {"projection_type": "perspective", "focal": 1.1, "k1": -0.1, "k2": 0.02},
    "fisheye": {"projection_type": "fisheye", "focal": 0.9, "k1": -0.1, "k2": 0.02},
}


def write_opensfm(folder, kind="brown"):
    camera = {"width": WIDTH, "height": HEIGHT, **OPENSFM[kind]}
    shots, pixels = {}, []
    for name, (rotation, center) in zip(NAMES, poses(), strict=True):
        translation = -rotation @ center
        axis = Rotation.from_matrix(rotation).as_rotvec()
        shots[name] = {"rotation": axis.tolist(), "translation": translation.tolist()}
        shots[name]["camera"] = "v2 a camera"
        x, y, z = rotation @ POINTS.T + translation[:, None]
        k = {key: v for key, v in camera.items() if key[0] in "kp" and key != "projection_type"}
        u, v = (fisheye if kind == "fisheye" else brown)(x / z, y / z, **k)
        focal = camera.get("focal", camera.get("focal_x")), camera.get("focal", 1.2)
        u = WIDTH * (focal[0] * u + camera.get("c_x", 0)) + WIDTH / 2
        pixels.append(
            np.column_stack([u, WIDTH * (focal[1] * v + camera.get("c_y", 0)) + HEIGHT / 2])
        )
    points = {
        str(i): {"coordinates": p.tolist(), "color": [9, 99, 199]} for i, p in enumerate(POINTS)
    }
    scene = {"cameras": {"v2 a camera": camera}, "shots": shots, "points": points}
    small = {"cameras": scene["cameras"], "shots": {"e.png": shots["a.png"]}, "points": {}}
    (folder / "reconstruction.json").write_text(json.dumps([small, scene]))
    return "OpenSfM", pixels


SENSOR = (
    '<resolution width="64" height="48"/><calibration class="{0}"><f>{f}</f>{more}</calibration>'
)
MORE = "<cx>1.5</cx><cy>-2</cy><b1>3</b1><k1>-.1</k1><k2>.02</k2><p1>.004</p1><p2>-.003</p2>"


def write_metashape(folder, sensor_type="frame"):
    """K1, K2 and P1, P2 by the equations of Metashape's manual, of frame cameras."""
    cameras, pixels = "", []
    more = MORE if sensor_type == "frame" else "<k1>-.1</k1><k2>.02</k2>"
    for name, (rotation, center) in zip(NAMES, poses(), strict=True):
        pose = np.eye(4)
        pose[:3] = np.column_stack([rotation.T, center])
        text = " ".join(map(repr, pose.ravel().tolist()))
        cameras += f'<camera label="{name[:-4]}" sensor_id="0" component_id="1">'
        cameras += f"<transform>{text}</transform></camera>"
        x, y, z = rotation @ (POINTS - center).T
        x, y = x / z, y / z
        if sensor_type == "frame":
            r2, p1, p2 = x * x + y * y, 0.004, -0.003
            radial = 1 - 0.1 * r2 + 0.02 * r2**2
            u = x * radial + p1 * (r2 + 2 * x * x) + 2 * p2 * x * y
            v = y * radial + p2 * (r2 + 2 * y * y) + 2 * p1 * x * y
            pixels.append(np.column_stack([32 + 1.5 + (70 + 3) * u, 24 - 2 + 70 * v]))
        else:
            u, v = fisheye(x, y, -0.1, 0.02)
            pixels.append(np.column_stack([32 + 70 * u, 24 + 70 * v]))
    sensor = SENSOR.format("initial", f=1, more="") + SENSOR.format("adjusted", f=70, more=more)
    (folder / "cameras.xml").write_text(
        f'<document><chunk><sensors><sensor id="0" type="{sensor_type}">{sensor}</sensor></sensors>'
        f'<cameras>{cameras}<camera label="e" sensor_id="0"/></cameras></chunk></document>'
    )
    return "Metashape", pixels


WRITERS = {
    "llff": write_llff,
    "3dgs": write_3dgs,
    **{f"opensfm {k}": lambda folder, k=k: write_opensfm(folder, k) for k in OPENSFM},
    **{f"metashape {k}": lambda f, k=k: write_metashape(f, k) for k in ("frame", "fisheye")},
}


@pytest.mark.parametrize("write", WRITERS.values(), ids=WRITERS)
def test_points_land_where_the_program_puts_them(tmp_path, write):
    program, pixels = write(photographs(tmp_path))
    dataset, notes = load_noting(tmp_path, test_every=4)
    assert f"({program} layout): 3 train views" in dataset.description
    views = views_by_name(dataset)
    for name, expected in zip(NAMES, pixels, strict=True):
        np.testing.assert_allclose(pixels_of(views[name[:-4]]), expected, atol=1e-9)
    rest = "left out, in other reconstructions than most: 1 photographs"
    assert any(rest in note for note in notes) == (program == "OpenSfM")


def test_a_fit_starts_from_the_points_of_opensfm(tmp_path):
    write_opensfm(photographs(tmp_path))
    values = {"data": {"path": str(tmp_path), "test_every": 4}, "init": {"num_points": 20}}
    config = config_from(values, "x.yml")
    dataset = load(tmp_path, test_every=4)
    start = start_of(resolve_defaults(config, dataset), dataset)
    np.testing.assert_allclose(start.means + np.array(dataset.origin), POINTS, atol=1e-6)
    np.testing.assert_allclose(start.colors[0], np.array([9, 99, 199]) / 255, atol=1e-6)
    assert load(tmp_path, test_every=4, ignore_points=True).point_cloud is None


def test_photographs_of_a_half_of_the_size_are_used(tmp_path):
    write_3dgs(photographs(tmp_path))
    (tmp_path / "images").rename(tmp_path / "images_2")
    for name in NAMES:
        Image.new("RGB", (32, 24)).save(tmp_path / "images_2" / name)
    (tmp_path / "images").mkdir()  # empty, as an archive may have it
    view = load(tmp_path, test_every=4).train[0]
    assert (view.width, view.fx, view.fy, view.cx) == (32, 35, 37.5, 16)


def camera_to_json(index, name, view):
    """Numbers of ``camera_to_JSON`` of the 3DGS reference, with its R and T of a camera."""
    world_to_camera = np.linalg.inv(view.camera_to_world)
    R, T = world_to_camera[:3, :3].T, world_to_camera[:3, 3]
    Rt = np.eye(4)
    Rt[:3, :3], Rt[:3, 3] = R.T, T
    pose, size = np.linalg.inv(Rt), (view.width, view.height)
    angles = [2 * np.arctan(n / (2 * f)) for n, f in zip(size, (view.fx, view.fy), strict=True)]
    fx, fy = (n / (2 * np.tan(angle / 2)) for n, angle in zip(size, angles, strict=True))
    text = {"id": index, "img_name": name, "width": size[0], "height": size[1]}
    return text, [*pose[:3, 3], *pose[:3, :3].ravel(), fx, fy]


@pytest.mark.parametrize("is_refined", [False, True])
def test_cameras_that_a_fit_writes_are_those_of_the_reference(tmp_path, is_refined):
    """Equations of the reference and the reader agree; the folder itself is no dataset."""
    write_3dgs(photographs(tmp_path))
    dataset, out = load(tmp_path, test_every=4, ignore_points=True), tmp_path / "out"
    out.mkdir()
    (out / "config.yml").write_text(f"data: {{path: a}}\ncameras: {{optimise: {is_refined}}}\n")
    moved = [v.with_offset(np.array([0.1, 0.2, 0.3])) for v in dataset.train]
    moved = [replace(v, fx=1.1 * v.fx, fy=1.2 * v.fy) for v in moved]
    write_views(out / REFINED_CAMERAS, replace(dataset, train=tuple(moved)))
    write_pinholes(out, dataset)
    expected = moved if is_refined else dataset.train
    cameras = json.loads((out / CAMERAS).read_text())
    for index, (camera, view) in enumerate(zip(cameras, expected, strict=True)):
        text, numbers = camera_to_json(index, dataset.train[index].name, view)
        position, *rows = camera.pop("position"), *camera.pop("rotation")
        found = [*position, *np.ravel(rows), camera.pop("fx"), camera.pop("fy")]
        np.testing.assert_allclose(found, numbers, atol=1e-12)
        assert camera == text
    assert refusal(out).startswith(f"{out}: ")
    photographs(out, [f"{view.name}.png" for view in dataset.train])
    views = views_by_name(load(out))
    for given, view in zip(dataset.train, expected, strict=True):
        read = views[given.name]
        np.testing.assert_allclose(read.camera_to_world, view.camera_to_world, atol=1e-12)
        assert (read.fx, read.fy) == pytest.approx((view.fx, view.fy))


REFUSED = {
    "photographs that are not those of LLFF": (write_llff, "poses_bounds.npy", None, "(5, 17)"),
    "another lens": (write_opensfm, "reconstruction.json", ('"brown"', '"dual"'), "got dual"),
    "no focal length": (write_opensfm, "reconstruction.json", ('"focal_y"', '"f"'), "'focal_y'"),
    "a radial term too many": (
        *(write_metashape, "cameras.xml", ("<b1>3</b1>", "<k4>.01</k4>")),
        "sensor 0 has k4 = 0.01, which no lens here has; optimize the cameras in Metashape",
    ),
    "no camera": (write_metashape, "cameras.xml", ("transform>", "place>"), "not cameras as"),
    "a pose that is not rigid": (
        *(
            write_3dgs,
            "cameras.json",
            ('"rotation"', '"rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 2]], "was"'),
        ),
        "frames[0].transform_matrix must be rigid",
    ),
}


@pytest.mark.parametrize(("write", "file", "change", "message"), REFUSED.values(), ids=REFUSED)
def test_what_is_not_of_the_program_is_refused(tmp_path, write, file, change, message):
    write(photographs(tmp_path))
    if change is None:
        Image.new("RGB", (WIDTH, HEIGHT)).save(tmp_path / "images/e.png")
    else:
        text = (tmp_path / file).read_text()
        assert change[0] in text
        (tmp_path / file).write_text(text.replace(*change))
    refused = refusal(tmp_path)
    assert refused.startswith(f"{tmp_path / file}: ") and message in refused


@pytest.mark.parametrize("write", [write_llff, write_3dgs, write_opensfm, write_metashape])
def test_damaged_files_are_refused_by_a_sentence_or_read(tmp_path, write):
    write(photographs(tmp_path))
    (file,) = (path for path in tmp_path.iterdir() if path.is_file())
    content, rng = file.read_bytes(), np.random.default_rng(0)
    for _ in range(60):
        start = int(rng.integers(len(content)))
        new = rng.bytes(int(rng.integers(1, 4)))
        file.write_bytes(content[:start] + new + content[start + int(rng.integers(0, 40)) :])
        try:
            load(tmp_path, test_every=4)
        except UserError as error:
            assert str(file) in str(error)
