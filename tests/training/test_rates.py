"""Learning rates over a fit, and steps of several views."""

import drjit as dr
import numpy as np
import pytest
from support.trainers import make_trainer

from drgs.gaussians.parameters import PARAMETER_NAMES

FIXED_POPULATION = {"start": 1, "stop": 2}
"""The population does not change."""


def rates_of(trainer):
    return {
        name: float(np.array(trainer.optimizer.state[name][2]).ravel()[0])
        for name in trainer.optimizer.state
    }


@pytest.mark.slow
def test_rates_decay_to_a_fraction_after_a_share_of_the_fit():
    trainer = make_trainer(optimizer={"decay": 0.1, "decay_from": 0.4}, densify=FIXED_POPULATION)
    rates = []
    for _ in range(50):
        trainer.step()
        rates.append(rates_of(trainer))
    config = trainer.config.optimizer
    for name, first in (("sh0", config.sh0_lr), ("log_scales", config.scales_lr)):
        measured = np.array([rate[name] for rate in rates])
        np.testing.assert_allclose(measured[:20], first, rtol=1e-6)
        # From iteration 20 to 50, in equal ratios.
        expected = first * 10 ** (-np.arange(1, 31) / 30)
        np.testing.assert_allclose(measured[20:], expected, rtol=1e-5)
    means = np.array([rate["means"] for rate in rates])
    np.testing.assert_allclose(
        means, 3.2e-4 * trainer.extent * 100.0 ** (-np.arange(1, 51) / 50), rtol=1e-5
    )


@pytest.mark.slow
def test_rates_are_constant_without_a_decay():
    trainer = make_trainer(densify=FIXED_POPULATION, optimizer={"decay": 1.0})
    before = rates_of(trainer)
    for _ in range(50):
        trainer.step()
    after = rates_of(trainer)
    assert {k: v for k, v in after.items() if k != "means"} == {
        k: v for k, v in before.items() if k != "means"
    }


@pytest.mark.slow
def test_revised_plan_keeps_past_rates():
    changes = {"optimizer": {"decay": 0.1, "decay_from": 0.2}, "densify": FIXED_POPULATION}
    trainer = make_trainer(**changes)
    past = []
    for _ in range(30):
        trainer.step()
        past.append(rates_of(trainer))
    trainer.reschedule(40, trainer.config.densify.stop)
    replayed = make_trainer(**trainer.config.model_dump(mode="json"))
    for expected in past:
        replayed.step()
        assert rates_of(replayed) == pytest.approx(expected, rel=1e-6)
    assert trainer.rates(40)["sh0"] == pytest.approx(0.1 * trainer.config.optimizer.sh0_lr)


AVERAGED_VIEWS = {"views": 3, "views_from": 0.5, "decay": 1.0}


@pytest.mark.slow
def test_step_of_several_views_uses_their_mean_gradient():
    """Iterations 27, 28, 29 -> a step at 30: Adam by hand, from gradients of single views."""
    trainer = make_trainer(optimizer=AVERAGED_VIEWS, densify=FIXED_POPULATION)
    while trainer.iteration < 27:
        trainer.step()
    name = "log_scales"
    before = np.array(dr.detach(trainer.optimizer[name]), np.float64)
    _, _, rate, (t, m, v, _) = trainer.optimizer.state[name]
    m, v = np.array(m, np.float64), np.array(v, np.float64)

    gradients = []
    for k in range(3):
        alone = make_trainer(densify=FIXED_POPULATION)
        alone.restore(trainer.state())
        alone.iteration += k
        parameters = alone.params[name]
        steps = []
        alone.optimizer.step = lambda p=parameters, s=steps: s.append(np.array(dr.grad(p)))
        alone.step()
        gradients.append(steps[0].ravel().astype(np.float64))
    for _ in range(2):
        trainer.step()
        assert np.array_equal(np.array(dr.detach(trainer.optimizer[name])), before)
    trainer.step()

    g, t = np.mean(gradients, axis=0), int(np.array(t).ravel()[0]) + 1
    m, v = 0.9 * m + 0.1 * g, 0.999 * v + 0.001 * g * g
    change = m / (1 - 0.9**t) / (np.sqrt(v / (1 - 0.999**t)) + 1e-15)
    expected = before.ravel() - float(np.array(rate).ravel()[0]) * change
    got = np.array(dr.detach(trainer.optimizer[name]), np.float64).ravel()
    # Single precision of values of about 3, and of gradients that are summed in another order.
    np.testing.assert_allclose(got, expected, atol=2e-6)
    assert np.abs(got - before.ravel()).max() > 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("stopped", [26, 27, 28, 29])
def test_fit_resumed_within_a_step_continues_to_the_same_bytes(stopped):
    uninterrupted, first = (
        make_trainer(optimizer=AVERAGED_VIEWS, densify=FIXED_POPULATION) for _ in range(2)
    )
    for _ in range(stopped):
        uninterrupted.step()
        first.step()
    second = make_trainer(optimizer=AVERAGED_VIEWS, densify=FIXED_POPULATION)
    second.restore(first.state())
    for _ in range(5):
        uninterrupted.step()
        second.step()
    expected, got = uninterrupted.gaussians(), second.gaussians()
    for name in PARAMETER_NAMES:
        assert getattr(got, name).tobytes() == getattr(expected, name).tobytes(), name


def test_views_are_averaged_only_after_the_last_density_change():
    trainer = make_trainer(optimizer={"views": 4, "views_from": 0.2}, densify={"stop": 30})
    counts = []
    for iteration in range(1, 51):
        trainer.iteration = iteration
        counts.append(trainer.last_step.num_averaged)
    assert counts == [1] * 30 + [4] * 20  # at 30, rows may change for the last time
