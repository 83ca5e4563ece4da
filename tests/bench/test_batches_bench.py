"""What the comparison of views a step compares."""

import pytest

from drgs.bench.batches import RULES, VIEWS, cases, table
from drgs.bench.ingredients import LEGO, WHOLE, config_of
from drgs.bench.recipes import Point
from drgs.training.rates import learning_rates


def configs():
    return {case.name: config_of(case, LEGO) for case in cases()}


def test_one_view_a_step_is_the_whole_recipe():
    assert configs()[f"1 a step: {RULES[0].name}"] == config_of(WHOLE, LEGO)


def test_rules_give_the_rates_and_decays_that_they_name():
    plain = config_of(WHOLE, LEGO).optimizer
    by_name = configs()
    for rule, factor, power in zip(RULES, (2, 2, 4, 1), (4, 1, 4, 1), strict=True):
        optimizer = by_name[f"4 a step: {rule.name}"].optimizer
        assert optimizer.views_per_step == 4
        expected = {name: factor * rate for name, rate in learning_rates(plain, 2.0).items()}
        assert learning_rates(optimizer, 2.0) == pytest.approx(expected)
        # What a step takes of the decays that are configured: see Trainer.
        assert optimizer.beta_1**4 == pytest.approx(plain.beta_1**power)
        assert optimizer.beta_2**4 == pytest.approx(plain.beta_2**power)


def test_a_table_has_a_row_for_each_case():
    points = [Point("lego", case.name, 0, 30.0, 0.9, 10, 10, 1.0, None) for case in cases()]
    rows = table(points).splitlines()
    assert len(rows) == 2 + len(cases()) and len(cases()) == len(VIEWS) + 6
    assert rows[2] == "| 1 | rates x sqrt(B), beta^B | 30.00 dB |"
