"""Scripts run, find known results, and write into the checkout only if they are told to."""

import importlib
import re
import sys
from dataclasses import asdict, replace

import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from PIL import Image
from support.helpers import FLOAT32 as SINGLE
from support.helpers import Case, clear, device_camera, device_gaussians

from drgs.bench import scenes
from drgs.reference import splatting as reference
from drgs.splatting import rendering

SCENES = REPOSITORY / "scenes"
STUDIES = SCENES / "studies"
KNOT = SCENES / "shapes" / "knot.ply"

SCRIPTS = {
    "compare_shapes": (("--size", 48), {"out/shapes.png"}),
    "knot": ((), {"out/knot.ply"}),
    "draw_tiles": ((), {"out/tiles.png"}),
    "flat_mirror": (("--size", 8, "--splats", 20), set()),
    "among_surfaces": ((), set()),
    "gallery": (
        (),
        {
            f"out/gallery/{n}.jpg"
            for n in ("defocus", "depth", "fisheye", "normals", "panorama", "popping")
        },
    ),
    "relight": ((KNOT,), {"out/relight/target.png"}),
}
"""Arguments, and the files that are written to the current folder."""


def main_scripts(folder):
    return sorted(path.stem for path in folder.glob("*.py") if "__main__" in path.read_text())


def files_of_the_checkout():
    """Return path, size and time of the last change of each file."""
    folders = ("docs", "drgs", "plugins", "scenes", "tests")
    paths = [path for name in folders for path in (REPOSITORY / name).rglob("*.*")]
    states = {path: path.stat() for path in paths if "__pycache__" not in path.parts}
    return {path: (state.st_size, state.st_mtime_ns) for path, state in states.items()}


@pytest.fixture
def load_script(monkeypatch, tmp_path):
    """Load a script in an empty folder, as with these arguments: load(name, *arguments)."""

    def load(name, *arguments):
        for folder in (SCENES, STUDIES, REPOSITORY / "docs"):
            monkeypatch.syspath_prepend(folder)
        monkeypatch.chdir(tmp_path)
        monkeypatch.setattr(sys, "argv", [f"{name}.py", *map(str, arguments)])
        return importlib.import_module(name)

    return load


def test_every_script_is_tested_and_every_study_has_its_result():
    assert {*main_scripts(SCENES), *main_scripts(REPOSITORY / "docs")} == SCRIPTS.keys()
    listed = (STUDIES / "README.md").read_text()
    for name in main_scripts(STUDIES):
        assert (STUDIES / f"{name}.md").is_file() and f"({name}.py)" in listed


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_script_writes_to_the_current_folder(load_script, monkeypatch, tmp_path, capsys, name):
    arguments, written = SCRIPTS[name]
    module = load_script(name, *arguments)
    if name == "compare_shapes":
        monkeypatch.setattr(module, "REPEATS", {"volprim_rf_basic": 1, "splats": 1})
    if name == "relight":
        image = np.zeros((4, 4, 3), np.uint8)
        (tmp_path / "out" / "relight").mkdir(parents=True)
        monkeypatch.setattr(
            module, "relight", lambda *words: iio.imwrite(words[-1] / "target.png", image)
        )
    if name == "among_surfaces":
        for rows in ("furnace_rows", "shadow_rows"):
            monkeypatch.setattr(module, rows, lambda *arguments: [])
    before = files_of_the_checkout()
    module.main()
    assert files_of_the_checkout() == before
    assert {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*.*")} == written
    assert written or capsys.readouterr().out.count("\n") >= 4


@pytest.mark.parametrize("name", main_scripts(STUDIES))
def test_every_study_has_help(load_script, name, capsys):
    with pytest.raises(SystemExit) as end:
        load_script(name, "--help").main()
    assert end.value.code == 0
    assert f"usage: {name}.py" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "arguments", "printed"),
    [
        ("hybrid", "--gaussians 100 --size 16 --rounds 1", "| 100 |"),
        ("effects", "--quick", "| camera refinement | pose and focal lengths |"),
        ("kernels", "--gaussians 200 --size 32 --rounds 1", "| a training iteration |"),
        ("prediction", "--quick", "| 64 | 25 Gbit/s |"),
    ],
)
def test_study_runs(load_script, name, arguments, printed, capsys):
    load_script(name, *arguments.split()).main()
    assert printed in capsys.readouterr().out


def test_useful_pairs_match_the_reference(load_script):
    case = clear(Case("pairs", 40, 35, 0, count=80))
    inputs = device_gaussians(case.gaussians, SINGLE), device_camera(case.camera, SINGLE)
    work = load_script("stages").count_work(rendering.render(*inputs, rendering.Pipeline(0)))
    splats = reference.project(case.gaussians, case.camera)
    order = reference.depth_order(splats.depths, splats.visible)
    y, x = np.mgrid[: case.height, : case.width] + 0.5
    transmittance, finished, useful = np.ones(x.shape), np.zeros(x.shape, bool), 0
    for i in order:
        d = np.stack([x - splats.means2d[i, 0], y - splats.means2d[i, 1]], axis=-1)
        exponent = -0.5 * np.einsum("hwi,ij,hwj->hw", d, splats.conics[i], d)
        alpha = np.minimum(splats.opacities[i] * np.exp(exponent), reference.ALPHA_MAX)
        seen = (alpha >= reference.ALPHA_CUT) & ~finished
        finished |= seen & (transmittance * (1 - alpha) < reference.TRANSMITTANCE_STOP)
        seen &= ~finished
        transmittance = np.where(seen, transmittance * (1 - alpha), transmittance)
        useful += int(seen.sum())
    assert work.useful == useful > 1000
    assert work.useful <= work.evaluated <= 16 * work.micro_entries
    assert work.entries <= work.micro_entries <= 16 * work.entries


