import pytest

from drgs.files import atomic_path


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
