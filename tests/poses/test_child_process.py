"""A function in a process of its own, and signals that wait."""

import os
import signal
import subprocess
import sys
import time

import psutil
import pytest
from support import child_functions

from drgs.core.errors import UserError
from drgs.poses.child_process import ChildEndedError, DeferredInterrupts, run_in_child


@pytest.fixture(autouse=True)
def handlers():
    """Ctrl-C as in a process that begins; afterwards as it was."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


def call(function, *arguments, watch=None):
    with DeferredInterrupts() as interrupts:
        return run_in_child(function, *arguments, watch=watch, interrupts=interrupts)


def is_running(process):
    """Whether a process of this number is there, a zombie not counted."""
    try:
        return psutil.Process(process).status() != psutil.STATUS_ZOMBIE
    except psutil.NoSuchProcess:
        return False


def test_a_child_reports_and_returns():
    reports = []
    assert call(child_functions.add, 2, 3, watch=lambda *given: reports.append(given)) == 5
    assert reports == [("given", 2, 3)]


def test_errors_of_the_child_are_raised_in_the_parent():
    """Unexpected ones with their tracebacks."""
    with pytest.raises(UserError, match=r"^a\.jpg: cannot be read$"):
        call(child_functions.refuse)
    with pytest.raises(RuntimeError, match=r"(?s)status 1:\nTraceback.*ZeroDivisionError: by not"):
        call(child_functions.fail)


@pytest.mark.parametrize("name", ["SIGKILL", "SIGABRT"])
def test_a_signal_that_ended_the_child_is_named(name):
    with pytest.raises(ChildEndedError, match=rf"^{name}: Check failed: out of luck$"):
        call(child_functions.crash, signal.Signals[name])


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_ends_the_child(number):
    processes, terminated = [], []
    signal.signal(signal.SIGTERM, lambda *_: terminated.append(True))

    def watch(process):
        processes.append(process)
        os.kill(os.getpid(), number)

    with pytest.raises(KeyboardInterrupt):
        call(child_functions.wait, watch=watch)
    assert not is_running(*processes)
    assert terminated == ([True] if number == signal.SIGTERM else [])


def test_a_child_ends_with_a_parent_that_is_killed():
    program = (
        f"import sys; sys.path[:] = {sys.path!r}\n"
        "from support import child_functions\n"
        "from drgs.poses.child_process import DeferredInterrupts, run_in_child\n"
        "with DeferredInterrupts() as interrupts:\n"
        "    show = lambda process: print(process, flush=True)\n"
        "    run_in_child(child_functions.wait, watch=show, interrupts=interrupts)\n"
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


def test_interrupt_is_deferred_to_the_end_of_the_block():
    done = []
    with pytest.raises(KeyboardInterrupt):
        with DeferredInterrupts():
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            done.append("all")
        done.append("more")
    assert done == ["all"]
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@pytest.mark.parametrize("comes_before", [True, False])
def test_interrupt_is_raised_once_where_allowed(comes_before):
    done = []
    with pytest.raises(KeyboardInterrupt), DeferredInterrupts() as interrupts:
        try:
            if comes_before:
                signal.raise_signal(signal.SIGINT)
            with interrupts.raise_interrupts():
                signal.raise_signal(signal.SIGINT)
                done.append("not reached")
        finally:
            signal.raise_signal(signal.SIGINT)
            done.append("cleaned up")
    assert done == ["cleaned up"]


def test_an_ignored_signal_stays_ignored():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with DeferredInterrupts() as interrupts, interrupts.raise_interrupts():
        signal.raise_signal(signal.SIGINT)
