"""Quality over time: the schedules of its fits, and the command."""

import csv

import mitsuba as mi
import pytest
import yaml
from PIL import Image
from support.small_capture import make_dataset, write_dataset

from drgs.bench import __main__ as bench
from drgs.bench import training
from drgs.config.changes import changed, with_iterations
from drgs.config.load import load_config
from drgs.config.schema import FitConfig


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def test_a_shorter_schedule_keeps_its_shares():
    config = FitConfig(
        data={"path": "."}, iterations=30_000, coarse=[{"until": 3000, "factor": 2}], seed=7
    )
    short = with_iterations(config, 6000)
    assert short.iterations == 6000 and short.seed == 7
    assert (short.densify.start, short.densify.stop, short.densify.every) == (100, 3000, 100)
    assert short.cameras.start == 0
    refined = changed(config, {"cameras.start": 1000})
    assert with_iterations(refined, 6000).cameras.start == 200
    assert (short.densify.adc.reset_every, short.densify.adc.white_background_reset) == (600, 100)
    assert short.model.sh_increase_every == 150 and short.coarse[0].until == 600
    assert with_iterations(short, 30_000) == config


def test_a_reset_that_is_off_stays_off_and_no_count_falls_to_zero():
    config = FitConfig(data={"path": "."}, densify={"white_background_reset": None})
    short = with_iterations(config, 30)
    assert short.densify.adc.white_background_reset is None
    assert (short.densify.start, short.densify.stop, short.model.sh_increase_every) == (1, 15, 1)


@pytest.mark.parametrize("iterations", [100, 5000])
def test_every_choice_is_a_configuration(iterations, tmp_path):
    """And each is another one."""
    numbers = {"init.num_points": 20_000, "densify.budget.gaussians": 50_000}
    decided = changed(load_config(training.CONFIG), numbers)
    shipped = with_iterations(decided, iterations)
    seen = []
    for choice in training.CHOICES:
        path = tmp_path / "x.yml"
        training.dump_config(choice.change(shipped), path)
        seen.append(load_config(path))
    assert seen[0] == shipped
    assert len({str(config) for config in seen}) == len(seen)


@pytest.mark.slow
def test_fits_run_and_are_not_repeated(tmp_path, capfd, monkeypatch):
    """Each in a process of its own, which does not know what this one has changed."""
    write_dataset(tmp_path / "data", make_dataset(train=3, test=1))
    values = yaml.safe_load(training.CONFIG.read_text())
    values["data"] = {"path": str(tmp_path / "data")}
    values["init"] = {"num_points": 60, "half_extent": 1.0}
    values["output"] = {"history_every": 50}
    config = tmp_path / "small.yml"
    config.write_text(yaml.safe_dump(values))
    command = ["training", "--quick", "--only", "1", "2", "--config", str(config)]
    command += ["--out", str(tmp_path / "out")]
    bench.main(command)
    folder = tmp_path / "out" / "training"
    rows = list(csv.DictReader((folder / "training.csv").open()))
    names = [training.CHOICES[k].name for k in (0, 1)]
    assert [(row["choice"], int(row["iterations"])) for row in rows] == [
        (name, n) for name in names for n in training.QUICK_BUDGETS
    ]
    assert all(float(row["psnr"]) > 0 and float(row["wall_s"]) > 0 for row in rows)
    assert Image.open(folder / "training.png").size[0] > 500
    coarse = training.folder_of(training.CHOICES[1], 100, folder)
    assert load_config(coarse / "config.yml").coarse[0].until == 25

    written = (folder / "training.csv").read_text()
    capfd.readouterr()
    bench.main(command)
    assert capfd.readouterr().out.count("this fit is finished") == 4
    assert (folder / "training.csv").read_text() == written

    bench.main([*command, "--times"])
    header, _, row = capfd.readouterr().out.strip().splitlines()[-3:]
    assert header.split("|")[1:3] == [" --budget ", " took "] and row.startswith("| 20s |")
    seconds = float(row.split("|")[2].split()[0])
    assert seconds == float((folder / "times" / "20s.s").read_text()) > 1
