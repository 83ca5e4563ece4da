"""Refusals of ``python -m drgs.render``: one line, nothing is written, and no file replaced."""

import json
import os

import pytest
from conftest import REPOSITORY
from PIL import Image
from support.commands import assert_ends_well, assert_refused
from support.folders import visible
from support.render_command import sensor, write_scene
from support.small_capture import HEIGHT, WIDTH, make_dataset, pose_around, write_fit

from drgs.core import memory
from drgs.core.folders import sole_writer
from drgs.render import __main__ as render


@pytest.fixture(autouse=True)
def eight_gigabytes(monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 8 * 10**9)


def refused(tmp_path, *words, message):
    words = (*words, "--out", tmp_path / "out")
    return assert_refused(render.main, *words, folder=tmp_path, message=message)


PLY = "point_cloud.ply"
CAMERA = ("--origin", 3, 0, 0)
MOST_PIXELS = 8 * 10**9 // memory.IMAGE_BYTES

SKY = REPOSITORY / "scenes" / "images" / "tiles.png"

WRONG_WORDS = [
    (("nowhere.ply",), "there is no such file or folder"),
    (("../data",), "there is no config.yml in it"),
    (("config.yml",), "must be a file of Gaussians (.compressed.ply, .glb, .ksplat,"),
    ((PLY,), "choose the cameras: --orbit N"),
    ((PLY, "--split", "test"), "needs photographs"),
    ((PLY, "--orbit", 2, "--data", "x"), "--orbit but without --scene"),
    ((PLY, "--orbit", 0), "--orbit: must be a whole number >= 1"),
    ((PLY, "--orbit", 10_000, "--size", 3000, 2000), "at most 2.1 GB, got 10,000 of 3000 x"),
    ((PLY, "--orbit", 2, "--size", 16384, 1), "must be at most 16,383 px wide and high, got 16384"),
    ((PLY, "--orbit", 2, "--up", 0, 0, 0), "up must not be zero"),
    ((PLY, "--orbit", 2, "--variant", "scalar_rgb"), "--variant: must be"),
    ((PLY, *CAMERA, "--size", 400), "argument --size: expected 2 arguments: --size W H"),
    (
        (PLY, *CAMERA, "--size", 20000, 20000),
        f"view camera: 20000 x 20000 px need about {4e8 * memory.IMAGE_BYTES / 1e9:.3g} GB of "
        f"memory, of which 8 GB are available; at most {MOST_PIXELS:,} pixels fit; give a smaller",
    ),
    ((PLY, *CAMERA, "--size", 70000, 70000), "are too many for Dr.Jit, whose arrays end at 2^32"),
    ((PLY, "--camera", "x" * 300), "cannot read the file: File name too long"),
    (("", "--orbit", 2, "--split", "test"), "--split: not allowed with argument --orbit"),
    (("", "--orbit", 2, "--up", 0, 0, 1), "--orbit, where it follows"),
    (("", "--size", 8, 8), "--size: is not used with Gaussians and --split"),
    (("", "--origin", 0, 0, 0), "must not be zero or parallel"),
    (("", "--origin", 0, 0, "nan"), "--origin: must be a finite number, got nan"),
    (("", *CAMERA, "--fov", 180), "--fov: must be between 0 and 180"),
    (("", "--panorama"), "--panorama: is not used with Gaussians and --split"),
    ((PLY, "--panorama"), "choose the cameras: --orbit N, --camera FILE.json, --origin X Y Z"),
    (("", "--orbit", 2, "--panorama", "--fov", 40), "--fov: a panorama shows all directions, got"),
    (("", *CAMERA, "--panorama", "--set", "model.projection=exact"), "equirectangular, got exact"),
    (("", "--background", "pink"), "or an image's file, got pink"),
    (("", "--background", 0, 0, 1.5), "got 0 0 1.5"),
    (("", "--background", SKY), "an image is not what the photographs were composited over"),
    (("", "--camera", "nowhere.json", "--size", 8, 8), "nowhere.json: cannot read"),
    (("", "--data", "nowhere"), "data.path: there is no folder"),
    (("", "--set", "data.imagesize=3"), "did you mean data.image_size?"),
    (("", "-D", "model=x.ply"), "--define: is not used with Gaussians"),
    (("", "--threads", 2**32), "argument --threads: must be at most 4,096, got"),
]


