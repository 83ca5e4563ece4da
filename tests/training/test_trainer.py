"""The parts of the training loop that can be stated without running a whole fit.

Prepared targets stay on the device while there is room, else they are prepared again.
"""

import numpy as np
import pytest
from support import small_fits as fits
from support.kernels import kernel_hashes
from support.small_fits import steps
from support.trainers import make_trainer

from drgs.gaussians.morton import space_order
from drgs.training.losses import target_bytes


def test_sh_degree_increases_by_one_at_fixed_intervals():
    trainer = make_trainer(model={"sh_degree": 2, "sh_increase_every": 3})
    degrees = [steps(trainer, 1).integrator.sh_degree for _ in range(10)]
    assert degrees == [0, 0, 1, 1, 1, 2, 2, 2, 2, 2]


@pytest.mark.slow
def test_only_sh_steps_compile_kernels_after_the_first_change_of_the_population():
    """Kernels by hash, as Dr.Jit's caches do: what they hold from other runs does not matter."""
    densify = {"start": 3, "stop": 66, "every": 4, "budget": {"gaussians": 90, "error_every": 3}}
    trainer = make_trainer(
        model={"sh_degree": 3, "sh_increase_every": 12}, densify={"strategy": "budget", **densify}
    )
    seen, compiled, populations = set(), set(), {trainer.num_gaussians}
    for iteration in range(1, 51):

        def step():
            populations.add(trainer.step().num_gaussians)
            trainer.watch.check()

        hashes = kernel_hashes(step)
        if hashes - seen:
            compiled.add(iteration)
        seen |= hashes
    assert len(populations) > 10
    # The first change is at 4; degrees rise at 12, 24 and 36.
    assert 4 in compiled and {i for i in compiled if i > 8} == {12, 24, 36}, compiled


def test_coarse_stages_come_first_and_end_as_configured():
    trainer = make_trainer(coarse=[{"until": 2, "factor": 4}, {"until": 5, "factor": 2}])
    sizes, names = [], []
    for iteration in range(1, 9):
        trainer.iteration = iteration
        view = trainer.last_step.views[-1].view
        sizes.append((view.width, view.height))
        names.append(view.name)
    assert sizes == [(5, 4)] * 2 + [(10, 8)] * 3 + [(20, 16)] * 3
    assert sorted(names[:4]) == sorted(names[4:]) == ["v0", "v1", "v2", "v3"]


def test_population_may_change_without_higher_degrees():
    """shN, which has no numbers then, is in no optimizer: its rows follow."""
    densify = {
        "start": 2,
        "stop": 30,
        "every": 5,
        "strategy": "adc",
        "adc": {"grad_threshold": 1e-9, "clone_scale": 10.0},
    }
    trainer = make_trainer(model={"sh_degree": 0}, densify=densify)
    reports = [trainer.step().density for _ in range(12)]
    assert sum(report.cloned for report in reports if report) > 0
    gaussians = trainer.gaussians()
    assert gaussians.shN.shape == (gaussians.num_gaussians, 0, 3)
    assert gaussians.num_gaussians > 40


def test_rows_are_sorted_in_space_with_all_that_belongs_to_them():
    trainer = steps(make_trainer(), 3)
    population, count, (name,) = trainer.population, trainer.num_gaussians, trainer.density.by_row
    shuffled = np.random.default_rng(0).permutation(count)
    population.edit(population.to_device_indices(shuffled))
    trainer.density.restore({**trainer.density.state(), name: np.arange(count)})
    before = trainer.state()
    trainer._sort_rows()
    after = trainer.state()
    rows = after[f"density/{name}"].astype(int)
    np.testing.assert_array_equal(rows, space_order(before["means.value"]))
    assert (rows != np.arange(count)).any()
    for key in filter(trainer._is_by_row, before):
        former, now = (state[key].reshape(count, -1) for state in (before, after))
        np.testing.assert_array_equal(now, former[rows], key)


def indices_on_device(trainer):
    """Indices of the views whose targets are on the device, by phase."""
    return [
        {view.index for view in phase.views if "photograph" in vars(view)}
        for phase in trainer.phases
    ]


def test_targets_are_cached_within_the_memory_limit():
    trainer, seen = make_trainer(room=2 * target_bytes(16, 20) + 7), []
    assert indices_on_device(trainer) == [set()]
    for _ in range(8):  # two rounds of four views
        trainer.step()
        seen += [trainer.last_step.views[-1].view.index]
        assert indices_on_device(trainer) == [set(seen[:2])]


@pytest.mark.slow
@pytest.mark.parametrize("effects", [{}, {"data__random_background": True, "colors__lr": 0.02}])
def test_fit_does_not_depend_on_cached_targets(effects):
    """Nor on effects that upload something of a view."""

    def result(**room):
        settings = {"loss__depth_weight": 0.2, **effects, **room}
        trainer = fits.make_trainer(fits.true_dataset(), **settings)
        return trainer, fits.everything_of(steps(trainer, 8))

    _, kept = result()
    trainer, made_again = result(room=0)
    assert indices_on_device(trainer) == [set()]
    assert not any(view.uploads for view in trainer.views)
    assert made_again == kept


def test_device_memory_of_a_view_is_counted():
    """Effects say what they upload of a pixel."""
    changes = {"loss__depth_weight": 0.2, "data__random_background": True, "colors__lr": 0.02}
    trainer = fits.make_trainer(fits.true_dataset(), **changes)
    view = steps(trainer, 1).last_step.views[-1].view
    arrays = [view.photograph.values, view.photograph.means, view.photograph.mean_squares]
    arrays += [view.uploads["colors"].array, view.uploads["background"].array]
    arrays += view.uploads["depth"]
    stored = 4 * sum(len(array) for array in arrays)
    of_uploads = sum(effect.upload_bytes for effect in trainer.effects) * view.width * view.height
    assert stored == target_bytes(view.height, view.width) + of_uploads


def test_finished_stage_leaves_no_arrays_on_the_device():
    trainer = make_trainer(coarse=[{"until": 3, "factor": 2}])
    steps(trainer, 3)
    coarse, full = indices_on_device(trainer)
    assert len(coarse) == 3 and not full
    steps(trainer, 1)
    coarse, full = indices_on_device(trainer)
    assert not coarse and len(full) == 1
    assert np.shape(trainer.last_step.views[-1].view.photograph.image) == (16, 20, 3)
