"""Errors of ``python -m drgs.render``: one line, and nothing is written."""

import json
import subprocess
import sys

import pytest
import yaml
from conftest import REPOSITORY
from support.render_command import run, sensor, write_scene
from support.small_capture import (
    HEIGHT,
    WIDTH,
    blobs,
    make_dataset,
    pose_around,
    write_dataset,
)


def fails(capsys, *arguments):
    """The one line that the command prints, with 2."""
    with pytest.raises(SystemExit) as exit_info:
        run(*arguments)
    assert exit_info.value.code == 2
    (line,) = capsys.readouterr().err.splitlines()
    return line.partition("error: ")[2]


@pytest.mark.parametrize(
    ("what", "arguments", "message"),
    [
        ("nowhere.ply", [], "there is no such file or folder"),
        ("../data", [], "there is no config.yml in it"),
        ("config.yml", [], "must be a file of Gaussians (.ply, .compressed.ply, .spz,"),
        ("point_cloud.ply", [], "choose the cameras: --orbit N"),
        ("point_cloud.ply", ["--split", "test"], "needs photographs"),
        (
            "point_cloud.ply",
            ["--orbit", "2", "--data", "x"],
            "--orbit but without --scene",
        ),
        (
            "point_cloud.ply",
            ["--orbit", "0"],
            "--orbit: must be a whole number >= 1",
        ),
        ("point_cloud.ply", ["--orbit", "2", "--up", "0", "0", "0"], "up must not be zero"),
        ("point_cloud.ply", ["--orbit", "2", "--variant", "scalar_rgb"], "--variant: must be"),
        ("", ["--orbit", "2", "--split", "test"], "--split: not allowed with argument --orbit"),
        (
            "",
            ["--orbit", "2", "--up", "0", "0", "1"],
            "--orbit, where it follows",
        ),
        ("", ["--size", "8", "8"], "--size: is not used with Gaussians and --split"),
        ("", ["--origin", "0", "0", "0"], "must not be zero or parallel"),
        ("", ["--origin", "0", "0", "nan"], "--origin: must be a finite number, got nan"),
        ("", ["--origin", "3", "0", "0", "--fov", "180"], "--fov: must be between 0 and 180"),
        (
            "",
            ["--origin", "3", "0", "0", "--size", "0", "9"],
            "--size: must be a whole",
        ),
        ("", ["--background", "pink"], "or an image's file, got pink"),
        ("", ["--background", "0", "0", "1.5"], "got 0 0 1.5"),
        ("", ["--camera", "nowhere.json", "--size", "8", "8"], "nowhere.json: cannot read"),
        ("", ["--data", "nowhere"], "data.path: there is no folder"),
        ("", ["--set", "data.imagesize=3"], "did you mean data.image_size?"),
        ("", ["-D", "model=x.ply"], "--define: is not used with Gaussians"),
    ],
)
def test_user_errors_are_one_line_and_write_no_files(
    fit, tmp_path, capsys, what, arguments, message
):
    assert message in fails(capsys, fit / what, *arguments, "--out", tmp_path / "out")
    assert not (tmp_path / "out").exists()


EXACT = ["--set", "model.projection=exact"]


@pytest.mark.parametrize("mode", ["--camera", "--split"])
def test_exact_projection_with_distortion_is_refused(tmp_path, capsys, mode):
    """With status 2, before anything is written; without the distortion it is rendered."""
    write_dataset(tmp_path / "data", make_dataset(1, 1))
    blobs().save(tmp_path / "blobs.ply")
    (tmp_path / "a.yml").write_text(yaml.safe_dump({"data": {"path": "data"}}))
    path = tmp_path / "data" / "transforms_test.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"k1": 0.1}))
    arguments = [tmp_path / "blobs.ply", "--scene", tmp_path / "a.yml", *EXACT]
    if mode == "--split":
        arguments += ["--split", "test"]
    else:
        arguments += ["--camera", path, "--size", WIDTH, HEIGHT]
    message = fails(capsys, *arguments, "--out", tmp_path / "out")
    assert message.startswith(
        "model.projection must be ewa or unscented for lenses that are no pinholes, such as that "
        f"of view {'r_0' if mode == '--split' else 'camera_0'} (opencv: k1), got exact; or "
        "give --ignore distortion"
    )
    assert not (tmp_path / "out").exists()
    run(*arguments, "--ignore", "distortion", "--out", tmp_path / "out")
    assert list((tmp_path / "out").glob("*.png"))


