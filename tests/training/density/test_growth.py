"""The strategy budget against its rules, written out in numpy."""

import math

import numpy as np
import pytest
from drjit.llvm.ad import Float, TensorXf, TensorXf64
from hypothesis import given
from hypothesis import strategies as st
from support.helpers import examples
from support.populations import make, rows_of, values
from support.trainers import make_trainer

from drgs.config.density import DensifyConfig
from drgs.config.schema import CoarseStage
from drgs.core.errors import UserError
from drgs.reference import splatting as reference
from drgs.training.density.budget import BudgetConfig, GrowthToNumber, halves


def strategy(optimizer, errors, first=None, **config):
    values = {"strategy": "budget", "start": 100, "stop": 1000, "every": 50, **config}
    config = DensifyConfig.model_validate(values)
    made = GrowthToNumber(config, config.section("budget", BudgetConfig))
    made.first = first or rows_of(optimizer).num_rows
    made.errors = Float(np.asarray(errors, np.float32))
    return made


def test_gaussians_with_the_largest_errors_are_split():
    optimizer = make([0.1] * 6, [0.5] * 6)
    before = values(optimizer)
    # Half of the way from 6 to 9 after half of two thirds of the time: 7.5, even: 8.
    growth = strategy(optimizer, [1, 5, 3, 0, 4, 2], budget={"gaussians": 9})
    report = growth.refine(rows_of(optimizer), 400)
    assert (report.num_gaussians, report.split, report.pruned, report.refused) == (8, 2, 0, 0)
    after = values(optimizer)
    assert np.array_equal(after["sh0"][:4], before["sh0"][[0, 2, 3, 5]])
    assert np.array_equal(after["sh0"][4:], before["sh0"][[1, 4, 1, 4]])
    assert np.array(growth.errors).tolist() == [0] * 8  # and starts again
    # The last change is at the end, wherever the intervals between the others lead.
    optimizer = make([0.1] * 6, [0.5] * 6)
    growth = strategy(optimizer, [1, 5, 3, 0, 4, 2], budget={"gaussians": 9}, stop=325)
    assert [k for k in range(1, 500) if growth.is_due(k)] == [150, 200, 250, 300, 325]
    assert growth.refine(rows_of(optimizer), 325).num_gaussians == 9


def test_equal_errors_are_split_by_index_and_zero_errors_never():
    optimizer = make([0.1] * 5, [0.5] * 5)
    before = values(optimizer)["sh0"]
    growth = strategy(optimizer, [0, 2, 2, 2, 0], budget={"gaussians": 7})
    assert growth.refine(rows_of(optimizer), 1000).split == 2
    assert np.array_equal(values(optimizer)["sh0"][3:5], before[[1, 2]])
    optimizer = make([0.1] * 5, [0.5] * 5)
    growth = strategy(optimizer, np.zeros(5), budget={"gaussians": 50})
    assert growth.refine(rows_of(optimizer), 1000).num_gaussians == 5


def test_transparent_gaussians_are_removed_and_replaced_unless_all_are():
    scales, opacities = [0.1, 0.1, 0.1, 4.1, 0.1], [0.5, 0.0049, np.nan, 0.5, 0.0051]
    optimizer = make(scales, opacities)
    before = values(optimizer)["sh0"]
    budget = {"gaussians": 5, "prune_opacity": 0.005}
    report = strategy(optimizer, [1, 9, 9, 2, 0.5], budget=budget).refine(rows_of(optimizer), 500)
    assert (report.num_gaussians, report.split, report.pruned) == (5, 2, 2)
    after = values(optimizer)["sh0"]
    assert np.array_equal(after, before[[4, 0, 3, 0, 3]])
    optimizer = make([0.1] * 3, [0.001] * 3)
    with pytest.raises(UserError, match=r"every Gaussian would be pruned .*budget\.prune_opacity"):
        strategy(optimizer, [1, 1, 1], budget={"gaussians": 5}).refine(rows_of(optimizer), 500)


@pytest.mark.parametrize("tensor_type", [TensorXf, TensorXf64])
def test_halves_are_on_both_sides_along_the_longest_axis(tensor_type):
    optimizer = make([0.1, 0.2, 0.05], [0.5, 0.9, 0.01], tensor_type=tensor_type)
    before = {name: value.astype(float) for name, value in values(optimizer).items()}
    rows = np.array([0, 2])
    got = {k: np.array(v, np.float64) for k, v in halves(rows_of(optimizer), rows).items()}
    rotations = reference.quat_to_rotation(before["quats"])
    # Some ten operations on numbers of order 1, each rounded by 6e-8 or 1e-16.
    tolerance = 1e-6 if tensor_type is TensorXf else 1e-14
    for k, (row, side) in enumerate([(0, 1), (2, 1), (0, -1), (2, -1)]):
        longest = int(np.argmax(before["log_scales"][row]))
        sigma = math.exp(before["log_scales"][row, longest])
        mean = before["means"][row] + side * 1.35 * sigma * rotations[row][:, longest]
        np.testing.assert_allclose(got["means"][k], mean, atol=10 * tolerance)
        factors = np.full(3, 0.893)
        factors[longest] = 0.55
        expected = np.exp(before["log_scales"][row]) * factors
        np.testing.assert_allclose(np.exp(got["log_scales"][k]), expected, rtol=10 * tolerance)
        opacity = reference.sigmoid(got["logit_opacities"][k])
        parent = reference.sigmoid(before["logit_opacities"][row])
        np.testing.assert_allclose(opacity, 0.6 * parent, rtol=10 * tolerance)
        for name in ("quats", "sh0", "shN"):
            assert np.array_equal(got[name][k], before[name][row])


