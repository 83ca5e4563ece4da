"""Gaussians from arrays, on the device, and some of them."""

from dataclasses import replace

import numpy as np
import pytest
from drjit.llvm.ad import TensorXf
from support.formats import gaussians_within_ranges
from support.helpers import both_precisions

import drgs
from drgs.gaussians.parameters import PARAMETER_NAMES

COUNT = 7


@both_precisions
@pytest.mark.parametrize("count", [1, 5, 2000])
def test_uploaded_arrays_are_copies(precision, count):
    """Dr.Jit wraps numpy's memory, in float32 without a conversion between."""
    source, expected = gaussians_within_ranges(count), gaussians_within_ranges(count)
    uploaded = source.to(precision.TensorXf)
    for name in PARAMETER_NAMES:
        getattr(source, name)[:] = 7
    for name in (*PARAMETER_NAMES, "sh", "scales", "opacities"):
        found = np.array(getattr(uploaded, name))
        # Activated values are float32 in numpy: a few roundings of 6e-8.
        tolerance = 1e-6 if name in ("scales", "opacities") else 0
        np.testing.assert_allclose(found, getattr(expected, name), rtol=tolerance, err_msg=name)
        assert found.dtype == precision.dtype


def arrays(degree=2):
    rng = np.random.default_rng(2)
    return {
        "means": rng.normal(0, 1, (COUNT, 3)),
        "quats": rng.normal(0, 1, (COUNT, 4)),
        "scales": rng.uniform(0.01, 3, (COUNT, 3)),
        "opacities": rng.uniform(0.01, 0.99, COUNT),
        "sh": rng.normal(0, 1, (COUNT, (degree + 1) ** 2, 3)),
    }


@pytest.mark.parametrize("degree", range(4))
def test_activated_values_survive_from_numpy(degree):
    given = arrays(degree)
    gaussians = drgs.Gaussians.from_numpy(**given)
    assert (gaussians.num_gaussians, gaussians.sh_degree) == (COUNT, degree)
    for name, values in given.items():
        # float32; a logarithm of 5 is rounded by 2.4e-7, the relative error of its exponential
        np.testing.assert_allclose(getattr(gaussians, name), values, rtol=1e-6)
    assert {getattr(gaussians, name).dtype for name in PARAMETER_NAMES} == {np.dtype(np.float32)}


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"means": np.zeros((COUNT, 2))}, r"means must be of shape \(7, 3\), got \(7, 2\)"),
        ({"means": np.zeros((3, COUNT))}, r"means must be of shape \(3, 3\), got \(3, 7\)"),
        ({"opacities": np.zeros((COUNT, 1))}, r"opacities must be of shape \(7,\)"),
        ({"sh": np.zeros((COUNT, 5, 3))}, r"sh must be of shape \(7, 1, 3\) or .*, got \(7, 5"),
        ({"scales": np.zeros((COUNT, 3))}, "scales must be above 0 and below inf, got 0.0"),
        ({"opacities": np.full(COUNT, 1.5)}, "opacities must be above 0 and below 1, got 1.5"),
    ],
)
def test_invalid_gaussians_are_refused(changes, message):
    with pytest.raises(ValueError, match=rf"Gaussians.from_numpy\(\): {message}"):
        drgs.Gaussians.from_numpy(**{**arrays(), **changes})


def test_rows_are_taken_from_every_parameter():
    g, rows = gaussians_within_ranges(9), np.array([7, 0])
    found = g[rows]
    for name in PARAMETER_NAMES:
        np.testing.assert_array_equal(getattr(found, name), getattr(g, name)[rows])
    assert found.features is None and found.smoothing is None
    for other in (g[[7, 0]], g[-2::-7], drgs.Gaussians.concatenate([g[7], g[0]])):
        for name in PARAMETER_NAMES:
            np.testing.assert_array_equal(getattr(other, name), getattr(found, name))
    assert len(g) == 9 and len(g[g.means[:, 0] > np.inf]) == 0
    with pytest.raises(IndexError):
        g[9]


def test_concatenated_gaussians_stay_where_they_are():
    """Parts of another origin, with fewer harmonics, on the device; what one lacks is left out."""
    labels = {"labels": np.ones((5, 2), np.float32)}
    first = replace(gaussians_within_ranges(5), origin=(100.0, 0, -7), features=labels)
    second = replace(gaussians_within_ranges(4, degree=1), features={"labels": np.zeros((4, 2))})
    whole = drgs.Gaussians.concatenate([first, second.to(TensorXf)])
    assert whole.origin == first.origin and len(whole) == 9
    world = np.concatenate([first.means + np.array(first.origin), second.means])
    # float32 at 100 from the origin.
    np.testing.assert_allclose(whole.means + np.array(whole.origin), world, atol=1e-4)
    np.testing.assert_array_equal(whole.features["labels"].sum(axis=1), [2] * 5 + [0] * 4)
    np.testing.assert_array_equal(whole.shN[5:, :3], second.shN)
    assert not whole.shN[5:, 3:].any() and whole.shN.shape == (9, 15, 3)
    assert drgs.Gaussians.concatenate([first, replace(second, features=None)]).features is None
