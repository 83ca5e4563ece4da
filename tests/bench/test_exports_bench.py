"""What a round trip through each file format costs: the command on a small fit."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import yaml
from support.small_capture import blobs, decibels, make_dataset, photograph, write_dataset

from drgs.bench import __main__ as bench
from drgs.io.formats import readable_formats

pytestmark = pytest.mark.filterwarnings("ignore:.*left out")


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    folder = tmp_path_factory.mktemp("exports")
    dataset = make_dataset(2, 2)
    write_dataset(folder / "data", dataset)
    (folder / "run").mkdir()
    (folder / "run" / "config.yml").write_text(
        yaml.safe_dump({"data": {"path": str(folder / "data")}})
    )
    blobs().save(folder / "run" / "point_cloud.ply")
    bench.main(["exports", str(folder / "run"), "--out", str(folder)])
    with (folder / "exports.csv").open() as file:
        return {row["format"]: row for row in csv.DictReader(file)}


def test_each_format_has_a_row(rows):
    assert list(rows) == [each.name for each in readable_formats()]
    assert {row["num_gaussians"] for row in rows.values()} == {"30"}


def test_sizes_are_those_of_the_files(rows):
    for name, row in rows.items():
        assert float(row["megabytes"]) == len(blobs().to_bytes(name)) / 1e6


def test_what_is_exact_loses_nothing_and_what_has_no_harmonics_most(rows):
    lost = {name: float(row["psnr_against_before"]) for name, row in rows.items()}
    assert lost["ply"] == np.inf
    assert lost["glb"] > 100 > lost["compressed-ply"] > lost["splat"]


def test_quality_is_measured_against_the_photographs(rows):
    """By the float64 reference, of a format that leaves the harmonics out."""
    flat = replace(blobs(), shN=blobs().shN[:, :0])
    scores = []
    for view in make_dataset(2, 2).test:
        # As written: half transparent, over white, in 8 bits.
        seen = np.round(view.image * 255) / 255 / 2 + 0.5
        picture = photograph(flat, view, np.ones(3)).image
        scores.append(decibels(np.clip(picture, 0, 1), seen))
    row = rows["splat"]
    # 8 bits of colours, of opacities and of the photographs.
    assert float(row["psnr"]) == pytest.approx(np.mean(scores), abs=0.02)
    assert float(row["psnr"]) + float(row["psnr_lost"]) == pytest.approx(float(rows["ply"]["psnr"]))
