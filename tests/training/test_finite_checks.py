"""A fit whose numbers are no longer finite: where it says the trouble began, and what it keeps."""

import re
from contextlib import nullcontext
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import small_fits as fits
from support.fit_command import assert_fits, run_fit, without_images, write_scene
from support.folders import visible
from support.trainers import make_trainer

from drgs.fit import session
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.splatting import rendering
from drgs.training.finite_checks import NonFiniteError
from drgs.training.losses import prepare_target
from drgs.training.steps import view_of
from drgs.training.trainer import Trainer

ROW = 17


def with_value(vector, row, value):
    """``vector``, a Float or an array of Floats, with ``value`` in its last column of one row."""
    columns = [vector] if dr.depth_v(vector) == 1 else list(vector)
    here = dr.arange(mi.UInt32, dr.width(vector)) == row
    columns[-1] = dr.select(here, value, columns[-1])
    return columns[0] if dr.depth_v(vector) == 1 else type(vector)(columns)


def poison_gradient(monkeypatch, trainer, name, iteration, value=np.nan, row=ROW):
    """One component of one row's gradient is ``value`` in that iteration."""
    real = rendering._back_to_rows  # private: gradients of rows before they are checked

    def poisoned(*arguments):
        d_rows, visible, numbers = real(*arguments)
        if trainer.iteration == iteration:
            assert visible[row]
            if name in ("sh0", "shN"):
                k = 0 if name == "sh0" else len(d_rows.sh) - 1
                sh = [with_value(v, row, value) if i == k else v for i, v in enumerate(d_rows.sh)]
                d_rows = replace(d_rows, sh=sh)
            else:
                d_rows = replace(d_rows, **{name: with_value(getattr(d_rows, name), row, value)})
        return d_rows, visible, numbers

    monkeypatch.setattr(rendering, "_back_to_rows", poisoned)


def poison_value(trainer, name, value=np.nan, row=ROW):
    """One component of one row of a parameter is ``value`` from now on."""
    old = dr.detach(trainer.optimizer[name])
    host = np.array(old)
    host[(row, *(-1,) * (host.ndim - 1))] = value
    trainer.population.replace(name, type(old)(host))


SPOILT = view_of(4, 4, seed=0)


def spoil_photograph(trainer):
    """The photograph that a fit of four views visits first in iteration 4 is NaN in one pixel."""
    view = trainer.views[SPOILT]
    photo = np.full((view.height, view.width, 3), 0.5, np.float32)
    photo[12, 16] = np.nan
    view.replacement = prepare_target(mi.TensorXf(photo))


@pytest.mark.slow
@pytest.mark.parametrize("name", PARAMETER_NAMES)
def test_nonfinite_gradient_is_named_although_detected_later(monkeypatch, name):
    trainer = make_trainer(model={"sh_degree": 1, "sh_increase_every": 1})
    poison_gradient(monkeypatch, trainer, name, iteration=3)
    fits.steps(trainer, 6)
    view = trainer.views[view_of(3, 4, trainer.config.seed)].name
    expected = f"iteration 3, view {view}: the gradient of {name} in row {ROW} is"
    with pytest.raises(NonFiniteError, match=f"^{re.escape(expected)} not finite"):
        trainer.watch.check()


@pytest.mark.parametrize(
    ("value", "is_fault"),
    # Adam squares gradients: 1e20 squared is beyond float32 (3.4e38), 1e18 squared is not.
    [(np.inf, True), (-np.inf, True), (1e20, True), (-1e20, True), (1e18, False)],
)
def test_gradient_whose_square_overflows_is_nonfinite(monkeypatch, value, is_fault):
    trainer = make_trainer()
    poison_gradient(monkeypatch, trainer, "log_scales", iteration=2, value=value)
    fits.steps(trainer, 2)
    expected = pytest.raises(NonFiniteError, match=f"log_scales in row {ROW}")
    with expected if is_fault else nullcontext():
        trainer.check()


def test_first_row_and_its_first_parameter_are_named(monkeypatch):
    trainer = make_trainer()
    for name, row in (("means", 30), ("sh0", 20), ("quats", 20), ("logit_opacities", 25)):
        poison_gradient(monkeypatch, trainer, name, iteration=1, row=row)
    trainer.step()
    with pytest.raises(NonFiniteError, match="gradient of quats in row 20 "):
        trainer.check()


