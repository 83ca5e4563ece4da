"""``mpiexec -n K drgs fit`` and ``render``: the same files, one error, and all processes end."""

import csv
import json
import os
import random
import signal
import time
from contextlib import suppress
from pathlib import Path

import pytest
from support import parallel_processes

CONFIG = """
data: {{path: {data}, image_size: 50}}
iterations: {iterations}
init: {{num_points: 300}}
model: {{antialiased: true}}
optimizer: {{views_per_step: 4}}
densify: {{budget: {{gaussians: 600}}}}
output: {{report: false, save_renders: false, checkpoint_every: 20, history_every: 20}}
"""


@pytest.fixture
def config(tmp_path):
    """Writes a configuration: config(iterations)."""

    def write(iterations=60):
        path = tmp_path / "fit.yml"
        data = parallel_processes.REPOSITORY / "scenes" / "lego"
        path.write_text(CONFIG.format(data=data, iterations=iterations))
        return path

    return write


def command(*words):
    return ["-m", "drgs.fit", *words]


def result(folder):
    with (folder / "history.csv").open(newline="") as file:
        rows = [{k: v for k, v in row.items() if k != "wall_s"} for row in csv.DictReader(file)]
    names = ("point_cloud.ply", "point_cloud_drgs.ply")
    return [(folder / name).read_bytes() for name in names], rows


def assert_all_end(word):
    """The launcher may have ended a moment before its processes."""
    end = time.monotonic() + 10
    while parallel_processes.ranks_of(str(word)):
        assert time.monotonic() < end
        time.sleep(0.05)


@pytest.mark.slow
def test_each_process_reads_its_photographs_from_disk(config, tmp_path):
    """The report of several ranks those of the first process."""
    path = config()
    for size, in_memory in ((1, "true"), (2, "false")):
        words = "--out", tmp_path / str(size), "--set", f"data.in_memory={in_memory}"
        words += ("--set", "output.report=true")
        status, _, errors = parallel_processes.run(size, command(path, *words))
        assert status == 0, errors
    assert result(tmp_path / "1") == result(tmp_path / "2")
    assert (tmp_path / "2" / "report.html").is_file()


SCENES = parallel_processes.REPOSITORY / "scenes"
KNOT = SCENES / "shapes" / "knot.ply"

