"""``drgs.fit`` on a scene so small that a fit takes a fraction of a second."""

from functools import partial
from pathlib import Path

import pytest
import yaml

from drgs.fit import __main__ as fit
from drgs.fit import fit_folder
from drgs.training.trainer import Trainer
from support.commands import assert_ends_well, assert_refused, run_in_process
from support.small_capture import make_dataset, write_dataset
from support.viewer_rendering import VIEWER_RENDERING

ITERATIONS = 8

SMALL = {"data": {"path": "data"}, "init": {"num_points": 40, "half_extent": 0.5}}
"""Sections that all scenes have here."""

VALUES = {
    "model": {"sh_degree": 1, "sh_increase_every": 3, **VIEWER_RENDERING},
    "densify": {
        "start": 1,
        "stop": 7,
        "every": 2,
        "strategy": "adc",
        "adc": {"reset_every": 3, "grad_threshold": 1e-6},
    },
    "iterations": ITERATIONS,
    "output": {"checkpoint_every": 2, "history_every": 1},
}


def write_scene(folder: Path, test: int = 1, train: int = 3, **values: object) -> Path:
    """``data/`` and ``a.yml``, which fits it; values: its other sections. Returns ``a.yml``."""
    write_dataset(folder / "data", make_dataset(train, test))
    (folder / "a.yml").write_text(yaml.safe_dump({**SMALL, **values}))
    return folder / "a.yml"


def write_project(folder: Path, **values: object) -> Path:
    """The same, of fits that save often; values: other sections than :data:`VALUES`."""
    return write_scene(folder, test=2, **{**VALUES, **values})


run_fit = partial(run_in_process, fit.main)
assert_fits = partial(assert_ends_well, fit.main)
assert_fit_refused = partial(assert_refused, fit.main)


def without_images(monkeypatch: pytest.MonkeyPatch) -> None:
    """A report that takes no time: an empty page."""

    def write_page(out: Path, *_: object) -> None:
        (out / "report.html").write_text("")

    monkeypatch.setattr(fit_folder, "write_results", write_page)


def stop_after(monkeypatch: pytest.MonkeyPatch, iteration: int) -> None:
    """Ctrl-C, without anything being saved, when so many iterations are done."""
    step = Trainer.step

    def step_and_stop(trainer: Trainer):
        if trainer.iteration == iteration:
            raise KeyboardInterrupt
        return step(trainer)

    monkeypatch.setattr(Trainer, "step", step_and_stop)
