"""Interrupted fits continue to the same bytes; later iterations compile no kernel."""

from dataclasses import replace

import pytest
from support import small_fits as fits
from support.kernels import kernel_hashes

plain, transparent = fits.plain_dataset, fits.transparent_dataset


def masked():
    return fits.masked(fits.plain_dataset())


def masked_with_depth():
    """One view has no depth."""
    first, *others = fits.masked(fits.true_dataset()).train
    return replace(fits.true_dataset(), train=(replace(first, depth=None), *others))


ADC = {
    "densify__start": 2,
    "densify__stop": 60,
    "densify__every": 4,
    "densify__adc__grad_threshold": 1e-6,
    "densify__adc__reset_every": 9,
}

PRUNING = {
    "iterations": 30,
    "densify__start": 2,
    "densify__stop": 14,
    "densify__every": 4,
    "densify__prune__to": 20,
    "densify__prune__every": 3,
    "densify__prune__stop": 24,
}
MCMC = {"densify__strategy": "mcmc", "densify__mcmc__gaussians": 60, "densify__mcmc__growth": 0.1}

LATE_STEPS = {
    "iterations": 8,
    "optimizer__views": 3,
    "optimizer__views_from": 0.5,
    "densify__start": 1,
    "densify__stop": 2,
}

CAMERAS = {"cameras__optimise": True, **fits.CAMERA_RATES}
COLORS = {"colors__lr": 2e-3, "colors__identity_weight": 0.1}
VIGNETTING = {"colors__vignetting_lr": 2e-3}
PHOTOMETRY = {**VIGNETTING, "colors__response_lr": 2e-3}
DEPTH = {"loss__depth_weight": 0.7}
RANDOM = {"data__random_background": True}
SMOOTHING = {"model__smoothing": True}
COARSE = {"coarse": [{"until": 2, "factor": 4}, {"until": 5, "factor": 2}]}

FOUR_VIEWS = {"optimizer__views_per_step": 4, "iterations": 40}
CHANGES = {"densify__start": 2, "densify__stop": 30, "densify__every": 5}
GROWING = {**FOUR_VIEWS, **CHANGES}
STRATEGIES = {
    f"{name}, four views a step": (plain, {**GROWING, "densify__strategy": name}, 3, 4)
    for name in ("adc", "budget", "mcmc")
}

SLOW_FITS = {
    "reset and degree": (plain, {**ADC, "model__sh_increase_every": 8}, 7, 7),
    "before a change, smoothing": (plain, {**ADC, **SMOOTHING}, 3, 8),
    "at a change, smoothing": (plain, {**ADC, **SMOOTHING}, 4, 7),
    "after a change, smoothing": (plain, {**ADC, **SMOOTHING}, 5, 6),
    "growth, then selection": (plain, {**PRUNING, **MCMC}, 5, 22),
    "selection": (plain, PRUNING, 16, 11),
    **{f"late step, {before}": (plain, LATE_STEPS, before, 5) for before in (4, 5, 6, 7)},
    "cameras, coarse": (plain, {**CAMERAS, **COARSE}, 4, 5),
    # The filter depends on where all cameras are, also on those not seen since.
    "cameras, smoothing": (plain, {**CAMERAS, **SMOOTHING, **ADC}, 6, 5),
    **STRATEGIES,
    "effects, four views a step": (
        transparent,
        {**FOUR_VIEWS, **CAMERAS, **COLORS, **VIGNETTING, **RANDOM, **SMOOTHING},
        *(3, 4),
    ),
    "late steps of eight views": (plain, {**FOUR_VIEWS, **COARSE, "optimizer__views": 8}, 3, 4),
}

QUICK_FITS = {
    "coarse": (plain, COARSE, 4, 4),
    "colors": (plain, COLORS, 4, 5),
    "photometry": (fits.two_camera_dataset, PHOTOMETRY, 4, 5),
    "depth and masks": (masked_with_depth, DEPTH, 4, 5),
    "random background": (transparent, {**RANDOM, **COARSE}, 2, 4),
    "shifted pixels": (fits.shifted_dataset, RANDOM, 11, 5),
}

FITS = [
    *(pytest.param(*case, id=name, marks=pytest.mark.slow) for name, case in SLOW_FITS.items()),
    *(pytest.param(*case, id=name) for name, case in QUICK_FITS.items()),
]


@pytest.mark.parametrize(("dataset", "changes", "before", "after"), FITS)
def test_interrupted_fit_continues_to_the_same_bytes(dataset, changes, before, after):
    def make():
        return fits.make_trainer(dataset(), **changes)

    fits.assert_resumes_to_the_same_bytes(make, before, after)


EFFECTS = {
    "masks": (masked, {}),
    "depth": (fits.true_dataset, DEPTH),
    "random background": (transparent, RANDOM),
    "cameras": (plain, CAMERAS),
    "colors": (plain, COLORS),
    "photometry": (fits.two_camera_dataset, PHOTOMETRY),
    "smoothing": (plain, SMOOTHING),
}


@pytest.mark.parametrize(("dataset", "changes"), EFFECTS.values(), ids=EFFECTS)
def test_no_kernel_is_compiled_after_all_views_were_seen(dataset, changes):
    """Kernels by hash: what Dr.Jit's caches hold from other runs does not matter."""
    trainer, seen = fits.make_trainer(dataset(), **changes), set()
    for iteration in range(12):

        def step():
            trainer.step()
            trainer.watch.check()

        hashes = kernel_hashes(step)
        assert hashes
        assert iteration < 7 or hashes <= seen, f"{len(hashes - seen)} at {iteration + 1}"
        seen |= hashes
