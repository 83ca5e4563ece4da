"""Functions that tests have run in a process of their own."""

import os
import signal
import time

from drgs.core.errors import UserError


def add(a, b, report):
    report("given", a, b)
    print("libraries print", flush=True)
    return a + b


def refuse(report):
    raise UserError("a.jpg: cannot be read")


def fail(report):
    raise ZeroDivisionError("by nothing")


def crash(number, report):
    """Ends by a signal, after what libraries write then."""
    os.write(2, b"Check failed:\n  out of luck\n*** Aborted at 1795625961\n  @ 0x7f1594aa8eec\n")
    os.kill(os.getpid(), number)


def wait(report):
    """Reports its process, and does not end by itself, whatever Ctrl-C may do."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    report(os.getpid())
    time.sleep(600)
