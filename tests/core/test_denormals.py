"""Denormal numbers are taken for zero where that is asked for, and nowhere else."""

import platform

import numpy as np
import pytest

from drgs.core.environment import denormals_flushed, denormals_kept
from drgs.initialization.start import mean_squared_neighbour_distance

pytestmark = pytest.mark.skipif(
    (platform.libc_ver()[0], platform.machine()) != ("glibc", "x86_64"),
    reason="the mode is only known there",
)


def denormal():
    """1e-40, or 0."""
    return float(np.float32(1e-30) * np.float32(1e-10))


def test_denormal_mode_is_set_and_restored():
    assert denormal() > 0
    with denormals_flushed():
        assert denormal() == 0
        with pytest.raises(ZeroDivisionError), denormals_kept():
            assert denormal() > 0
            print(1 / 0)
        assert denormal() == 0
    assert denormal() > 0


def test_nearest_neighbours_of_equal_points_at_zero_are_found():
    """SciPy's tree ended the process, as the least number above zero was zero."""
    points = np.zeros((40, 3), np.float32)
    points[17] = 1  # all others are one point
    points[20:, 1] = np.arange(20)  # and these lie in a plane through zero
    with denormals_flushed():
        found = 3 * mean_squared_neighbour_distance(points)[[0, 17, 39]]
    assert found.round(9).tolist() == [0, 8, 14]
