import errno
import os

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
        assert not path.exists()
        assert temporary.suffix == ".txt"
    assert path.read_text() == "1"
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]


def test_atomic_path_keeps_the_old_file_after_an_error(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(RuntimeError), atomic_path(path) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


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

    def refuse(*arguments, **options):
        raise OSError(number, os.strerror(number))

    if stage == "replace":
        monkeypatch.setattr(os, "replace", refuse)
    with pytest.raises(UserError) as error, atomic_path(path) as temporary:
        temporary.write_text("half")
        if stage == "write":
            refuse()
    assert str(error.value) == f"{path}: cannot write the file: {message}"
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_folder_is_not_replaced_by_a_file(tmp_path):
    (tmp_path / "a.txt").mkdir()
    message = "Is a directory; remove or rename the folder"
    with pytest.raises(UserError, match=message), atomic_path(tmp_path / "a.txt") as temporary:
        temporary.write_text("1")
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_file_is_not_replaced_by_a_folder(tmp_path):
    (tmp_path / "a").write_text("old")
    message = "choose another folder: a part of this path is a file"
    with pytest.raises(UserError, match=message), atomic_path(tmp_path / "a" / "b.txt"):
        pass
    assert (tmp_path / "a").read_text() == "old"


def test_text_is_read_up_to_a_limit(tmp_path):
    path = tmp_path / "a.txt"
    path.write_bytes(b"\xc3\xa4b")
    assert read_text(path, "poem", 3) == "äb"
    (tmp_path / "marked.txt").write_bytes(b"\xef\xbb\xbfa")  # as editors of Windows begin files
    assert read_text(tmp_path / "marked.txt", "poem", 4) == "a"
    with pytest.raises(UserError) as error:
        read_text(path, "poem", 2)
    assert str(error.value) == f"{path}: cannot read the poem: more than 2 bytes"
    path.write_bytes(b"ab\xff")
    with pytest.raises(UserError) as error:
        read_text(path, "poem", 9)
    assert str(error.value) == f"{path}: cannot read the poem: not UTF-8 text (byte 2)"
    with pytest.raises(UserError, match="cannot read the poem: Is a directory"):
        read_text(tmp_path, "poem", 9)


def test_only_regular_files_are_read_and_pipes_do_not_block(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to(tmp_path / "pipe")
    for path, kind in ((tmp_path / "pipe", "a named pipe"), (tmp_path / "link", "a named pipe")):
        with pytest.raises(UserError) as error:
            read_text(path, "poem", 9)
        assert str(error.value) == (
            f"{path}: cannot read the poem: must be a regular file, got {kind}"
        )
    with pytest.raises(UserError, match=r"/dev/zero: .* must be a regular file, got a device"):
        open_regular("/dev/zero")
    with pytest.raises(UserError, match="cannot read the file: embedded null byte"):
        open_regular("a\0b")
    (tmp_path / "a.txt").write_text("x")
    (tmp_path / "link").unlink()
    (tmp_path / "link").symlink_to(tmp_path / "a.txt")
    assert read_text(tmp_path / "link", "poem", 9) == "x"


def test_names_are_shortened_between_characters():
    assert shorten_stem("a" * 200) == "a" * 200
    assert shorten_stem("a" * 201) == "a" * 200
    assert shorten_stem("a" + "\u4e2d" * 90) == "a" + "\u4e2d" * 66
    assert shorten_stem(os.fsdecode(b"\xff") * 9) == os.fsdecode(b"\xff") * 9


def test_file_over_the_size_limit_is_not_opened(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"abc")
    open_regular(tmp_path / "a.txt", "poem", 3).close()
    with pytest.raises(UserError, match=r"a.txt: cannot read the poem: more than 2 bytes"):
        open_regular(tmp_path / "a.txt", "poem", 2)


@pytest.mark.parametrize("letter", ["x", "\u00e4"])
def test_atomic_path_accepts_the_longest_file_names(tmp_path, letter):
    """The temporary file's name would be longer."""
    path = tmp_path / f"{letter * (250 // len(letter.encode()))}.txt"
    with atomic_path(path) as temporary:
        temporary.write_text("x")
        assert is_temporary(temporary.name)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_reading_allocates_no_more_than_the_file_size(tmp_path):
    (tmp_path / "a").write_bytes(b"abc")
    assert read_bytes(tmp_path / "a", "file", 1 << 60) == b"abc"
    with pytest.raises(UserError, match=r"a: cannot read the file: more than 2 bytes"):
        read_bytes(tmp_path / "a", "file", 2)
    with (tmp_path / "a").open("wb") as file:
        file.truncate(1 << 40)
    with pytest.raises(UserError, match=r"a: cannot read the file: more than 4,096 bytes"):
        read_bytes(tmp_path / "a", "file", 4096)
