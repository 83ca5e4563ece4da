"""The coefficients of all degrees as one array."""

import drjit.llvm.ad as llvm
import numpy as np
from support.small_capture import blobs


def test_sh_is_sh0_followed_by_shn():
    gaussians = blobs()
    assert gaussians.sh.shape == (30, 4, 3)
    assert np.array_equal(gaussians.sh[:, :1], gaussians.sh0)
    assert np.array_equal(gaussians.sh[:, 1:], gaussians.shN)


def test_sh_is_equal_on_the_device():
    gaussians = blobs()
    on_device = gaussians.to(llvm.TensorXf).sh
    assert isinstance(on_device, llvm.TensorXf)
    assert np.array_equal(on_device.numpy(), gaussians.sh)
