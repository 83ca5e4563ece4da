"""A folder has one writer, which knows the files that it wrote and replaces no others."""

import json
import os
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest
from support.formats import refusal

from drgs.core.errors import UserError
from drgs.core.folders import FolderRecord, digest, sole_writer

record = partial(FolderRecord, command="render")


def write(folder, **files):
    for name, text in files.items():
        (folder / name).write_text(text)


def test_claimed_files_may_be_rewritten_until_they_are_sealed(tmp_path):
    """Also by another process, when the first was killed."""
    record(tmp_path).claim("ab")
    write(tmp_path, a="half")
    record(tmp_path).claim("abc")
    write(tmp_path, a="ours", b="ours")
    record(tmp_path).seal()
    assert not record(tmp_path).foreign_files("abc")
    write(tmp_path, b="theirs", c="theirs")  # c did not exist when the record was sealed
    refused = refusal(tmp_path, lambda folder: record(folder).claim("abc"))
    assert refused.startswith("holds b, c, which this command would replace")
    assert sorted(path.name for path in tmp_path.iterdir()) == [".drgs-render.json", *"abc"]


def test_links_folders_and_files_of_other_commands_are_foreign(tmp_path):
    record(tmp_path).claim("ab")
    record(tmp_path, command="fit").claim("c")
    write(tmp_path, photograph="mine", c="of a fit")
    (tmp_path / "a").symlink_to(tmp_path / "photograph")
    (tmp_path / "b").mkdir()
    assert record(tmp_path).foreign_files("abcd") == ["a", "b", "c"]


def test_files_of_a_version_without_records_are_claimed_once(tmp_path):
    write(tmp_path, a="ours", b="ours")
    record(tmp_path).claim(["a"], earlier={"a", "b"})
    record(tmp_path).claim(["b"])
    write(tmp_path, c="theirs")
    refused = refusal(tmp_path, lambda folder: record(folder).claim("c", earlier="c"))
    assert refused.startswith("holds c, which")


def test_non_utf8_names_and_paths_are_recorded(tmp_path):
    name = b"\xff.png".decode(errors="surrogateescape")
    record(tmp_path).claim([name], {"data.path": "../data"})
    write(tmp_path, **{name: "ours"})
    record(tmp_path).seal()
    assert record(tmp_path).paths == {"data.path": "../data"}
    assert json.loads(record(tmp_path).path.read_text())["files"] == {name: digest(tmp_path / name)}
    assert not record(tmp_path).foreign_files([name])


@pytest.mark.parametrize(
    "text", [" ", "[]", "7", '{"files": 7}', '{"files": {"a": 7}}', '{"b": {}}', "[" * 10_000]
)
def test_a_damaged_record_is_refused_by_name(tmp_path, text):
    record(tmp_path).path.write_text(text)
    assert "must be the record of the files that were written here" in refusal(tmp_path, record)


def test_writers_of_one_folder_keep_each_others_files(tmp_path):
    """In threads, and within the time in which one computes its digests."""

    def write_one(name):
        one = record(tmp_path / "new")
        one.claim([name])
        write(tmp_path / "new", **{name: name})
        one.seal([name])

    names = [f"file{k}" for k in range(16)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(write_one, names))
    known = json.loads(record(tmp_path / "new").path.read_text())["files"]
    assert known == {name: digest(tmp_path / "new" / name) for name in names}


def test_a_record_is_not_sealed_for_others(tmp_path):
    """A file that another command is about to replace would be foreign to it afterwards."""
    first = record(tmp_path)
    first.claim("a")
    record(tmp_path).claim("c")
    write(tmp_path, a="ours", c="old")
    first.seal("a")
    write(tmp_path, c="new")
    assert not record(tmp_path).foreign_files("ac")


def test_a_record_that_was_begun_and_not_written_names_nothing(tmp_path):
    record(tmp_path).path.touch()
    write(tmp_path, a="theirs")
    assert record(tmp_path).foreign_files("a") == ["a"]


def test_removed_record_leaves_no_file(tmp_path):
    kept = record(tmp_path)
    kept.claim(["a"])
    kept.remove()
    kept.remove()
    kept.seal()
    assert not list(tmp_path.iterdir())


def test_temporary_files_of_killed_writers_are_removed(tmp_path):
    """Other files' may be another command's, and a process that runs goes on."""
    with subprocess.Popen([sys.executable, "-c", ""]) as dead:
        pass
    dead = dead.pid
    gone = [
        f".a.{dead}.tmp.png",
        f".a.{dead}-7.tmp.png",
        f".metrics.{dead}.tmp.json",
        f".notes.{dead}.tmp",
    ]
    kept = [f".a.{os.getpid()}.tmp.png", f".b.{dead}.tmp.png", ".a.tmp.png", f".a.{dead}.tmp"]
    for name in (*gone, *kept):
        (tmp_path / name).touch()
    record(tmp_path).claim(["a.png", "metrics.json", "notes"])
    assert {path.name for path in tmp_path.iterdir()} == {*kept, ".drgs-render.json"}


def test_folder_has_one_writer(tmp_path):
    folder = tmp_path / "out"
    folder.mkdir()
    with sole_writer(folder) as keep:
        assert keep()
        message = r"out: another command is writing to this folder; wait"
        with pytest.raises(UserError, match=message), sole_writer(folder):
            pass
        with sole_writer(tmp_path / "other"):
            pass
        assert os.listdir(folder) == []
    with pytest.raises(KeyError), sole_writer(folder):
        raise KeyError
    with sole_writer(folder):
        pass


def test_lock_creates_a_new_folder_on_demand(tmp_path):
    folder = tmp_path / "new" / "out"
    with sole_writer(folder) as keep, sole_writer(folder) as keep_as_well:
        assert not folder.exists()
        assert keep() and folder.is_dir()
        with pytest.raises(UserError, match="another command is writing to this folder"):
            keep_as_well()


@pytest.mark.slow
def test_a_killed_process_leaves_no_lock(tmp_path, run_python):
    program = (
        "import os, pathlib, signal\n"
        "from drgs.core.folders import sole_writer\n"
        f"with sole_writer(pathlib.Path({str(tmp_path)!r})):\n"
        "    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    with sole_writer(tmp_path):
        assert "another command is writing to this folder" in run_python(program).stderr
    assert run_python(program).returncode == -signal.SIGKILL
    with sole_writer(tmp_path):
        pass


def test_path_that_cannot_be_locked_is_not_locked(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "out", tmp_path / "file"):
        with sole_writer(path) as keep:
            assert not keep()