@pytest.mark.parametrize(("words", "message"), WRONG_WORDS, ids=[m[:50] for _, m in WRONG_WORDS])
def test_wrong_words_are_refused(fit, tmp_path, words, message):
    line = refused(tmp_path, fit / words[0], *words[1:], message=message)
    assert len(line) < 600


@pytest.mark.parametrize("mode", ["--camera", "--split"])
def test_exact_projection_with_distortion_is_refused(tmp_path, mode):
    """Without the distortion it is rendered."""
    fit = write_fit(tmp_path, make_dataset(1, 1))
    path = tmp_path / "data" / "transforms_test.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"k1": 0.1}))
    words = [fit, "--set", "model.projection=exact", mode]
    words += ["test"] if mode == "--split" else [path, "--size", WIDTH, HEIGHT]
    view = "r_0" if mode == "--split" else "camera_0"
    message = f"such as that of view {view}, opencv (k1), got exact; or give --ignore distortion"
    refused(tmp_path, *words, message=message)
    assert_ends_well(render.main, *words, "--ignore", "distortion", "--out", tmp_path / "out")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"w": 1e9, "h": 1e9}, ".json: w must be <= 16777216, got "),
        ({"w": 800, "h": 800}, "800 x 800 px with 1,000 samples each need about "),
    ],
)
def test_camera_file_beyond_limits_is_refused(fit, tmp_path, values, message):
    """The last: an image that would fit once does not a thousand times."""
    pose, close = ((pose_around(x, 0.3) * [1, -1, -1, 1]).tolist() for x in (0.8, 0.9))
    frames = [{"transform_matrix": pose, "transform_matrix_close": close}]
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"camera_angle_x": 0.7, "frames": frames, **values}))
    words = (fit, "--camera", path, "--set")
    line = refused(tmp_path, *words, "data.shutter_samples=1000", message=message)
    assert len(line) < 300
    message = "data.shutter_samples must be <= 1000, got 1001"
    refused(tmp_path, *words, "data.shutter_samples=1001", message=message)


SENSOR = sensor(pose_around(0.8, 0.3))
MODEL = '<string name="filename" value="model.ply"/>'
SAMPLES = '"sample_count" value="{}"'
NESTED_SPP = '<integer name="nested_spp" value="4294967296"/>'
SCENES = {
    "not XML": (None, "no xml", "blobs.xml: "),
    "empty": (None, '<scene version="3.0.0"/>', "must hold an integrator and at least one sensor"),
    "model missing": ("model.ply", "nowhere.ply", "nowhere.ply: cannot read the file"),
    "no Gaussians": (MODEL, "", "splats: there are no Gaussians: give the integrator 'filename'"),
    "wrong sensor": (
        SENSOR,
        '<sensor type="irradiancemeter"/>',
        "the sensor must be of type persp",
    ),
    "no samples": (SAMPLES.format(1), SAMPLES.format(0), "a sample_count of at least"),
    "many samples": (SAMPLES.format(1), SAMPLES.format(10**9), "at most 4,096 samp"),
    "wide": (f'"width" value="{WIDTH}"', '"width" value="1000000000"', "too many for Dr.Jit"),
    "nested samples": (MODEL, MODEL + NESTED_SPP, "from 0 to 2147483647, got"),
    "unknown name": (MODEL, f'{MODEL}<float name="neer" value="1"/>', "did you mean near?"),
    "not UTF-8": ("splats", "spl\udca9ts", "not a valid scene: it holds bytes that are not UTF-8"),
}


@pytest.mark.parametrize(("old", "new", "message"), SCENES.values(), ids=SCENES)
def test_errors_of_a_mitsuba_scene_are_one_line(tmp_path, old, new, message):
    path = write_scene(tmp_path, SENSOR)
    text = path.read_text().replace(old, new) if old else new
    path.write_bytes(os.fsencode(text))
    refused(tmp_path, path, message=message)


OTHER_NAME = "argument --define/-D: must be NAME=VALUE with a name other than"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--orbit", 3), "--orbit: is not used with a Mitsuba scene"),
        (("-D", "model"), "taken by Mitsuba's loader, got model; see"),
        (("-D", "colour=1"), "colour"),
        *((("-D", f"{name}=model.ply"), OTHER_NAME) for name in ("path", "parallel", "optimize")),
    ],
)
def test_wrong_options_with_a_scene_are_refused(tmp_path, words, message):
    """Names of parameters of Mitsuba's loader, also where the file has one."""
    path = write_scene(tmp_path, SENSOR)
    if message == OTHER_NAME:
        path.write_text(path.read_text().replace("model.ply", f"${words[1].partition('=')[0]}"))
    refused(tmp_path, path, *words, message=message)


