"""The worked example ``scenes/relight.py``, on the shipped knot."""

import re
import sys
from dataclasses import asdict, replace

import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from PIL import Image

SCENES = REPOSITORY / "scenes"
MODEL = SCENES / "shapes" / "knot.ply"


@pytest.fixture
def relight(monkeypatch):
    monkeypatch.syspath_prepend(SCENES)
    mi.set_variant("llvm_ad_rgb")
    import relight

    return relight


def run(relight, monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["relight.py", *map(str, arguments)])
    relight.main()


def distances(found, true) -> dict[str, float]:
    return {name: float(np.linalg.norm(np.subtract(v, true[name]))) for name, v in found.items()}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["objects", "mirror"])
def test_parameters_of_the_target_image_are_recovered(relight, monkeypatch, tmp_path, capsys, name):
    """In 40 steps of more paths, from a start that is half as far away."""
    case = relight.CASES[name]
    true = asdict(case.true)
    start = {k: ((np.array(v) + true[k]) / 2).tolist() for k, v in asdict(case.start).items()}
    nearer = replace(case, start=replace(case.start, **start), spp=4 * case.spp)
    monkeypatch.setitem(relight.CASES, name, nearer)
    monkeypatch.setattr(relight, "TARGET_SPP", 64)
    monkeypatch.setattr(relight, "BALL", [0.9, 0.2, 0.45])  # beside the knot
    out = ["--out", tmp_path]
    run(relight, monkeypatch, MODEL, "--case", name, "--size", 40, "--iterations", 40, *out)
    output = capsys.readouterr().out
    losses = [float(x) for x in re.findall(r"loss ([\d.e+-]+)", output)]
    assert losses[-1] < losses[0] / 20
    _, _, *rows = re.findall(r"^\| (.*) \| .* \| .* \| (.*) \|$", output, re.MULTILINE)
    printed = {title: [float(x) for x in row.split(", ")] for title, row in rows}
    found = {key: printed[title] for key, title in case.start.TITLES.items()}
    at_start, at_end = distances(start, true), distances(found, true)
    for key in start:
        assert at_end[key] < at_start[key] / 3, key
    for rendered in ("target", "start", "end", "difference"):
        assert iio.imread(tmp_path / f"{rendered}.png").shape == (40, 40, 3)
    with Image.open(tmp_path / "relight.webp") as animation:
        assert animation.n_frames == 14 and animation.size == (80, 40)


def test_a_models_smoothing_filter_reaches_the_integrator(relight):
    model = relight.load(MODEL)
    smoothing = np.full(model.num_gaussians, 0.05, np.float32)
    stages = [relight.Objects.of(one, 20) for one in (model, replace(model, smoothing=smoothing))]
    filters = [stage.scene.integrator().smoothing for stage in stages]
    assert filters[0] is None
    np.testing.assert_array_equal(np.array(filters[1]), smoothing)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.ply"], "nowhere.ply: "),
        ([MODEL, "--iterations", 0], "--iterations must be >= 1, got 0"),
        ([MODEL, "--size", 90], "--size must be a multiple of 20 px, got 90"),
    ],
)
def test_wrong_arguments_are_refused(relight, monkeypatch, tmp_path, capsys, arguments, message):
    with pytest.raises(SystemExit) as caught:
        run(relight, monkeypatch, *arguments, "--out", tmp_path / "out")
    assert caught.value.code == 2
    assert capsys.readouterr().err.startswith(f"error: {message}")
