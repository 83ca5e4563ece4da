"""``python -m drgs.capture``, on scenes whose images are known in closed form.

A convex diffuse body under a sky of constant radiance L sends albedo x L everywhere and in all
directions: nothing shades it and nothing is reflected onto it twice. Rooms, scenes with sensors and
scenes with splats follow.
"""

import json
import math
import shlex
import sys
from dataclasses import replace
from itertools import product

import imageio.v3 as iio
import numpy as np
import pytest
from conftest import REPOSITORY
from support.commands import assert_ends_well, assert_refused
from support.folders import contents, visible
from support.render_command import write_scene

from drgs.capture import __main__ as capture
from drgs.capture import camera_placement, dataset, path_tracing
from drgs.capture.path_tracing import CaptureSettings, lit_part
from drgs.config.load import load_config
from drgs.config.schema import DataConfig
from drgs.datasets import load_dataset
from drgs.initialization.start import initial_gaussians
from drgs.io.ply import read_points

CENTER = np.array([0.3, -0.2, 0.5])
RADIUS = 0.8
ALBEDO = np.array([0.05, 0.2, 0.6])

BALL = f"""
<scene version="3.0.0">
    <emitter type="constant"><rgb name="radiance" value="1"/></emitter>
    <shape type="sphere">
        <point name="center" x="{CENTER[0]}" y="{CENTER[1]}" z="{CENTER[2]}"/>
        <float name="radius" value="{RADIUS}"/>
        <bsdf type="diffuse"><rgb name="reflectance" value="{", ".join(map(str, ALBEDO))}"/></bsdf>
    </shape>
    {{extra}}
</scene>
"""

LAMP = """
<shape type="rectangle">
    <transform name="to_world"><scale value="2"/><translate z="3"/></transform>
    <emitter type="area"><rgb name="radiance" value="1"/></emitter>
</shape>
"""

CUBE = """
import mitsuba as mi

def scene():
    return {
        "type": "scene",
        "sky": {"type": "constant"},
        "cube": {"type": "cube", "to_world": mi.ScalarTransform4f().scale(0.5)},
    }
"""

SETTINGS = {"views": 6, "test_views": 3, "size": (20, 20), "spp": 16, "points": 600}

SMALL = ["--views", 6, "--test-views", 3, "--size", 20, 20, "--spp", 16, "--points", 600]

DISTANCE = RADIUS * math.sqrt(3) / math.sin(path_tracing.NERF_SYNTHETIC_FOV / 2)
"""Without --distance the bounding box's sphere touches the edges of the image."""


def write(folder, name, text):
    path = folder / name
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return write(tmp_path_factory.mktemp("scene"), "ball.xml", BALL.format(extra=""))


def run(scene, out, *options):
    """The command, in this process."""
    capture.main([str(scene), "--out", str(out), *map(str, options)])


@pytest.fixture(scope="module")
def captured(ball, tmp_path_factory):
    out = tmp_path_factory.mktemp("captured") / "ball"
    run(ball, out, *SMALL)
    return out


def encode_srgb(linear):
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def test_layout_matches_nerf_synthetic(captured):
    assert visible(captured) == {
        *("capture.json", "points3d.ply", "transforms_train.json", "transforms_test.json"),
        *(f"train/r_{i}.png" for i in range(6)),
        *(f"test/r_{i}.png" for i in range(3)),
    }
    transforms = json.loads((captured / "transforms_train.json").read_text())
    assert transforms["camera_angle_x"] == 0.6911112070083618
    names = [frame["file_path"] for frame in transforms["frames"]]
    assert names == [f"./train/r_{i}" for i in range(6)]
    image = iio.imread(captured / "train" / "r_0.png")
    assert image.shape == (20, 20, 4) and image.dtype == np.uint8


def test_dataset_loads_and_its_cameras_look_at_the_object_from_above(captured):
    dataset = load_dataset(DataConfig(path=captured))
    assert (len(dataset.train), len(dataset.test)) == (6, 3)
    for view in dataset.train + dataset.test:
        rotation = view.camera_to_world[:3, :3]
        x, y, z = view.K @ rotation.T @ (CENTER - view.center)
        # The box is stored in float32, at coordinates around 1.
        assert x / z == pytest.approx(10, abs=1e-4)
        assert y / z == pytest.approx(10, abs=1e-4)
        assert z == pytest.approx(DISTANCE, rel=1e-5)
        assert view.center[2] > CENTER[2]
        assert rotation[2, 1] < 0, "the image's downward axis points up"
        assert rotation[2, 0] == pytest.approx(0, abs=1e-12), "the horizon is not level"
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


