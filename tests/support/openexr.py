"""OpenEXR files, on any number of threads."""

import mitsuba as mi

from drgs.io.scenes import openexr_threads


def read_exr(path) -> mi.Bitmap:
    with openexr_threads():
        return mi.Bitmap(str(path))
