"""Adaptive density control against the rules of the 3DGS reference, written out row by row."""

import math

import drjit as dr
import numpy as np
import pytest
from drjit.llvm.ad import Array2f, Bool, Float, TensorXf, TensorXf64
from support.populations import EXTENT, assert_standard_normal, make, moments, rows_of, values

from drgs.config.schema import DensifyConfig
from drgs.core.errors import UserError
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from drgs.training.density.adc import AdaptiveDensityControl, AdcConfig
from drgs.training.density.strategy import StepInfo

EARLY, LATE = 600, 3100  # before and after the first opacity reset of the default schedule
SMALL, LARGE = 0.01, 0.2  # world units: cloned, split
HIGH = 3e-4  # a mean gradient norm above the default threshold of 2e-4


def config_of(max_gaussians=1_000_000, **adc):
    return DensifyConfig(max_gaussians=max_gaussians), AdcConfig(**adc)


def run(optimizer, gradient_norms, iteration=EARLY, seed=0, **config):
    norms = np.asarray(gradient_norms, np.float32)
    strategy = AdaptiveDensityControl(
        *config_of(**config), False, Float(4 * norms), dr.full(Float, 4, len(norms))
    )
    return strategy.densify_and_prune(rows_of(optimizer, seed), iteration)


@pytest.mark.parametrize("as_tensor", [False, True])
def test_statistics_are_gradient_norms_in_ndc_over_visible_views(as_tensor):
    width, height, num = 40, 26, 5
    random = np.random.default_rng(0)
    gradients = random.standard_normal((3, num, 2))
    visible = random.random((3, num)) < 0.6
    visible[:, 2] = False
    gradients[~visible] = np.nan
    result = AdaptiveDensityControl(*config_of())
    result.begin(rows_of(make([SMALL] * num, 0.5)))
    for gradient, is_seen in zip(gradients, visible, strict=True):
        pixel = TensorXf(gradient) if as_tensor else Array2f(gradient.T)
        result.update_statistics(StepInfo(1, width, height, pixel, Bool(is_seen), {}))

    # d/dx_ndc = d/dx_px * W / 2, because x_ndc spans 2 over W pixels.
    norms = np.linalg.norm(gradients * [width / 2, height / 2], axis=2)
    np.testing.assert_array_equal(result.views, visible.sum(0))
    np.testing.assert_allclose(result.gradient_norms, np.nansum(norms, axis=0), rtol=1e-6)


@pytest.mark.parametrize(("white", "first"), [(False, 20), (True, 20), (True, None)])
def test_schedule_matches_the_reference_training_loop(white, first):
    adc = {"reset_every": 60, "white_background_reset": first}
    config = DensifyConfig(start=20, stop=200, every=10)
    strategy = AdaptiveDensityControl(config, AdcConfig(**adc), white)
    for i in range(1, 300):
        densify = reset = False
        if i < 200:
            densify = i > 20 and i % 10 == 0
            reset = i % 60 == 0 or (white and i == first)
        assert strategy.densifies(i) == densify, i
        assert strategy.resets(i) == reset, i
        assert strategy.is_due(i) == (densify or reset), i
        assert strategy.needs_statistics(i) == (i < 200), i


def test_samples_have_the_mean_and_covariance_of_their_parent():
    count = 20_000
    optimizer = make([LARGE, LARGE], 0.5, tensor_type=TensorXf64)
    before = values(optimizer)
    run(optimizer, [0, HIGH], split_count=count)
    samples = values(optimizer)["means"][1:]
    assert samples.shape == (count, 3)
    covariance = reference.covariances(before["quats"], before["log_scales"])[1]
    # In the parent's own axes.
    whiten = np.linalg.inv(np.linalg.cholesky(covariance))
    assert_standard_normal((samples - before["means"][1]) @ whiten.T)


def test_thresholds_compare_like_in_the_reference():
    # Gradient >= threshold, scale <= clone_scale x extent, opacity < prune_opacity. Powers of
    # two, so that all are exact.
    config = {"grad_threshold": 2**-12, "clone_scale": 2**-7, "prune_opacity": 0.25}
    edge = 2**-7 * EXTENT
    optimizer = make([edge, edge * 1.001, edge], 0.5, tensor_type=TensorXf64)
    report = run(optimizer, [2**-12, 2**-12, 2**-12 * 0.999], **config, reset_opacity=0.3)
    assert (report.cloned, report.split, report.pruned) == (1, 1, 0)

    optimizer = make([SMALL, SMALL], [0.2501, 0.2499])
    assert run(optimizer, [0, 0], **config, reset_opacity=0.3).pruned == 1


def test_last_gaussian_is_not_pruned_silently():
    optimizer = make([SMALL, SMALL], 0.001)
    with pytest.raises(UserError, match="iteration 600: every Gaussian would be pruned"):
        run(optimizer, [HIGH, 0])
    assert rows_of(optimizer).num_rows == 2


