"""Prepared targets stay on the device while there is room, else they are prepared again."""

import numpy as np
import pytest
from support import small_fits as fits
from support.trainers import make_trainer

from drgs.training import memory
from drgs.training import steps as training_steps
from drgs.training.losses import TARGET_BYTES

PIXELS = 20 * 16


def indices_on_device(trainer):
    """Indices of the views whose targets are on the device, by stage."""
    return [
        {view.index for view in stage.views if "photograph" in vars(view)}
        for stage in trainer.stages
    ]


def test_targets_are_cached_within_the_memory_limit(monkeypatch):
    monkeypatch.setattr(memory, "MAX_TARGET_BYTES", 2 * PIXELS * TARGET_BYTES + 7)
    trainer, seen = make_trainer(), []
    assert indices_on_device(trainer) == [set()]
    for _ in range(8):  # two rounds of four views
        trainer.step()
        seen += [trainer.last_step.views[-1].view.index]
        assert indices_on_device(trainer) == [set(seen[:2])]


@pytest.mark.slow
@pytest.mark.parametrize("effects", [{}, {"data__random_background": True, "colors__lr": 0.02}])
def test_fit_does_not_depend_on_cached_targets(monkeypatch, effects):
    """Nor on effects that upload something of a view."""

    def result():
        trainer = fits.make_trainer(fits.true_dataset(), loss__depth_weight=0.2, **effects)
        return trainer, fits.everything_of(fits.steps(trainer, 8))

    _, kept = result()
    monkeypatch.setattr(memory, "MAX_TARGET_BYTES", 0)
    trainer, made_again = result()
    assert indices_on_device(trainer) == [set()]
    assert not any(view.uploads for view in trainer.views)
    assert made_again == kept


def test_device_memory_of_a_view_is_counted():
    """Effects say what they upload of a pixel."""
    changes = {"loss__depth_weight": 0.2, "data__random_background": True, "colors__lr": 0.02}
    trainer = fits.make_trainer(fits.true_dataset(), **changes)
    view = fits.steps(trainer, 1).last_step.views[-1].view
    arrays = [view.photograph.values, view.photograph.means, view.photograph.mean_squares]
    arrays += [view.uploads["colors"].array, view.uploads["background"].array]
    arrays += view.uploads["depth"]
    count = sum(len(array) for array in arrays) * 4
    assert count == view.width * view.height * training_steps.bytes_per_pixel(trainer.effects)


def test_finished_stage_leaves_no_arrays_on_the_device():
    trainer = make_trainer(coarse=[{"until": 3, "factor": 2}])
    fits.steps(trainer, 3)
    coarse, full = indices_on_device(trainer)
    assert len(coarse) == 3 and not full
    fits.steps(trainer, 1)
    coarse, full = indices_on_device(trainer)
    assert not coarse and len(full) == 1
    assert np.shape(trainer.last_step.views[-1].view.photograph.image) == (16, 20, 3)