@pytest.mark.parametrize("jitter", [0.0, 1.0])
def test_directions_are_spread_evenly_over_the_upper_hemisphere(jitter):
    count = 100
    directions = camera_placement.hemisphere(count, jitter, np.random.default_rng(3))
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-12)
    assert (directions[:, 2] > 0).all()
    # Uniform on the hemisphere: the mean is (0, 0, 1/2) and z is uniform in 0..1.
    np.testing.assert_allclose(directions.mean(axis=0), [0, 0, 0.5], atol=0.04)
    np.testing.assert_allclose(directions[:, 2], (np.arange(count) + 0.5) / count, atol=0.5 / count)
    # No gaps: a direction in the hemisphere has a camera within two mean spacings,
    # sqrt(2 pi / 100) = 14 degrees.
    probes = np.random.default_rng(0).normal(size=(500, 3))
    probes[:, 2] = abs(probes[:, 2])
    probes /= np.linalg.norm(probes, axis=1, keepdims=True)
    assert np.degrees(np.arccos((probes @ directions.T).max(axis=1))).max() < 28


def test_splits_and_seeds_have_different_cameras():
    settings = CaptureSettings(views=5, val_views=5, test_views=5)
    views = [
        *camera_placement.views_around(settings, np.zeros(3), 4.0),
        *camera_placement.views_around(replace(settings, seed=1), np.zeros(3), 4.0),
    ]
    centers = np.array([view.pose[:3, 3] for view in views])
    distances = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    assert distances[~np.eye(len(centers), dtype=bool)].min() > 0.01


@pytest.mark.parametrize("axis", ["x", "y", "z"])
def test_hemisphere_stands_on_the_chosen_axis(axis):
    settings, height = CaptureSettings(up=axis, views=9), "xyz".index(axis)
    for view in camera_placement.views_around(settings, np.array([1.0, 2.0, 3.0]), 4.0):
        assert view.pose[height, 3] > [1, 2, 3][height] and view.pose[height, 1] > 0
        assert np.linalg.det(view.pose[:3, :3]) == pytest.approx(1)


def test_alpha_is_the_coverage_of_a_disc(captured):
    size = 20
    focal = size / 2 / math.tan(path_tracing.NERF_SYNTHETIC_FOV / 2)
    radius = focal * math.tan(math.asin(RADIUS / DISTANCE))
    x, y = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    from_center = np.hypot(x - size / 2, y - size / 2)
    inside, outside = from_center < radius - 0.75, from_center > radius + 0.75
    assert inside.sum() > 40 and outside.sum() > 100
    for path in captured.glob("*/r_*.png"):
        alpha = iio.imread(path)[:, :, 3] / 255
        assert (alpha[inside] == 1).all() and (alpha[outside] == 0).all()
        assert ((alpha > 0.1) & (alpha < 0.9)).sum() > 10
        # About 2 pi r edge pixels, each with an error of at most 1/4 (16 samples in 4x4 strata).
        assert alpha.sum() == pytest.approx(math.pi * radius**2, rel=0.02)


def test_color_of_covered_pixels_is_encoded_unpremultiplied_radiance(captured):
    expected = 255 * encode_srgb(ALBEDO)
    for path in captured.glob("*/r_*.png"):
        rgba = iio.imread(path).astype(float)
        covered = rgba[:, :, 3] > 250
        assert rgba[covered, :3].mean(axis=0) == pytest.approx(expected, abs=1.5)
        # Edge pixels hold the same colour: 4 covered samples or more have little noise here.
        edge = (rgba[:, :, 3] > 60) & ~covered
        assert rgba[edge, :3].mean(axis=0) == pytest.approx(expected, abs=3)
        assert (rgba[rgba[:, :, 3] == 0] == 0).all()


def test_lamps_are_invisible_and_outside_the_bounding_box(tmp_path, ball, captured):
    lit = write(tmp_path, "lit.xml", BALL.format(extra=LAMP))
    run(lit, tmp_path / "out", *SMALL)
    for name in (f"test/r_{i}.png" for i in range(3)):
        alpha, expected = (iio.imread(f / name)[:, :, 3] for f in (tmp_path / "out", captured))
        # The lamp hangs between the cameras and the ball; without it the paths are others.
        assert abs(alpha.astype(int) - expected).max() <= 64
        assert alpha.sum() == pytest.approx(expected.sum(), rel=0.02)
    positions, _ = read_points(tmp_path / "out" / "points3d.ply")
    assert np.linalg.norm(positions - CENTER, axis=1).max() == pytest.approx(RADIUS, rel=1e-4)


