"""Draws against what chance allows, and their hash against plain integers."""

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Float, Float64, UInt32
from scipy import stats

from drgs.training.density.mcmc import normals, pcg4d, sample_in_proportion


def test_rows_are_sampled_in_proportion_to_weights():
    random = np.random.default_rng(0)
    weights = random.random(500) * (random.random(500) < 0.8)
    expected = 3000 * weights / weights.sum()
    for seed in range(5):
        counts = np.bincount(sample_in_proportion(weights, 3000, [seed, 7]), minlength=500)
        assert counts.sum() == 3000
        assert np.abs(counts - expected).max() < 1
        assert not counts[weights == 0].any()


@pytest.mark.slow
def test_mean_count_over_many_keys_is_the_weight():
    # Fewer draws than rows: each row is drawn once or not at all, with probability 20 w. Of 4000
    # keys, six standard deviations of the mean of such a variable.
    weights = np.arange(1, 41) / np.arange(1, 41).sum()
    keys = 4000
    drawn = [
        np.bincount(sample_in_proportion(weights, 20, [3, i]), minlength=40) for i in range(keys)
    ]
    shares = 20 * weights
    deviation = np.sqrt((shares % 1) * (1 - shares % 1) / keys)
    assert (np.abs(np.mean(drawn, axis=0) - shares) <= 6 * deviation + 1e-12).all()


def test_nan_weights_count_as_zero():
    weights = np.array([np.nan, 0.0, 1e-300, -1.0, np.nan])
    np.testing.assert_array_equal(sample_in_proportion(weights, 3, [0, 0]), [2, 2, 2])
    with pytest.raises(ValueError, match="must be positive and finite"):
        sample_in_proportion(np.array([0.0, np.nan]), 1, [0, 0])
    assert sample_in_proportion(weights, 0, [0, 0]).size == 0


def test_hash_matches_the_paper():
    random = np.random.default_rng(2)
    words = random.integers(0, 2**32, (4, 50), dtype=np.uint64)
    x, y, z, w = ([int(v) for v in row] for row in words)
    expected = []
    for i in range(50):
        v = [(k * 1664525 + 1013904223) % 2**32 for k in (x[i], y[i], z[i], w[i])]
        for final in (False, True):
            v[0] = (v[0] + v[1] * v[3]) % 2**32
            v[1] = (v[1] + v[2] * v[0]) % 2**32
            v[2] = (v[2] + v[0] * v[1]) % 2**32
            v[3] = (v[3] + v[1] * v[2]) % 2**32
            if not final:
                v = [k ^ (k >> 16) for k in v]
        expected.append(v)
    np.testing.assert_array_equal(np.transpose(pcg4d(*map(UInt32, (x, y, z, w)))), expected)


@pytest.mark.parametrize("float_type", [Float, Float64])
def test_normals_are_independent_standard_normal_numbers(float_type):
    count = 20_000
    draws = [
        np.array(
            normals(
                float_type, dr.arange(UInt32, count), dr.opaque(UInt32, i), dr.opaque(UInt32, seed)
            )
        ).T
        for i, seed in ((1, 0), (2, 0), (1, 1))
    ]
    columns = np.concatenate(draws, axis=1)
    for column in columns.T:
        # Kolmogorov and Smirnov; one in 10,000 would fail.
        assert stats.kstest(column, "norm").pvalue > 1e-4
    # Correlations of independent numbers have the standard deviation 1 / sqrt(count).
    correlations = np.corrcoef(columns.T) - np.eye(9)
    assert np.abs(correlations).max() < 5 / np.sqrt(count)
    lagged = [np.corrcoef(column[1:], column[:-1])[0, 1] for column in columns.T]
    assert np.abs(lagged).max() < 5 / np.sqrt(count)


def test_normals_have_the_same_bits_with_any_number_of_threads():
    threads, found = dr.thread_count(), set()
    try:
        for count in (1, 2):
            dr.set_thread_count(count)
            rows, key = dr.arange(UInt32, 10_000), dr.opaque(UInt32, 9)
            found.add(np.array(normals(Float, rows, key, key)).tobytes())
    finally:
        dr.set_thread_count(threads)
    assert len(found) == 1
