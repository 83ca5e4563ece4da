"""Axis conventions: OpenCV's (x right, y down, z forward), OpenGL's, and Mitsuba's."""

from __future__ import annotations

import numpy as np

MITSUBA_AXES = np.diag([-1.0, -1.0, 1.0, 1.0])
"""From OpenCV's: Mitsuba's camera has x to the left and y up."""

OPENCV_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
"""Of camera axes: y and z change sign."""


def in_opengl_axes(pose: np.ndarray) -> list[list[float]]:
    """Camera to world (4, 4), of a camera in OpenCV axes: as datasets in OpenGL's write it."""
    return (pose * [1, -1, -1, 1]).tolist()


def in_opencv_axes(matrix: list[list[float]]) -> np.ndarray:
    """The same back: (4, 4) float64."""
    return np.array(matrix, np.float64).reshape(4, 4) * [1, -1, -1, 1]