@examples
@given(
    seed=st.integers(0, 1000),
    num=st.integers(1, 20),
    target=st.integers(4, 60),
    cap=st.integers(4, 60),
    iteration=st.integers(101, 1000),
)
def test_growth_exceeds_neither_curve_nor_cap(seed, num, target, cap, iteration):
    random = np.random.default_rng(seed)
    optimizer = make(random.uniform(0.01, 0.5, num), random.uniform(0.001, 0.9, num))
    growth = strategy(
        optimizer,
        random.choice([0.0, 1.0, 2.0], num),
        budget={"gaussians": target},
        max_gaussians=cap,
    )
    try:
        report = growth.refine(rows_of(optimizer), iteration)
    except UserError:
        return
    u = min(1, 1.5 * (iteration - 100) / 900)
    on_curve = num + max(target - num, 0) * u
    assert report.num_gaussians == rows_of(optimizer).num_rows
    assert report.num_gaussians <= max(num, min(on_curve + 1, cap))
    assert report.num_gaussians == num + report.num_added - report.pruned
    assert growth.max_num_gaussians(num, 1000) >= report.num_gaussians


@pytest.mark.parametrize(("every", "stop", "error_every"), [(4, 26, 10), (2, 12, 5), (100, 30, 7)])
def test_each_change_has_accumulated_errors(every, stop, error_every):
    """If there were none since the last change, errors of its own view are used."""
    budget = {"gaussians": 70, "error_every": error_every}
    config = DensifyConfig(start=1, stop=stop, every=every, budget=budget)
    growth, seen = GrowthToNumber(config, config.section("budget", BudgetConfig)), 0
    for iteration in range(1, stop + 5):
        seen += growth.needs_statistics(iteration)
        if growth.is_due(iteration):
            assert seen > 0
            seen = 0
    assert seen == 0


def test_target_is_reached_with_coarse_images_until_the_end_of_growth():
    coarse = [CoarseStage(until=1000, factor=2)]
    config = DensifyConfig(start=100, stop=1000, every=100)
    growth = GrowthToNumber(config, BudgetConfig(gaussians=90), coarse, first=50)
    early, late = (50 + round(40 * u / 2 ** (2 - u)) for u in (1 / 3, 1))
    assert [growth.goal(i) for i in (300, 700, 900, 1000)] == [early, late, late, 90]


@pytest.mark.slow
def test_coarse_images_have_fewer_gaussians_and_a_constant_means_rate():
    coarse = [{"until": 9, "factor": 4}, {"until": 17, "factor": 2}]
    budget = {"gaussians": 70, "error_every": 3}
    densify = {"strategy": "budget", "start": 4, "stop": 24, "every": 4, "budget": budget}
    trainer, counts, rates = make_trainer(densify=densify, coarse=coarse), [], []
    for _ in range(50):
        report = trainer.step()
        counts.append(report.num_gaussians)
        rates.append(report.means_lr)
    expected = []
    for i, r in ((8, 4), (12, 2), (16, 2), (20, 1), (24, 1)):
        u = min(1, 1.5 * (i - 4) / 20)
        expected.append(40 + 30 * u / r ** (2 - u))
    assert counts[7:24:4] == pytest.approx(expected, abs=1)
    first = 3.2e-4 * trainer.extent
    assert rates[:17] == pytest.approx([first] * 17)
    assert rates[17:] == pytest.approx([first * 100 ** (-k / 33) for k in range(1, 34)])


def test_default_number_follows_from_the_image_size():
    trainer = make_trainer(densify={"strategy": "budget"})
    assert trainer.config.densify.budget.gaussians == round(250 * math.sqrt(20 * 16))


def test_half_of_an_opacity_of_one_has_a_logit():
    optimizer = make([0.1], 0.5)
    optimizer["logit_opacities"] = Float([60.0])  # an opacity that is 1 in double precision
    got = halves(rows_of(optimizer), np.array([0]))["logit_opacities"]
    assert reference.sigmoid(np.array(got, np.float64)) == pytest.approx(0.6)
