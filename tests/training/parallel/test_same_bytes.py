"""However many processes share a fit, it is the same."""

import pytest
from support import parallel_processes
from support import small_fits as fits


def settings(views_per_step=4, **changes):
    values = {"optimizer.views_per_step": views_per_step, "output.history_every": 4}
    return values | {key.replace("__", "."): value for key, value in changes.items()}


def assert_the_same(changes, sizes, steps=8, data="plain"):
    dataset = parallel_processes.DATASETS[data]()
    alone = fits.Trainer(fits.config_of(**changes), dataset, fits.disturbed_blobs())
    expected = parallel_processes.hashes_and_reports(alone, steps)
    for size in sizes:
        state, reports = parallel_processes.fitted(size, steps, changes, data)
        assert reports == expected[1], size
        assert state == expected[0], size


DENSITY_SCHEDULE = {"densify__start": 2, "densify__stop": 30, "densify__every": 5}

STRATEGIES = {
    "adc": {**DENSITY_SCHEDULE, "densify__strategy": "adc", "densify__adc__grad_threshold": 1e-6},
    "budget": {
        **DENSITY_SCHEDULE,
        "densify__strategy": "budget",
        "densify__budget__gaussians": 60,
        "densify__budget__error_every": 3,
    },
    "mcmc": {
        **DENSITY_SCHEDULE,
        "densify__strategy": "mcmc",
        "densify__mcmc__gaussians": 60,
        "densify__mcmc__min_opacity": 0.3,
    },
    "importance": {
        "densify__start": 1,
        "densify__stop": 2,
        "densify__prune__to": 15,
        "densify__prune__method": "importance",
        "densify__prune__start": 4,
        "densify__prune__stop": 24,
        "densify__prune__every": 7,
    },
    "selection": {
        "densify__start": 1,
        "densify__stop": 2,
        "densify__prune__to": 15,
        "densify__prune__method": "selection",
        "densify__prune__start": 4,
        "densify__prune__stop": 24,
        "densify__prune__every": 7,
    },
}

EFFECTS = {
    "data__random_background": True,
    "model__smoothing": True,
    "colors__lr": 0.02,
    "coarse": [{"until": 10, "factor": 2}],
}


@pytest.mark.slow
def test_two_processes_grow_the_same_population_as_one():
    assert_the_same(settings(**STRATEGIES["budget"]), [2])


@pytest.mark.slow
@pytest.mark.parametrize("strategy", STRATEGIES)
def test_every_strategy_gives_the_same_bytes_on_one_to_four_processes(strategy):
    assert_the_same(settings(**STRATEGIES[strategy]), [1, 2, 3, 4])


@pytest.mark.slow
def test_six_views_per_step_give_the_same_bytes():
    assert_the_same(settings(6, **STRATEGIES["adc"]), [1, 2, 3])


@pytest.mark.slow
def test_effects_of_views_give_the_same_bytes():
    assert_the_same(settings(**EFFECTS), [1, 2, 3], data="transparent")


@pytest.mark.slow
def test_late_steps_of_more_views_give_the_same_bytes():
    late = {"optimizer__views": 8, "optimizer__views_from": 0.0, "densify__stop": 2}
    assert_the_same(settings(**late, densify__start=1), [2, 3])


@pytest.mark.slow
def test_nonfinite_value_is_reported_by_all_processes():
    alone = fits.make_trainer(fits.plain_dataset(), optimizer__views_per_step=4)
    expected = parallel_processes.spoiled(alone, 17)
    assert "in row 17" in expected
    assert parallel_processes.state_text(3, 17) == expected


REFINED = {
    "cameras__optimise": True,
    "cameras__start": 5,
    "cameras__rotation_lr": 1e-3,
    "cameras__focal_lr": 1e-3,
    "cameras__principal_lr": 1e-3,
    **STRATEGIES["adc"],
}


@pytest.mark.slow
def test_refined_cameras_give_the_same_bytes():
    """Derivatives of a camera are summed over all processes in one place."""
    assert_the_same(settings(**REFINED), [3])


@pytest.mark.slow
@pytest.mark.parametrize("data", ["plain", "blurred"])
def test_refined_cameras_give_the_same_bytes_on_one_to_four_processes(data):
    assert_the_same(settings(**REFINED), [1, 2, 4], data=data)


@pytest.mark.slow
def test_partly_moving_cameras_give_the_same_bytes():
    """A view that is blurred is projected at several times, and others once."""
    assert_the_same(settings(**STRATEGIES["adc"]), [2, 3], data="blurred")
