"""Fits in memory: ``drgs.train`` and ``FitSession``, and the decisions of rank 0."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import yaml
from support.fit_command import VALUES, write_project
from support.folders import contents
from support.small_capture import make_dataset, write_dataset

import drgs
from drgs.config.load import load_config
from drgs.core.errors import UserError
from drgs.effects.base import TrainingEffect
from drgs.fit import __main__ as fit
from drgs.fit import fit_folder
from drgs.fit.budget import rehearse
from drgs.fit.session import FitSession
from drgs.training.contracts import GivenParts
from drgs.training.density.strategy import DensityReport, DensityStrategy
from drgs.training.losses import Loss


@pytest.mark.slow
def test_session_without_a_folder_writes_and_prints_nothing(tmp_path, capsys):
    config = load_config(write_project(tmp_path))
    before, session = contents(tmp_path), FitSession(config)
    assert session.run()
    assert session.trainer.iteration == VALUES["iterations"] == session.history.rows[-1].iteration
    assert contents(tmp_path) == before and capsys.readouterr().out == ""


class Halves(DensityStrategy):
    """Keeps half of the rows after the fourth iteration."""

    def is_due(self, iteration):
        return iteration == 4

    def refine(self, population, iteration):
        kept = np.arange(population.num_rows // 2)
        population.edit(population.to_device_indices(kept))
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
    density, effect = {**VALUES["densify"], "remove_floaters": False}, Blue()
    config = load_config(write_project(tmp_path, densify=density))
    session = FitSession(config, parts=GivenParts(Halves(), [effect], Squares()))
    session.prepare()
    assert session.run() and effect.count == VALUES["iterations"]
    view = session.trainer.views[-1]
    image = dr.zeros(mi.TensorXf, (view.height, view.width, 3)) + 0.5
    _, loss, _ = session.trainer.compare(image, view)
    expected = np.square(np.array([0, 0, 0.5]) - np.array(view.target.image)).mean()
    assert float(loss[0]) == pytest.approx(expected, rel=1e-5)
    dataset, start = session.dataset, session.trainer.gaussians()
    rehearsal, _ = rehearse(session.config, dataset, start, None, session.parts)
    further = session.trainer.spawn(session.config, start)
    assert type(rehearsal.density) is Halves is not type(further.density)
    assert rehearsal.num_gaussians == start.num_gaussians // 2
    for trainer in (rehearsal, further):
        assert type(trainer.loss) is Squares and type(trainer.effects[0]) is Blue
        assert trainer.loss is not session.parts.loss and trainer.effects[0] is not effect
    assert effect.count == VALUES["iterations"] < rehearsal.effects[0].count


CONFIG = {
    "data": {"path": "data"},
    "init": {"num_points": 40, "half_extent": 0.5},
    "model": {"sh_degree": 1},
    "iterations": 7,
    "densify": {"start": 1, "stop": 6, "every": 2, "budget": {"prune_opacity": 0.005}},
    "output": {"history_every": 3, "save_renders": False},
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A dataset, and a configuration of it; the current folder."""
    write_dataset(tmp_path / "data", make_dataset(train=4, test=1))
    (tmp_path / "a.yml").write_text(yaml.safe_dump(CONFIG))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(fit_folder, "write_results", lambda *arguments: None)
    return tmp_path


@pytest.mark.slow
def test_train_gives_the_bytes_of_the_command(folder):
    """From a file, from nested mappings, and from a configuration with its dataset."""
    fit.main([str(folder / "a.yml"), "--out", str(folder / "out")])
    expected = (folder / "out" / "point_cloud_drgs.ply").read_bytes()
    history = (folder / "out" / "history.csv").read_text().splitlines()[1:]
    dataset = drgs.load_dataset("data")
    for arguments in ((folder / "a.yml",), (CONFIG,), (load_config("a.yml"), dataset)):
        result = drgs.train(*arguments)
        result.gaussians.save(folder / "a.ply")
        assert (folder / "a.ply").read_bytes() == expected
        rows = [(row.iteration, f"{row.loss:.6g}") for row in result.history]
        assert rows == [(int(line.split(",")[0]), line.split(",")[1]) for line in history]
        assert [iteration for iteration, _ in rows] == [3, 6, 7]


def test_callback_receives_each_iteration_and_may_end_the_fit(folder):
    reports = []
    result = drgs.train(CONFIG, callback=reports.append)
    assert [report.iteration for report in reports] == [1, 2, 3, 4, 5, 6, 7]
    assert reports[2].loss == result.history[0].loss

    result = drgs.train(CONFIG, callback=lambda report: report.iteration == 4)
    assert result.trainer.iteration == 4
    assert [row.iteration for row in result.history] == [3]
    assert result.gaussians.num_gaussians == reports[3].num_gaussians
    result.trainer.step()
    assert result.trainer.iteration == 5


def test_configuration_of_a_dataset_in_memory_names_no_data(folder):
    rest = {key: value for key, value in CONFIG.items() if key != "data"}
    without = drgs.train(rest, drgs.load_dataset("data"), lambda report: report.iteration == 2)
    given = drgs.train(CONFIG, drgs.load_dataset("data"), lambda report: report.iteration == 2)
    np.testing.assert_array_equal(without.gaussians.means, given.gaussians.means)


def test_folder_is_fitted_with_the_settings_of_its_data(folder):
    config = drgs.train("data", callback=lambda report: True).trainer.config
    assert config.data.path == folder / "data" and config.iterations == 3000


@pytest.mark.parametrize(
    ("config", "message"),
    [
        ({"iterations": 3}, "train(): config: data is missing"),
        ({**CONFIG, "iterations": 0}, "train(): config: iterations must be >= 1, got 0"),
        ({**CONFIG, "data": {"path": "nowhere"}}, "data.path: there is no folder "),
        ("b.yml", "b.yml: "),
    ],
)
def test_wrong_configurations_are_refused_like_by_the_command(folder, config, message):
    with pytest.raises(UserError) as error:
        drgs.train(config)
    assert str(error.value).startswith(message)


def test_datasets_take_their_settings_by_name(folder):
    plain = drgs.load_dataset("data")
    black = drgs.load_dataset(folder / "data", background="black", image_size=16)
    assert black.background == (0.0, 0.0, 0.0) and plain.background == (1.0, 1.0, 1.0)
    assert black.train[0].width == 16 < plain.train[0].width
    section = load_config("a.yml").data
    assert drgs.load_dataset(section, background="black").background == black.background
    with pytest.raises(UserError, match=r"load_dataset\(\): unknown key data.image_sise; did you"):
        drgs.load_dataset("data", image_sise=3)