def test_known_pixels_are_encoded():
    half = 0.2145  # linear value of display 0.5005
    pixels = [[0, 0, 0, 0], [half, 0, 2, 1], [half / 2, 0, 0.5, 0.5], [1e-4, 0, 0, 1e-3]]
    encoded = path_tracing.encode(np.array([pixels]))
    expected = [[0, 0, 0, 0], [128, 0, 255, 255], [128, 0, 255, 128], [0, 0, 0, 0]]
    assert encoded[0].tolist() == expected


def test_points_lie_on_the_sphere_with_its_color(captured):
    positions, colors = read_points(captured / "points3d.ply")
    assert positions.shape == (600, 3)
    # float32 hits, from about 5 away.
    np.testing.assert_allclose(np.linalg.norm(positions - CENTER, axis=1), RADIUS, atol=1e-5)
    assert colors.mean(axis=0) == pytest.approx(encode_srgb(ALBEDO), abs=0.01)
    assert positions.std(axis=0).min() > 0.2, "all points are on one side"


def test_points_of_a_python_scene_lie_on_the_cube(tmp_path):
    out = tmp_path / "out"
    run(write(tmp_path, "cube.py", CUBE), out, *SMALL, "--points", 100)
    positions, _ = read_points(out / "points3d.ply")
    assert len(positions) == 100
    np.testing.assert_allclose(abs(positions).max(axis=1), 0.5, atol=1e-5)
    # Its images are not cut by their edges.
    corners = np.array(list(product((-0.5, 0.5), repeat=3)))
    for view in load_dataset(DataConfig(path=out)).train:
        projected = (corners - view.center) @ view.camera_to_world[:3, :3] @ view.K.T
        pixels = projected[:, :2] / projected[:, 2:]
        assert pixels.min() > -1e-4 and pixels.max() < 20 + 1e-4


def test_points_are_optional_and_images_need_not_be_square(ball, tmp_path, capfd):
    out = tmp_path / "out"
    # No two whole numbers of similar size make 7: Mitsuba's sampler takes one path more.
    run(ball, out, *SMALL, "--test-views", 0, "--size", 24, 12, "--fov", 60, "--spp", 7)
    printed, errors = capfd.readouterr()
    assert "image 6/6" in printed and "600 points" in printed and "24x12" in printed
    assert "\r" not in printed and "WARN" not in printed + errors
    alpha = iio.imread(out / "train" / "r_0.png")[:, :, 3]
    assert alpha.shape == (12, 24) and alpha[6, 12] == 255
    assert not alpha[[0, -1]].any()  # the ball is within the image's smaller side as well
    transforms = json.loads((out / "transforms_train.json").read_text())
    assert transforms["camera_angle_x"] == math.radians(60)
    run(ball, tmp_path / "b", *SMALL, "--views", 1, "--test-views", 0, "--points", 0)
    assert visible(tmp_path / "b") == {"capture.json", "transforms_train.json", "train/r_0.png"}


def test_the_same_command_gives_the_same_bytes(ball, captured, tmp_path):
    run(ball, tmp_path / "again", *SMALL)
    assert contents(tmp_path / "again") == contents(captured)


def test_folder_in_use_by_another_capture_is_refused(ball, captured, tmp_path, monkeypatch):
    out, message = tmp_path / "out", "out: another command is writing to this folder; wait"
    write_png, refused = dataset.write_png, []

    def write_while_another_begins(path, rendered):
        if not refused:
            refused.append(path)
            assert_refused(capture.main, ball, "--out", out, *SMALL, folder=out, message=message)
        write_png(path, rendered)

    monkeypatch.setattr(dataset, "write_png", write_while_another_begins)
    run(ball, out, *SMALL)
    assert refused and contents(out) == contents(captured)


