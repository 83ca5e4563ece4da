"""The study of populations: its changes of the rules do what they say, its fits are fits."""

import csv

import mitsuba as mi
import numpy as np
import pytest
import yaml
from PIL import Image
from support import populations
from support.small_capture import make_dataset, write_dataset

from drgs.bench import __main__ as bench
from drgs.bench import population
from drgs.config.load import load_config
from drgs.config.schema import DensifyConfig
from drgs.datasets import load_dataset
from drgs.training.density import adc

EXTENT = populations.EXTENT
LATE = 3100  # large Gaussians are pruned from the first regular reset on


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def change(optimizer, norms):
    """Through the module's name, as the trainer calls it."""
    rows = populations.rows_of(optimizer)
    return adc.densify_and_prune(rows, populations.statistics(norms), DensifyConfig(), LATE)


def test_samples_that_are_still_too_large_are_pruned_at_once():
    """A giant's samples are smaller by 1.6, which may not be enough; clones of it are kept."""
    scales = np.array([0.5, 0.12, 0.05, 0.05]) * EXTENT  # x 0.1 is the limit
    opacities, norms = [0.5, 0.5, 0.5, 0.001], [1.0, 1.0, 0.0, 0.0]
    spared = change(populations.make(scales, opacities), norms)
    assert (spared.split, spared.pruned, spared.num_gaussians) == (2, 1, 5)
    optimizer = populations.make(scales, opacities)
    with population._prune_added_rows_at_once():
        pruned = change(optimizer, norms)
    assert (pruned.split, pruned.pruned, pruned.num_gaussians) == (2, 3, 3)
    sizes = np.exp(np.array(optimizer["log_scales"])).max(axis=1)
    assert len(sizes) == 3 and (sizes <= 0.1 * EXTENT).all()
    assert change(populations.make(scales, opacities), norms) == spared


def test_resets_go_on_but_for_the_last_iteration_that_counts():
    config = DensifyConfig(stop=15_000, reset_every=3000)

    def resets():
        return [i for i in range(1, 30_001) if adc.should_reset(config, i, True)]

    as_they_are = resets()
    with population._reset_until_the_end():
        changed = resets()
    assert as_they_are == [500, 3000, 6000, 9000, 12_000]
    assert changed == [*as_they_are, 15_000, 18_000, 21_000, 24_000, 27_000]
    assert resets() == as_they_are


def test_changes_of_the_configuration():
    config = load_config(population.CONFIG)
    assert population._threshold_in_pixels(config, 4.0) == {
        "densify.adc.grad_threshold": 2e-4 * 100
    }
    rates = population._unscaled_means_rate(config, 4.0)
    assert rates["optimizer.means_lr"] * 4 == config.optimizer.means_lr
    assert rates["optimizer.means_lr_final"] * 4 == config.optimizer.means_lr_final


@pytest.mark.slow
def test_fits_of_the_study_run_and_are_not_repeated(tmp_path, capfd):
    write_dataset(tmp_path / "data", make_dataset(train=3, test=1))
    command = ["population", "--data", str(tmp_path / "data"), "--out", str(tmp_path / "out")]
    command += ["--only", "1", "4", "5", "--iterations", "3"]
    bench.main(command)
    folder = tmp_path / "out" / "population"
    rows = list(csv.DictReader((folder / "population.csv").open()))
    assert [row["case"] for row in rows] == [population.CASES[k].name for k in (0, 3, 4)]
    assert all(int(row["gaussians"]) == 100_000 and float(row["psnr"]) > 0 for row in rows)
    assert Image.open(folder / "population.png").size[0] > 500

    configs = {k: yaml.safe_load((folder / f"{k}/config.yml").read_text()) for k in (1, 4, 5)}
    extent = load_dataset(load_config(folder / "1" / "config.yml").data).extent
    recipe = configs[1]
    assert (
        recipe["data"]["image_size"] == 200 and recipe["densify"]["adc"]["grad_threshold"] == 2e-4
    )
    configs[4]["optimizer"]["means_lr"] *= extent
    configs[4]["optimizer"]["means_lr_final"] *= extent
    rates = [configs[k]["optimizer"] for k in (1, 4)]
    assert [rate.pop("means_lr_aims") for rate in rates] == [[], []]
    assert rates[1] == pytest.approx(rates[0], rel=1e-12)
    assert configs[5]["densify"]["adc"].pop("white_background_reset") is None
    assert recipe["densify"]["adc"].pop("white_background_reset") == 500
    assert configs[5]["densify"] == recipe["densify"]

    written = (folder / "population.csv").read_text()
    capfd.readouterr()
    bench.main(command)
    assert capfd.readouterr().out.count("this fit is finished") == 3
    assert (folder / "population.csv").read_text() == written
