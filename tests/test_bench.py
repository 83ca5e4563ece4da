"""The measurements run, write what they say, and measure what they say."""

import csv

import numpy as np
import pytest
from PIL import Image

from drgs.bench import __main__ as bench
from drgs.bench import stability


@pytest.fixture(scope="module")
def stability_run(tmp_path_factory):
    out = tmp_path_factory.mktemp("bench")
    bench.main(["stability", "--quick", "--out", str(out)])
    return out


def test_stability_writes_its_table_and_plot(stability_run):
    with (stability_run / "stability.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["sweep"] for row in rows} == {sweep.name for sweep in stability.sweeps()}
    assert all(np.isfinite(float(value)) for row in rows for value in list(row.values())[1:])
    assert Image.open(stability_run / "stability.png").size[0] > 800


def test_stability_finds_no_error_beyond_the_conditioning(stability_run):
    """As in test_hard_cases.py: 30 times the noise, 4 roundings in the exponential, n in a sum."""
    with (stability_run / "stability.csv").open() as file:
        for row in csv.DictReader(file):
            layers = float(row["value"]) if row["sweep"] == "Stack depth" else 60
            rounding = stability.UNIT_ROUNDOFF * (4 + np.sqrt(layers))
            for what in ("picture", "gradient"):
                allowed = 30 * (float(row[f"{what}_noise"]) + rounding)
                assert 0 < float(row[what]) <= allowed, row
            assert float(row["left_out"]) < 0.1


def test_noise_is_that_of_single_precision():
    """Rounding the scene to float32 changes the picture by about as much as the noise says."""
    sweep = next(s for s in stability.sweeps() if s.name == "Anisotropy")
    found = stability.measure(sweep, 100.0, samples=4)
    assert 0.1 < found.storage / found.picture_noise < 10
