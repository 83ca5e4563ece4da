import errno
import os
import re
from unittest.mock import Mock

import pytest

from drgs.core.errors import UserError
from drgs.core.files import (
    atomic_path,
    is_temporary,
    open_regular,
    read_bytes,
    read_text,
    shorten_stem,
)


def test_atomic_path_replaces_the_file_and_creates_folders(tmp_path):
    path = tmp_path / "new" / "a.txt"
    with atomic_path(path) as temporary:
        temporary.write_text("1")
        assert not path.exists() and temporary.suffix == ".txt"
    with pytest.raises(RuntimeError), atomic_path(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "1"
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]


@pytest.mark.parametrize(
    ("number", "message"),
    [
        (errno.ENOSPC, "No space left on device; free some space, or choose another disk"),
        (errno.EACCES, "Permission denied; choose a folder that you may write to"),
        (errno.EIO, "Input/output error"),
    ],
)
@pytest.mark.parametrize("stage", ["write", "replace"])
def test_file_system_errors_are_user_errors(tmp_path, monkeypatch, stage, number, message):
    path = tmp_path / "a.txt"
    path.write_text("old")
    refuse = Mock(side_effect=OSError(number, os.strerror(number)))
    if stage == "replace":
        monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(UserError) as error, atomic_path(path) as temporary:
        temporary.write_text("half")
        if stage == "write":
            refuse()
    assert str(error.value) == f"{path}: cannot write the file: {message}"
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_files_and_folders_do_not_replace_each_other(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_text("old")
    for name, message in (
        ("folder", "Is a directory; remove or rename the folder"),
        ("file/b.txt", "choose another folder: a part of this path is a file"),
    ):
        with pytest.raises(UserError, match=message), atomic_path(tmp_path / name) as temporary:
            temporary.write_text("1")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]
    assert (tmp_path / "file").read_text() == "old"


@pytest.mark.parametrize("letter", ["x", "\u00e4"])
def test_atomic_path_accepts_the_longest_file_names(tmp_path, letter):
    """The temporary file's name would be longer."""
    path = tmp_path / f"{letter * (250 // len(letter.encode()))}.txt"
    with atomic_path(path) as temporary:
        temporary.write_text("x")
        assert is_temporary(temporary.name)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.fixture
def files(tmp_path, monkeypatch):
    """The current folder, with files of all kinds."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "a.txt").write_bytes(b"\xc3\xa4b")
    (tmp_path / "marked.txt").write_bytes(b"\xef\xbb\xbfa")  # as editors of Windows begin files
    (tmp_path / "damaged.txt").write_bytes(b"ab\xff")
    (tmp_path / "link").symlink_to("a.txt")
    (tmp_path / "folder").mkdir()
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link to a pipe").symlink_to("pipe")
    (tmp_path / "hole").touch()
    os.truncate(tmp_path / "hole", 1 << 40)


REFUSED = [
    (read_text, "a.txt", 2, "more than 2 bytes"),
    (read_bytes, "a.txt", 2, "more than 2 bytes"),
    (open_regular, "a.txt", 2, "more than 2 bytes"),
    (read_bytes, "hole", 4096, "more than 4,096 bytes"),
    (read_text, "damaged.txt", 9, "not UTF-8 text (byte 2)"),
    (read_text, "folder", 9, "Is a directory"),
    (read_text, "pipe", 9, "must be a regular file, got a named pipe"),
    (read_text, "link to a pipe", 9, "must be a regular file, got a named pipe"),
    (open_regular, "/dev/zero", 9, "must be a regular file, got a device"),
    (open_regular, "a\0b", 9, "embedded null byte"),
]


@pytest.mark.parametrize(("read", "name", "limit", "message"), REFUSED)
@pytest.mark.usefixtures("files")
def test_only_regular_files_are_read_up_to_a_limit(read, name, limit, message):
    message = re.escape(f"{name}: cannot read the poem: {message}").replace(r"\x00", ".*")
    with pytest.raises(UserError, match=message):
        read(name, "poem", limit)


@pytest.mark.usefixtures("files")
def test_contents_are_read():
    assert read_text("a.txt", "poem", 3) == read_text("link", "poem", 3) == "äb"
    assert read_text("marked.txt", "poem", 4) == "a"
    assert read_bytes("a.txt", "file", 1 << 60) == b"\xc3\xa4b"  # takes no memory of such a size
    open_regular("a.txt", "poem", 3).close()


def test_names_are_shortened_between_characters():
    assert shorten_stem("a" * 200) == "a" * 200
    assert shorten_stem("a" * 201) == "a" * 200
    assert shorten_stem("a" + "\u4e2d" * 90) == "a" + "\u4e2d" * 66
    assert shorten_stem(os.fsdecode(b"\xff") * 9) == os.fsdecode(b"\xff") * 9


def test_file_on_a_broken_disk_is_named(tmp_path, monkeypatch):
    path = tmp_path / "a.yml"
    path.write_text("a")
    broken = Mock(side_effect=OSError(errno.EIO, "Input/output error"))
    monkeypatch.setattr("drgs.core.files.require_memory", broken)  # called before reading
    with pytest.raises(UserError, match=r"a\.yml: cannot read the \w+: Input/output error"):
        read_bytes(path, "configuration", 100)