def test_interrupted_capture_continues_to_the_same_bytes(
    ball, captured, tmp_path, monkeypatch, capsys
):
    image, calls = path_tracing.CaptureCamera.image, []

    def interrupted(self, view):
        calls.append(view)
        if len(calls) == 4:
            raise KeyboardInterrupt
        return image(self, view)

    monkeypatch.setattr(path_tracing.CaptureCamera, "image", interrupted)
    with pytest.raises(SystemExit) as stop:
        run(ball, tmp_path / "out", *SMALL)
    assert stop.value.code == 130
    assert "the same command continues" in capsys.readouterr().err
    assert visible(tmp_path / "out") == {"capture.json", *(f"train/r_{i}.png" for i in range(3))}
    run(ball, tmp_path / "out", *SMALL)
    assert len(calls) == 4 + 6, "images that were there were taken again"
    assert contents(tmp_path / "out") == contents(captured)


def test_changed_import_of_a_python_scene_changes_its_fingerprint(tmp_path):
    helper = write(tmp_path, "capture_test_neighbour.py", "SIZE = 1")
    path = write(tmp_path, "s.py", "import capture_test_neighbour\n" + CUBE)
    path_tracing.load_scene(path)
    before = dataset.fingerprint(path)
    assert dataset.fingerprint(path) == before
    helper.write_text("SIZE = 2")
    assert dataset.fingerprint(path) != before


@pytest.mark.slow
def test_shipped_scene_fits_the_image_and_has_hundreds_of_parts():
    path = REPOSITORY / "scenes" / "brick_crane.py"
    scene = path_tracing.load_scene(path)
    low, high = path_tracing.bounding_box(scene)
    assert np.abs([low, high]).max() < 1.2
    assert sys.modules["drgs_capture_scene_brick_crane"].build().num_parts > 250
    settings = CaptureSettings(size=(48, 48), spp=4, views=8, distance=4.0311, target=(0, 0, 0))
    camera = path_tracing.CaptureCamera(scene, settings)
    placement = camera_placement.target_and_distance(scene, settings)
    for view in camera_placement.views_around(settings, *placement)[:8]:
        alpha = camera.image(view)[:, :, 3]
        assert not alpha[[0, -1]].any() and not alpha[:, [0, -1]].any()
        assert (alpha == 255).mean() > 0.1


CORNELL = "import mitsuba as mi\n\ndef scene():\n    return mi.cornell_box()\n"

TINY = ["--views", 10, "--test-views", 2, "--size", 12, 12, "--spp", 4, "--points", 200]


@pytest.fixture(scope="module")
def cornell(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "cornell.py"
    path.write_text(CORNELL)
    return path


def capture_room(scene, out, *options):
    return assert_ends_well(capture.main, scene, "--out", out, *TINY, *options)


def lit_parts(out):
    return [lit_part(iio.imread(path)) for path in out.glob("t*/r_*.png")]


@pytest.fixture(scope="module")
def inside(cornell, tmp_path_factory):
    """The outcome of the command, and its folder; its name has a space."""
    out = tmp_path_factory.mktemp("captured") / "a room"
    return capture_room(cornell, out), out


def test_room_is_captured_from_inside_without_dark_images(inside):
    outcome, out = inside
    assert outcome.stderr == ""
    assert "cameras: 12 inside the scene, around (" in outcome.stdout
    assert "field of view 70 degrees" in outcome.stdout
    parts = lit_parts(out)
    assert len(parts) == 12 and min(parts) > 0.7
    # Including its lamp: white, as in a photograph.
    images = [iio.imread(path) for path in out.glob("*/*.png")]
    assert any((rendered[:, :, :3] == 255).all(axis=2).any() for rendered in images)


def fitting_command(outcome):
    """The configuration and the words behind it, as a shell would split what was printed last."""
    *_, last = outcome.stdout.splitlines()
    assert last.startswith("fit it with: python -m drgs.fit ")
    config, *words = shlex.split(last)[6:]
    return REPOSITORY / config, words


def test_output_ends_with_the_command_to_fit_the_result(inside):
    path, (data, folder, assign, assignment) = fitting_command(inside[0])
    assert (data, folder, assign) == ("--data", str(inside[1]), "--set")
    config = load_config(path, [f"data.path={folder}", assignment])
    dataset = load_dataset(config.data)
    assert (len(dataset.train), len(dataset.test)) == (10, 2)
    positions, _ = read_points(inside[1] / "points3d.ply")
    assert initial_gaussians(config, dataset).means.tolist() == positions.tolist()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--cameras", "around"], " of the first 10 images are empty or black: give --cameras in"),
        (["--distance", 4], " of the first 10 images are empty or black: give --cameras inside"),
        (["--target", 50, 0, 0, "--distance", 9, "--points", 0], "warning: 10 of the first 10 im"),
    ],
)
def test_mostly_black_or_empty_images_give_a_one_line_warning(cornell, tmp_path, options, message):
    (line,) = capture_room(cornell, tmp_path / "out", *options).stderr.splitlines()
    assert line.startswith("warning: ") and message in line


