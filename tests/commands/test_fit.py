"""``python -m drgs.fit`` from end to end, on a small scene made by the reference renderer."""

import csv
import json
import signal
import subprocess
import sys
import time
from datetime import datetime

import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import pytest
import yaml
from conftest import REPOSITORY
from support.commands import run_in_process
from support.folders import visible
from support.viewer_rendering import VIEWER_RENDERING

from drgs.cli.execution import execution_settings
from drgs.config.load import dump_config, load_config
from drgs.datasets import load_dataset
from drgs.fit import main
from drgs.gaussians.parameters import Gaussians
from drgs.initialization.start import initial_gaussians
from drgs.reference import splatting as reference

SIZE = 32
FIELD_OF_VIEW = 0.7
OUTPUTS = (
    *("point_cloud.ply", "metrics.json", "history.csv", "density.csv", "config.yml"),
    *("curves.png", "orbit.webp", "orbit.gif", "report.html", "viewer.html", "views.json"),
)


def random_blobs(num, rng):
    """A handful of large coloured blobs within the unit cube."""
    return reference.Gaussians(
        means=rng.uniform(-0.7, 0.7, (num, 3)),
        quats=rng.normal(size=(num, 4)),
        log_scales=np.log(rng.uniform(0.1, 0.3, (num, 3))),
        logit_opacities=np.full(num, 2.0),
        sh0=rng.uniform(-1.5, 1.5, (num, 1, 3)),
        shN=np.zeros((num, 0, 3)),
    )


def orbit_pose(angle):
    """Camera to world in OpenGL axes, on a circle of radius 4 around the origin."""
    back = np.array([np.cos(angle), np.sin(angle), 0.5])
    back /= np.linalg.norm(back)
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
    pose[:3, 3] = 4 * back
    return pose


def write_view(folder, split, index, angle, blobs):
    """Render one RGBA image (straight alpha) with the reference; returns its frame."""
    pose = orbit_pose(angle)
    focal = SIZE / 2 / np.tan(FIELD_OF_VIEW / 2)
    camera = reference.Camera(
        rotation=(pose[:3, :3] * [1, -1, -1]).T,
        center=pose[:3, 3],
        fx=focal,
        fy=focal,
        cx=SIZE / 2,
        cy=SIZE / 2,
        width=SIZE,
        height=SIZE,
    )
    rendered = reference.render(blobs, camera)
    straight = rendered.image / np.maximum(rendered.alpha[:, :, None], 1e-9)
    rgba = np.dstack([np.clip(straight, 0, 1), rendered.alpha])
    (folder / split).mkdir(exist_ok=True)
    name = f"{split}/r_{index}"
    iio.imwrite(folder / f"{name}.png", np.round(rgba * 255).astype(np.uint8))
    return {"file_path": f"./{name}", "transform_matrix": pose.tolist()}


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    folder = tmp_path_factory.mktemp("blobs")
    blobs = random_blobs(6, np.random.default_rng(0))
    for split, count, offset in (("train", 12, 0.0), ("test", 3, 0.3)):
        angles = offset + np.arange(count) * 2 * np.pi / count
        frames = [write_view(folder, split, i, a, blobs) for i, a in enumerate(angles)]
        transforms = {"camera_angle_x": FIELD_OF_VIEW, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(transforms))
    return folder


@pytest.fixture(scope="module")
def configuration(dataset):
    path = dataset / "blobs.yml"
    values = {
        "data": {"path": str(dataset), "background": "white"},
        "init": {"num_points": 300, "half_extent": 1.0},
        "model": {"sh_degree": 1, "sh_increase_every": 100, **VIEWER_RENDERING},
        "densify": {
            "strategy": "adc",
            "adc": {"clone_scale": 0.03, "reset_every": 150, "white_background_reset": 80},
            "start": 60,
            "stop": 200,
            "every": 20,
            "max_gaussians": 500,
        },
        "iterations": 300,
    }
    path.write_text(yaml.safe_dump(values))
    return path


def fit(*arguments):
    return run_in_process(main, *arguments)


def fit_in_a_process(*arguments):
    return subprocess.run(
        [sys.executable, "-m", "drgs.fit", *map(str, arguments)],
        cwd=REPOSITORY,
        capture_output=True,
        text=True,
        timeout=300,
    )


@pytest.fixture(scope="module")
def fitted(configuration, tmp_path_factory):
    out = tmp_path_factory.mktemp("out") / "first"
    return fit_in_a_process(configuration, "--out", out, "--threads", 2), out


def test_fit_writes_its_outputs_and_nothing_temporary(fitted):
    result, out = fitted
    assert result.returncode == 0, result.stderr
    images = {f"{kind}/test/r_{i}.png" for kind in ("renders", "side_by_side") for i in range(3)}
    assert visible(out) == {*OUTPUTS, *images}


