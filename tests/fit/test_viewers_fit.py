"""Gaussians that are fitted further as viewers render them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import small_fits as fits
from support.small_capture import decibels
from support.viewer_rendering import VIEWER_RENDERING

from drgs.config.approximations import Approximations
from drgs.config.changes import with_changes
from drgs.config.schema import ModelConfig
from drgs.core.errors import UserNote
from drgs.fit import viewers_fit as viewers
from drgs.fit.viewers_fit import fit_small_file, for_viewers, num_iterations, tuning
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.scene import make_scene, render_views
from drgs.io import sog
from drgs.io.quantization import morton_order
from drgs.training.trainer import Trainer

NON_VIEWER_SETTINGS = {"model.antialiased": True, "model.low_pass": 0.02}


def ended_fit(iterations=20, **changes):
    """A trainer that has done all of its iterations, its dataset, and its Gaussians."""
    dataset = fits.plain_dataset()
    config = with_changes(fits.config_of(iterations=iterations), {**NON_VIEWER_SETTINGS, **changes})
    start = fits.disturbed_blobs()
    start = replace(start, shN=start.shN[:, : (config.model.sh_degree + 1) ** 2 - 1])
    trainer = fits.steps(Trainer(config, dataset, start), iterations)
    return trainer, dataset, trainer.gaussians()


def quat_to_rotations(quats):
    return Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()


def psnr(images, dataset):
    pairs = zip(images, dataset.test, strict=True)
    return np.mean([decibels(image, view.image) for image, view in pairs])


@pytest.mark.slow
def test_iterations_improve_images_of_viewers(monkeypatch):
    monkeypatch.setattr(viewers, "ITERATIONS_SHARE", 1.0)
    trainer, dataset, gaussians = ended_fit()
    before, counted = list(trainer.images(dataset.test)), []
    found = for_viewers(trainer, gaussians, lambda *done: counted.append(done))
    assert counted == [(k, 20) for k in range(1, 21)]
    model = ModelConfig(near=0.2, **VIEWER_RENDERING)

    def in_viewers(gaussians):
        scene = make_scene(gaussians, model, dataset.background)
        return psnr(render_views(scene, dataset.test), dataset)

    tuned = in_viewers(found.gaussians)
    assert tuned > in_viewers(gaussians) + 0.2
    assert psnr(found.images(dataset.test), dataset) == pytest.approx(tuned, abs=1e-6)
    assert found.gaussians.rendered_with == {"antialiased": False, "low_pass": 0.3}
    # The fit itself renders the same images as before.
    np.testing.assert_array_equal(list(trainer.images(dataset.test)), before)


def test_refined_cameras_and_colours_are_kept():
    """Its rates are next to nothing; the views to measure are those of the refined cameras."""
    changes = {"cameras.optimise": True, "cameras.rotation_lr": 1e-3, "colors.lr": 0.02}
    changes["colors.vignetting_lr"] = 0.02
    trainer, _, gaussians = ended_fit(8, **changes)
    before = {effect.name: effect.values() for effect in trainer.effects}
    tuners = []
    found = for_viewers(trainer, gaussians, lambda *done: tuners.append(done))
    assert len(tuners) == num_iterations(trainer.config) == 1
    for effect in found.effects:
        for name, values in effect.values().items():
            np.testing.assert_array_equal(values, before[effect.name][name])
    config = tuning(trainer.config, 1)
    colors = config.sections["colors"]
    assert colors.lr == colors.vignetting_lr == viewers.NEGLIGIBLE_RATE
    assert config.sections["cameras"].rotation_lr == 0 and len(found.effects) == 3


def test_nonfinite_values_fall_back_to_the_closed_form(monkeypatch):
    trainer, _, gaussians = ended_fit(8)
    # Private: what no iteration has changed.
    expected = viewers._closed_form(trainer, gaussians, Approximations())
    monkeypatch.setitem(viewers.TOUCH_UP_RATES, "scales_lr", 10.0)
    monkeypatch.setattr(viewers, "ITERATIONS_SHARE", 0.5)
    step = Trainer.step

    def step_and_break(self):
        report = step(self)
        self.optimizer["means"] = self.optimizer["means"] * np.nan
        return report

    monkeypatch.setattr(Trainer, "step", step_and_break)
    with pytest.warns(UserNote, match="for viewers are not fitted any further"):
        found = for_viewers(trainer, gaussians)
    np.testing.assert_array_equal(found.gaussians.log_scales, expected.log_scales)


def test_tuning_keeps_the_population_and_continues_the_schedule():
    changes = {**NON_VIEWER_SETTINGS, "model.order": "pixel", "coarse": [{"until": 9, "factor": 2}]}
    config = with_changes(fits.config_of(iterations=400), changes)
    further = tuning(config, 32)
    assert further.iterations == 432 and further.densify.stop == 1 and further.coarse == []
    assert further.optimizer.decay_from == 400 / 432
    assert further.model.approximations.is_default and not config.model.approximations.is_default
    assert further.model.sh_degree == config.model.sh_degree
    assert further.loss == config.loss and further.data == config.data


@pytest.mark.parametrize("degree", [0, 1])
def test_a_small_file_shows_what_was_fitted(tmp_path, monkeypatch, degree):
    """The images that are measured are those of the file, and nearer than without iterations."""
    monkeypatch.setattr(viewers, "ROUNDED_ITERATIONS", 30)
    monkeypatch.setattr(sog, "CELLS", 2)  # so that the palette has fewer entries than Gaussians
    changes = {"model.sh_degree": degree, "model.sh_increase_every": 2, "output.small_file": "sog"}
    trainer, dataset, gaussians = ended_fit(20, **changes)
    found = fit_small_file(trainer, gaussians)
    assert (found.model.low_pass, found.model.antialiased) == (0.075, False)  # as PlayCanvas
    found.gaussians.save(tmp_path / "a.sog")
    read = Gaussians.load(tmp_path / "a.sog")
    order = morton_order(found.gaussians.means)  # in which the file has them
    for name in PARAMETER_NAMES:
        shown, expected = (getattr(g, name) for g in (read, found.gaussians[order]))
        if name == "quats":  # of which files have neither signs nor lengths
            shown, expected = map(quat_to_rotations, (shown, expected))
        # 16 bits of positions between bounds that may be narrower by a step or two.
        atol = {"means": 1e-4, "quats": 1e-6}.get(name, 0)
        np.testing.assert_allclose(shown, expected, rtol=1e-5, atol=atol)
    monkeypatch.setattr(viewers, "ROUNDED_ITERATIONS", 1)
    other = fit_small_file(trainer, gaussians)
    fitted, rounded = (psnr(each.images(dataset.test), dataset) for each in (found, other))
    assert fitted > rounded + 0.1


def test_a_number_that_is_not_finite_leaves_the_small_file_unfitted(monkeypatch):
    """Rounding would make a finite number of it."""
    trainer, _, gaussians = ended_fit(8, **{"output.small_file": "sog"})
    step = Trainer.step

    def step_and_break(self):
        report = step(self)
        self.optimizer["sh0"] = self.optimizer["sh0"] * np.nan
        return report

    monkeypatch.setattr(Trainer, "step", step_and_break)
    with pytest.warns(UserNote, match="not fitted any further: sh0: a number is not finite"):
        found = fit_small_file(trainer, gaussians)
    assert np.isfinite(found.gaussians.sh0).all()


def test_several_processes_write_the_small_file_without_fitting_it(monkeypatch):
    trainer, _, gaussians = ended_fit(8, **{"output.small_file": "sog"})
    monkeypatch.setattr(trainer.comm, "size", 2)
    monkeypatch.setattr(Trainer, "step", None)
    with pytest.warns(UserNote, match="several processes write it without fitting it"):
        found = fit_small_file(trainer, gaussians)
    np.testing.assert_array_equal(found.gaussians.means, gaussians.means)
