"""Populations of a few Gaussians for density control."""

import drjit as dr
import numpy as np
from drjit.llvm.ad import TensorXf

from drgs.core.adam import make_optimizer
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.training.optimizer import Population

EXTENT = 4.0


def logit(opacity):
    return np.log(opacity / (1 - np.asarray(opacity, dtype=float)))


def make(scales, opacities, sh_rows=3, tensor_type=TensorXf, seed=0):
    """An optimizer that has made one step; scales: largest standard deviations, world units."""
    random = np.random.default_rng(seed)
    num = len(scales)
    log_scales = np.log(np.asarray(scales, dtype=float))[:, None] - [0.0, 0.3, 0.7]
    arrays = {
        "means": random.standard_normal((num, 3)),
        "quats": random.standard_normal((num, 4)),
        "log_scales": random.permuted(log_scales, axis=1),
        "logit_opacities": np.broadcast_to(logit(opacities), num),
        "sh0": random.standard_normal((num, 1, 3)),
        "shN": random.standard_normal((num, sh_rows, 3)),
    }
    flat_type = dr.array_t(tensor_type)
    parameters = {
        name: flat_type(a) if a.ndim == 1 else tensor_type(flat_type(a.ravel()), a.shape)
        for name, a in arrays.items()
    }
    # Rates of 0: the step fills the moments and leaves the values where they are.
    optimizer = make_optimizer(parameters, dict.fromkeys(PARAMETER_NAMES, 0.0))
    for key, value in optimizer.items():
        dr.set_grad(value, type(value)(random.standard_normal(value.shape) + 3))
        assert key in PARAMETER_NAMES
    optimizer.step()
    return optimizer


def rows_of(optimizer, seed=0):
    """The population of an optimizer as strategies see it."""
    return Population(optimizer, EXTENT, seed)


def assert_standard_normal(samples):
    """Five standard deviations of sample means and covariances."""
    count, dims = samples.shape
    assert np.abs(samples.mean(0)).max() < 5 / np.sqrt(count)
    assert np.abs(np.cov(samples.T) - np.eye(dims)).max() < 5 * np.sqrt(2 / count)


def values(optimizer):
    """Return all parameters on the host."""
    return {name: np.array(dr.detach(value)) for name, value in optimizer.items()}


def moments(optimizer, name):
    """The first and the second one of a parameter, a row for each Gaussian."""
    value, _, _, (_, m, v, _) = optimizer.state[name]
    num = value.shape[0]
    return np.array(m).reshape(num, -1), np.array(v).reshape(num, -1)
