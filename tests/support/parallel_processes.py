"""Several processes that do something together: started by ``mpiexec``, as users start them.

``python -m support.parallel_processes`` is a program that each of them runs.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import subprocess
import sys
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from drgs.cameras.viewpoints import CameraMotion
from drgs.datasets.images import without_images
from drgs.datasets.types import View
from drgs.initialization.defaults import resolve_defaults
from drgs.training.finite_checks import NonFiniteError
from drgs.training.parallel.communicator import Communicator
from drgs.training.parallel.population import own_views
from drgs.training.trainer import Trainer
from support import small_fits as fits

TESTS = Path(__file__).resolve().parent.parent
REPOSITORY = TESTS.parent
TIMEOUT = 240
"""Seconds."""


def mpiexec() -> str:
    """The launcher; skips the test where it, or what talks to it, is not installed."""
    pytest.importorskip("mpi4py", reason="the extra mpi is not installed")
    beside = Path(sys.executable).parent / "mpiexec"
    found = str(beside) if beside.exists() else shutil.which("mpiexec")
    if found is None:
        pytest.skip("there is no mpiexec")
    return found


def environment() -> dict[str, str]:
    """For processes that find ``support`` and this checkout, and were not started by others."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith(("PMI", "PYTEST"))}
    return {**kept, "PYTHONPATH": f"{TESTS}{os.pathsep}{REPOSITORY}"}


def start(
    size: int, words: Sequence[str], cwd: Path = REPOSITORY, on_second: str = ":"
) -> subprocess.Popen:
    """Begin to run ``python WORDS`` on so many processes.

    on_second: what a shell does before, on the second of them.
    """
    shell = f'if [ "$PMI_RANK" = 1 ]; then {on_second}; fi; exec "$@"'
    return subprocess.Popen(
        [mpiexec(), "-n", str(size), "sh", "-c", shell, "sh", sys.executable, *map(str, words)],
        cwd=cwd,
        env=environment(),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(
    size: int, words: Sequence[str], cwd: Path = REPOSITORY, on_second: str = ":"
) -> tuple[int, str, str]:
    """Status, output and errors of ``python WORDS`` on so many processes: see :func:`start`."""
    process = start(size, words, cwd, on_second)
    output, errors = process.communicate(timeout=TIMEOUT)
    return process.returncode, output, errors


def failing_import(folder: Path, module: str, error: str) -> str:
    """For a shell: from now on, importing ``module`` raises ``error``, an expression of Python."""
    (folder / "sitecustomize.py").write_text(
        "import sys\n"
        "class Failing:\n"
        "    def find_spec(self, name, path=None, target=None):\n"
        f"        if name == {module!r}:\n"
        f"            raise {error}\n"
        "sys.meta_path.insert(0, Failing())\n"
    )
    return f'export PYTHONPATH="{folder}:$PYTHONPATH"'


def ranks_of(word: str) -> list[int]:
    """The running processes of MPI whose command line has this word (Linux)."""
    found = []
    for folder in Path("/proc").iterdir():
        try:
            words = (folder / "cmdline").read_bytes().split(b"\0")
            variables = (folder / "environ").read_bytes()
        except OSError:  # no process, or one that is gone
            continue
        if word.encode() in words and b"PMI_RANK=" in variables:
            found.append(int(folder.name))
    return found


def _blurred() -> Any:
    """Photographs of which every other one was taken by a camera that moved."""

    def moving(view: View) -> View:
        closed = view.camera_to_world.copy()
        closed[:3, 3] += 0.05
        return replace(view, motion=CameraMotion(closed, "global", samples=3))

    dataset = fits.plain_dataset()
    views = (view if k % 2 else moving(view) for k, view in enumerate(dataset.train))
    return replace(dataset, train=tuple(views))


DATASETS = {
    "plain": fits.plain_dataset,
    "transparent": fits.true_dataset,
    "shifted": fits.shifted_dataset,
    "blurred": _blurred,
}


def fitted(size: int, changes: Mapping[str, Any], data: str = "plain", **task: int) -> Any:
    """Return the result of a small fit on so many processes; data: of DATASETS.

    task: ``steps`` of :func:`hashes_and_reports`, or the row of :func:`spoiled`.
    """
    text = json.dumps({"changes": dict(changes), "data": data, **task})
    status, output, errors = run(size, ["-m", "support.parallel_processes", text])
    assert status == 0, errors
    return json.loads(output)


def hashes_and_reports(trainer: Any, steps: int) -> list:
    """After some steps: hashes of the state by name, and what each step has reported."""
    reports = [trainer.step() for _ in range(steps)]
    state = trainer.state()
    hashes = {name: hashlib.sha256(v.tobytes()).hexdigest()[:12] for name, v in state.items()}
    shown = [[r.iteration, r.loss, r.psnr, r.num_gaussians, r.means_lr] for r in reports]
    return [hashes, shown]


def main() -> None:
    """A process's part of :func:`fitted`."""
    mi.set_variant("llvm_ad_rgb")
    dr.set_thread_count(1)
    task = json.loads(sys.argv[1])
    dataset = DATASETS[task["data"]]()
    comm = Communicator.world()
    config = resolve_defaults(fits.config_of(**task["changes"]), dataset)  # reads all images
    own = own_views(len(dataset.train), config.optimizer.views_per_step, comm.rank, comm.size)
    train = (v if i in own else without_images(v) for i, v in enumerate(dataset.train))
    dataset = replace(dataset, train=tuple(train))
    trainer = Trainer(config, dataset, fits.disturbed_blobs(), comm)
    if "spoiled" in task:
        found = spoiled(trainer, task["spoiled"])
    else:
        found = hashes_and_reports(trainer, task["steps"])
    if comm.is_root:
        print(json.dumps(found))


def spoiled(trainer: Any, row: int) -> str:
    """Return the trainer's error on all processes, when an opacity of a row is NaN."""
    logits = trainer.population.value("logit_opacities")
    here = row - trainer.population.first_row
    changed = dr.select(
        dr.arange(dr.uint32_array_t(type(logits)), len(logits)) == here, dr.nan, logits
    )
    trainer.population.set_values("logit_opacities", changed)
    try:
        trainer.check()
    except NonFiniteError as error:
        said = str(error)
    same = trainer.comm.all_gather(np.array([zlib.crc32(said.encode())]))
    assert (same == same[0]).all()
    return said


if __name__ == "__main__":
    main()