def test_the_folder_of_a_fit_is_not_overwritten(fit, capsys):
    assert "holds a fit" in fails(capsys, fit, "--out", fit)


def test_an_output_folder_that_is_a_file_is_an_error(fit, tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    assert "cannot write" in fails(capsys, fit, "--out", tmp_path / "out")
    assert (tmp_path / "out").read_text() == "mine"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("no xml", "blobs.xml: "),
        ('<scene version="3.0.0"/>', "must hold an integrator and at least one sensor"),
        (
            '<scene version="3.0.0"><integrator type="splats">'
            '<string name="filename" value="nowhere.ply"/></integrator></scene>',
            "nowhere.ply: cannot read the file",
        ),
        (
            '<scene version="3.0.0"><integrator type="splats">'
            '<string name="filename" value="model.ply"/></integrator>'
            '<sensor type="irradiancemeter"/></scene>',
            "the sensor must be of type perspective, thinlens, orthographic or calibrated",
        ),
        (
            '<scene version="3.0.0"><integrator type="splats"/>'
            '<sensor type="perspective"/></scene>',
            "splats: there are no Gaussians: give the integrator 'filename' or tensors",
        ),
    ],
    ids=["not XML", "empty", "model missing", "wrong sensor", "no Gaussians"],
)
def test_errors_of_a_mitsuba_scene_are_one_line(tmp_path, capsys, content, message):
    path = write_scene(tmp_path)
    path.write_text(content)
    assert message in fails(capsys, path, "--out", tmp_path / "out")


def test_options_for_gaussians_are_refused_with_a_scene(tmp_path, capsys):
    path = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)))
    message = fails(capsys, path, "--orbit", "3", "--out", tmp_path / "out")
    assert message.startswith("--orbit: is not used with a Mitsuba scene")


@pytest.mark.parametrize("word", ["model", "=model.ply"])
def test_parameters_without_a_name_or_a_value_are_refused(tmp_path, capsys, word):
    path = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)))
    message = fails(capsys, path, "-D", word, "--out", tmp_path / "out")
    assert message.startswith("argument --define/-D: must be NAME=VALUE")
    assert f"got {word}" in message


@pytest.mark.parametrize("name", ["path", "parallel", "optimize"])
def test_reserved_parameters_of_mitsubas_loader_are_refused(tmp_path, capsys, name):
    """Also where the file has one: it cannot be given from Python."""
    path = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)))
    path.write_text(path.read_text().replace("model.ply", f"${name}"))
    message = fails(capsys, path, "-D", f"{name}=model.ply", "--out", tmp_path / "out")
    assert message.startswith("argument --define/-D: must be NAME=VALUE with a name other than")
    assert "taken by Mitsuba's loader" in message


def test_unknown_scene_parameters_are_refused(tmp_path, capsys):
    path = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)))
    message = fails(capsys, path, "-D", "colour=1", "--out", tmp_path / "out")
    assert message.startswith(f"{path}: ") and "colour" in message


@pytest.mark.slow
def test_module_runs_as_a_command(fit, tmp_path):
    result = subprocess.run(
        [sys.executable, "-m", "drgs.render", fit, "--orbit", "1", "--out", tmp_path / "out"],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert result.returncode == 0, result.stderr
    assert f"orbit_000: {WIDTH}x{HEIGHT}" in result.stdout
