"""``python -m drgs.capture``: killed anywhere, without space, asked for too much, misled."""

import errno
import os
from itertools import count
from pathlib import Path

import mitsuba as mi
import pytest
from support.commands import assert_ends_well, assert_refused, run_in_process
from support.folders import contents

from drgs.capture import __main__ as capture
from drgs.core import files, memory

BALL = '<scene version="3.0.0"><emitter type="constant"/><shape type="sphere"/></scene>'

TINY = ["--views", 2, "--test-views", 1, "--size", 4, 4, "--spp", 1, "--points", 8]
FILES = 7
"""The settings, three images, points, two transforms files."""


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "ball.xml"
    path.write_text(BALL)
    return path


def run(scene, out, *options):
    assert_ends_well(capture.main, scene, "--out", out, *TINY, *options)


def refused(scene, out, *options, folder, message):
    words = (scene, "--out", out, *TINY, *options)
    return assert_refused(capture.main, *words, folder=folder, message=message)


@pytest.fixture(scope="module")
def captured(ball, tmp_path_factory):
    out = tmp_path_factory.mktemp("captured") / "ball"
    run(ball, out)
    return contents(out)


def test_edited_files_are_kept(ball, captured, tmp_path):
    """A mask in a frame, an image that was touched up; what is missing is made again."""
    run(ball, tmp_path / "out")
    edited = ("transforms_train.json", "points3d.ply", "train/r_0.png")
    for name in edited:
        (tmp_path / "out" / name).write_text("mine")
    (tmp_path / "out" / "transforms_test.json").unlink()
    run(ball, tmp_path / "out")
    assert contents(tmp_path / "out") == {**captured, **dict.fromkeys(edited, b"mine")}


class Killed(BaseException):
    """An exception that ends the process without any cleaning up."""


@pytest.mark.slow
@pytest.mark.parametrize("place", ["before", "behind"])
@pytest.mark.parametrize("number", range(FILES))
def test_capture_killed_at_any_file_resumes_to_the_same_bytes(
    ball, captured, tmp_path, monkeypatch, number, place
):
    out, replaced, replace = tmp_path / "out", count(), os.replace

    def killed(source, target):
        if next(replaced) != number:
            return replace(source, target)
        if place == "behind":
            replace(source, target)
        raise Killed

    with monkeypatch.context() as patch:
        patch.setattr(files.os, "replace", killed)
        patch.setattr(files.os, "getpid", lambda: 4711)  # another process than the next
        patch.setattr(Path, "unlink", lambda *_, **__: None)
        with pytest.raises(Killed):
            run(ball, out)
    left = [name for name in contents(out) if name.endswith(".tmp", 0, name.rfind("."))]
    assert len(left) == (place == "before")
    run(ball, out)
    assert contents(out) == captured


@pytest.mark.slow
@pytest.mark.parametrize("number", range(FILES))
def test_full_disk_is_reported_in_one_line_and_the_capture_resumes(
    ball, captured, tmp_path, monkeypatch, number
):
    out, written = tmp_path / "out", count()

    def full(write):
        def limited(path, data, *options, **named):
            if next(written) != number:
                return write(path, data, *options, **named)
            write(path, data[: len(data) // 2], *options, **named)
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        return limited

    with monkeypatch.context() as patch:
        patch.setattr(Path, "write_bytes", full(Path.write_bytes))
        patch.setattr(Path, "write_text", lambda path, text: path.write_bytes(text.encode()))
        outcome = run_in_process(capture.main, ball, "--out", out, *TINY)
    (line,) = outcome.stderr.splitlines()
    assert outcome.returncode == 2
    assert "cannot write the file: No space left on device; free some space" in line
    assert not [name for name in contents(out) if ".tmp" in name]
    run(ball, out)
    assert contents(out) == captured


OPTIONS = [
    (["--views", 0], "--views: must be a whole number >= 1, got 0"),
    (["--test-views", -1], "--test-views: must be a whole number >= 0, got -1"),
    (["--size", 400], "--size: expected 2 arguments: --size W H"),
    (["--size", 0, 9], "--size: must be a whole number >= 1, got 0"),
    (["--size", 10**9, 10**9], "size must be at most 16,777,216 px"),
    (["--size", 10**20, 1], "--size: must be at most 2,147,483,647"),
    (["--size", 4000, 4000], "4000 x 4000 px need about 4 GB of memory, of which 2 GB are avail"),
    (["--fov", 181], "--fov: must be between 0 and 180 degrees, got 181"),
    (["--fov", 0], "--fov: must be between 0 and 180 degrees, got 0"),
    (["--fov", "nan"], "--fov: must be a finite number, got nan"),
    (["--distance", -1], "distance must be > 0, got -1"),
    (["--distance", 1e300], "no camera may be farther from the scene than 100000 of its"),
    (["--distance", 3, "--target", 900, 0, 0], "the cameras see nothing of the scene"),
    (["--target", 0, "inf", 0], "--target: must be a finite number, got inf"),
    (["--target", 1e300, 0, 0], "no camera may be farther from the scene than 100000"),
    (["--points", 10**9], "--points: must be at most 5,000,000"),
    (["--views", 10**9], "--views: must be at most 100,000"),
    (["--spp", 10**9], "--spp: must be at most 1,048,576"),
    (["--max-depth", 10**9], "--max-depth: must be at most 65,536"),
    (["--seed", "9" * 5000], "--seed: must be a whole number"),
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
    ("a.py", "def scene():\n    return {'type': 'sphere'}", 'with "type": "scene"'),
    ("a.py", "def scene():\n\n    return 1 / 0", "a.py:3: ZeroDivisionError: division by zero"),
    ("a.py", "import nothing_of_that_name", "a.py:1: ModuleNotFoundError"),
    ("a.py", "def scene(:", "a.py:1: SyntaxError"),
    ("a.py", "def scene():\n    return {'type': 'scene', 's': {'type': 'ball'}}", "ball"),
    ("a.py", SCENE_THAT.format("pass") + f"\n{OTHER_VARIANT}", "must leave Mitsuba's variant at"),
    ("a.py", SCENE_THAT.format(OTHER_VARIANT), "must leave Mitsuba's variant at"),
    ("a.py", "raise SystemExit(0)", "SystemExit"),
    ("a.py", SCENE_THAT.format("raise SystemExit(0)"), "SystemExit"),
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
    run(ball, out)
    for options, message in (
        (["--spp", 17], "spp is 1, requested is 17"),
        (["--size", 4, 8], "size is [4, 4], requested is [4, 8]"),
        (["--fov", 50], "fov is 39.5978, requested is 50.0"),
    ):
        refused(ball, out, *options, folder=out, message=message)
    other = tmp_path / "ball.xml"
    other.write_text(f"{BALL}<!-- changed -->")
    message = "the folder holds another capture: scene_sha256"
    refused(other, out, folder=out, message=message)


def test_captured_image_of_another_size_is_refused(ball, captured, tmp_path):
    run(ball, tmp_path / "out")
    run(ball, tmp_path / "other", "--size", 5, 4)
    path = tmp_path / "out" / "train" / "r_1.png"
    path.write_bytes((tmp_path / "other" / "train" / "r_1.png").read_bytes())
    (tmp_path / "out" / "points3d.ply").unlink()  # or no image would be looked at
    message = f"{path}: must be an RGBA image of 4 x 4 px of this capture, got 5 x 4"
    refused(ball, tmp_path / "out", folder=tmp_path, message=message)
    path.unlink()
    run(ball, tmp_path / "out")
    assert contents(tmp_path / "out") == captured
