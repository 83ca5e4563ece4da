"""The last phase of a population: when it acts, and what it removes."""

import numpy as np
import pytest
from scipy.special import expit, logit
from support.populations import make, moments, rows_of, values

from drgs.config.changes import with_changes, with_iterations
from drgs.config.schema import FitConfig
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.training.density.pruning import MAX_PRESSURE, NaturalSelection, keep_best

SIZE = 0.05


def config_of(iterations=4000, grows_until=2000, **prune):
    return FitConfig(
        data={"path": "."}, iterations=iterations, densify={"stop": grows_until, "prune": prune}
    )


def test_the_phase_follows_growth_and_leaves_half_of_what_is_left():
    schedule = NaturalSelection(config_of(to=100))
    assert (schedule.start, schedule.stop) == (2000, 3000)
    config = FitConfig(data={"path": "."}, densify={"prune": {"to": 9}})
    reference = NaturalSelection(config)
    assert (reference.start, reference.stop) == (22_500, 26_250)
    assert [i for i in range(5000) if schedule.is_due(i)] == list(range(2050, 3001, 50))
    config = config_of(to=100, start=2500, stop=2730, every=100)
    assert [i for i in range(5000) if NaturalSelection(config).is_due(i)] == [2600, 2700, 2730]
    later = NaturalSelection(with_changes(config, {"densify.stop": 2600}))
    assert (later.start, later.stop) == (2600, 2730)
    # Each change leaves the same share, and the last one the number.
    schedule = NaturalSelection(config_of(to=100, start=1000, stop=1400, grows_until=900))
    wanted = [schedule.goal(i, 1600) for i in (1100, 1200, 1300, 1400)]
    assert wanted == [800, 400, 200, 100]
    assert schedule.goal(1100, 100) == schedule.goal(1100, 50) == 100


def test_the_best_stay_in_their_order_with_their_moments():
    optimizer = make([SIZE] * 6, 0.5)
    before = values(optimizer)
    former = {name: moments(optimizer, name) for name in PARAMETER_NAMES}
    report = keep_best(rows_of(optimizer), np.array([3.0, np.nan, 1.0, 7.0, 1.0, 0.5]), 3)
    assert (report.pruned, report.num_gaussians) == (3, 3)
    for name, value in values(optimizer).items():
        np.testing.assert_array_equal(value, before[name][[0, 2, 3]])
        for moment, expected in zip(moments(optimizer, name), former[name], strict=True):
            np.testing.assert_array_equal(moment, expected[[0, 2, 3]])


def test_as_many_fall_below_the_threshold_as_are_to_go():
    random = np.random.default_rng(0)
    opacities = random.uniform(0.005, 0.02, 200)
    optimizer = make([SIZE] * 200, opacities)
    before = values(optimizer)
    former = moments(optimizer, "logit_opacities")
    phase = NaturalSelection(config_of(to=50))
    report = phase.refine(rows_of(optimizer), 2500)
    left = round(200 * 0.25**0.5)
    assert (report.pruned, report.num_gaussians) == (200 - left, left)
    kept = np.sort(np.argsort(-opacities)[:left])
    after = values(optimizer)
    np.testing.assert_array_equal(after["means"], before["means"][kept])
    # All are lowered alike: the most opaque of those that go is at the threshold.
    pressure = logit(np.sort(opacities)[200 - left - 1]) - logit(0.005)
    expected = logit(opacities[kept]) - pressure
    np.testing.assert_allclose(after["logit_opacities"], expected, atol=1e-5)
    assert expit(after["logit_opacities"]).min() > 0.005
    for moment, expected in zip(moments(optimizer, "logit_opacities"), former, strict=True):
        np.testing.assert_array_equal(moment, expected[kept])


def test_in_the_end_exactly_so_many_are_left():
    opacities = np.linspace(0.3, 0.9, 20)
    optimizer = make([SIZE] * 20, opacities)
    before = values(optimizer)["means"]
    phase = NaturalSelection(config_of(to=5))
    report = phase.refine(rows_of(optimizer), 3000)
    assert report.num_gaussians == 5
    np.testing.assert_array_equal(values(optimizer)["means"], before[15:])
    assert not any(phase.is_due(i) for i in range(5000))


def test_opacities_are_faster_while_they_are_under_pressure():
    phase = NaturalSelection(config_of(to=5))
    optimizer = make([SIZE] * 20, 0.5)

    def factors():
        return [phase.rate_factors(i)["logit_opacities"] for i in (1000, 2060, 2999, 3001)]

    assert factors() == [1, 1, 1, 1]
    assert phase.refine(rows_of(optimizer), 2050) is None  # the pressure is limited
    logits = values(optimizer)["logit_opacities"]
    np.testing.assert_allclose(logits, -MAX_PRESSURE, rtol=1e-6)
    assert factors() == [1, 4, 4, 1]
    phase.refine(rows_of(optimizer), 3000)
    assert factors() == [1, 1, 1, 1]


@pytest.mark.parametrize("seed", range(6))
def test_random_populations_end_with_the_number(seed):
    random = np.random.default_rng(seed)
    num, to = map(int, random.integers(4, 100, 2))  # both more and fewer than the number
    phase = NaturalSelection(config_of(to=to))
    optimizer = make([SIZE] * num, random.uniform(0.001, 0.99, num), seed=seed)
    rows, left, before = rows_of(optimizer), num, values(optimizer)
    for iteration in range(2000, 3001):
        if phase.is_due(iteration):
            report = phase.refine(rows, iteration)
            assert min(num, to) <= rows.num_rows <= left
            assert report is None or report.pruned == left - rows.num_rows
            left = rows.num_rows
    assert left == min(num, to)
    for name, value in values(optimizer).items():
        assert num > to or np.array_equal(value, before[name])  # too few: nothing changes


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"stop": 1999}, r"prune\.stop must be > densify\.stop"),
        ({"iterations": 2000}, r"densify\.stop must be < iterations \(2000\), .* got 2000"),
        ({"start": 4000}, r"densify\.prune\.start must be < iterations \(4000\), .* got 4000"),
        ({"stop": 4001}, r"densify\.prune\.stop must be <= iterations \(4000\), got 4001"),
    ],
)
def test_a_phase_that_would_not_be_over_in_time_is_refused(values, message):
    with pytest.raises(ValueError, match=message):
        config_of(to=5, **values)


def test_the_phase_keeps_its_share_of_a_longer_fit():
    config = with_iterations(config_of(to=5, start=2500, stop=3000), 8000)
    assert config.densify.prune_window(8000) == (5000, 6000)
    config = with_iterations(config_of(to=5), 8000)
    assert config.densify.prune_window(8000) == (4000, 6000)
    assert config.densify.first_fixed_iteration(8000) == 6001
    assert config_of().densify.first_fixed_iteration(4000) == 2001  # growth may end at 2000
