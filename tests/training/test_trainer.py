"""The parts of the training loop that can be stated without running a whole fit."""

import mitsuba as mi
import numpy as np
import pytest
from support.small_fits import kernel_hashes, steps
from support.trainers import make_trainer, small_dataset, small_view

from drgs.datasets.images import smaller_view
from drgs.training.steps import view_of


def test_views_are_shuffled_every_round():
    rounds = np.array([view_of(i, 10, seed=3) for i in range(1, 51)]).reshape(5, 10)
    assert np.array_equal(np.sort(rounds, axis=1), np.tile(np.arange(10), (5, 1)))
    assert len({tuple(r) for r in rounds}) == 5
    assert [view_of(i, 10, seed=4) for i in range(1, 51)] != rounds.ravel().tolist()


def test_sh_degree_increases_by_one_at_fixed_intervals():
    trainer = make_trainer(model={"sh_degree": 2, "sh_increase_every": 3})
    degrees = [steps(trainer, 1).integrator.sh_degree for _ in range(10)]
    assert degrees == [0, 0, 1, 1, 1, 2, 2, 2, 2, 2]


@pytest.mark.slow
def test_only_sh_steps_compile_kernels_after_the_first_change_of_the_population():
    """Kernels by hash, as Dr.Jit's caches do: what they hold from other runs does not matter."""
    densify = {"start": 3, "stop": 45, "every": 4, "budget": {"gaussians": 90, "error_every": 3}}
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


def test_reported_loss_and_psnr_are_measured_before_the_step():
    trainer = make_trainer(loss={"dssim_weight": 0.0})
    report = trainer.step()
    first = view_of(1, 4, seed=0)
    untouched = make_trainer(loss={"dssim_weight": 0.0})
    image = np.array(
        mi.render(untouched.scene, sensor=untouched.stages[-1].views[first].sensor, spp=1)
    )
    photo = small_dataset().train[first].image
    assert report.loss == pytest.approx(np.abs(image - photo).mean(), rel=1e-5)
    psnr = -10 * np.log10(np.mean((image.astype(float) - photo) ** 2))
    assert report.psnr == pytest.approx(psnr, rel=1e-5)


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


def test_smaller_view_is_the_same_camera_with_larger_pixels():
    view = small_view("v", 1.0)
    smaller = smaller_view(view, 4)
    blocks = view.image.reshape(4, 4, 5, 4, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(smaller.image, blocks, rtol=1e-6)
    # A point on the film is at a quarter of its place, counted from the corner.
    point = np.array([0.3, -0.2, 2.0])
    film, smaller_film = view.K @ point / point[2], smaller.K @ point / point[2]
    np.testing.assert_allclose(smaller_film[:2], film[:2] / 4, rtol=1e-12)
    assert smaller.name == "v" and np.array_equal(smaller.camera_to_world, view.camera_to_world)


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
