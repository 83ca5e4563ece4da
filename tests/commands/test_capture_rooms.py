"""``python -m drgs.capture`` of rooms, of scenes with sensors and of scenes with splats."""

import json
import shlex

import imageio.v3 as iio
import mitsuba as mi
import pytest
from conftest import REPOSITORY
from support.commands import assert_ends_well, assert_refused
from support.render_command import write_scene

from drgs.capture import __main__ as capture
from drgs.capture import dataset
from drgs.capture.path_tracing import lit_part
from drgs.config.load import load_config
from drgs.datasets import load_dataset
from drgs.initialization.start import initial_gaussians
from drgs.io.ply import read_points

CORNELL = "import mitsuba as mi\n\ndef scene():\n    return mi.cornell_box()\n"

TINY = ["--views", 10, "--test-views", 2, "--size", 12, 12, "--spp", 4, "--points", 200]


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture(scope="module")
def cornell(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "cornell.py"
    path.write_text(CORNELL)
    return path


def run(scene, out, *options):
    return assert_ends_well(capture.main, scene, "--out", out, *TINY, *options)


def lit_parts(out):
    return [lit_part(iio.imread(path)) for path in out.glob("t*/r_*.png")]


@pytest.fixture(scope="module")
def inside(cornell, tmp_path_factory):
    """The outcome of the command, and its folder; its name has a space."""
    out = tmp_path_factory.mktemp("captured") / "a room"
    return run(cornell, out), out


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
    (line,) = run(cornell, tmp_path / "out", *options).stderr.splitlines()
    assert line.startswith("warning: ") and message in line


def test_first_images_are_spread_over_all_views():
    """Else those near the horizon would decide whether a warning is due."""
    assert dataset.spread_first(list(range(125)))[:10] == list(range(0, 120, 12))
    for count in (0, 1, 9, 10, 11, 19, 125):
        assert sorted(dataset.spread_first(list(range(count)))) == list(range(count))


def test_azimuth_and_elevation_keep_cameras_at_the_open_side(cornell, tmp_path):
    out, elevation = tmp_path / "out", ["--elevation", -15, 20]
    assert run(cornell, out, "--azimuth", -25, 25, *elevation).stderr == ""
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
