"""Two that want to write into one folder."""

import multiprocessing
import os
import signal

import pytest

from drgs.core.errors import UserError
from drgs.core.folders import sole_writer


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


def _keep(folder, pipe):
    with sole_writer(folder):
        pipe.send("kept")
        pipe.recv()


@pytest.mark.slow
def test_a_killed_process_leaves_no_lock(tmp_path):
    ours, theirs = multiprocessing.get_context("spawn").Pipe()
    process = multiprocessing.get_context("spawn").Process(target=_keep, args=(tmp_path, theirs))
    process.start()
    assert ours.recv() == "kept"
    with pytest.raises(UserError), sole_writer(tmp_path):
        pass
    os.kill(process.pid, signal.SIGKILL)
    process.join()
    with sole_writer(tmp_path):
        pass


def test_path_that_cannot_be_locked_is_not_locked(tmp_path):
    (tmp_path / "file").write_text("")
    for path in (tmp_path / "file" / "out", tmp_path / "file"):
        with sole_writer(path) as keep:
            assert not keep()
