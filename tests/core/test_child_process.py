"""A function in a process of its own."""

import signal
import subprocess
import sys
import time

import psutil
import pytest
from support import child_functions

from drgs.core.child_process import ChildEndedError, run_in_child
from drgs.core.errors import UserError


def is_running(process):
    """Whether a process of this number is there, a zombie not counted."""
    try:
        return psutil.Process(process).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_a_child_reports_and_returns():
    reports = []
    assert run_in_child(child_functions.add, 2, 3, watch=lambda *given: reports.append(given)) == 5
    assert reports == [("given", 2, 3)]


def test_errors_of_the_child_are_raised_in_the_parent():
    """Unexpected ones with their tracebacks."""
    with pytest.raises(UserError, match=r"^a\.jpg: cannot be read$"):
        run_in_child(child_functions.refuse, watch=print)
    with pytest.raises(RuntimeError, match=r"(?s)status 1:\nTraceback.*ZeroDivisionError: by not"):
        run_in_child(child_functions.fail, watch=print)


@pytest.mark.parametrize("name", ["SIGKILL", "SIGABRT"])
def test_a_signal_that_ended_the_child_is_named(name):
    with pytest.raises(ChildEndedError, match=rf"^{name}: Check failed: out of luck$"):
        run_in_child(child_functions.crash, signal.Signals[name], watch=print)


def test_an_interrupt_ends_the_child():
    processes = []

    def watch(process):
        processes.append(process)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_in_child(child_functions.wait, watch=watch)
    assert not is_running(*processes)


def test_a_child_ends_with_a_parent_that_is_killed():
    program = (
        f"import sys; sys.path[:] = {sys.path!r}\n"
        "from support import child_functions\n"
        "from drgs.core.child_process import run_in_child\n"
        "run_in_child(child_functions.wait, watch=lambda process: print(process, flush=True))\n"
    )
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as parent:
        child = int(parent.stdout.readline())
        assert is_running(child)
        parent.kill()
    for _ in range(200):
        if not is_running(child):
            break
        time.sleep(0.05)
    assert not is_running(child)
