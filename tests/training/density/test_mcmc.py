"""Relocation, growth, noise, regularisers and draws of the strategy ``mcmc``."""

import math
from functools import partial

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Float, Float64, TensorXf64, UInt32
from scipy import stats
from scipy.integrate import quad
from scipy.special import expit
from support.kernels import kernel_hashes
from support.populations import EXTENT, assert_standard_normal, make, moments, rows_of, values

from drgs.config.density import DensifyConfig
from drgs.core.errors import UserError
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.training.density.mcmc import (
    MAX_COPIES,
    MarkovChain,
    McmcConfig,
    correct_copies,
    normals,
    pcg4d,
    sample_in_proportion,
)

SIZE, DEAD = 0.05, 0.001


def strategy(max_gaussians=1_000_000, **mcmc):
    """Copies lie where their sources are, unless the test is about that."""
    mcmc = {"gaussians": 100_000, "spread": 0.0} | mcmc
    config = DensifyConfig(start=500, stop=15_000, max_gaussians=max_gaussians)
    result = MarkovChain(config, McmcConfig(**mcmc))
    result.begin(rows_of(make([SIZE], 0.5)))
    return result


def act(optimizer, iteration=600, seed=0, **config):
    return strategy(**config).refine(rows_of(optimizer, seed), iteration)


@pytest.mark.parametrize("opacity", [0.006, 0.1, 0.5, 0.99, 0.9999])
@pytest.mark.parametrize("count", [1, 2, 3, 10, MAX_COPIES])
def test_copies_composite_to_the_original_opacity(opacity, count):
    (copies,), (factor,) = correct_copies(np.array([opacity]), np.array([count]))
    assert 1 - (1 - copies) ** count == pytest.approx(opacity, rel=1e-12)
    # Along a line through the centre, x in standard deviations of the copies: as much in all.
    composited, _ = quad(
        lambda x: 1 - (1 - copies * math.exp(-x * x / 2)) ** count, -40, 40, epsabs=1e-13, limit=400
    )
    assert factor * composited == pytest.approx(opacity * math.sqrt(2 * math.pi), rel=1e-9)


def test_transparent_gaussians_become_copies_of_opaque_ones():
    optimizer = make([SIZE] * 6, [0.5, DEAD, 0.0051, DEAD, 0.6, DEAD], tensor_type=TensorXf64)
    before, kept_moments = values(optimizer), moments(optimizer, "quats")
    report = act(optimizer, growth=0.0, seed=1)
    after = values(optimizer)
    assert (report.relocated, report.num_added, report.pruned, report.num_gaussians) == (3, 0, 0, 6)

    # Three draws in proportion to 0.5, 0.0051, 0.6.
    sources = [int(np.argmin(np.abs(before["quats"][:, 0] - q))) for q in after["quats"][:, 0]]
    counts = np.bincount(sources, minlength=6)
    assert not counts[[1, 3, 5]].any()
    assert [row for row in (0, 2, 4) if counts[row] == 1] == [2]  # the others are drawn
    assert sources[:3] == [2, 0, 4]
    for name in ("means", "quats", "sh0", "shN"):
        np.testing.assert_array_equal(after[name], before[name][sources])
    opacities = expit(before["logit_opacities"])[sources]
    expected, factors = correct_copies(opacities, counts[sources])
    np.testing.assert_allclose(expit(after["logit_opacities"]), expected, rtol=1e-12)
    np.testing.assert_allclose(
        np.exp(after["log_scales"] - before["log_scales"][sources]),
        np.repeat(factors[:, None], 3, axis=1),
        rtol=1e-12,
    )
    for name in PARAMETER_NAMES:
        for moment in moments(optimizer, name):
            assert not moment[1:].any()
    for moment, former in zip(moments(optimizer, "quats"), kept_moments, strict=True):
        np.testing.assert_array_equal(moment[0], former[2])


