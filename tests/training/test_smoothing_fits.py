"""Fits with the 3D smoothing filter."""

import drjit as dr
import numpy as np
import pytest
from support import small_capture as capture
from support.smoothing import smoothed_reference
from support.viewer_rendering import VIEWER_RENDERING

import drgs  # noqa: F401  (registers the plugin)
from drgs.config.schema import FitConfig
from drgs.effects.smoothing import bake_smoothing
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.reference import effects as reference_effects
from drgs.reference import splatting as reference

GROWING = {
    "start": 3,
    "stop": 60,
    "every": 4,
    "strategy": "adc",
    "adc": {"grad_threshold": 1e-6, "reset_every": 25},
}


def make_trainer(coarse=(), **changes):
    from drgs.training.trainer import Trainer

    config = FitConfig.model_validate(
        {
            "data": {"path": "."},
            "model": {
                "smoothing": True,
                "sh_degree": 1,
                "sh_increase_every": 1,
                **VIEWER_RENDERING,
            },
            "densify": GROWING,
            "iterations": 60,
            "coarse": list(coarse),
            **changes,
        }
    )
    return Trainer(config, capture.make_dataset(4, 1), capture.blobs(40))


def reference_cameras(views, near=0.2) -> list[reference.Camera]:
    return [
        reference.Camera(
            view.camera_to_world[:3, :3].T, view.center, view.fx, view.fy, view.cx, view.cy,
            view.width, view.height, near,
        )
        for view in views
    ]  # fmt: skip


def expected_filter(means, views) -> np.ndarray:
    rates = reference_effects.sampling_rates(
        np.asarray(means, np.float64), reference_cameras(views)
    )
    return np.sqrt(0.2) / rates


def test_fit_keeps_one_filter_per_gaussian():
    """Through changes of the population and resets; in the end it is that of the final means."""
    trainer = make_trainer()
    counts = set()
    for _ in range(14):
        trainer.step()
        counts.add(trainer.num_gaussians)
        gaussians = trainer.gaussians()
        assert gaussians.smoothing.shape == (gaussians.num_gaussians,)
        # float32: as in the comparison of the filter above.
        expected = expected_filter(gaussians.means, capture.make_dataset(4, 1).train)
        np.testing.assert_allclose(gaussians.smoothing, expected, rtol=2e-5)
    assert len(counts) == 4  # at 4, 8 and 12


def test_fit_renders_with_its_filter():
    """The loss of the first iteration is that of the widened Gaussians."""
    from drgs.training.steps import view_of

    loss = make_trainer(loss={"dssim_weight": 0.0}).step().loss
    dataset, start = capture.make_dataset(4, 1), capture.blobs(40)
    photo = dataset.train[view_of(1, 4, seed=0)]
    by_reference = reference.Gaussians(
        **{name: getattr(start, name).astype(np.float64) for name in PARAMETER_NAMES}
    )
    widened = smoothed_reference(by_reference, expected_filter(start.means, dataset.train))
    (camera,) = reference_cameras([photo])
    rendered = reference.render(widened, camera, np.ones(3), 1)
    # A mean of 2304 numbers in single precision; without the filter it is another.
    assert loss == pytest.approx(np.abs(rendered.image - photo.image).mean(), rel=1e-5)
    unfiltered = reference.render(by_reference, camera, np.ones(3), 1)
    assert np.abs(unfiltered.image - photo.image).mean() != pytest.approx(loss, rel=1e-4)


def test_coarse_stages_have_wider_filters():
    """Their cameras have larger pixels; filters are computed anew when a stage ends."""
    trainer = make_trainer(coarse=[{"until": 2, "factor": 2}], densify={"start": 50, "stop": 60})
    widths = []
    for _ in range(4):
        trainer.step()
        widths.append(np.array(trainer.integrator.smoothing))
    np.testing.assert_allclose(widths[1], widths[0])
    # The means have moved a little.
    np.testing.assert_allclose(widths[2], widths[1] / 2, rtol=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("pause", [3, 4, 5, 11])
def test_resumed_fit_ends_with_the_same_bytes(pause):
    """Just before a change of the population, at it, after it, and later."""
    uninterrupted, first = make_trainer(), make_trainer()
    for _ in range(pause):
        first.step()
    second = make_trainer()
    second.restore(first.state())
    for _ in range(14):
        uninterrupted.step()
    while second.iteration < 14:
        second.step()
    expected, got = uninterrupted.gaussians(), second.gaussians()
    assert expected.num_gaussians != 40
    for name in (*PARAMETER_NAMES, "smoothing"):
        assert getattr(got, name).tobytes() == getattr(expected, name).tobytes(), name


def test_no_iteration_after_the_first_compiles_a_kernel():
    trainer = make_trainer(densify={"start": 50, "stop": 60})
    seen = set()
    for iteration in range(6):
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            trainer.step()
            trainer.watch.check()
            hashes = {kernel["hash"] for kernel in dr.kernel_history([dr.KernelType.JIT])}
        assert iteration < 3 or hashes <= seen, iteration
        seen |= hashes


FITS = """
import sys
from drgs import fit
for name, *options in {runs!r}:
    fit.main([{config!r}, "--out", {out!r} + "/" + name, *options])
    print(name, "drgs.effects.smoothing" in sys.modules)
"""


@pytest.mark.slow
def test_fit_writes_the_filter_or_baked_gaussians(run_python, tmp_path):
    """And imports nothing of it where it is not asked for: the first of three."""
    capture.write_dataset(tmp_path / "data", capture.make_dataset(3, 1))
    config = tmp_path / "small.yml"
    config.write_text(
        f"data: {{path: {tmp_path / 'data'}}}\ninit: {{num_points: 30, half_extent: 1.0}}\n"
        "model: {low_pass: 0.3, antialiased: false}\niterations: 2\noutput: {save_renders: false}\n"
    )
    asked = ("--set", "model.smoothing=true")
    runs = [
        ("without",),
        ("with", *asked),
        ("baked", *asked, "--set", "output.bake_smoothing=true"),
    ]
    result = run_python(FITS.format(config=str(config), out=str(tmp_path), runs=runs))
    assert result.returncode == 0, result.stderr
    lines = result.stdout.splitlines()
    assert "without False" in lines and "with True" in lines and "baked True" in lines
    written = {name: Gaussians.load(tmp_path / name / "point_cloud.ply") for name, *_ in runs}
    assert written["without"].smoothing is written["baked"].smoothing is None
    expected = bake_smoothing(written["with"])
    for name in PARAMETER_NAMES:
        actual = getattr(written["baked"], name)
        np.testing.assert_array_equal(actual, getattr(expected, name), err_msg=name)
    assert (written["baked"].log_scales > written["with"].log_scales).all()
