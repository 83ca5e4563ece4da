"""However many processes share a fit, it is the same."""

import pytest
from support import parallel_processes
from support import small_fits as fits


def settings(views_per_step=4, **changes):
    values = {"optimizer.views_per_step": views_per_step, "output.history_every": 4}
    return values | {key.replace("__", "."): value for key, value in changes.items()}


CHANGES = {"densify__start": 2, "densify__stop": 30, "densify__every": 5}
STATIC = {"densify__start": 1, "densify__stop": 2}
PRUNING = {"to": 15, "start": 4, "stop": 24, "every": 7}
PRUNED = STATIC | {f"densify__prune__{name}": value for name, value in PRUNING.items()}
ADC = {**CHANGES, "densify__strategy": "adc", "densify__adc__grad_threshold": 1e-6}
BUDGET = {"densify__budget__gaussians": 60, "densify__budget__error_every": 3}
MCMC = {"densify__mcmc__gaussians": 60, "densify__mcmc__min_opacity": 0.3}
REFINED = {
    **ADC,
    "cameras__optimise": True,
    "cameras__start": 5,
    "cameras__rotation_lr": 1e-3,
    "cameras__focal_lr": 1e-3,
    "cameras__principal_lr": 1e-3,
}
EFFECTS = {
    "data__random_background": True,
    "model__smoothing": True,
    "colors__lr": 0.02,
    "colors__vignetting_lr": 0.02,
    "coarse": [{"until": 10, "factor": 2}],
}
LATE = {"optimizer__views": 8, "optimizer__views_from": 0.0, **STATIC}

FITS = {
    "adc": (settings(**ADC), [1, 2, 3, 4], "plain"),
    "budget": (settings(**CHANGES, **BUDGET, densify__strategy="budget"), [1, 2, 3, 4], "plain"),
    "mcmc": (settings(**CHANGES, **MCMC, densify__strategy="mcmc"), [1, 2, 3, 4], "plain"),
    "selection": (settings(**PRUNED), [1, 2, 3, 4], "plain"),
    "six views": (settings(6, **ADC), [1, 2, 3], "plain"),
    "effects": (settings(**EFFECTS), [1, 2, 3], "transparent"),
    "shifted pixels": (settings(**STATIC), [2, 3], "shifted"),
    "late steps": (settings(**LATE), [2, 3], "plain"),
    # Derivatives of a camera are summed over all processes in one place.
    "refined cameras": (settings(**REFINED), [1, 2, 3, 4], "plain"),
    "refined moving cameras": (settings(**REFINED), [1, 2, 4], "blurred"),
    # A view that is blurred is projected at several times, and others once.
    "partly moving cameras": (settings(**ADC), [2, 3], "blurred"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("changes", "sizes", "data"), FITS.values(), ids=FITS)
def test_any_number_of_processes_gives_the_same_bytes(changes, sizes, data):
    dataset = parallel_processes.DATASETS[data]()
    alone = fits.Trainer(fits.config_of(**changes), dataset, fits.disturbed_blobs())
    expected = parallel_processes.hashes_and_reports(alone, 8)
    for size in sizes:
        state, reports = parallel_processes.fitted(size, changes, data, steps=8)
        assert reports == expected[1], size
        assert state == expected[0], size


@pytest.mark.slow
def test_nonfinite_value_is_reported_by_all_processes():
    alone = fits.make_trainer(fits.plain_dataset(), optimizer__views_per_step=4)
    expected = parallel_processes.spoiled(alone, 17)
    assert "in row 17" in expected
    changes = {"optimizer.views_per_step": 4}
    assert parallel_processes.fitted(3, changes, spoiled=17) == expected