def test_copies_are_sampled_from_the_covariance_of_their_original():
    num, opacity = 4000, 0.7
    optimizer = make(np.full(num, 0.3), opacity, tensor_type=TensorXf64)
    before = values(optimizer)
    assert act(optimizer, growth=1.0, spread=0.5).num_added == num
    after = values(optimizer)["means"]
    np.testing.assert_array_equal(after[:num], before["means"])  # all are drawn once
    _, factors = correct_copies(np.array([opacity]), np.array([2]))
    covariances = reference.covariances(before["quats"], before["log_scales"])
    whiten = np.linalg.inv(np.linalg.cholesky((0.5 * factors[0]) ** 2 * covariances))
    normal = (whiten @ (after[num:] - before["means"])[..., None])[..., 0]
    assert_standard_normal(normal)


def test_nearly_transparent_gaussians_stay_transparent_when_copied():
    optimizer = make([SIZE] * 3, [DEAD, DEAD, 0.006])
    act(optimizer, growth=0.0)
    np.testing.assert_allclose(expit(values(optimizer)["logit_opacities"]), 0.005, rtol=1e-5)
    with pytest.raises(UserError, match="iteration 600: no Gaussian is more opaque than"):
        act(make([SIZE] * 3, DEAD))


def test_population_above_the_cap_loses_transparent_gaussians():
    optimizer = make([SIZE] * 10, [0.5] * 6 + [DEAD] * 4)
    report = act(optimizer, gaussians=8)
    assert (report.pruned, report.relocated, report.num_added) == (2, 2, 0)
    assert report.num_gaussians == 8
    optimizer = make([SIZE] * 10, [0.5] * 9 + [DEAD])
    report = act(optimizer, gaussians=8)
    assert (report.pruned, report.relocated, report.num_gaussians) == (1, 0, 9)


@pytest.mark.parametrize("seed", range(10))
def test_random_populations_respect_both_caps(seed):
    random = np.random.default_rng(seed)
    num = int(random.integers(1, 60))
    opacities = np.where(random.random(num) < 0.4, DEAD, random.uniform(0.01, 0.99, num))
    opacities[random.random(num) < 0.1] = np.nan
    opacities[0] = 0.5
    config = {
        "gaussians": int(random.integers(4, 70)),
        "max_gaussians": int(random.integers(4, 70)),
        "growth": float(random.uniform(0, 0.5)),
    }
    optimizer = make([SIZE] * num, opacities, seed=seed)
    report = act(optimizer, seed=seed, **config)
    alive = int((opacities > 0.005).sum())
    cap = min(config["gaussians"], config["max_gaussians"])
    after = values(optimizer)
    assert report.num_gaussians == len(after["means"]) <= max(alive, cap)
    assert report.num_gaussians == num + report.num_added - report.pruned
    assert report.num_added <= max(config["growth"] * num, 1)
    assert all(np.isfinite(value).all() for value in after.values())
    assert strategy(**config).max_num_gaussians(num, 30_000) >= report.num_gaussians


def test_noise_follows_the_covariance_of_transparent_gaussians():
    num, rate, seed, iteration = 4000, 1e-3, 7, 12
    optimizer = make(np.full(num, 0.3), 0.02, tensor_type=TensorXf64)
    before = values(optimizer)
    chain = strategy(noise_lr=2e3)
    chain.perturb(rows_of(optimizer, seed), iteration, rate)
    after = values(optimizer)
    for name in PARAMETER_NAMES:
        assert (name == "means") == (after[name] != before[name]).any()
    covariances = reference.covariances(before["quats"], before["log_scales"])
    fading = 1 / (1 + math.exp(100 * (0.02 - 0.005)))
    factor = 2e3 * rate / EXTENT**2 * fading
    normal = np.linalg.solve(factor * covariances, (after["means"] - before["means"])[..., None])
    assert_standard_normal(normal[..., 0])


def test_opaque_gaussians_get_no_noise_and_moments_stay():
    optimizer = make([SIZE, SIZE, 1e30], [0.9, 0.001, 0.001])
    before, former = values(optimizer)["means"], moments(optimizer, "means")
    strategy().perturb(rows_of(optimizer), 1, 1e-3)
    after = values(optimizer)["means"]
    np.testing.assert_array_equal(after[0], before[0])
    assert (after[1] != before[1]).all() and np.isfinite(after).all()
    for moment, expected in zip(moments(optimizer, "means"), former, strict=True):
        np.testing.assert_array_equal(moment, expected)