REFUSED = [
    (3, ["fit", "--set", "optimizer.views_per_step=2"], "at least the number of processes (3)"),
    (2, ["fit", "--set", "optimizer.views_per_step=101"], "the number of training views (100)"),
    (2, ["fit", "--set", "densify.prune.to=1"], "2 processes cannot share 1 Gaussians"),
    (2, ["fit", "--variant", "cuda_ad_rgb"], "--variant cuda_ad_rgb: not usable here"),
    (2, ["fit", "--threads", "100000"], "--threads"),
    (2, ["fit", "--view"], "--view: shows the fit of one process alone"),
    (2, ["fit", "--set", "densify.budget.prune_opacity=0.999"], "every Gaussian would be pruned"),
    (2, ["fit", "--nonsense"], "--nonsense"),
    (2, ["export", KNOT], "mpiexec: processes can share fit and render"),
    (2, ["render", SCENES / "hybrid.xml"], "a scene of Mitsuba is rendered by one process"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("size", "words", "message"), REFUSED)
def test_error_is_reported_once(config, tmp_path, size, words, message):
    (name, *words), out = words, tmp_path / "a.spz"
    files = [config()] if name == "fit" else []
    command = ["-m", f"drgs.{name}", *files, *words, "--out", out]
    status, _, errors = parallel_processes.run(size, command)
    assert (status, errors.count("error: ")) == (2, 1), errors
    assert message in errors and (name == "fit" or not out.exists())


@pytest.mark.slow
def test_processes_share_the_frames_of_an_orbit(tmp_path):
    outputs, files = [], []
    for size in (1, 3):
        out = tmp_path / str(size)
        words = ["-m", "drgs.render", KNOT, "--orbit", 5, "--size", 30, 20, "--out", out]
        status, output, errors = parallel_processes.run(size, words)
        assert status == 0, errors
        outputs.append(output.replace(str(out), "OUT"))
        files.append({p.name: p.read_bytes() for p in out.iterdir() if p.suffix != ".json"})
    assert outputs[0] == outputs[1]
    assert files[0] == files[1] and len(files[0]) == 6  # frames, and an animation


MISSING = "ModuleNotFoundError('No module named mpi4py', name='mpi4py')"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("on_second", "message"),
    [
        ("export DRJIT_LIBLLVM_PATH=/nonexistent.so", "process 1: error: --variant llvm_ad_rgb"),
        (MISSING, "process 1: error: mpiexec: needs mpi4py"),
    ],
    ids=["behind the start", "before the start"],
)
def test_failure_of_one_process_is_reported_once_and_ends_all(config, tmp_path, on_second, message):
    if on_second is MISSING:
        on_second = parallel_processes.failing_import(tmp_path, "mpi4py", MISSING)
    words, start = command(config(), "--out", tmp_path / "out"), time.monotonic()
    status, _, errors = parallel_processes.run(2, words, on_second=on_second)
    assert (status, errors.count("error: ")) == (2, 1), errors
    assert message in errors and "Traceback" not in errors and "Fatal" not in errors
    assert time.monotonic() - start < 60  # 4 to 8 s; without an end, for ever
    assert_all_end(tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_unexpected_error_of_one_process_prints_one_traceback_and_ends_all(config, tmp_path):
    failing = parallel_processes.failing_import(
        tmp_path, "drgs.training.parallel.exchange", "RuntimeError('a bug')"
    )
    words = command(config(), "--out", tmp_path / "out")
    status, _, errors = parallel_processes.run(2, words, on_second=failing)
    assert status == 1, errors
    assert errors.startswith("process 1: Traceback") and errors.count("Traceback") == 1
    assert errors.endswith("RuntimeError: a bug\n")


def wait_for(process, is_reached):
    """Wait until a running process has done something."""
    end = time.monotonic() + 60
    while not is_reached():
        assert process.poll() is None and time.monotonic() < end
        time.sleep(0.05)


def memory_map(process):
    """The files that a running process has loaded, among them libraries (Linux)."""
    with suppress(OSError):
        return Path(f"/proc/{process}/maps").read_text()
    return ""


@pytest.mark.slow
def test_ctrl_c_during_a_rehearsal_ends_all_processes(config, tmp_path):
    """In a rehearsal: nothing is to be saved, and nobody is left behind."""
    path, out = config(iterations=100_000), tmp_path / "out"
    process = parallel_processes.start(2, command(path, "--out", out, "--budget", "1h"))

    def have_imported():
        ranks = parallel_processes.ranks_of(str(out))
        return len(ranks) >= 2 and all("scipy/ndimage" in memory_map(rank) for rank in ranks)

    wait_for(process, have_imported)
    time.sleep(2.5)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert_all_end(out)


def started(path, out, size=2):
    """A fit that has saved a checkpoint and goes on."""
    process = parallel_processes.start(size, command(path, "--out", out))
    wait_for(process, (out / "checkpoint.npz").exists)
    return process


@pytest.mark.slow
def test_fit_stopped_by_ctrl_c_resumes_on_another_number_of_processes(config, tmp_path):
    path = config(iterations=800)
    process = started(path, tmp_path / "out")
    process.send_signal(signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130 and "stopped; continue with" in output
    status, output, errors = parallel_processes.run(3, command("--resume", tmp_path / "out"))
    assert status == 0 and output.count("written: ") == 1 and "Traceback" not in errors
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert metrics["config"]["optimizer"]["views_per_step"] == 4
    assert parallel_processes.run(1, command(path, "--out", tmp_path / "whole"))[0] == 0
    assert result(tmp_path / "out") == result(tmp_path / "whole")


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_death_of_a_process_ends_all_and_the_fit_resumes(config, tmp_path, seed):
    """At any moment; the checkpoint is whole, and others go on with it."""
    out, rng = tmp_path / "out", random.Random(seed)
    process = started(config(iterations=800), out, 3)
    time.sleep(2 * rng.random())
    ranks = parallel_processes.ranks_of(str(out))
    assert len(ranks) == 3
    os.kill(rng.choice(ranks), signal.SIGKILL)
    process.communicate(timeout=30)
    assert process.returncode != 0
    assert_all_end(out)
    assert parallel_processes.run(2, command("--resume", out))[0] == 0
    assert (out / "metrics.json").exists()
