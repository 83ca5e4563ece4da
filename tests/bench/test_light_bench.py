"""Price and error of light between splats and surfaces: the command, shrunk."""

import csv

import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from support.lit_scenes import pixel_rays

from drgs.bench import __main__ as bench
from drgs.bench import light
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.reference import light as reference
from drgs.reference import splatting


@pytest.fixture
def model(tmp_path):
    """A cloud of splats."""
    means = np.random.default_rng(0).normal(0, 0.3, (60, 3)).astype(np.float32)
    n = len(means)
    values = {
        "means": means,
        "quats": np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        "log_scales": np.full((n, 3), -3.5, np.float32),
        "logit_opacities": np.full(n, 3, np.float32),
        "sh0": np.random.default_rng(1).normal(0, 1, (n, 1, 3)).astype(np.float32),
        "shN": np.zeros((n, 0, 3), np.float32),
    }
    path = tmp_path / "model" / "point_cloud.ply"
    path.parent.mkdir()
    Gaussians(**values).save(path)
    return path


def test_the_command_writes_its_table(model, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(light, "SIZE", (60, 40))
    monkeypatch.setattr(light, "QUICK_PATHS", (1,))
    monkeypatch.setattr(light, "QUICK_MANY", 2)
    out, file = tmp_path / "out", REPOSITORY / "scenes" / "hybrid.xml"
    bench.main(["light", str(model), "--file", str(file), "--quick", "--out", str(out)])
    with (out / "light.csv").open() as opened:
        rows = list(csv.DictReader(opened))
    assert len(rows) == 7 * 4 * 2
    for row in rows:
        assert float(row["seconds"]) > 0 and float(row["psnr"]) > 5
        assert 0 < float(row["share"]) < 0.9
        if row["light"] == "none":
            assert float(row["factor"]) == 1
    assert (out / "light.png").exists() and (out / "light_pictures.png").exists()
    assert "| mirror ball" in capsys.readouterr().out


def test_pixels_of_an_object_are_those_that_show_it(model):
    """Of a ball: where a ray meets it, and what the reference's rays pass before is clear."""
    mi.set_variant("llvm_ad_rgb")
    stage = light.stages(model, REPOSITORY / "scenes" / "hybrid.xml")[0]
    scene = stage.load(light="none")
    found = light.mask_of(scene, stage.subjects[0]).ravel()
    box = next(s.bbox() for s in scene.shapes() if s.id() == stage.subjects[0])
    center, radius = np.array(box.center()), box.extents()[0] / 2
    origins, directions = pixel_rays(scene.sensors()[0])
    to_center = center - origins
    along = (to_center * directions).sum(1)
    inside = radius**2 - (to_center**2).sum(1) + along**2
    far = np.where(inside > 0, along - np.sqrt(np.maximum(inside, 0)), 0)
    splats = splatting.Gaussians(**{k: getattr(Gaussians.load(model), k) for k in PARAMETER_NAMES})
    # Splats at the pixels that matter, and some that do not.
    chosen = np.flatnonzero((inside > 0) | (np.arange(len(inside)) % 50 == 0))
    T = reference.pass_splats(splats, origins[chosen], directions[chosen], far[chosen])
    sure = (np.abs(inside[chosen]) > 1e-4) & (np.abs(T.transmittances - light.LIT) > 1e-3)
    shows = (inside[chosen] > 0) & (T.transmittances > light.LIT)
    assert 0.02 < found.mean() < 0.3 and (shows & sure).sum() > 500
    np.testing.assert_array_equal(found[chosen][sure], shows[sure])
    assert not found[np.setdiff1d(np.arange(len(found)), chosen)].any()
