"""Denormal numbers are taken for zero where that is asked for, and nowhere else."""

import platform

import numpy as np
import pytest

from drgs.core.environment import denormals_flushed, denormals_kept

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


@pytest.mark.slow
def test_nearest_neighbours_of_equal_points_at_zero_are_found(run_python):
    """In another process: SciPy's tree ended it, as the least number above zero was zero."""
    result = run_python("""
import numpy as np
from drgs.core.environment import denormals_flushed
from drgs.initialization.start import mean_squared_neighbour_distance
points = np.zeros((40, 3), np.float32)
points[17] = 1          # all others are one point
points[20:, 1] = np.arange(20)  # and these lie in a plane through zero
with denormals_flushed():
    print((3 * mean_squared_neighbour_distance(points)[[0, 17, 39]]).round(9).tolist())
""")
    assert (result.returncode, result.stdout) == (0, "[0.0, 8.0, 14.0]\n"), result