def naive_decisions(norms, scales, opacities, large_is_pruned, config, settings):
    """The rules, one Gaussian after the other: (kept, cloned, split) row numbers."""
    limit = settings.prune_scale * EXTENT if large_is_pruned else math.inf
    kinds = []
    for norm, scale, opacity in zip(norms, scales, opacities, strict=True):
        if not opacity >= settings.prune_opacity:  # also NaN
            kinds.append("prune")
        elif norm >= settings.grad_threshold:
            kinds.append("clone" if scale <= settings.clone_scale * EXTENT else "split")
        else:
            kinds.append("prune" if scale > limit else "keep")
    room = config.max_gaussians - sum(kind != "prune" for kind in kinds)
    candidates = [i for i, kind in enumerate(kinds) if kind in ("clone", "split")]
    full = False
    for i in sorted(candidates, key=lambda i: (-norms[i], i)):
        cost = 1 if kinds[i] == "clone" else settings.split_count - 1
        full = full or cost > room
        if full:
            kinds[i] = "prune" if scales[i] > limit else "keep"
        else:
            room -= cost
    rows = {kind: [i for i, k in enumerate(kinds) if k == kind] for kind in set(kinds)}
    kept = sorted(rows.get("keep", []) + rows.get("clone", []))
    return kept, rows.get("clone", []), rows.get("split", [])


@pytest.mark.parametrize("seed", range(12))
def test_random_populations_follow_rules_and_cap(seed):
    random = np.random.default_rng(seed)
    num = 60
    # float32, as in the statistics; coarse steps make ties.
    norms = (random.integers(0, 8, num) * 1e-4).astype(np.float32)
    scales = np.exp(random.uniform(np.log(0.005), np.log(2), num))
    opacities = np.where(random.random(num) < 0.2, 0.001, random.uniform(0.01, 0.9, num))
    opacities[random.random(num) < 0.1] = norms[random.random(num) < 0.1] = np.nan
    config = {
        "max_gaussians": int(random.integers(50, 110)),
        "split_count": int(random.integers(2, 5)),
    }
    iteration = random.choice([EARLY, LATE])
    optimizer = make(scales, opacities)
    before = values(optimizer)
    report = run(optimizer, norms, iteration=iteration, seed=seed, **config)
    after = values(optimizer)

    config, settings = config_of(**config)
    kept, cloned, split = naive_decisions(
        norms.astype(float), scales, opacities, iteration == LATE, config, settings
    )
    parents = [*kept, *cloned, *np.repeat(split, settings.split_count)]
    assert report.num_gaussians == rows_of(optimizer).num_rows == len(parents)
    assert report.num_gaussians <= max(config.max_gaussians, len(kept))
    assert (report.cloned, report.split) == (len(cloned), len(split))
    assert report.pruned == num - len(kept) - len(split)
    assert report.num_added == report.num_gaussians - num + report.pruned
    same = len(kept) + len(cloned)
    for name in PARAMETER_NAMES:
        is_sampled = name in ("means", "log_scales")
        rows = slice(same if is_sampled else None)
        np.testing.assert_array_equal(after[name][rows], before[name][parents][rows])
        for moment in moments(optimizer, name):
            assert moment[: len(kept)].all()
            assert not moment[len(kept) :].any()
    shrunk = before["log_scales"][parents[same:]] - math.log(1.6)
    # 1e-6: single precision of a logarithm.
    np.testing.assert_allclose(after["log_scales"][same:], shrunk, rtol=0, atol=1e-6)
    assert len(np.unique(after["means"][same:], axis=0)) == len(parents) - same


def test_equal_seeds_give_equal_bytes():
    def population(seed, iteration):
        optimizer = make([LARGE, SMALL, LARGE], 0.5)
        run(optimizer, [HIGH] * 3, iteration=iteration, seed=seed)
        return b"".join(value.tobytes() for value in values(optimizer).values())

    first = population(3, EARLY)
    assert population(3, EARLY) == first
    assert population(4, EARLY) != first
    assert population(3, EARLY + 100) != first


def test_reset_lowers_opacities_and_clears_only_their_moments():
    config, settings = config_of()
    optimizer = make([SMALL] * 3, [0.9, 0.01001, 0.007])
    before, (means_m, _) = values(optimizer), moments(optimizer, "means")
    AdaptiveDensityControl(config, settings).reset_opacities(rows_of(optimizer))
    after = values(optimizer)
    opacities = reference.sigmoid(after["logit_opacities"].astype(float))
    # 1e-6: single precision of a logit of -4.6.
    np.testing.assert_allclose(opacities, [0.01, 0.01, 0.007], rtol=1e-6)
    assert after["logit_opacities"][2] == before["logit_opacities"][2]
    for moment in moments(optimizer, "logit_opacities"):
        assert not moment.any()
    np.testing.assert_array_equal(moments(optimizer, "means")[0], means_m)
    assert optimizer.state["logit_opacities"][3][0][0] == 1
    # No Gaussian falls below the prune threshold by being reset.
    assert run(optimizer, [0, 0, 0]).pruned == 0
