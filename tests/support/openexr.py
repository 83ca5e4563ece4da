"""OpenEXR files: Mitsuba uses Dr.Jit's pool for them, and with one thread waits for ever."""

from contextlib import contextmanager

import drjit as dr
import mitsuba as mi


@contextmanager
def two_threads():
    """Within it Dr.Jit has two threads at least."""
    before = dr.thread_count()
    dr.set_thread_count(max(before, 2))
    try:
        yield
    finally:
        dr.set_thread_count(before)


def read_exr(path) -> mi.Bitmap:
    with two_threads():
        return mi.Bitmap(str(path))
