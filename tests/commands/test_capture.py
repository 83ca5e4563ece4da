"""``python -m drgs.capture``, on scenes whose images are known in closed form.

A convex diffuse body under a sky of constant radiance L sends albedo x L everywhere and in all
directions: nothing shades it and nothing is reflected onto it twice. Scenes with sensors and
scenes with splats follow.
"""

import errno
import json
import math
import shlex
import sys
from itertools import product
from unittest.mock import Mock

import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from support.commands import assert_ends_well, assert_refused, run_in_process
from support.folders import contents, visible
from support.render_command import write_scene

from drgs.capture import __main__ as capture
from drgs.capture import camera_placement, dataset, path_tracing
from drgs.capture.path_tracing import CaptureSettings, lit_part
from drgs.config.load import load_config
from drgs.config.schema import DataConfig
from drgs.core import memory
from drgs.core.folders import sole_writer
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

SMALL = ["--views", 6, "--test-views", 3, "--size", 20, 20, "--spp", 16, "--points", 600]

DISTANCE = RADIUS * math.sqrt(3) / math.sin(path_tracing.NERF_SYNTHETIC_FOV / 2)
"""Without --distance the bounding box's sphere touches the edges of the image."""


def write(folder, name, text):
    (folder / name).write_text(text)
    return folder / name


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    return write(tmp_path_factory.mktemp("scene"), "ball.xml", BALL.format(extra=""))


def run(scene, out, *options):
    """The command, in this process."""
    return assert_ends_well(capture.main, scene, "--out", out, *options)


@pytest.fixture(scope="module")
def captured(ball, tmp_path_factory):
    out = tmp_path_factory.mktemp("captured") / "ball"
    run(ball, out, *SMALL)
    return out


def encode_srgb(linear):
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def test_layout_matches_nerf_synthetic_and_cameras_look_down_at_the_object(captured):
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
    dataset = load_dataset(DataConfig(path=captured))
    assert (len(dataset.train), len(dataset.test)) == (6, 3)
    for view in dataset.train + dataset.test:
        rotation = view.camera_to_world[:3, :3]
        x, y, z = view.K @ rotation.T @ (CENTER - view.center)
        # The box is stored in float32, at coordinates around 1.
        assert (x / z, y / z) == pytest.approx((10, 10), abs=1e-4)
        assert z == pytest.approx(DISTANCE, rel=1e-5) and view.center[2] > CENTER[2]
        assert rotation[2, 1] < 0, "the image's downward axis points up"
        assert rotation[2, 0] == pytest.approx(0, abs=1e-12), "the horizon is not level"
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_images_show_a_disc_of_the_encoded_radiance(captured):
    """Alpha is the coverage; colours are not premultiplied by it."""
    size, color = 20, 255 * encode_srgb(ALBEDO)
    focal = size / 2 / math.tan(path_tracing.NERF_SYNTHETIC_FOV / 2)
    radius = focal * math.tan(math.asin(RADIUS / DISTANCE))
    x, y = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    from_center = np.hypot(x - size / 2, y - size / 2)
    inside, outside = from_center < radius - 0.75, from_center > radius + 0.75
    assert inside.sum() > 40 and outside.sum() > 100
    for path in captured.glob("*/r_*.png"):
        rgba = iio.imread(path).astype(float)
        alpha = rgba[:, :, 3] / 255
        assert (alpha[inside] == 1).all() and (rgba[alpha == 0] == 0).all()
        assert (alpha[outside] == 0).all() and ((alpha > 0.1) & (alpha < 0.9)).sum() > 10
        # About 2 pi r edge pixels, each with an error of at most 1/4 (16 samples in 4x4 strata).
        assert alpha.sum() == pytest.approx(math.pi * radius**2, rel=0.02)
        covered = rgba[:, :, 3] > 250
        assert rgba[covered, :3].mean(axis=0) == pytest.approx(color, abs=1.5)
        # Edge pixels hold the same colour: 4 covered samples or more have little noise here.
        edge = (rgba[:, :, 3] > 60) & ~covered
        assert rgba[edge, :3].mean(axis=0) == pytest.approx(color, abs=3)


