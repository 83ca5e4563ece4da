"""The comparison of one process with several."""

import pytest
from support import together
from support.fit_command import assert_fits, write_project

from drgs.bench import processes
from drgs.bench.processes import Timing, Way, median_of, table, timed
from drgs.core.errors import UserError


def test_ways_say_what_they_are():
    assert Way(0, 2).name == "1 process without MPI, 2 threads"
    assert Way(1, 1).name == "1 process, 1 thread"
    assert Way(3, 1).name == "3 processes, 1 thread"


def test_the_median_run_is_shown_as_times_a_view():
    runs = [Timing("a", 4, ms, ms / 10, ms / 20, 2e6) for ms in (90.0, 80.0, 100.0)]
    assert median_of(runs) == runs[0]
    faster = Timing("b", 4, 45.0, 4.0, 2.0, 1e6)
    rows = table([runs[0], faster]).splitlines()[2:]
    assert rows == [
        "| a | 22.5 | 1.00 | 2.2 | 1.1 | 2.0 |",
        "| b | 11.2 | 2.00 | 1.0 | 0.5 | 1.0 |",
    ]


def test_a_folder_without_a_fit_is_refused(tmp_path):
    with pytest.raises(UserError, match="must be the folder of a fit that has ended"):
        processes.run(type("Arguments", (), {"folder": tmp_path}))


@pytest.mark.slow
def test_runs_of_one_and_of_two_processes_are_timed(tmp_path):
    together.mpiexec()  # or there is nothing to time
    project = write_project(tmp_path)
    assert_fits(project, "--out", tmp_path / "fit")
    for way in (Way(0, 1), Way(2, 1)):
        timing = timed(way, tmp_path / "fit", views=2)
        assert timing.ms > 0 and timing.way == way.name
        assert (timing.sent_bytes > 0) == (way.processes == 2)
