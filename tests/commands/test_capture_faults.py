"""``python -m drgs.capture``: killed anywhere, without space, asked for too much, misled."""

import errno
import os
from itertools import count
from pathlib import Path

import mitsuba as mi
import pytest
from support.commands import run_in_process

from drgs.capture import __main__ as capture
from drgs.core import files, memory

BALL = """
<scene version="3.0.0">
    <emitter type="constant"/>
    <shape type="sphere"/>
</scene>
"""

TINY = ["--views", 2, "--test-views", 1, "--size", 4, 4, "--spp", 1, "--points", 8]
FILES = 7
"""The settings, three images, points, two transforms files."""


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture(scope="module")
def ball(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "ball.xml"
    path.write_text(BALL)
    return path


def run(scene, out, *options):
    return run_in_process(capture.main, scene, "--out", out, *TINY, *options)


@pytest.fixture(scope="module")
def captured(ball, tmp_path_factory):
    out = tmp_path_factory.mktemp("captured") / "ball"
    assert run(ball, out).returncode == 0
    return contents(out)


def contents(folder):
    """Bytes by name, hidden files included."""
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def refused(outcome):
    """The one line that a refusal consists of."""
    assert outcome.returncode == 2
    (line,) = outcome.stderr.splitlines()
    return line


def test_edited_files_are_kept(ball, captured, tmp_path):
    """A mask in a frame, an image that was touched up; what is missing is made again."""
    run(ball, tmp_path / "out")
    edited = ("transforms_train.json", "points3d.ply", "train/r_0.png")
    for name in edited:
        (tmp_path / "out" / name).write_text("mine")
    (tmp_path / "out" / "transforms_test.json").unlink()
    assert run(ball, tmp_path / "out").returncode == 0
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
    assert run(ball, out).returncode == 0
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
        line = refused(run(ball, out))
    assert "cannot write the file: No space left on device; free some space" in line
    assert not [name for name in contents(out) if ".tmp" in name]
    assert run(ball, out).returncode == 0
    assert contents(out) == captured


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--size", 10**9, 10**9], "size must be at most 16,777,216 px"),
        (["--size", 10**20, 1], "--size: must be at most 2,147,483,647"),
        (["--points", 10**9], "--points: must be at most 5,000,000"),
        (["--views", 10**9], "--views: must be at most 100,000"),
        (["--test-views", 10**9], "--test-views: must be at most 100,000"),
        (["--spp", 10**9], "--spp: must be at most 1,048,576"),
        (["--max-depth", 10**9], "--max-depth: must be at most 65,536"),
        (["--seed", "9" * 5000], "--seed: must be a whole number"),
        (["--distance", 1e300], "no camera may be farther from the scene than 100000 of its"),
        (["--target", 1e300, 0, 0], "no camera may be farther from the scene than 100000"),
    ],
)
def test_sizes_beyond_limits_are_refused_with_the_limit(ball, tmp_path, options, message):
    line = refused(run(ball, tmp_path / "out", *options))
    assert message in line
    assert len(line) < 300
    assert not (tmp_path / "out").exists()


def test_images_larger_than_memory_are_refused(ball, tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "available_memory", lambda: 2 * 10**9)
    line = refused(run(ball, tmp_path / "out", "--size", 4000, 4000))
    assert "--size: 4000 x 4000 px need about 4 GB of memory, of which 2 GB are available" in line
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("[" * 200_000, "not valid JSON"),
        (" " * (1 << 20) + "{}", "more than 1,048,576 bytes"),
        ("nonsense", "not valid JSON"),
        ('{"scene": "' + 9000 * "x" + '"}', "the folder holds another capture: scene is"),
        ("[]", "the folder holds another capture: scene is null"),
    ],
    ids=["nested without end", "too long", "no JSON", "long value", "a list"],
)
def test_damaged_capture_json_is_refused_and_kept(ball, tmp_path, content, message):
    path = tmp_path / "capture.json"
    path.write_text(content)
    line = refused(run(ball, tmp_path))
    assert line.startswith(f"error: {path}: ") and message in line
    assert len(line) < 600
    assert contents(tmp_path) == {"capture.json": content.encode()}


def test_captured_image_of_another_size_is_refused(ball, captured, tmp_path):
    assert run(ball, tmp_path / "out").returncode == 0
    assert run(ball, tmp_path / "other", "--size", 5, 4).returncode == 0
    path = tmp_path / "out" / "train" / "r_1.png"
    path.write_bytes((tmp_path / "other" / "train" / "r_1.png").read_bytes())
    (tmp_path / "out" / "points3d.ply").unlink()  # or no image would be looked at
    line = refused(run(ball, tmp_path / "out"))
    assert f"{path}: must be an RGBA image of 4 x 4 px of this capture, got 5 x 4" in line
    path.unlink()
    assert run(ball, tmp_path / "out").returncode == 0
    assert contents(tmp_path / "out") == captured


@pytest.mark.parametrize(
    ("program", "message"),
    [
        ("mi.set_variant('scalar_rgb')", "must leave Mitsuba's variant at llvm_ad_rgb, got"),
        ("raise SystemExit(0)", "SystemExit"),
    ],
)
@pytest.mark.parametrize("inside", [True, False])
def test_scene_that_modifies_the_process_is_refused(tmp_path, program, message, inside):
    lines = ["import mitsuba as mi", "def scene():", "    pass", "    return {'type': 'scene'}"]
    lines.insert(*((3, f"    {program}") if inside else (1, program)))
    path = tmp_path / "s.py"
    path.write_text("\n".join(lines))
    line = refused(run(path, tmp_path / "out"))
    assert line.startswith(f"error: {path}") and message in line
    assert not (tmp_path / "out").exists()
    assert mi.variant() == "llvm_ad_rgb"