@pytest.mark.parametrize(
    ("dssim_weight", "gradient"), [(0.0, ""), (0.2, r" and the gradient of \w+ in row \d+ .*")]
)
def test_nonfinite_loss_names_iteration_and_view(dssim_weight, gradient):
    """SSIM's gradient tells as well; that of L1 is 0 at a NaN."""
    trainer = make_trainer(loss={"dssim_weight": dssim_weight})
    spoil_photograph(trainer)
    fits.steps(trainer, 3)
    trainer.check()
    trainer.step()
    message = f"^iteration 4, view v{SPOILT}: the loss is nan{gradient}$"
    with pytest.raises(NonFiniteError, match=message):
        trainer.check()


EVENTS = {
    "saving": ({}, lambda trainer: trainer.state()),
    "returning": ({}, lambda trainer: trainer.gaussians()),
    "densifying": ({"start": 1, "every": 4}, lambda trainer: trainer.step()),
    "opacity reset": (
        {"start": 1, "strategy": "adc", "adc": {"reset_every": 4}},
        lambda trainer: trainer.step(),
    ),
}


@pytest.mark.parametrize("event", EVENTS)
def test_nothing_is_saved_returned_or_edited_after_a_fault(monkeypatch, event):
    densify, act = EVENTS[event]
    trainer = make_trainer(densify=densify)
    poison_gradient(monkeypatch, trainer, "log_scales", iteration=2)
    fits.steps(trainer, 3)
    for attempt in (act, type(trainer).state):  # nor by who has caught the error
        with pytest.raises(NonFiniteError, match=r"^iteration 2, "):
            attempt(trainer)


def test_restored_trainer_has_no_fault(monkeypatch):
    trainer = make_trainer()
    trainer.step()
    good = trainer.state()
    poison_gradient(monkeypatch, trainer, "means", iteration=2)
    trainer.step()
    trainer.restore(good)
    monkeypatch.undo()
    trainer.step()
    trainer.check()


@pytest.mark.slow
@pytest.mark.parametrize("name", PARAMETER_NAMES)
@pytest.mark.parametrize("value", [np.nan, -np.inf])
def test_nonfinite_value_is_named(name, value):
    trainer = fits.steps(make_trainer(model={"sh_degree": 1, "sh_increase_every": 1}), 1)
    poison_value(trainer, name, value)
    message = f"^after iteration 1: {name} is {value} in row {ROW}$"
    with pytest.raises(NonFiniteError, match=message):
        trainer.check()


def test_nonfinite_value_is_detected_without_a_nonfinite_gradient():
    """Such a Gaussian is invisible; densification would have removed it without a word."""
    trainer = make_trainer(densify={"start": 1, "every": 5})
    trainer.step()
    poison_value(trainer, "log_scales")
    for _ in range(3):
        assert np.isfinite(trainer.step().loss)
    trainer.watch.check()
    message = f"^after iteration 5: log_scales is nan in row {ROW}$"
    with pytest.raises(NonFiniteError, match=message):
        trainer.step()


def test_nonfinite_statistics_are_named():
    """A gradient of positions on the film that overflows may leave all parameters' gradients."""
    trainer = make_trainer(densify={"strategy": "adc", "remove_floaters": False})
    trainer.step()
    trainer.density.gradient_norms = with_value(trainer.density.gradient_norms, ROW, np.nan)
    with pytest.raises(NonFiniteError, match=f"gradient_norms is nan in row {ROW}$"):
        trainer.state()


EFFECTS = {
    "colors.matrices": {"colors__lr": 2e-3},
    "cameras.turns": {"cameras__optimise": True},
    "cameras.moves": {"cameras__optimise": True},
    "cameras.log_focals": {"cameras__optimise": True, "cameras__focal_lr": 1e-3},
    "cameras.shifts": {"cameras__optimise": True, "cameras__principal_lr": 1e-3},
}


def poison_effect(trainer, name, index, value, part="value"):
    """The last number of a view's row, or of that for all views, is ``value`` from now on."""
    (effect,) = trainer.effects
    state, key = effect.state(), f"{name.partition('.')[2]}.{part}"
    state[key] = state[key].copy()
    rows = len(state[key])
    state[key][min(index, rows - 1), -1] = value
    effect.restore(state)
    return f"in row {index} (view r_{index})" if rows > 1 else "in row 0 (all views)"


@pytest.mark.slow
@pytest.mark.parametrize("part", ["value", "m", "v"])
@pytest.mark.parametrize("name", EFFECTS)
def test_nonfinite_numbers_of_an_effect_are_named(name, part):
    trainer = fits.steps(fits.make_trainer(fits.plain_dataset(), **EFFECTS[name]), 2)
    where = poison_effect(trainer, name, 3, np.inf, part)
    shown = name if part == "value" else f"{name}.{part}"
    for act in (Trainer.check, Trainer.state, Trainer.gaussians):
        with pytest.raises(NonFiniteError) as error:
            act(trainer)
        assert str(error.value) == f"after iteration 2: {shown} is inf {where}"