def test_known_pixels_are_encoded():
    half = 0.2145  # linear value of display 0.5005
    pixels = [[0, 0, 0, 0], [half, 0, 2, 1], [half / 2, 0, 0.5, 0.5], [1e-4, 0, 0, 1e-3]]
    encoded = path_tracing.encode(np.array([pixels]))
    expected = [[0, 0, 0, 0], [128, 0, 255, 255], [128, 0, 255, 128], [0, 0, 0, 0]]
    assert encoded[0].tolist() == expected


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
    words = ("--test-views", 0, "--size", 24, 12, "--fov", 60, "--spp", 7)
    printed, errors = run(ball, out, *SMALL, *words).stdout, "".join(capfd.readouterr())
    assert "image 6/6" in printed and "600 points" in printed and "24x12" in printed
    assert "\r" not in printed and "WARN" not in printed + errors
    alpha = iio.imread(out / "train" / "r_0.png")[:, :, 3]
    assert alpha.shape == (12, 24) and alpha[6, 12] == 255
    assert not alpha[[0, -1]].any()  # the ball is within the image's smaller side as well
    transforms = json.loads((out / "transforms_train.json").read_text())
    assert transforms["camera_angle_x"] == math.radians(60)
    run(ball, tmp_path / "b", *SMALL, "--views", 1, "--test-views", 0, "--points", 0)
    assert visible(tmp_path / "b") == {"capture.json", "transforms_train.json", "train/r_0.png"}


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
    return write(tmp_path_factory.mktemp("scene"), "cornell.py", CORNELL)


@pytest.fixture(scope="module")
def boxed(cornell, tmp_path_factory):
    """The outcome of the command, and its folder; its name has a space."""
    out = tmp_path_factory.mktemp("captured") / "a room"
    return run(cornell, out, *TINY, "--azimuth", -10, 10, "--elevation", -10, 10), out


def test_cornell_box_is_captured_through_its_open_side(boxed):
    outcome, out = boxed
    assert outcome.stderr == ""
    assert "cameras: 12 around the scene, field of view 39.31 degrees" in outcome.stdout
    images = [iio.imread(path) for path in out.glob("*/*.png")]
    assert len(images) == 12 and min(map(lit_part, images)) > 0.7


def test_output_ends_with_the_command_to_fit_the_result(boxed):
    """Split as by a shell."""
    outcome, out = boxed
    *_, last = outcome.stdout.splitlines()
    assert last.startswith("fit it with: python -m drgs.fit ")
    path, *words, assignment = shlex.split(last)[6:]
    assert words == ["--data", str(out), "--set"]
    config = load_config(REPOSITORY / path, [f"data.path={out}", assignment])
    dataset = load_dataset(config.data)
    assert (len(dataset.train), len(dataset.test)) == (10, 2)
    positions, _ = read_points(out / "points3d.ply")
    assert initial_gaussians(config, dataset).means.tolist() == positions.tolist()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--cameras", "around"], " of the first 10 images are empty or black: give --azimuth"),
        (["--distance", 4], " of the first 10 images are empty or black: give --azimuth"),
        (["--target", 50, 0, 0, "--distance", 9, "--points", 0], "warning: 10 of the first 10 im"),
    ],
)
def test_mostly_black_or_empty_images_give_a_one_line_warning(cornell, tmp_path, options, message):
    (line,) = run(cornell, tmp_path / "out", *TINY, *options).stderr.splitlines()
    assert line.startswith("warning: ") and message in line


def test_first_images_are_spread_over_all_views():
    """Else those near the horizon would decide whether a warning is due."""
    assert dataset.spread_first(list(range(125)))[:10] == list(range(0, 120, 12))
    for count in (0, 1, 9, 10, 11, 19, 125):
        assert sorted(dataset.spread_first(list(range(count)))) == list(range(count))


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


def nest(folder):
    text = (folder / "blobs.xml").read_text().replace("</integrator>", "</integrator></integrator>")
    aov = '<integrator type="aov"><string name="aovs" value="n:sh_normal"/><integrator '
    (folder / "blobs.xml").write_text(text.replace("<integrator ", aov, 1))


SHAPE_SCENE = """
import mitsuba as mi
import numpy as np

def scene():
    values = {'opacities': np.ones((1, 1)), 'sh_coeffs': np.ones((1, 3))}
    values['data'] = np.array([[0, 0, 0, 1, 1, 1, 0, 0, 0, 1]])
    tensors = {k: mi.TensorXf(v.astype(np.float32)) for k, v in values.items()}
    shape = {'type': 'ellipsoids', **tensors}
    instance = {'type': 'instance', 'r': {'type': 'ref', 'id': 'g'}}
    group = {'type': 'shapegroup', 'id': 'g', 'gaussians': shape}
    return {'type': 'scene', """


