"""Fits with the 3D smoothing filter."""

import numpy as np
import pytest
from support import reference_effects
from support import small_fits as fits
from support.cases import smoothed_reference
from support.fit_command import assert_fits, without_images, write_scene
from support.small_capture import reference_camera
from support.viewer_rendering import VIEWER_RENDERING

import drgs  # noqa: F401  (registers the plugin)
from drgs.effects.smoothing import bake_smoothing
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.results.folder import own_gaussians
from drgs.training.steps import view_of


def make_trainer(**changes):
    return fits.make_trainer(fits.plain_dataset(), model__smoothing=True, **changes)


def expected_filter(means) -> np.ndarray:
    cameras = [reference_camera(view) for view in fits.plain_dataset().train]
    rates = reference_effects.sampling_rates(np.asarray(means, np.float64), cameras)
    return np.sqrt(0.2) / rates


def test_fit_keeps_one_filter_per_gaussian():
    """Through changes of the population and resets; in the end it is that of the final means."""
    densify = {"start": 3, "stop": 60, "every": 4}
    densify |= {"adc__grad_threshold": 1e-6, "adc__reset_every": 10}
    changes = {f"densify__{name}": value for name, value in densify.items()}
    trainer, counts = make_trainer(**changes), set()
    for _ in range(14):
        gaussians = fits.steps(trainer, 1).gaussians()
        counts.add(gaussians.num_gaussians)
        # float32: as in the comparison of the filter with the reference.
        expected = expected_filter(gaussians.means)
        np.testing.assert_allclose(gaussians.smoothing, expected, rtol=2e-5)
    assert len(counts) == 4  # at 4, 8 and 12


def test_fit_renders_with_its_filter():
    """The loss of the first iteration is that of the widened Gaussians."""
    loss = make_trainer(loss__dssim_weight=0.0).step().loss
    photo = fits.plain_dataset().train[view_of(1, 6, seed=0)]
    start = fits.double(fits.disturbed_blobs())
    widened = smoothed_reference(start, expected_filter(start.means))

    def expected(gaussians):
        return np.abs(fits.photograph(gaussians, photo).image - photo.image).mean()

    # A mean of 2304 numbers in single precision; without the filter it is another.
    assert loss == pytest.approx(expected(widened), rel=1e-5)
    assert loss != pytest.approx(expected(start), rel=1e-4)


def test_coarse_stages_have_wider_filters():
    """Their cameras have larger pixels; filters are computed anew when a stage ends."""
    trainer, widths = make_trainer(coarse=[{"until": 2, "factor": 2}]), []
    for _ in range(3):
        trainer.step()
        widths.append(np.array(trainer.integrator.smoothing))
    np.testing.assert_allclose(widths[1], widths[0])
    # The means have moved a little.
    np.testing.assert_allclose(widths[2], widths[1] / 2, rtol=0.02)


@pytest.mark.slow
def test_fit_writes_the_filter_or_baked_gaussians(tmp_path, monkeypatch):
    without_images(monkeypatch)
    model = {**VIEWER_RENDERING, "smoothing": True}
    config, written = write_scene(tmp_path, model=model, iterations=2), []
    for bakes in ("false", "true"):
        out = tmp_path / bakes
        assert_fits(config, "--out", out, "--set", f"output.bake_smoothing={bakes}")
        written.append(Gaussians.load(own_gaussians(out)))
        assert Gaussians.load(out / "point_cloud.ply").smoothing is None
    filtered, baked = written
    assert baked.smoothing is None and (baked.log_scales > filtered.log_scales).all()
    expected = bake_smoothing(filtered)
    for name in PARAMETER_NAMES:
        actual = getattr(baked, name)
        np.testing.assert_array_equal(actual, getattr(expected, name), err_msg=name)
