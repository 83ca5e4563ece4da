"""Fits of photographs with their cameras treated in turn: what each sees, and what is written."""

import csv
import json
from pathlib import Path

import pytest
from PIL import Image
from support.colmap_models import NAMES, write_binary, write_dataset, write_pictures
from support.corner import SIZE, write_photographs
from support.datasets import load

from drgs import fit
from drgs.bench import __main__ as bench
from drgs.bench import photographs
from drgs.datasets.folders import config_for


@pytest.fixture
def fits(monkeypatch):
    """The command lines of fits, which end at once."""
    lines = []

    def fit(arguments):
        lines.append(arguments)
        out = Path(arguments[arguments.index("--out") + 1])
        out.mkdir(parents=True)
        metrics = {"test": {"psnr": 30.5, "ssim": 0.9}, "num_gaussians": 1234}
        (out / "metrics.json").write_text(json.dumps({**metrics, "iterations": 7000, "wall_s": 61}))
        return 1_500_000_000

    monkeypatch.setattr(photographs, "fit_in_own_process", fit)
    monkeypatch.setattr(photographs, "measured_as_taken", lambda out, config: 29.25)
    return lines


def test_each_case_is_fitted_once_and_becomes_a_row(tmp_path, fits, capsys):
    data, out = tmp_path / "data", tmp_path / "out"
    write_dataset(data, ["OPENCV"])
    for _ in range(2):
        bench.main(["photographs", str(data), "--out", str(out), "--only", "1", "2", "4"])
    assert [line[0] for line in fits] == [str(data)] * 3
    size = ["--set", "data.image_size=640"]
    assert [line[3:] for line in fits] == [
        size,
        [*size, "--set", "data.ignore_distortion=true"],
        [*size, "--set", "init.start=random"],
    ]
    assert "| as they are | 30.50 dB | 0.9000 | 29.25 dB | 1,234 |" in capsys.readouterr().out
    with (out / "photographs" / "photographs.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["case"] for row in rows] == [
        "as they are", "distortion ignored", "from random points",
    ]  # fmt: skip


def test_fits_of_other_folders_or_with_other_values_are_others(tmp_path, fits):
    for name in ("a", "b"):
        write_dataset(tmp_path / name / "data", ["OPENCV"])
    words = ["--out", str(tmp_path / "out"), "--only", "1"]
    for name in ("a", "b", "a"):
        bench.main(["photographs", str(tmp_path / name / "data"), *words])
    assert len(fits) == 2
    for _ in range(2):
        bench.main(["photographs", str(tmp_path / "a" / "data"), *words, "--set", "seed=3"])
    assert len(fits) == 3


def test_without_a_model_of_colmap_nothing_is_undistorted(photographs, fits, tmp_path, capsys):
    bench.main(["photographs", str(photographs), "--out", str(tmp_path / "out"), "--only", "3"])
    assert fits == [] and "undistorted beforehand: left out" in capsys.readouterr().out


def test_photographs_are_undistorted_at_their_own_size(tmp_path):
    """Of pictures half as large as COLMAP saw them: as large again, but for a border."""
    pytest.importorskip("pycolmap")
    model = write_dataset(tmp_path, ["SIMPLE_RADIAL"])
    model.points = []
    model.cameras.append((99, *model.cameras[0][1:]))  # of no image
    write_binary(tmp_path / "sparse" / "0", model)
    write_pictures(tmp_path / "images", size=(320, 240))
    config, _ = config_for(tmp_path)
    (tmp_path / "out").mkdir()
    dataset = load(photographs.undistorted(config, tmp_path / "out"))
    assert len(dataset.train) + len(dataset.test) == 4
    for view in dataset.train:
        assert view.lens is None and view.fx == pytest.approx(300)
        assert 300 <= view.width <= 330 and 225 <= view.height <= 250


def test_cameras_are_thrown_away_and_found_again(tmp_path, fits, capsys):
    pytest.importorskip("pycolmap")
    data, out = tmp_path / "data", tmp_path / "out"
    names = [f"cam{k % 2}/{k // 2}.png" for k in range(6)]
    for folder in ("cam0", "cam1", "masks"):
        (data / folder).mkdir(parents=True)
    Image.new("L", SIZE, 255).save(data / "masks" / "0.png")
    poses = write_photographs(data, names)
    frames = [
        {"file_path": name, "transform_matrix": pose.tolist()}
        for name, pose in zip(names, poses, strict=True)
    ]
    frames[0]["mask_path"] = "masks/0.png"
    (data / "transforms.json").write_text(json.dumps({"fl_x": 300, "frames": frames}))
    bench.main(["photographs", str(data), "--out", str(out), "--only", "5"])
    assert "| cameras found by drgs poses (6 placed) | 30.50 dB |" in capsys.readouterr().out
    (words,) = fits
    found = load(Path(words[0]))
    assert len(found.train) + len(found.test) == 6
    assert found.train[0].lens is not None  # not known before
    views = (*found.train, *found.test)
    with_masks = [view.files["image"] for view in views if view.mask is not None]
    assert with_masks == [Path(words[0]) / "images" / "cam0" / "0.png"]


def test_fits_are_measured_on_photographs_as_they_were_taken(tmp_path):
    """A fit that sees them as they are is measured to the same number."""
    data = tmp_path / "data"
    write_dataset(data, ["OPENCV"])
    write_pictures(data / "images", size=(160, 120))
    words = ["--set", "iterations=2", "--set", "output.report=false", "--set", "init.num_points=50"]
    fit.main([str(data), "--out", str(tmp_path / "out"), *words])
    config, _ = config_for(data)
    expected = json.loads((tmp_path / "out" / "metrics.json").read_text())["test"]["psnr"]
    measured = photographs.measured_as_taken(tmp_path / "out", config)
    assert measured == pytest.approx(expected, abs=1e-3)


RATES = ("means_lr", "means_lr_final", "sh0_lr", "shN_lr", "opacities_lr", "scales_lr", "quats_lr")


def test_a_fit_that_ignores_the_lens_is_measured_through_it(tmp_path):
    """With rates of next to nothing, fits with and without the lens end with the same Gaussians.

    What the one with it is at by its own measure is what the other is at, as taken, but for
    rounding.
    """
    data = tmp_path / "data"
    model = write_dataset(data, ["OPENCV"])
    number, *size, values = model.cameras[0]
    model.cameras[0] = (number, *size, (*values[:4], -0.2, 0.0, 0.0, 0.0))
    write_binary(data / "sparse" / "0", model)
    write_pictures(data / "images", NAMES[::-1], size=(160, 120))  # the view to test is not dark
    rates = [word for rate in RATES for word in ("--set", f"optimizer.{rate}=1e-12")]
    words = ["--set", "iterations=1", "--set", "output.report=false", *rates]
    words += ["--set", "densify.max_gaussians=9"]  # those that there are
    ignoring = ["--set", "data.ignore_distortion=true"]
    own = {}
    for name, options in (("as it is", []), ("ignoring", ignoring)):
        out = tmp_path / name
        fit.main([str(data), "--out", str(out), *words, *options])
        own[name] = json.loads((out / "metrics.json").read_text())["test"]["psnr"]
    config, _ = config_for(data)
    measured = photographs.measured_as_taken(tmp_path / "ignoring", config)
    assert measured == pytest.approx(own["as it is"], abs=1e-3)
    assert abs(measured - own["ignoring"]) > 0.02