def write_shapes(shapes):
    return lambda folder: (folder / "blobs.py").write_text(f"{SHAPE_SCENE}{shapes}}}")


SHAPES = "the scene holds splats (it has shapes of type ellipsoids)"
SPLATS = "blobs.xml: the scene holds splats (its integrator is splats)"


@pytest.mark.parametrize(
    ("suffix", "change", "message"),
    [
        ("xml", lambda folder: None, SPLATS),
        ("xml", nest, SPLATS),
        ("py", write_shapes("'gaussians': shape"), SHAPES),
        ("py", write_shapes("'g': group, 'i': instance"), SHAPES),
        ("xml", lambda folder: (folder / "model.ply").unlink(), "model.ply: cannot read the file"),
    ],
    ids=["splats", "nested", "shapes", "instanced shapes", "model missing"],
)
def test_splats_in_a_captured_scene_are_refused(tmp_path, suffix, change, message):
    if suffix == "xml":
        write_scene(tmp_path)
    change(tmp_path)
    words = (tmp_path / f"blobs.{suffix}", "--out", tmp_path / "out", *TINY)
    line = assert_refused(capture.main, *words, folder=tmp_path, message=message)
    assert ("python -m drgs.render" in line) == ("splats" in message)


LEAST = ["--views", 2, "--test-views", 1, "--size", 4, 4, "--spp", 1, "--points", 8]


def refused(scene, out, *options, folder, message):
    words = (scene, "--out", out, *LEAST, *options)
    return assert_refused(capture.main, *words, folder=folder, message=message)


def test_edited_files_are_kept(ball, tmp_path):
    """A mask in a frame, an image that was touched up; what is missing is made again."""
    out = tmp_path / "out"
    run(ball, out, *LEAST)
    captured = contents(out)
    edited = ("transforms_train.json", "points3d.ply", "train/r_0.png")
    for name in edited:
        (out / name).write_text("mine")
    (out / "transforms_test.json").unlink()
    run(ball, out, *LEAST)
    assert contents(out) == {**captured, **dict.fromkeys(edited, b"mine")}


OPTIONS = [
    (["--views", 0], "--views: must be a whole number >= 1, got 0"),
    (["--size", 400], "--size: expected 2 arguments: --size W H"),
    (["--size", 10**9, 10**9], "size must be at most 16,777,216 px"),
    (["--size", 4000, 4000], "4000 x 4000 px need about 4 GB of memory, of which 2 GB are avail"),
    (["--fov", 181], "--fov: must be between 0 and 180 degrees, got 181"),
    (["--distance", -1], "distance must be > 0, got -1"),
    (["--distance", 1e300], "the coordinates of origin must be at most 1e+09 in size"),
    (["--distance", 3, "--target", 900, 0, 0], "the cameras see nothing of the scene"),
    (["--target", 0, "inf", 0], "--target: must be a finite number, got inf"),
    (["--points", 10**9], "--points: must be at most 5,000,000"),
    (["--out", "/dev/null/out"], "/dev/null"),
]


@pytest.mark.parametrize(("options", "message"), OPTIONS, ids=[str(o)[:30] for o, _ in OPTIONS])
def test_wrong_options_are_refused_before_images_are_taken(
    ball, tmp_path, monkeypatch, options, message
):
    monkeypatch.setattr(memory, "available_memory", lambda: 2 * 10**9)
    refused(ball, tmp_path / "out", *options, folder=tmp_path, message=message)


XML = '<scene version="3.0.0">{}</scene>'
SCENE_THAT = "import mitsuba as mi\ndef scene():\n    {}\n    return {{'type': 'scene'}}"
OTHER_VARIANT = "mi.set_variant('scalar_rgb')"
SCENES = [
    ("missing.xml", None, "there is no such scene file"),
    ("a.xml", "no XML", "Mitsuba cannot load the scene"),
    ("a.xml", XML.format('<shape type="ball"/>'), "cannot load the scene"),
    ("a.xml", '<bsdf version="3.0.0" type="diffuse"/>', "a.xml"),
    ("a.xml", XML.format('<emitter type="constant"/>'), "no surfaces"),
    ("a.py", "x = 1", "must define a function scene()"),
    ("a.py", "def scene():\n    return []", 'must return a dictionary with "type": "scene"'),
    ("a.py", "def scene():\n\n    return 1 / 0", "a.py:3: ZeroDivisionError: division by zero"),
    ("a.py", "import nothing_of_that_name", "a.py:1: ModuleNotFoundError"),
    ("a.py", "def scene(:", "a.py:1: SyntaxError"),
    ("a.py", "def scene():\n    return {'type': 'scene', 's': {'type': 'ball'}}", "ball"),
    ("a.py", SCENE_THAT.format("pass") + f"\n{OTHER_VARIANT}", "must leave Mitsuba's variant at"),
    ("a.py", SCENE_THAT.format(OTHER_VARIANT), "must leave Mitsuba's variant at"),
    ("a.py", "raise SystemExit(0)", "SystemExit"),
]


