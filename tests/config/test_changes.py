"""A fit of fewer iterations has the same schedule, in proportion."""

from drgs.config.changes import with_changes, with_iterations
from drgs.config.schema import FitConfig


def test_shorter_schedule_is_scaled_in_proportion():
    config = FitConfig(
        data={"path": "."}, iterations=30_000, coarse=[{"until": 3000, "factor": 2}], seed=7
    )
    short = with_iterations(config, 6000)
    assert short.iterations == 6000 and short.seed == 7
    assert (short.densify.start, short.densify.stop, short.densify.every) == (100, 3000, 100)
    assert short.cameras.start == 0
    refined = with_changes(config, {"cameras.start": 1000})
    assert with_iterations(refined, 6000).cameras.start == 200
    assert (short.densify.adc.reset_every, short.densify.adc.white_background_reset) == (600, 100)
    assert short.model.sh_increase_every == 150 and short.coarse[0].until == 600
    assert with_iterations(short, 30_000) == config


def test_disabled_reset_stays_off_and_counts_stay_positive():
    config = FitConfig(data={"path": "."}, densify={"adc": {"white_background_reset": None}})
    short = with_iterations(config, 30)
    assert short.densify.adc.white_background_reset is None
    assert (short.densify.start, short.densify.stop, short.model.sh_increase_every) == (1, 15, 1)