def test_first_images_are_spread_over_all_views():
    """Else those near the horizon would decide whether a warning is due."""
    assert dataset.spread_first(list(range(125)))[:10] == list(range(0, 120, 12))
    for count in (0, 1, 9, 10, 11, 19, 125):
        assert sorted(dataset.spread_first(list(range(count)))) == list(range(count))


def test_azimuth_and_elevation_keep_cameras_at_the_open_side(cornell, tmp_path):
    out, elevation = tmp_path / "out", ["--elevation", -15, 20]
    assert capture_room(cornell, out, "--azimuth", -25, 25, *elevation).stderr == ""
    assert min(lit_parts(out)) > 0.6
    noted = json.loads((out / "capture.json").read_text())
    assert (noted["azimuth"], noted["elevation"]) == ([-25, 25], [-15, 20])
    words = (cornell, "--out", out, *TINY, "--azimuth", -25, 30, *elevation)
    message = "azimuth is [-25.0, 25.0], requested is [-25.0, 30.0]"
    assert_refused(capture.main, *words, folder=out, message=message)


def test_sensors_of_the_scene_are_used_if_requested(cornell, tmp_path):
    words = [cornell, "--cameras", "sensors", "--size", 12, 12, "--spp", 4, "--points", 0]
    outcome = assert_ends_well(capture.main, *words, "--out", tmp_path / "out")
    assert outcome.stderr == ""
    assert "cameras: the scene's own sensors, 1\n" in outcome.stdout
    transforms = json.loads((tmp_path / "out" / "transforms_train.json").read_text())
    (frame,) = transforms["frames"]
    assert frame["camera_angle_x"] == pytest.approx(0.68605, abs=1e-5)  # 39.3077 degrees
    assert frame["transform_matrix"][2] == pytest.approx([0, 0, 1, 3.9], abs=1e-6)
    assert "--set data.test_split=train" in outcome.stdout.splitlines()[-1]


def write_nested(folder):
    path = write_scene(folder)
    text = path.read_text().replace("</integrator>", "</integrator></integrator>")
    aov = '<integrator type="aov"><string name="aovs" value="n:sh_normal"/><integrator '
    path.write_text(text.replace("<integrator ", aov, 1))
    return path


def write_without_model(folder):
    path = write_scene(folder)
    (folder / "model.ply").unlink()
    return path


def write_shapes(scene):
    """A function that writes a scene of Gaussian shapes."""

    def write(folder):
        path = folder / "s.py"
        path.write_text(
            "import mitsuba as mi\n"
            "import numpy as np\n\n"
            "def scene():\n"
            "    row = np.array([[0, 0, 0, 1, 1, 1, 0, 0, 0, 1]], np.float32)\n"
            "    values = {'opacities': np.ones((1, 1)), 'sh_coeffs': np.ones((1, 3))}\n"
            "    tensors = {k: mi.TensorXf(v.astype(np.float32)) for k, v in values.items()}\n"
            "    shape = {'type': 'ellipsoids', 'data': mi.TensorXf(row), **tensors}\n"
            f"    return {scene}\n"
        )
        return path

    return write


INSTANCED = (
    "{'type': 'scene', 'g': {'type': 'shapegroup', 'id': 'g', 'gaussians': shape}, "
    "'i': {'type': 'instance', 'r': {'type': 'ref', 'id': 'g'}}}"
)


SHAPES = "the scene holds splats (it has shapes of type ellipsoids)"
SPLATS = "blobs.xml: the scene holds splats (its integrator is splats)"


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (write_scene, SPLATS),
        (write_nested, SPLATS),
        (write_shapes("{'type': 'scene', 'gaussians': shape}"), SHAPES),
        (write_shapes(INSTANCED), SHAPES),
        (write_without_model, "model.ply: cannot read the file: No such file or directory"),
    ],
    ids=["splats", "nested", "shapes", "instanced shapes", "model missing"],
)
def test_splats_in_a_captured_scene_are_refused(tmp_path, write, message):
    words = (write(tmp_path), "--out", tmp_path / "out", *TINY)
    line = assert_refused(capture.main, *words, folder=tmp_path, message=message)
    assert ("python -m drgs.render" in line) == ("splats" in message)