@pytest.mark.parametrize(("name", "text", "message"), SCENES)
def test_wrong_scenes_are_refused(tmp_path, name, text, message):
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    refused(path, tmp_path / "out", folder=tmp_path, message=message)
    assert mi.variant() == "llvm_ad_rgb"


CONTENTS = {
    "nested without end": ("[" * 200_000, "not valid JSON"),
    "too long": (" " * (1 << 20) + "{}", "more than 1,048,576 bytes"),
    "no JSON": ("nonsense", "not valid JSON"),
    "long value": ('{"scene": "' + 9000 * "x" + '"}', "the folder holds another capture: scene is"),
    "a list": ("[]", "the folder holds another capture: scene is null"),
}


@pytest.mark.parametrize(("content", "message"), CONTENTS.values(), ids=CONTENTS)
def test_damaged_capture_json_is_refused_and_kept(ball, tmp_path, content, message):
    path = tmp_path / "capture.json"
    path.write_text(content)
    line = refused(ball, tmp_path, folder=tmp_path, message=message)
    assert line.startswith(f"error: {path}: ") and len(line) < 600


def test_foreign_folders_are_left_alone(ball, tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    message = "the folder is not empty and holds no capture.json"
    refused(ball, tmp_path, folder=tmp_path, message=message)
    message = "--out must be a folder"
    refused(ball, tmp_path / "notes.txt", folder=tmp_path, message=message)
    out = tmp_path / "out"
    run(ball, out, *LEAST)
    with sole_writer(out):
        message = "out: another command is writing to this folder; wait"
        refused(ball, out, folder=out, message=message)
    for options, message in (
        (["--spp", 17], "spp is 1, requested is 17"),
        (["--size", 4, 8], "size is [4, 4], requested is [4, 8]"),
        (["--fov", 50], "fov is 39.5978, requested is 50.0"),
        (["--azimuth", -25, 30], "azimuth is null, requested is [-25.0, 30.0]"),
    ):
        refused(ball, out, *options, folder=out, message=message)
    other = tmp_path / "ball.xml"
    other.write_text(f"{ball.read_text()}<!-- changed -->")
    message = "the folder holds another capture: scene_sha256"
    refused(other, out, folder=out, message=message)


def test_captured_image_of_another_size_is_refused(ball, tmp_path):
    run(ball, tmp_path / "out", *LEAST)
    captured, path = contents(tmp_path / "out"), tmp_path / "out" / "train" / "r_1.png"
    iio.imwrite(path, np.zeros((4, 5, 4), np.uint8))
    (tmp_path / "out" / "points3d.ply").unlink()  # or no image would be looked at
    message = f"{path}: must be an RGBA image of 4 x 4 px of this capture, got 5 x 4"
    refused(ball, tmp_path / "out", folder=tmp_path, message=message)
    path.unlink()
    run(ball, tmp_path / "out", *LEAST)
    assert contents(tmp_path / "out") == captured


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (OSError(errno.ENOSPC, "full", "r_0.png"), 2, "error: r_0.png: full; free some space"),
        (KeyboardInterrupt(), 130, "the same command continues"),
    ],
)
def test_stopped_capture_gives_the_reason(ball, tmp_path, monkeypatch, error, status, message):
    monkeypatch.setattr(path_tracing.CaptureCamera, "image", Mock(side_effect=error))
    outcome = run_in_process(capture.main, ball, *LEAST, "--out", tmp_path / "out")
    assert outcome.returncode == status and message in outcome.stderr


def test_transparent_images_give_no_points(ball, tmp_path, monkeypatch):
    empty = np.zeros((4, 4, 4), np.uint8)
    monkeypatch.setattr(path_tracing.CaptureCamera, "image", lambda *_: empty)
    outcome = run(ball, tmp_path / "out", *LEAST)
    assert "no points: the images to train on show no surface" in outcome.stdout
    assert not (tmp_path / "out" / dataset.POINTS).exists()
