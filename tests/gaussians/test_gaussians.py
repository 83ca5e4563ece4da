"""The scene representation: copies, not views."""

import numpy as np
import pytest
from support.helpers import both_precisions

from drgs.bench.scenes import bench_gaussians
from drgs.gaussians.parameters import PARAMETER_NAMES


@both_precisions
@pytest.mark.parametrize("count", [1, 5, 2000])
def test_uploaded_arrays_are_copies(precision, count):
    """Dr.Jit wraps numpy's memory, in float32 without a conversion between."""
    source = bench_gaussians(count)
    values = {name: getattr(source, name).copy() for name in PARAMETER_NAMES}
    uploaded = source.to(precision.TensorXf)
    for name in PARAMETER_NAMES:
        getattr(source, name)[:] = 7
    for name, value in values.items():
        np.testing.assert_array_equal(np.array(getattr(uploaded, name)), value, name)
        assert np.array(getattr(uploaded, name)).dtype == precision.dtype


@both_precisions
def test_activated_values_follow_from_raw_ones(precision):
    source = bench_gaussians(50)
    uploaded = source.to(precision.TensorXf)
    # numpy's side is float32 in both cases: a few roundings of 6e-8.
    np.testing.assert_allclose(np.array(uploaded.scales), source.scales, rtol=1e-6)
    np.testing.assert_allclose(np.array(uploaded.opacities), source.opacities, rtol=1e-6)