@pytest.mark.slow
@pytest.mark.parametrize("name", EFFECTS)
def test_nonfinite_iteration_names_the_effect_that_caused_it(name):
    trainer = fits.steps(fits.make_trainer(fits.plain_dataset(), **EFFECTS[name]), 2)
    index = view_of(3, len(trainer.views), trainer.config.seed)
    poison_effect(trainer, name, index, np.nan)
    trainer.step()
    with pytest.raises(NonFiniteError, match=f"^iteration 3, view r_{index}: {name} is nan"):
        trainer.check()


def test_step_waits_for_one_value_and_a_check_is_small():
    """Each copy is a value that the host waits for: the number of entries."""
    trainer = fits.steps(make_trainer(), 5)
    for act in (trainer.step, trainer.watch.check):
        dr.sync_thread()
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            act()
            dr.sync_thread()
        history = dr.kernel_history()
        if act == trainer.step:
            assert [entry["type"] for entry in history].count(dr.KernelType.Memcpy) == 1
        else:
            assert all(entry["size"] <= 4 for entry in history)


@pytest.fixture
def configuration(tmp_path, monkeypatch):
    """A fit without reports whose population stays."""
    without_images(monkeypatch)
    output = {"checkpoint_every": 2, "history_every": 3, "save_renders": False}
    values = {"model": {"sh_degree": 0}, "densify": {"stop": 100}, "iterations": 7}
    return write_scene(tmp_path, train=4, output=output, **values)


def spoil(monkeypatch, what):
    """Spoil a photograph, or, after iteration 4, a value; return the error."""
    step = Trainer.step

    def step_and_spoil(trainer):
        if what == "photograph":
            spoil_photograph(trainer)
        report = step(trainer)
        if what == "value" and trainer.iteration == 4:
            poison_value(trainer, "log_scales", np.inf)
        return report

    monkeypatch.setattr(Trainer, "step", step_and_spoil)
    if what == "photograph":
        return f"iteration 4, view r_{SPOILT}: the loss is nan"
    return f"after iteration 4: log_scales is inf in row {ROW}"


@pytest.mark.slow
@pytest.mark.parametrize("what", ["photograph", "value"])
def test_stopped_fit_keeps_the_last_good_checkpoint_and_resumes(
    monkeypatch, tmp_path, configuration, what
):
    out, saved, save = tmp_path / "out", [], session.save_checkpoint

    def save_and_remember(folder, *rest):
        save(folder, *rest)
        saved.append((folder / "checkpoint.npz").read_bytes())

    with monkeypatch.context() as spoiling:
        spoiling.setattr(session, "save_checkpoint", save_and_remember)
        expected = spoil(spoiling, what)
        message = run_fit(configuration, "--out", out).stderr
    assert message.startswith(f"error: {expected}") and message.count("\n") == 1
    assert f"the last checkpoint is kept. --resume {out} --debug repeats this" in message
    assert visible(out) == {"checkpoint.npz", "config.yml"}
    assert [(out / "checkpoint.npz").read_bytes()] == saved  # that of iteration 2
    assert "continues at iteration 2\n" in assert_fits("--resume", out).stdout
    assert_fits(configuration, "--out", tmp_path / "good")
    expected = (tmp_path / "good" / "point_cloud.ply").read_bytes()
    assert (out / "point_cloud.ply").read_bytes() == expected


@pytest.mark.parametrize(
    ("what", "iterations", "done"),
    [("photograph", 7, 6), ("value", 4, 4)],
    ids=["at the next row of the history", "in the last iteration"],
)
def test_fit_without_checkpoints_stops_and_leaves_no_results(
    monkeypatch, tmp_path, configuration, what, iterations, done
):
    expected, steps, step = spoil(monkeypatch, what), [], Trainer.step
    monkeypatch.setattr(Trainer, "step", lambda self: steps.append(self) or step(self))
    few = ("--set", f"iterations={iterations}", "--set", "output.checkpoint_every=null")
    outcome = run_fit(configuration, "--out", tmp_path / "out", *few)
    assert outcome.returncode == 2 and outcome.stderr.startswith(f"error: {expected}")
    assert len(steps) == done and visible(tmp_path / "out") == {"config.yml"}