def test_penalties_are_mean_opacity_and_mean_scale():
    optimizer = make([0.1, 0.2, 0.4], [0.1, 0.5, 0.9], tensor_type=TensorXf64)
    parameters = dict(optimizer.items())
    terms = list(strategy(opacity_weight=0.3, scale_weight=0.7).penalties(parameters, 3))
    before = values(optimizer)
    opacities, scales = expit(before["logit_opacities"]), np.exp(before["log_scales"])
    expected = 0.3 * opacities.mean(), 0.7 * scales.mean() / EXTENT
    np.testing.assert_allclose([float(term[0]) for term in terms], expected, rtol=1e-12)

    dr.set_grad(optimizer, 0)
    dr.backward(terms[0] + terms[1])
    slopes = 0.3 * opacities * (1 - opacities) / 3
    np.testing.assert_allclose(dr.grad(parameters["logit_opacities"]), slopes, rtol=1e-12)
    d_scales = np.array(dr.grad(parameters["log_scales"]))
    np.testing.assert_allclose(d_scales, 0.7 * scales / EXTENT / 9, rtol=1e-12)
    assert not list(strategy(opacity_weight=0.0, scale_weight=0.0).penalties(parameters, 3))


def test_extreme_numbers_and_opacities_have_finite_copies():
    for numbers in correct_copies(np.array([0.7] * 2), np.array([1000, MAX_COPIES])):
        assert numbers[0] == numbers[1]
    copies, factors = correct_copies(np.array([1.0]), np.array([2]))
    assert 0.99 < copies[0] < 1 and 0 < factors[0] < 1


@pytest.mark.parametrize(
    ("num", "cap", "expected"),
    # 5 % of 6 are less than one.
    [(100, 117, [105, 110, 115, 117, 117]), (6, 8, [7, 8, 8])],
)
def test_population_grows_by_a_fraction_up_to_its_cap(num, cap, expected):
    optimizer = make([SIZE] * num, 0.5)
    iterations = [100 * i for i in range(6, 6 + len(expected))]
    assert [act(optimizer, i, gaussians=cap).num_gaussians for i in iterations] == expected


@pytest.mark.parametrize("is_due", [True, False], ids=["relocated", "perturbed"])
def test_changes_are_functions_of_seed_and_iteration(is_due):
    def change(seed, iteration):
        optimizer = make([SIZE] * 40, [0.5] * 30 + [DEAD] * 10)
        if is_due:
            act(optimizer, iteration, seed)
        else:
            strategy().perturb(rows_of(optimizer, seed), iteration, 1e-3)
        return values(optimizer)["means"].tobytes()

    assert change(3, 600) == change(3, 600)
    assert len({change(3, 600), change(4, 600), change(3, 700)}) == 3


def test_noise_compiles_one_kernel():
    optimizer, chain, hashes = make([SIZE] * 5, 0.5), strategy(), set()
    for iteration in (1, 2, 3):
        arguments = rows_of(optimizer), iteration, 1e-3 / iteration
        hashes |= kernel_hashes(partial(chain.perturb, *arguments))
        assert len(hashes) == 1


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
    keys = [map(partial(dr.opaque, UInt32), key) for key in ((1, 0), (2, 0), (1, 1))]
    draws = [np.array(normals(float_type, dr.arange(UInt32, count), *key)) for key in keys]
    columns = np.concatenate(draws).T
    for column in columns.T:
        # Kolmogorov and Smirnov; one in 10,000 would fail.
        assert stats.kstest(column, "norm").pvalue > 1e-4
    # Correlations of independent numbers have the standard deviation 1 / sqrt(count).
    correlations = np.corrcoef(columns.T) - np.eye(9)
    assert np.abs(correlations).max() < 5 / np.sqrt(count)
    lagged = [np.corrcoef(column[1:], column[:-1])[0, 1] for column in columns.T]
    assert np.abs(lagged).max() < 5 / np.sqrt(count)
