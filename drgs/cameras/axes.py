"""Axes of a camera: OpenCV's (x right, y down, z forward), which drgs uses, and others.

Datasets use OpenGL's (x right, y up, z backward), Mitsuba's sensors x left, y up, z forward. A
matrix here stands on the right of a pose (camera to world) and is its own inverse.
"""

from __future__ import annotations

import numpy as np

OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])

OPENCV_TO_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])

OPENGL_TO_MITSUBA = OPENCV_TO_OPENGL @ OPENCV_TO_MITSUBA


def between_opencv_and_opengl(pose: np.ndarray) -> np.ndarray:
    """Return a pose (4, 4), camera to world, in the other of the two conventions, float64."""
    turned = np.array(pose, np.float64)
    turned[:3, 1:3] *= -1
    return turned
