"""What a path-traced object among splats costs: the command, shrunk."""

import csv

import pytest

from drgs.bench import __main__ as bench
from drgs.bench import effects, hybrid
from drgs.bench.scenes import bench_gaussians


def test_the_command_writes_its_table(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(effects, "SIZE", 32)
    monkeypatch.setattr(hybrid, "SIZE", 32)
    monkeypatch.setattr(hybrid, "QUICK_COUNTS", (150,))
    monkeypatch.setattr(hybrid, "QUICK_ROUNDS", 1)
    monkeypatch.setattr(hybrid, "SAMPLES", (1, 2))
    bench.main(["hybrid", "--quick", "--out", str(tmp_path)])
    with (tmp_path / "hybrid.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [(row["num_gaussians"], row["nested_spp"]) for row in rows] == [
        ("150", "1"),
        ("150", "2"),
    ]
    for row in rows:
        splats, nested, both = (float(row[f"{n}_ms"]) for n in ("splats", "nested", "hybrid"))
        assert min(splats, nested, both) > 0
        # Of a single round.
        assert float(row["factor"]) == pytest.approx((both - nested) / splats)
    printed = capsys.readouterr().out
    assert "| Gaussians | samples |" in printed and str(tmp_path / "hybrid.csv") in printed


def test_the_object_stands_among_the_splats():
    """Splats are before it and behind it: neither picture is the other with more on top."""
    import mitsuba as mi
    import numpy as np

    mi.set_variant("llvm_ad_rgb")
    loaded = hybrid.scene(bench_gaussians(3000), 1, hybrid._objects())
    both = np.array(mi.render(loaded))
    alone = np.array(mi.render(hybrid.scene(bench_gaussians(3000), 1, {})))
    nested = np.array(mi.render(loaded, integrator=mi.load_dict({"type": "path"}), spp=1))
    covered = nested.sum(axis=-1) > 0
    assert 0.02 < covered.mean() < 0.5
    assert np.abs(both - alone)[covered].max() > 0.1
    assert np.abs(both - nested)[covered].max() > 0.1
