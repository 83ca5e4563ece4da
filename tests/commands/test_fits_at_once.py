"""Two fits that write into one folder: there is one."""

from contextlib import ExitStack

import pytest
from support.fit_command import (
    assert_fit_refused,
    assert_fits,
    run_fit,
    stop_after,
    without_images,
    write_project,
)
from support.folders import contents

from drgs.core.folders import sole_writer
from drgs.training import session

MESSAGE = (
    "out: another command is writing to this folder; wait until it has ended, or choose another"
)


@pytest.fixture
def project(tmp_path, monkeypatch):
    without_images(monkeypatch)
    return write_project(tmp_path)


@pytest.mark.slow
def test_folder_in_use_by_another_fit_is_refused(project, tmp_path, monkeypatch):
    """Whether it is resumed, replaced or begun again; afterwards it goes on."""
    out = tmp_path / "out"
    with monkeypatch.context() as stopped:
        stop_after(stopped, 5)
        assert run_fit(project, "--out", out).returncode == 130
    with sole_writer(out):
        for arguments in ((project, "--out", out), ("--resume", out)):
            assert_fit_refused(*arguments, folder=tmp_path, message=MESSAGE)
        assert_fit_refused(project, "--out", out, "--overwrite", folder=tmp_path, message=MESSAGE)
    assert_fits("--resume", out)


def test_second_of_two_simultaneous_fits_is_refused(project, tmp_path, monkeypatch):
    """The first makes the folder while the second reads its data."""
    out, load_dataset = tmp_path / "out", session.load_dataset
    with ExitStack() as first:

        def load(config, **others):
            first.enter_context(sole_writer(out))()
            return load_dataset(config, **others)

        monkeypatch.setattr(session, "load_dataset", load)
        assert MESSAGE in run_fit(project, "--out", out).stderr
    assert contents(out) == {}