def test_every_kernel_of_an_iteration_belongs_to_a_stage(load_script):
    stages, before = load_script("stages"), rendering.bin_splats
    mi.set_variant("llvm_ad_rgb")
    scene = stages.Scene("small", scenes.bench_gaussians(500), scenes.bench_camera(48))
    clock = stages.clocked_step(stages.warm_trainer(scene))
    assert rendering.bin_splats is before
    assert {stage for stage, _ in clock.history} == set(stages.STAGES)
    assert all(clock.num_kernels(s) > 0 and clock.kernel_ms[s] > 0 for s in stages.STAGES)


@pytest.mark.parametrize("settings", [{"background": [1.0] * 3}, {}], ids=["background", "sky"])
def test_white_cloud_before_white_is_white_in_every_pixel(load_script, settings):
    mean, error = load_script("among_surfaces").furnace(16, settings, {}, rounds=2)
    assert mean == pytest.approx(1, abs=1e-5) and error < 1e-6


@pytest.mark.slow
def test_splats_among_surfaces_agree_with_known_results(load_script):
    """A white furnace for every material and light, and the shadow of a ball of splats."""
    script = load_script("among_surfaces")
    rows = script.furnace_rows(16, rounds=4)
    assert len(rows) == 2 + len(script.MATERIALS) * len(script.LIGHTS)
    for material, light, mean, error in rows:
        # Four standard errors, and half a thousandth that probes leave.
        assert abs(mean - 1) < 4 * error + 5e-4, (material, light)
    for lamp, known, found, difference in script.shadow_rows(16, 4000):
        # Its outline is soft, by 4 % of its radius: so much more of the light is gone.
        assert found == pytest.approx(known, abs=0.015), lamp
        assert difference < 0.015 and known < 0.95, lamp


@pytest.mark.slow
@pytest.mark.parametrize("name", ["objects", "mirror"])
def test_relighting_recovers_the_parameters_of_the_target(
    load_script, monkeypatch, tmp_path, capsys, name
):
    """In 40 steps of more paths, from a start that is half as far away."""
    words = ("--case", name, "--size", 40, "--iterations", 40, "--out", tmp_path)
    relight = load_script("relight", KNOT, *words)
    case = relight.CASES[name]
    true = asdict(case.true)
    start = {k: ((np.array(v) + true[k]) / 2).tolist() for k, v in asdict(case.start).items()}
    nearer = replace(case, start=replace(case.start, **start), spp=4 * case.spp)
    monkeypatch.setitem(relight.CASES, name, nearer)
    monkeypatch.setattr(relight, "TARGET_SPP", 64)
    monkeypatch.setattr(relight, "BALL", [0.9, 0.2, 0.45])  # beside the knot
    relight.main()
    output = capsys.readouterr().out
    losses = [float(x) for x in re.findall(r"loss ([\d.e+-]+)", output)]
    assert losses[-1] < losses[0] / 20
    _, _, *rows = re.findall(r"^\| (.*) \| .* \| .* \| (.*) \|$", output, re.MULTILINE)
    printed = {title: [float(x) for x in row.split(", ")] for title, row in rows}
    found = {key: printed[title] for key, title in case.start.TITLES.items()}
    for key, value in true.items():
        at_start, at_end = (np.linalg.norm(np.subtract(v[key], value)) for v in (start, found))
        assert at_end < at_start / 3, key
    for rendered in ("target", "start", "end", "difference"):
        assert iio.imread(tmp_path / f"{rendered}.png").shape == (40, 40, 3)
    with Image.open(tmp_path / "relight.webp") as animation:
        assert animation.n_frames == 14 and animation.size == (80, 40)


def test_a_models_smoothing_filter_reaches_the_integrator(load_script):
    relight = load_script("relight")
    model = relight.load(KNOT)
    smoothing = np.full(model.num_gaussians, 0.05, np.float32)
    stages = [relight.Objects.of(one, 20) for one in (model, replace(model, smoothing=smoothing))]
    plain, smooth = (stage.scene.integrator().smoothing for stage in stages)
    assert plain is None
    np.testing.assert_array_equal(np.array(smooth), smoothing)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere.ply"], "nowhere.ply: "),
        ([KNOT, "--iterations", 0], "--iterations must be >= 1, got 0"),
        ([KNOT, "--size", 90], "--size must be a multiple of 20 px, got 90"),
    ],
)
def test_wrong_arguments_of_relighting_are_refused(load_script, capsys, arguments, message):
    with pytest.raises(SystemExit, match="2"):
        load_script("relight", *arguments).main()
    assert capsys.readouterr().err.startswith(f"error: {message}")
