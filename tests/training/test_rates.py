"""Learning rates over a fit."""

import math

import numpy as np
import pytest

from drgs.config.schema import FitConfig
from drgs.training.rates import ExponentialDecay, rates_over_time

EXTENT = 2.5


def rates_of(decay, decay_from=0.4):
    optimizer = {"decay": decay, "decay_from": decay_from, "scales_lr": 0.01}
    config = FitConfig(data={"path": "."}, iterations=50, optimizer=optimizer, coarse=[])
    return config.optimizer, rates_over_time(config, EXTENT)


def test_rates_decay_to_a_fraction_after_a_share_of_the_fit():
    config, rates = rates_of(0.1)
    for name, first in (("sh0", config.sh0_lr), ("log_scales", config.scales_lr)):
        found = [rates(iteration)[name] for iteration in range(1, 51)]
        np.testing.assert_allclose(found[:20], first, rtol=1e-12)
        # From iteration 20 to 50, in equal ratios.
        np.testing.assert_allclose(found[20:], first * 10 ** (-np.arange(1, 31) / 30), rtol=1e-12)
    found = [rates(iteration)["means"] for iteration in range(1, 51)]
    expected = config.means_lr * EXTENT * 100.0 ** (-np.arange(1, 51) / 50)
    np.testing.assert_allclose(found, expected, rtol=1e-12)


def test_rates_but_that_of_means_are_constant_without_a_decay():
    _, rates = rates_of(1.0)
    assert rates(1) | {"means": 0} == rates(50) | {"means": 0}


def test_decay_is_exponential_from_its_start_to_its_end():
    rate = ExponentialDecay(1.0, 1e-4, 50, 150)
    exponents = [math.log10(rate(i)) for i in (0, 50, 75, 100, 150, 200)]
    np.testing.assert_allclose(exponents, [0, 0, -1, -2, -4, -4], rtol=1e-12)
    with pytest.raises(ValueError, match="must be > 0"):
        ExponentialDecay(1e-3, 0.0, 0, 10)
