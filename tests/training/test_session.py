"""``FitSession``: a fit without a command, and the decisions of rank 0."""

from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.fit_command import VALUES, write_project
from support.folders import contents
from support.trainers import make_trainer

import drgs
from drgs.config.load import load_config
from drgs.core.errors import UserError
from drgs.training.budget import Budget, rehearse
from drgs.training.density.strategy import DensityReport, DensityStrategy
from drgs.training.effects.base import TrainingEffect
from drgs.training.loop import RootDecides, iterations
from drgs.training.losses import Loss
from drgs.training.session import FitSession


@pytest.mark.slow
def test_session_without_a_folder_writes_and_prints_nothing(tmp_path, capsys):
    config = load_config(write_project(tmp_path))
    before, session = contents(tmp_path), FitSession(config)
    assert session.run()
    assert session.trainer.iteration == VALUES["iterations"] == session.history.rows[-1].iteration
    assert contents(tmp_path) == before and capsys.readouterr().out == ""
    fitted = drgs.train(config).gaussians
    np.testing.assert_array_equal(session.trainer.gaussians().means, fitted.means)


@pytest.mark.slow
def test_budget_too_short_is_refused_before_creating_the_trainer(tmp_path):
    config = load_config(write_project(tmp_path))
    session = FitSession(config, budget=Budget(seconds=1.0, end=0.0))
    with pytest.warns(), pytest.raises(UserError, match="--budget: must leave time for 50"):
        session.run()
    assert not hasattr(session, "trainer")


class Halves(DensityStrategy):
    """Keeps half of the rows after the fourth iteration."""

    def is_due(self, iteration):
        return iteration == 4

    def refine(self, population, iteration):
        kept = np.arange(population.num_rows // 2)
        population.edit(population.rows(kept))
        return DensityReport(num_gaussians=len(kept))


class Blue(TrainingEffect):
    """Renderings are compared without red and green; counts the views that it sees."""

    name, count = "blue", 0

    def before_render(self, fit, view):
        self.count += 1

    def adjust(self, image, view):
        return image * type(image)(mi.Float([0.0, 0.0, 1.0]), (1, 1, 3))


class Squares(Loss):
    """The mean squared error."""

    def __call__(self, image, target):
        return dr.mean(dr.square(image.array - target.image.array))


@pytest.mark.slow
def test_objects_are_used_and_other_trainers_get_copies_of_them(tmp_path):
    """A rehearsal gets all of them; Gaussians for viewers, whose number stays, no strategy."""
    config, effect = load_config(write_project(tmp_path)), Blue()
    session = FitSession(config, strategy=Halves(), effects=[effect], loss=Squares())
    session.prepare()
    assert session.run() and effect.count == VALUES["iterations"]
    view = session.trainer.views[-1]
    image = dr.zeros(mi.TensorXf, (view.height, view.width, 3)) + 0.5
    _, loss, _ = session.trainer.compare(image, view)
    expected = np.square(np.array([0, 0, 0.5]) - np.array(view.target.image)).mean()
    assert float(loss[0]) == pytest.approx(expected, rel=1e-5)
    dataset, start = session.dataset, session.trainer.gaussians()
    objects = session.strategy, session.effects, session.loss
    rehearsal, _ = rehearse(session.config, dataset, start, None, *objects)
    further = session.trainer.spawn(session.config, start)
    assert type(rehearsal.density) is Halves is not type(further.density)
    assert rehearsal.num_gaussians == start.num_gaussians // 2
    for trainer in (rehearsal, further):
        assert type(trainer.loss) is Squares and type(trainer.effects[0]) is Blue
        assert trainer.loss is not session.loss and trainer.effects[0] is not effect
    assert effect.count == VALUES["iterations"] < rehearsal.effects[0].count


class Revises:
    """Rank 0 sets another end after the second iteration, and ends there."""

    def should_continue(self, trainer):
        if trainer.iteration == 2:
            trainer.reschedule(5, 4)
        return trainer.iteration < trainer.config.iterations

    def num_iterations(self, trainer):
        return trainer.config.iterations


def test_other_ranks_end_and_revise_a_fit_like_rank_0():
    told = []

    def ask(numbers):
        told.append(numbers)
        return np.array(numbers)

    root = SimpleNamespace(is_root=True, broadcast_numbers=ask)
    other = SimpleNamespace(is_root=False, broadcast_numbers=lambda numbers: np.array(told.pop(0)))
    trainers = [make_trainer(iterations=50, densify={"start": 3, "stop": 30}) for _ in range(2)]
    for trainer, comm in zip(trainers, (root, other), strict=True):
        criterion = RootDecides(Revises() if comm.is_root else None, comm)
        history = SimpleNamespace(add=lambda report: None, add_density=lambda *_: None)
        assert len(list(iterations(trainer, history, criterion))) == 5
    assert trainers[0].config == trainers[1].config and not told
    assert trainers[1].config.iterations == 5 and trainers[1].config.densify.stop == 4