@pytest.mark.parametrize("suffix", ["webp", "gif", "ico", "tif"])
def test_a_background_that_mitsuba_cannot_read_is_refused(fit, tmp_path, suffix):
    mode = "CMYK" if suffix == "tif" else "RGB"
    path = tmp_path / f"a.{suffix}"
    Image.new(mode, (16, 16)).save(path)
    message = "mode CMYK" if mode == "CMYK" else "must be a PNG, JPEG, BMP, PPM or TGA image, got "
    refused(tmp_path, fit, *CAMERA, "--background", path, message=message)


def test_names_in_capital_letters_and_long_ones_are_read(fit, tmp_path):
    """Windows programs write suffixes in capital letters."""
    (tmp_path / "MODEL.PLY").write_bytes((fit / PLY).read_bytes())
    words = (tmp_path / "MODEL.PLY", *CAMERA, "--size", 8, 6)
    assert_ends_well(render.main, *words, "--out", tmp_path / "a")
    scene = write_scene(tmp_path, SENSOR)
    scene = scene.rename(scene.with_name("x" * 251 + ".xml"))
    assert_ends_well(render.main, scene, "--out", tmp_path / "b")
    assert visible(tmp_path / "b") == {"x" * 200 + ".exr", "x" * 200 + ".png"}


@pytest.fixture
def fitted(tmp_path):
    return write_fit(tmp_path, make_dataset(2, 2))


def assert_kept(fitted, *words, message):
    assert_refused(render.main, fitted, *words, folder=fitted.parent, message=message)


VIEWS = {
    "split": [],
    "orbit": ["--orbit", 2, "--size", 8, 6],
    "origin": ["--origin", 3, 0, 1, "--size", 8, 6],
}


@pytest.mark.parametrize(
    ("way", "name", "content"),
    [
        ("split", "r_1.png", ""),
        *(("split", "metrics.json", text) for text in ("[", "[]", '{"split": "test"}', "7")),
        ("orbit", "orbit_001.png", ""),
        ("orbit", "orbit.webp", ""),
        ("origin", "camera.png", ""),
    ],
)
def test_files_that_are_not_the_commands_are_kept(fitted, tmp_path, way, name, content):
    out, test = tmp_path / "out", tmp_path / "data" / "test"
    out.mkdir()
    (out / name).write_text(content)
    message = f"{out}: holds {name}, which this command would replace and has not written"
    assert_kept(fitted, *VIEWS[way], "--out", out, message=message)
    message = f"--out {test}: holds images of the dataset (r_0.png, r_1.png); choose"
    assert_kept(fitted, *VIEWS[way], "--out", test, message=message)
    assert_kept(fitted, *VIEWS[way], "--out", fitted, message="holds a fit")
    assert_kept(fitted, *VIEWS[way], "--out", out / name, message="cannot write")


def test_a_reference_beside_a_scene_is_not_replaced(tmp_path):
    """Mitsuba's own command writes it there."""
    words = (write_scene(tmp_path, SENSOR), "--out", tmp_path)
    (tmp_path / "blobs.exr").write_text("reference")
    message = "holds blobs.exr, which this command would replace"
    assert_refused(render.main, *words, folder=tmp_path, message=message)
    (tmp_path / "blobs.exr").unlink()
    for _ in range(2):
        assert_ends_well(render.main, *words)


@pytest.mark.slow
def test_own_images_are_replaced_unless_modified(fitted, tmp_path):
    out = tmp_path / "out"
    for options in ((), ("--background", "black")):
        for words in VIEWS.values():
            assert_ends_well(render.main, fitted, *words, *options, "--out", out)
    (out / "r_0.png").write_bytes((fitted.parent / "data" / "test" / "r_0.png").read_bytes())
    message = "holds r_0.png, which this command would replace and has not written, or which chang"
    assert_kept(fitted, "--out", out, message=message)
    with sole_writer(out):
        message = "out: another command is writing to this folder; wait"
        assert_kept(fitted, "--out", out, message=message)
