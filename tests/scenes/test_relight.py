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
from scipy.spatial.transform import Rotation

from drgs.gaussians.rotation import rotate_sh

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


def errors(true, found) -> dict[str, float]:
    """Return the distance of each unknown from the truth."""
    true = asdict(true)
    return {name: float(np.linalg.norm(np.subtract(v, true[name]))) for name, v in found.items()}


def start_halfway(relight, monkeypatch, name):
    """A case whose start is half as far away, of more paths: its unknowns by name, at first."""
    case = relight.CASES[name]
    start = {
        key: ((np.array(value) + asdict(case.true)[key]) / 2).tolist()
        for key, value in asdict(case.start).items()
    }
    nearer = replace(case, start=replace(case.start, **start), spp=4 * case.spp)
    monkeypatch.setitem(relight.CASES, name, nearer)
    monkeypatch.setattr(relight, "TARGET_SPP", 64)
    return start


def printed_unknowns(relight, output, name) -> dict[str, list[float]]:
    """The unknowns in the table that a run has printed."""
    rows = re.findall(r"^\| (.*) \| .* \| .* \| (.*) \|$", output, re.MULTILINE)
    found = {title: [float(x) for x in row.split(", ")] for title, row in rows[2:]}
    titles = relight.CASES[name].start.TITLES
    assert list(found) == list(titles.values())
    return {key: found[title] for key, title in titles.items()}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["objects", "mirror"])
def test_parameters_of_the_target_image_are_recovered(relight, monkeypatch, tmp_path, capsys, name):
    """In 40 steps, from a start that is half as far away."""
    start = start_halfway(relight, monkeypatch, name)
    monkeypatch.setattr(relight, "BALL", [0.9, 0.2, 0.45])  # beside the knot
    out = ["--out", tmp_path]
    run(relight, monkeypatch, MODEL, "--case", name, "--size", 40, "--iterations", 40, *out)
    output = capsys.readouterr().out
    losses = [float(x) for x in re.findall(r"loss ([\d.e+-]+)", output)]
    assert losses[-1] < losses[0] / 20
    true = relight.CASES[name].true
    at_start, at_end = errors(true, start), errors(true, printed_unknowns(relight, output, name))
    for key in start:
        assert at_end[key] < at_start[key] / 3, key
    assert (tmp_path / "parameters.md").read_text() in output
    for rendered in ("target", "start", "end", "difference"):
        assert iio.imread(tmp_path / f"{rendered}.png").shape == (40, 40, 3)
    with Image.open(tmp_path / "relight.webp") as animation:
        assert animation.n_frames == 14 and animation.size == (80, 40)
    assert (tmp_path / "loss.png").exists() and (tmp_path / "relight.gif").exists()


def test_a_models_smoothing_filter_reaches_the_integrator(relight):
    model = relight.load(MODEL)
    smoothing = np.full(model.num_gaussians, 0.05, np.float32)
    stages = [relight.Objects.of(one, 20) for one in (model, replace(model, smoothing=smoothing))]
    filters = [stage.scene.integrator().smoothing for stage in stages]
    assert filters[0] is None
    np.testing.assert_array_equal(np.array(filters[1]), smoothing)


def test_sh_rotation_matches_the_host(relight):
    rotation = Rotation.from_rotvec([0.3, -0.7, 0.4]).as_matrix()
    coefficients = np.random.default_rng(0).normal(0, 1, (5, 15, 3)).astype(np.float32)
    matrix = relight.sh_rotation(mi.Matrix3f(rotation), 3)
    actual = np.array(matrix @ mi.TensorXf(coefficients))
    # Some tens of float32 products of numbers of size one.
    np.testing.assert_allclose(actual, rotate_sh(coefficients, rotation), atol=1e-5)


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
    assert not (tmp_path / "out").exists()
