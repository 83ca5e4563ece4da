"""Steps of several views, all of which see the same Gaussians."""

from dataclasses import replace

import drjit as dr
import numpy as np
import pytest
from pydantic import ValidationError
from support import small_fits as fits

from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.training.steps import step_of, view_of


def make_trainer(views_per_step, dataset=None, **changes):
    dataset = dataset or fits.plain_dataset()
    return fits.make_trainer(dataset, optimizer__views_per_step=views_per_step, **changes)


def test_steps_are_consecutive_and_the_last_may_be_shorter():
    steps, done = [], 0
    while done < 11:
        steps.append(step_of(done + 1, 4, 11))
        assert all(step_of(i, 4, 11) == steps[-1] for i in steps[-1])
        done = steps[-1][-1]
    assert steps == [range(1, 5), range(5, 9), range(9, 12)]
    assert step_of(12, 4, 11) == range(12, 13)  # of somebody who goes on


@pytest.mark.parametrize(("num_views", "views_per_step"), [(10, 1), (10, 4), (12, 3), (3, 4)])
def test_each_place_of_a_step_has_its_own_views_in_shuffled_rounds(num_views, views_per_step):
    count = 60 * views_per_step
    drawn, other = (
        np.array([view_of(i, num_views, seed, views_per_step) for i in range(1, count + 1)])
        for seed in (3, 4)
    )
    assert num_views == 3 or (drawn != other).any()
    for place, views in enumerate(drawn.reshape(-1, views_per_step).T):
        own = np.arange(place % num_views, num_views, views_per_step)
        rounds = views[: 60 // len(own) * len(own)].reshape(-1, len(own))
        assert np.array_equal(np.sort(rounds, axis=1), np.tile(own, (len(rounds), 1)))
        num_orders = len({tuple(r) for r in rounds})
        assert num_orders > 1 or len(own) == 1
        assert num_orders == len(rounds) or len(own) < 10
    assert set(drawn) == set(range(num_views))


def test_step_is_adam_on_the_mean_gradient_with_scaled_rates_and_decays():
    """Two steps by hand, in double precision, from gradients of single views."""
    views_per_step = 3
    trainer = make_trainer(views_per_step, iterations=8)
    m, v = (dict.fromkeys(PARAMETER_NAMES, 0.0) for _ in range(2))
    for t, iterations in ((1, (1, 2, 3)), (2, (4, 5, 6))):
        before = {name: np.array(value, np.float64) for name, value in trainer.parameters.items()}
        gradients = []
        trainer.integrator.sh_degree = 1
        for iteration in iterations:
            (view,) = (v.view for v in trainer.plan(iteration).views if v.iteration == iteration)
            trainer.iteration = iteration
            gradients.append(fits.gradients_of_loss(trainer, view))
        trainer.iteration = iterations[0] - 1
        dr.set_grad(trainer.optimizer, 0)
        report = trainer.step()
        assert report.iteration == trainer.iteration == iterations[-1]
        after = {name: np.array(value, np.float64) for name, value in trainer.parameters.items()}
        b1, b2 = 0.9**views_per_step, 0.999**views_per_step
        rates = trainer.config.optimizer
        # The rate of means is that of the step's last iteration.
        late = iterations[-1] / 8
        means = trainer.extent * rates.means_lr ** (1 - late) * rates.means_lr_final**late
        own = rates.quats_lr, rates.scales_lr, rates.opacities_lr, rates.sh0_lr, rates.shN_lr
        expected_rates = dict(zip(PARAMETER_NAMES, (means, *own), strict=True))
        falls = rates.decay ** max(0.0, (late - rates.decay_from) / (1 - rates.decay_from))
        for name, value in before.items():
            g = np.mean([gradient[name] for gradient in gradients], axis=0)
            m[name], v[name] = b1 * m[name] + (1 - b1) * g, b2 * v[name] + (1 - b2) * g * g
            ahead = (b1 * m[name] + (1 - b1) * g) / (1 - b1 ** (t + 1))
            change = ahead / (np.sqrt(v[name] / (1 - b2**t)) + 1e-15)
            rate = np.sqrt(views_per_step) * expected_rates[name]
            rate *= 1 if name == "means" else falls
            # Gradients that are rounding noise still make full steps of Adam.
            is_sure = np.abs(g) > 1e-4 * np.abs(g).max()
            got, expected = (after[name] - value)[is_sure], -(rate * change)[is_sure]
            # Sums of float32 are off by some 1e-6 of the largest gradient: by 1e-2 of a small one.
            np.testing.assert_allclose(got, expected, rtol=2e-2, atol=1e-6, err_msg=name)
            assert np.abs(got - expected).mean() < 1e-3 * np.abs(expected).mean(), name


def test_report_is_the_mean_of_single_views_and_statistics_are_their_sum():
    settings = {"densify__start": 1, "densify__stop": 100, "densify__every": 50}
    trainer, dataset, reports, norms = make_trainer(3, **settings), fits.plain_dataset(), [], 0.0
    for index in (view_of(i, 6, 0, 3) for i in (1, 2, 3)):
        alone = make_trainer(1, replace(dataset, train=(dataset.train[index],)), **settings)
        reports.append(alone.step())
        norms = norms + alone.state()["density/gradient_norms"].astype(np.float64)
    report = trainer.step()
    # Single precision.
    assert report.loss == pytest.approx(np.mean([each.loss for each in reports]), rel=1e-6)
    assert report.psnr == pytest.approx(np.mean([each.psnr for each in reports]), abs=1e-5)
    assert len({each.loss for each in reports}) == 3
    # Single precision: gradients that were divided by three, and multiplied again.
    np.testing.assert_allclose(trainer.state()["density/gradient_norms"], norms, rtol=1e-4)
    assert norms.max() > 0


def test_image_size_changes_with_the_first_step_after_a_stage():
    trainer = make_trainer(4, coarse=[{"until": 6, "factor": 2}])
    steps = [trainer.plan(iteration) for iteration in (1, 5, 9, 13)]
    whole = fits.plain_dataset().train[0].width
    widths = [step.views[-1].view.width for step in steps]
    assert widths == [whole // 2, whole // 2, whole, whole]
    assert [step.begins_phase for step in steps] == [False, False, True, False]


def test_density_change_due_within_a_step_follows_the_step():
    trainer = make_trainer(
        4, densify__strategy="budget", densify__start=3, densify__stop=20, densify__every=6
    )
    reports = [trainer.step() for _ in range(6)]
    changes = [report.iteration for report in reports if report.density is not None]
    assert changes == [8, 12, 20]  # of iterations 6, 12, 18 and 20


def test_effects_use_the_same_parameters_for_all_views_of_a_step():
    """Focal lengths, which all share, move once the last view of the step was rendered."""
    trainer = make_trainer(3, cameras__optimise=True, cameras__focal_lr=1e-3)
    fits.steps(trainer, 2)
    (effect,) = trainer.effects
    shared, before = [], effect.before_render

    def watched(fit, view):
        before(fit, view)
        shared.append(effect.numpy()["log_focals"].copy())

    effect.before_render = watched
    start = effect.numpy()["log_focals"].copy()
    trainer.step()
    assert len(shared) == 3 and all(np.array_equal(s, start) for s in shared)
    assert not np.array_equal(effect.numpy()["log_focals"], start)
    turns = effect.state()["turns.t"]
    assert turns.sum() == 9  # each view has taken a step when it was seen


def test_late_steps_consist_of_whole_steps():
    trainer = make_trainer(
        2, optimizer__views=6, optimizer__views_from=0.5, densify__start=1, densify__stop=2
    )
    trainer.iteration = 300
    counts, steps, step = [], [], trainer.optimizer.step
    trainer.optimizer.step = lambda: (steps.append(trainer.iteration), step())
    for _ in range(6):
        trainer.step()
        counts.append(trainer.last_step.num_averaged)
    assert counts == [6] * 6 and steps == [306, 312]


def test_late_step_uses_the_mean_gradient_of_its_views():
    late = {"optimizer__views": 3, "optimizer__views_from": 0.5, "iterations": 10}
    trainer = make_trainer(1, **late, densify__start=1, densify__stop=2)
    trainer.iteration, trainer.integrator.sh_degree = 6, 1
    views = [trainer.plan(iteration).views[0].view for iteration in (7, 8, 9)]
    gradients = [fits.gradients_of_loss(trainer, view) for view in views]
    dr.set_grad(trainer.optimizer, 0)
    found = []
    trainer.optimizer.step = lambda: found.append(
        {name: np.array(dr.grad(value)) for name, value in trainer.optimizer.items()}
    )
    fits.steps(trainer, 3)
    (found,) = found
    for name, values in found.items():
        expected = np.mean([gradient[name] for gradient in gradients], axis=0)
        # Sums in another order, in single precision.
        np.testing.assert_allclose(values, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize(
    ("densify", "first"),
    [({"stop": 30}, 31), ({"stop": 14, "prune__to": 20, "prune__stop": 24}, 25)],
)
def test_views_are_averaged_only_after_the_last_density_change(densify, first):
    densify = {f"densify__{name}": value for name, value in {"start": 2, **densify}.items()}
    trainer = make_trainer(
        1, iterations=50, optimizer__views=4, optimizer__views_from=0.2, **densify
    )
    counts = [trainer.plan(iteration).num_averaged for iteration in range(1, 51)]
    assert counts == [1] * (first - 1) + [4] * (51 - first)


def test_late_steps_must_be_a_multiple():
    with pytest.raises(ValidationError, match=r"views must be a multiple .*\(4\).*, got 6"):
        make_trainer(4, optimizer__views=6)