def test_last_line_names_the_file_to_open(fitted):
    result, out = fitted
    assert result.stdout.splitlines()[-1] == f"open {out / 'report.html'}"


def test_report_records_command_machine_and_date(fitted, configuration):
    _, out = fitted
    page = (out / "report.html").read_text()
    metrics = json.loads((out / "metrics.json").read_text())
    command = f"python -m drgs.fit {configuration} --out {out} --threads 2"
    assert metrics["command"] == command and command in page
    assert metrics["processor"] and metrics["processor"] in page
    assert abs(datetime.fromisoformat(metrics["date"]).timestamp() - time.time()) < 3600
    assert '<a href="point_cloud.ply" download>' in page
    with (out / "history.csv").open() as file:
        measured = {row["iteration"]: row["test_psnr"] for row in csv.DictReader(file)}
    assert [iteration for iteration, psnr in measured.items() if psnr] == ["100", "200", "300"]
    # All three test views are measured on the way.
    assert float(measured["300"]) == pytest.approx(metrics["test"]["psnr"], abs=1e-3)


def test_fit_reaches_a_good_image_of_test_views(fitted):
    _, out = fitted
    metrics = json.loads((out / "metrics.json").read_text())
    # 300 random points reach 27 dB and more; a fit that does not learn stays below 15 dB.
    assert metrics["test"]["psnr"] > 25
    assert metrics["test"]["num_views"] == 3
    assert metrics["test"]["split"] == "test"
    assert metrics["iterations"] == 300
    assert metrics["config"]["densify"]["max_gaussians"] == 500
    assert metrics["seed"] == 0


def test_metrics_agree_with_the_images_written(fitted, dataset):
    _, out = fitted
    scores = []
    for i in range(3):
        rgba = iio.imread(dataset / "test" / f"r_{i}.png") / 255
        photo = rgba[:, :, :3] * rgba[:, :, 3:] + (1 - rgba[:, :, 3:])
        image = iio.imread(out / "renders" / "test" / f"r_{i}.png") / 255
        scores.append(-10 * np.log10(np.mean((image - photo) ** 2)))
    metrics = json.loads((out / "metrics.json").read_text())
    # The images are rounded to 8 bits: at 30 dB that moves the PSNR by about 0.01 dB.
    assert np.mean(scores) == pytest.approx(metrics["test"]["psnr"], abs=0.1)


def test_population_changes_and_never_exceeds_its_cap(fitted):
    _, out = fitted
    with (out / "history.csv").open() as file:
        rows = list(csv.DictReader(file))
    population = [int(row["num_gaussians"]) for row in rows]
    assert len(set(population)) > 1
    assert max(population) <= 500
    assert len(Gaussians.load(out / "point_cloud.ply").means) == population[-1]
    assert [int(row["iteration"]) for row in rows] == list(range(10, 301, 10))
    assert float(rows[-1]["loss"]) < 0.5 * float(rows[0]["loss"])


def make_trainer(config):
    mi.set_variant("llvm_ad_rgb")
    from drgs.training.trainer import Trainer

    dataset = load_dataset(config.data)
    return Trainer(config, dataset, initial_gaussians(config, dataset))


@pytest.mark.slow
def test_configuration_covers_every_change_within_a_fit(fitted, configuration):
    """The tests below compare the bytes of such fits, this one with those of a longer process."""
    config = load_config(configuration)
    reports, degrees, opacities = [], set(), {}
    with execution_settings(threads=None, debug=False):
        trainer = make_trainer(config)
        for iteration in range(1, config.iterations + 1):
            reports.append(trainer.step().density)
            degrees.add(trainer.sh_degree)
            if iteration in (79, 80, 149, 150):
                opacities[iteration] = trainer.gaussians().opacities.max()
    densified = [report for report in reports if report is not None]
    assert len(densified) == 6  # after 80, 100, ..., 180
    for change in ("cloned", "split", "pruned"):
        assert sum(getattr(report, change) for report in densified) > 0, change
    for reset in (80, 150):  # white_background_reset, reset_every
        assert opacities[reset - 1] > 0.02
        assert opacities[reset] == pytest.approx(0.01)
    assert degrees == {0, 1}

    _, first = fitted
    trainer.gaussians().save(first.parent / "in_process.ply")
    expected = (first / "point_cloud.ply").read_bytes()
    assert (first.parent / "in_process.ply").read_bytes() == expected


