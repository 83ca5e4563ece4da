"""What effects are good for: the command, shrunk, and what it spoils and measures."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import yaml
from PIL import Image
from scipy.spatial.transform import Rotation
from support.small_capture import make_dataset, write_dataset

from drgs.bench import __main__ as bench
from drgs.bench import benefits


@pytest.fixture
def small(tmp_path, monkeypatch):
    """The command's configuration, of a small dataset."""
    write_dataset(tmp_path / "data", make_dataset(train=4, test=2))
    config = tmp_path / "small.yml"
    config.write_text(yaml.safe_dump({"data": {"path": str(tmp_path / "data")}}))
    monkeypatch.setattr(benefits, "SCENE", replace(benefits.SCENE, config=config))
    for name, value in {"SIZE": 16, "NUM_POINTS": 60, "QUICK_ITERATIONS": 4, "FEW": 2}.items():
        monkeypatch.setattr(benefits, name, value)
    return tmp_path


@pytest.mark.slow
def test_every_case_is_fitted_and_written(small, capsys):
    out = small / "out"
    bench.main(["benefits", "--quick", "--out", str(out)])
    with (out / "benefits.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {(row["effect"], row["name"]) for row in rows} == {
        (case.effect, case.name) for case in benefits.CASES
    }
    assert all(np.isfinite(float(row["value"])) for row in rows)
    sizes = [row["quantity"] for row in rows if row["effect"] == "antialiasing"]
    assert sizes == 4 * [f"PSNR at {name}, dB" for name in ("2x", "1x", "1/2", "1/4")]
    with Image.open(out / "antialiasing.png") as picture:
        assert picture.width > 500
    printed = capsys.readouterr().out
    assert "| effect | fit | measured |" in printed and str(out / "benefits.csv") in printed


def test_what_all_cameras_have_in_common_is_undone():
    """Umeyama's similarity, of points that it maps exactly."""
    rng = np.random.default_rng(3)
    points, rotation = rng.normal(0, 1, (6, 3)), Rotation.from_rotvec([0.4, -1.2, 0.3]).as_matrix()
    scale, turn, move = benefits.similarity(points, 1.7 * points @ rotation.T + [1, 2, 3])
    assert scale == pytest.approx(1.7)
    np.testing.assert_allclose(turn, rotation, atol=1e-12)
    np.testing.assert_allclose(move, [1, 2, 3], atol=1e-12)


def test_colours_are_fitted_but_what_is_not_a_colour_stays():
    rng = np.random.default_rng(4)
    image = rng.uniform(0.1, 0.5, (8, 8, 3))
    matrix = np.array([[1.2, 0.1, 0], [0, 0.8, 0.1], [0.1, 0, 1.1]])
    exposed = image @ matrix.T + 0.05
    np.testing.assert_allclose(benefits.fitted_colors(exposed, image), image, atol=1e-10)
    moved = np.roll(image, 1, axis=0)
    assert np.abs(benefits.fitted_colors(moved, image) - image).max() > 0.1


def test_gains_of_pictures_are_one_on_average(small):
    dataset = make_dataset(train=4, test=2)
    spoiled = benefits.spoil_exposure(dataset, np.random.default_rng(0))
    gains = np.stack(
        [
            after.image.sum(axis=(0, 1)) / before.image.sum(axis=(0, 1))
            for before, after in zip(dataset.train, spoiled.train, strict=True)
        ]
    )
    np.testing.assert_allclose(gains.mean(axis=0), benefits.DARK, rtol=1e-5)
    assert np.ptp(gains, axis=0).min() > 0.05
