"""Requests that ``python -m drgs.render`` cannot show, hold or write are refused at the start."""

import os

import numpy as np
import pytest
from PIL import Image
from support.commands import run_in_process
from support.render_command import sensor, write_scene
from support.small_capture import blobs, pose_around

from drgs import fit, render
from drgs.capture import __main__ as capture
from drgs.core.errors import UserError
from drgs.io.images import check_animation


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "model.ply"
    blobs().save(path)
    return path


def refused(main, out, *arguments):
    """The line that the command prints; nothing is written."""
    outcome = run_in_process(main, *arguments, "--out", out)
    assert outcome.returncode == 2, outcome
    assert outcome.stderr.startswith("error: ") and outcome.stderr.count("\n") == 1
    assert len(outcome.stderr) < 600
    assert not os.path.lexists(out)
    return outcome.stderr


CAMERA = ("--origin", 0, -4, 1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--orbit", 10**9), "argument --orbit: must be at most 10,000, got 1000000000"),
        (("--orbit", 10_000, "--size", 3000, 2000), "must take at most 2.1 GB, got 10,000 of 3000"),
        (("--orbit", 2, "--size", 16384, 1), "must be at most 16,383 px wide and high, got 16384"),
        (("--orbit", 2, "--size", 1, 16384), "must be at most 16,383 px wide and high, got 1 x"),
        ((*CAMERA, "--size", 10**20, 10**20), "argument --size: must be at most 2,147,483,647"),
        ((*CAMERA, "--size", "9" * 5000, 1), "argument --size: must be a whole number"),
        (("--camera", "x" * 300), "cannot read the file: File name too long"),
        (("--camera", "x/" * 2000), "cannot read the file: "),
    ],
)
def test_sizes_and_names_beyond_limits_are_refused(model, tmp_path, arguments, message):
    assert message in refused(render.main, tmp_path / "out", model, *arguments)


def test_the_largest_animation_is_allowed():
    check_animation(60, 800, 800)
    check_animation(10_000, 1, 1)
    with pytest.raises(UserError, match="choose a smaller size"):
        check_animation(1, 16_384, 1)


def test_the_suffix_may_have_capital_letters(model, tmp_path):
    """Windows programs write such suffixes."""
    (tmp_path / "MODEL.PLY").write_bytes(model.read_bytes())
    size = ("--size", 8, 6)
    outcome = run_in_process(
        render.main, tmp_path / "MODEL.PLY", *CAMERA, *size, "--out", tmp_path / "out"
    )
    assert outcome.returncode == 0, outcome.stderr


@pytest.mark.parametrize("suffix", ["webp", "gif", "ico", "tif"])
def test_a_background_that_mitsuba_cannot_read_is_refused(model, tmp_path, suffix):
    rendered = Image.fromarray(np.zeros((16, 16, 3), np.uint8))
    rendered.save(tmp_path / f"a.{suffix}")
    background = ("--background", tmp_path / f"a.{suffix}")
    line = refused(render.main, tmp_path / "out", model, *CAMERA, *background)
    assert "must be a PNG, JPEG, BMP, PPM or TGA image, got " in line


def test_cmyk_background_is_refused(model, tmp_path):
    Image.new("CMYK", (16, 16)).save(tmp_path / "a.tif")
    background = ("--background", tmp_path / "a.tif")
    assert "mode CMYK" in refused(render.main, tmp_path / "out", model, *CAMERA, *background)


@pytest.mark.parametrize("name", ["pipe.ply", "pipe.xml", "pipe.json", "pipe.png"])
def test_pipe_is_refused_without_blocking(model, tmp_path, name):
    pipe = tmp_path / name
    os.mkfifo(pipe)
    arguments = {
        "pipe.json": (model, "--camera", pipe),
        "pipe.png": (model, *CAMERA, "--background", pipe),
    }.get(name, (pipe, *(CAMERA if name == "pipe.ply" else ())))
    line = refused(render.main, tmp_path / "out", *arguments)
    assert f"{pipe}: cannot read the " in line and "must be a regular file" in line


@pytest.mark.parametrize("main", [fit.main, render.main, capture.main])
@pytest.mark.parametrize("what", ["x" * 300, "x" * 300 + ".ply"])
def test_invalid_file_names_are_refused(tmp_path, main, what):
    line = refused(main, tmp_path / "out", what)
    assert "255 bytes" in line or "File name too long" in line


@pytest.mark.parametrize("main", [fit.main, render.main])
def test_invalid_folder_names_are_refused(tmp_path, main):
    (tmp_path / "a.yml").write_text("data: {path: .}\n")
    outcome = run_in_process(main, tmp_path / "a.yml", "--out", tmp_path / ("x" * 300))
    assert outcome.returncode == 2 and outcome.stderr.count("\n") == 1
    assert "File name too long" in outcome.stderr
    assert os.listdir(tmp_path) == ["a.yml"]


def test_long_scene_names_are_shortened_in_image_names(tmp_path):
    scene = write_scene(tmp_path, sensor(pose_around(0.3, 0.5)))
    long = scene.rename(scene.with_name("x" * 251 + ".xml"))
    outcome = run_in_process(render.main, long, "--out", tmp_path / "out")
    assert outcome.returncode == 0, outcome.stderr
    names = {name for name in os.listdir(tmp_path / "out") if not name.startswith(".")}
    assert names == {"x" * 200 + ".exr", "x" * 200 + ".png"}


def test_a_scene_whose_name_is_not_utf_8_is_refused(tmp_path):
    scene = write_scene(tmp_path, sensor(pose_around(0.3, 0.5)))
    other = scene.rename(scene.with_name(os.fsdecode(b"\xff.xml")))
    assert "Mitsuba takes names in UTF-8 only" in refused(render.main, tmp_path / "out", other)


def test_scene_with_non_utf_8_content_is_refused(tmp_path):
    scene = write_scene(tmp_path, sensor(pose_around(0.3, 0.5)))
    content = scene.read_bytes()
    assert content.count(b'type="splats"') == 1
    scene.write_bytes(content.replace(b'type="splats"', b'type="spl\xa9ts"'))
    line = refused(render.main, tmp_path / "out", scene)
    assert f"{scene}: not a valid scene: it holds bytes that are not UTF-8" in line
