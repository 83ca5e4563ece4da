"""No command replaces a file that it did not write: refused in one line, with nothing changed."""

import pytest
import yaml
from support.commands import assert_ends_well, assert_refused, run_in_process
from support.folders import contents, visible
from support.render_command import sensor, write_scene
from support.small_capture import blobs, make_dataset, pose_around, write_dataset

from drgs import render


@pytest.fixture
def fitted(tmp_path):
    """A folder as a fit leaves it, with its dataset beside it."""
    write_dataset(tmp_path / "data", make_dataset(2, 2))
    blobs().save(tmp_path / "run" / "point_cloud.ply")
    config = {"data": {"path": str(tmp_path / "data")}}
    (tmp_path / "run" / "config.yml").write_text(yaml.safe_dump(config))
    return tmp_path / "run"


def refused(fitted, *words, message):
    assert_refused(render.main, fitted, *words, folder=fitted.parent, message=message)


VIEWS = {
    "split": [],
    "orbit": ["--orbit", 2, "--size", 8, 6],
    "origin": ["--origin", 3, 0, 1, "--size", 8, 6],
}


@pytest.mark.parametrize("way", VIEWS)
def test_images_are_not_written_into_a_photograph_folder(fitted, way):
    test = fitted.parent / "data" / "test"
    message = f"--out {test}: holds images of the dataset (r_0.png, r_1.png); choose"
    refused(fitted, *VIEWS[way], "--out", test, message=message)


@pytest.mark.parametrize(
    ("way", "name", "content"),
    [
        ("split", "r_1.png", ""),
        *(("split", "metrics.json", text) for text in ("[", "[]", '{"split": "test"}', "7")),
        ("orbit", "orbit_001.png", ""),
        ("orbit", "orbit.gif", ""),
        ("origin", "camera.png", ""),
    ],
)
def test_user_file_is_not_replaced(fitted, tmp_path, way, name, content):
    out = tmp_path / "out"
    out.mkdir()
    (out / name).write_text(content)
    message = f"{out}: holds {name}, which this command would replace and has not written"
    refused(fitted, *VIEWS[way], "--out", out, message=message)


def test_a_reference_beside_a_scene_is_not_replaced(tmp_path):
    """Mitsuba's own command writes it there."""
    scene = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)))
    (tmp_path / "blobs.exr").write_text("reference")
    message = "holds blobs.exr, which this command would replace"
    assert_refused(render.main, scene, "--out", tmp_path, folder=tmp_path, message=message)
    (tmp_path / "blobs.exr").unlink()
    assert_ends_well(render.main, scene, "--out", tmp_path)
    assert_ends_well(render.main, scene, "--out", tmp_path)


@pytest.mark.slow
def test_own_images_are_replaced_unless_modified(fitted, tmp_path):
    out = tmp_path / "out"
    for options in ((), ("--background", "black")):
        for words in VIEWS.values():
            assert_ends_well(render.main, fitted, *words, *options, "--out", out)
    (out / "r_0.png").write_bytes((fitted.parent / "data" / "test" / "r_0.png").read_bytes())
    message = "holds r_0.png, which this command would replace and has not written, or which chang"
    refused(fitted, "--out", out, message=message)


def test_folder_in_use_by_another_command_is_refused(fitted, tmp_path, monkeypatch):
    """The one that was refused leaves what the other notes of its images alone."""
    out, message = tmp_path / "out", "out: another command is writing to this folder; wait"
    write_png, others = render.write_png, []

    def write_while_another_begins(path, image):
        write_png(path, image)
        if not others:
            others.append(path)
            refused(fitted, "--out", out, message=message)

    monkeypatch.setattr(render, "write_png", write_while_another_begins)
    assert_ends_well(render.main, fitted, "--out", out)
    assert others and visible(out) == {"r_0.png", "r_1.png", "metrics.json"}


@pytest.mark.slow
def test_images_of_an_interrupted_command_are_replaced(fitted, tmp_path, monkeypatch):
    expected, out = tmp_path / "whole", tmp_path / "out"
    assert_ends_well(render.main, fitted, "--out", expected)
    write_png, written = render.write_png, []

    def write_one(path, image):
        if written:
            raise KeyboardInterrupt
        written.append(path)
        write_png(path, image)

    with monkeypatch.context() as patched:
        patched.setattr(render, "write_png", write_one)
        assert run_in_process(render.main, fitted, "--out", out).returncode == 130
    assert visible(out) == {"r_0.png"}
    rendered = (out / "r_0.png").read_bytes()
    (out / "r_0.png").write_text("mine")
    message = "holds r_0.png, which this command would replace"
    refused(fitted, "--out", out, message=message)
    (out / "r_0.png").write_bytes(rendered)
    assert_ends_well(render.main, fitted, "--out", out)
    assert contents(out) == contents(expected)