@pytest.mark.slow
def test_the_resolved_configuration_gives_the_same_bytes_on_any_number_of_threads(fitted, tmp_path):
    """One thread, and the first fit's two. The configuration itself is fitted again above."""
    _, first = fitted
    again = fit(first / "config.yml", "--out", tmp_path / "again", "--threads", 1)
    assert again.returncode == 0, again.stderr
    for folder, threads in ((first, 2), (tmp_path / "again", 1)):
        assert json.loads((folder / "metrics.json").read_text())["threads"] == threads
    for name in ("point_cloud.ply", "renders/test/r_0.png"):
        assert (tmp_path / "again" / name).read_bytes() == (first / name).read_bytes(), name
    page = (first / "viewer.html").read_text().replace("<title>first:", "<title>again:")
    assert (tmp_path / "again" / "viewer.html").read_text() == page


@pytest.mark.slow
def test_shipped_scene_gives_the_same_bytes_on_any_number_of_threads():
    """Some moments of 30,000 Gaussians are denormal numbers from the start."""
    config = load_config(REPOSITORY / "scenes" / "lego_mini.yml")
    trainer = make_trainer(config)
    start, results = trainer.state(), {}
    for threads in (1, 2, 5):
        with execution_settings(threads, debug=False):
            trainer.restore(start)
            for _ in range(8):
                trainer.step()
            results[threads] = trainer.state()
    for name, values in results[1].items():
        for threads in (2, 5):
            assert results[threads][name].tobytes() == values.tobytes(), (name, threads)


@pytest.mark.slow
def test_another_seed_gives_another_result(configuration):
    """The seed chooses the initial points and the order of the views."""
    results = []
    for seed in (0, 0, 1):
        trainer = make_trainer(load_config(configuration, [f"seed={seed}"]))
        views = []
        for _ in range(8):
            trainer.step()
            views.append(trainer.last_step.views[-1].view.index)
        results.append((trainer.gaussians().means.tobytes(), views))
    first, again, other = results
    assert first == again
    assert first[0] != other[0] and first[1] != other[1]


@pytest.mark.slow
@pytest.mark.parametrize("sent", [signal.SIGINT, signal.SIGKILL])
def test_stopped_fit_resumes_to_the_same_bytes(fitted, configuration, tmp_path, sent):
    """Ctrl-C saves and exits with 130; kill -9 loses what came after the last checkpoint."""
    _, first = fitted
    out = tmp_path / "stopped"
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "drgs.fit", configuration, "--out", out),
            *("--set", "output.checkpoint_every=20"),
        ],
        cwd=REPOSITORY,
        stdout=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 120
    while not (out / "checkpoint.npz").exists() and time.monotonic() < deadline:
        time.sleep(0.01)
    process.send_signal(sent)
    output, _ = process.communicate(timeout=120)
    if sent == signal.SIGINT:
        assert process.returncode == 130
        assert f"python -m drgs.fit --resume {out}" in output
    assert not (out / "metrics.json").exists()

    resumed = fit("--resume", out)
    assert resumed.returncode == 0, resumed.stderr
    assert "continues at iteration" in resumed.stdout
    for name in ("point_cloud.ply", "renders/test/r_0.png"):
        assert (out / name).read_bytes() == (first / name).read_bytes(), name
    with (out / "history.csv").open() as file:
        iterations = [int(row["iteration"]) for row in csv.DictReader(file)]
    assert iterations == list(range(10, 301, 10))
    assert not (out / "checkpoint.npz").exists()


def test_damaged_checkpoint_is_refused_by_name(configuration, tmp_path):
    out = tmp_path / "damaged"
    out.mkdir()
    dump_config(load_config(configuration), out / "config.yml")
    (out / "checkpoint.npz").write_bytes(b"PK\x03\x04 cut short")
    result = fit("--resume", out)
    assert result.returncode == 2
    assert "checkpoint.npz: cannot read the checkpoint" in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "densify.evry=5"], "unknown key densify.evry; did you mean densify.every?"),
        (["--set", "densify.every=0"], "densify.every must be >= 1, got 0"),
        (["--data", "nowhere"], "there is no folder"),
    ],
)
def test_user_errors_exit_with_2_and_one_line(configuration, tmp_path, arguments, message):
    result = fit(configuration, "--out", tmp_path / "out", *arguments)
    assert result.returncode == 2
    assert message in result.stderr
    assert "Traceback" not in result.stderr
    assert len(result.stderr.strip().splitlines()) == 1
    assert not (tmp_path / "out").exists()


def test_progress_is_readable_without_a_terminal(fitted):
    result, _ = fitted
    last = [line for line in result.stdout.splitlines() if line.startswith("iteration")][-1]
    assert "iteration 300/300" in last
    for word in ("loss", "PSNR", "Gaussians", "left"):
        assert word in last
    assert "\x1b" not in result.stdout
