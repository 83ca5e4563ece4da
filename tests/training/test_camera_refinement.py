"""Cameras that are refined: derivatives against differences in numpy, what is found, what stays."""

import json
from dataclasses import replace
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import small_fits as fits
from support.helpers import central_difference, single
from support.small_fits import CAMERA_RATES, photometric_loss

from drgs.cameras.fisheye import Fisheye
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cameras.thin_prism_fisheye import ThinPrismFisheye
from drgs.cameras.viewpoints import CameraMotion
from drgs.core.errors import UserError
from drgs.datasets.camera_file import read_viewpoints
from drgs.datasets.images import smaller_view
from drgs.effects.cameras import INTRINSICS, REFINED_CAMERAS
from drgs.integrator.scene import render_views
from drgs.results.refined_cameras import refined_dataset


def make_trainer(dataset=None, gaussians=None, **changes):
    return fits.make_trainer(
        dataset or fits.plain_dataset(), gaussians, **{"cameras__optimise": True, **changes}
    )


def effect_of(trainer):
    return next(effect for effect in trainer.effects if effect.name == "cameras")


def moved(view, turns=(0, 0, 0), moves=(0, 0, 0), log_focals=(0, 0), shifts=(0, 0)):
    """A view whose camera is turned and moved in its own axes, in numpy."""
    change = np.eye(4)
    change[:3, :3] = Rotation.from_rotvec(turns).as_matrix()
    change[:3, 3] = moves
    fx, fy = np.array([view.fx, view.fy]) * np.exp(log_focals)
    cx, cy = np.array([view.cx, view.cy]) + np.array(shifts) * [view.width, view.height]
    pose = view.camera_to_world @ change
    return replace(view, camera_to_world=pose, fx=fx, fy=fy, cx=cx, cy=cy)


def moving(view):
    """The view with a pose when its shutter closes, turned and moved a little."""
    close = moved(view, turns=(0.02, 0.01, 0), moves=(0.1, 0, 0)).camera_to_world
    return replace(view, motion=CameraMotion(close, "rolling"))


def random_numbers(seed=0, count=6) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(seed)
    values = {
        "turns": rng.normal(0, 0.02, (count, 3)),
        "moves": rng.normal(0, 0.05, (count, 3)),
        "log_focals": rng.normal(0, 0.05, (1, 2)),
        "shifts": rng.normal(0, 0.01, (1, 2)),
    }
    return {name: single(value) for name, value in values.items()}


def row_of(numbers, index) -> dict[str, np.ndarray]:
    return {name: value[min(index, len(value) - 1)] for name, value in numbers.items()}


def rendered_before(trainer, view):
    """Prepare the cameras of the first iteration, as the trainer does."""
    trainer.iteration = 1
    effect_of(trainer).before_render(trainer.fit_state(), view)


def derivatives(trainer, view) -> dict[str, np.ndarray]:
    """Return derivatives of the loss by names of the view's numbers."""
    rendered_before(trainer, view)
    leaves = effect_of(trainer).parameters(view)
    fits.gradients_of_loss(trainer, view)
    fits.end_view(effect_of(trainer), trainer, view)
    return {name: np.array(dr.grad(leaf)).astype(np.float64) for name, leaf in leaves.items()}


def test_first_steps_equal_the_rates():
    """Moves in units of the scene's extent; all rates fall as that of the means does."""
    trainer = make_trainer(**CAMERA_RATES, iterations=1)  # the means' rate is the last one at once
    trainer.step()
    extent, decay = fits.plain_dataset().extent, 0.01
    rates = {"turns": 1e-3, "moves": 2e-3 * extent, "log_focals": 3e-3, "shifts": 4e-3}
    numbers = effect_of(trainer).numpy()
    for name, rate in rates.items():
        (moved_row,) = numbers[name][numbers[name].any(axis=1)]
        np.testing.assert_allclose(np.abs(moved_row), decay * rate, rtol=1e-4)


def test_cameras_are_unchanged_before_the_start():
    trainer, plain = make_trainer(cameras__start=3), fits.make_trainer(fits.plain_dataset())
    for iteration in range(1, 6):
        report, expected = trainer.step(), plain.step()
        has_moved = any(value.any() for value in effect_of(trainer).numpy().values())
        assert has_moved == (iteration > 3)
        assert has_moved or report.loss == pytest.approx(expected.loss, rel=1e-5)


@pytest.mark.parametrize(
    "text",
    [
        "{",
        "[]",
        '{"frames": []}',
        '{"lens_change": {}, "frames": []}',
        '{"lens_change": {"focal": [1]}, "frames": [{"file_path": "r_0"}]}',
    ],
)
def test_damaged_cameras_are_refused(text, tmp_path):
    (tmp_path / REFINED_CAMERAS).write_text(text)
    with pytest.raises(UserError, match=r"refined_cameras\.json: must hold .* remove it"):
        refined_dataset(fits.plain_dataset(), tmp_path)


@pytest.mark.slow
def test_filter_uses_refined_cameras():
    """Also after a coarse stage, before its views were seen again."""
    trainer = make_trainer(
        cameras__focal_lr=0.1, model__smoothing=True, coarse=[{"until": 5, "factor": 2}]
    )
    fits.steps(trainer, 7)
    dataset = fits.plain_dataset()
    refined = replace(dataset, train=tuple(effect_of(trainer).refined_views(dataset.train)))
    plain = fits.make_trainer(refined, model__smoothing=True)
    plain.step()  # with the cameras where they are
    plain.optimizer["means"] = mi.TensorXf(trainer.gaussians().means)
    found, expected = (each.gaussians().smoothing for each in (trainer, plain))
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize("shutter", [None, "rolling"])
def test_sensor_matches_the_camera_moved_in_numpy(shutter):
    """In Mitsuba's axes: x to the left, y up. Both poses of a moving camera move together."""
    dataset = fits.plain_dataset()
    if shutter is not None:
        dataset = fits.with_views(dataset, moving)
    trainer = fits.with_numbers(make_trainer(dataset, **CAMERA_RATES), **random_numbers())
    for index in (0, 5):
        view, photo = trainer.views[index], dataset.train[index]
        rendered_before(trainer, view)
        expected = moved(photo, **row_of(random_numbers(), index))
        params = mi.traverse(view.sensor)
        pose = np.array(params["to_world"].matrix)[..., 0] @ np.diag([-1, -1, 1, 1])
        # Single precision, of numbers up to 4.
        np.testing.assert_allclose(pose, expected.camera_to_world, atol=2e-6)
        for name in INTRINSICS:
            assert float(params[name][0]) == pytest.approx(getattr(expected, name), rel=1e-6)
        if shutter is not None:
            close = np.array(params["to_world_close"].matrix)[..., 0] @ np.diag([-1, -1, 1, 1])
            between = np.linalg.inv(photo.camera_to_world) @ photo.motion.close_to_world
            np.testing.assert_allclose(np.linalg.inv(pose) @ close, between, atol=1e-5)


@pytest.mark.parametrize("index", [1, 4])
def test_derivatives_of_the_loss_equal_differences_in_numpy(index):
    """Each of the ten numbers of a view, away from the camera's start."""
    start = fits.true_blobs()
    # Colours that no pixel clips: only then are both losses the same.
    start = replace(start, sh0=0.4 * start.sh0, shN=0.3 * start.shN)
    gaussians = fits.double(start)
    photo, row = fits.plain_dataset().train[index], row_of(random_numbers(), index)
    rendered = fits.photograph(gaussians, moved(photo, **row))
    assert not rendered.near_threshold.any() and rendered.image.max() <= 1
    trainer = fits.with_numbers(make_trainer(gaussians=start, **CAMERA_RATES), **random_numbers())
    found = derivatives(trainer, trainer.views[index])
    target = np.asarray(photo.image, np.float64)

    def loss_at(values, name) -> float:
        view = moved(photo, **{**row, name: values})
        return photometric_loss(fits.photograph(gaussians, view).image, target)

    for name, values in row.items():
        loss_of = partial(loss_at, name=name)
        expected = [central_difference(loss_of, values, k, 1e-7) for k in range(len(values))]
        # Sums over the film of terms of both signs, in single precision: measured 2e-5; and some
        # of the kinks of |x| lie within a step.
        tolerance = 5e-4 * np.abs(expected).max()
        np.testing.assert_allclose(found[name], expected, atol=tolerance, err_msg=name)
        assert np.abs(found[name]).max() > 0


@pytest.mark.parametrize("shutter", ["rolling", "global"])
def test_static_camera_has_the_derivatives_of_a_moving_one_with_equal_poses(shutter):
    photo, found = fits.plain_dataset().train[1], []
    for motion in (None, CameraMotion(photo.camera_to_world, shutter)):
        dataset = replace(fits.plain_dataset(), train=(replace(photo, motion=motion),))
        trainer = make_trainer(dataset)
        found.append(derivatives(trainer, trainer.views[0]))
    for name in ("turns", "moves"):
        # Sums of terms of both signs in single precision.
        tolerance = 5e-4 * np.abs(found[0][name]).max()
        np.testing.assert_allclose(found[1][name], found[0][name], atol=tolerance)
        assert tolerance > 0


def test_intrinsics_with_zero_rates_have_no_numbers():
    photos, trainers = fits.plain_dataset(), (make_trainer(), make_trainer(cameras__focal_lr=1e-3))
    without, with_focal = map(effect_of, trainers)
    assert set(without.numpy()) == {"turns", "moves"}
    assert set(with_focal.numpy()) == {"turns", "moves", "log_focals"}
    for view, other in zip(without.correct_views(photos.test), photos.test, strict=True):
        assert [getattr(view, n) for n in INTRINSICS] == [getattr(other, n) for n in INTRINSICS]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "rates", "iterations"),
    [
        # Two degrees and a fiftieth of its distance away.
        ({"turns": (0.02, -0.025, 0.015), "moves": (0.05, -0.04, 0.06)}, (3e-3, 2.3e-3, 0, 0), 150),
        ({"log_focals": (0.04, 0.03), "shifts": (0.02, -0.015)}, (0, 0, 2e-3, 1e-3), 100),
    ],
    ids=["pose", "intrinsics"],
)
def test_disturbed_camera_is_recovered_with_true_gaussians(change, rates, iterations):
    true = fits.plain_dataset().train[2]
    disturbed = moved(true, **change)
    dataset = replace(fits.plain_dataset(), train=(disturbed,))
    rates = dict(zip(CAMERA_RATES, rates, strict=True))
    trainer = make_trainer(dataset, fits.true_blobs(), **rates, **fits.FROZEN_GAUSSIANS)
    start = trainer.step().loss
    assert fits.steps(trainer, iterations).step().loss < 0.05 * start
    (found,) = effect_of(trainer).refined_views(dataset.train)

    def errors(view):
        yield np.linalg.norm(view.camera_to_world[:3, :3] - true.camera_to_world[:3, :3])
        yield np.linalg.norm(view.center - true.center)
        yield from (abs(getattr(view, name) - getattr(true, name)) for name in INTRINSICS)

    for before, after in zip(errors(disturbed), errors(found), strict=True):
        assert after < max(0.3 * before, 1e-5)  # rounding of what was right, and stays


LENSES = (
    None,
    None,
    RadialTangential.from_coefficients(k1=0.1, p2=-0.02),
    RadialTangential.from_coefficients(k1=0.1, k4=0.25),
    Fisheye.from_coefficients(k1=0.05, k2=-0.01),
    ThinPrismFisheye.from_coefficients(k1=0.05, p2=-0.01, sx1=0.02),
)


def test_refined_cameras_survive_a_round_trip(tmp_path):
    """All lenses; a dataset at another size, and both poses of a camera that moves."""
    dataset = fits.plain_dataset()
    views = [replace(v, lens=lens) for v, lens in zip(dataset.train, LENSES, strict=True)]
    dataset = replace(dataset, train=(moving(views[0]), *views[1:]))
    trainer = fits.with_numbers(make_trainer(dataset, **CAMERA_RATES), **random_numbers())
    effect_of(trainer).write(tmp_path, dataset)
    frames = json.loads((tmp_path / REFINED_CAMERAS).read_text())["frames"]
    assert [frame["file_path"] for frame in frames] == [view.name for view in dataset.train]
    assert frames[0]["shutter"] == "rolling"
    smaller = replace(dataset, train=tuple(smaller_view(view, 2) for view in dataset.train))
    found = refined_dataset(smaller, tmp_path)
    cameras = [*read_viewpoints(tmp_path / REFINED_CAMERAS, None), *found.train]
    for k, (camera, view) in enumerate(zip(cameras, (*dataset.train, *smaller.train), strict=True)):
        expected = moved(view, **row_of(random_numbers(), k % 6))
        # Single precision, of numbers up to 4.
        np.testing.assert_allclose(camera.camera_to_world, expected.camera_to_world, atol=2e-6)
        for name in INTRINSICS:
            assert getattr(camera, name) == pytest.approx(getattr(expected, name), rel=1e-6)
        assert (camera.width, camera.height) == (view.width, view.height)
        assert camera.lens == view.lens
    close, photo = found.train[0].motion.close_to_world, dataset.train[0]
    between = np.linalg.inv(photo.camera_to_world) @ photo.motion.close_to_world
    begin = np.linalg.inv(found.train[0].camera_to_world)
    np.testing.assert_allclose(begin @ close, between, atol=1e-9)
    (tmp_path / REFINED_CAMERAS).unlink()
    assert refined_dataset(dataset, tmp_path) is dataset


def test_test_views_use_the_refined_intrinsics(tmp_path):
    """Their poses are not changed."""
    dataset = fits.plain_dataset()
    trainer = fits.with_numbers(make_trainer(**CAMERA_RATES), **random_numbers())
    lens = {name: random_numbers()[name][0] for name in ("log_focals", "shifts")}
    expected = [moved(view, **lens) for view in dataset.test]
    effect_of(trainer).write(tmp_path, dataset)
    read = refined_dataset(dataset, tmp_path).test
    for found in (effect_of(trainer).correct_views(dataset.test), read):
        for view, other in zip(found, expected, strict=True):
            np.testing.assert_array_equal(view.camera_to_world, other.camera_to_world)
            for name in INTRINSICS:
                assert getattr(view, name) == pytest.approx(getattr(other, name), rel=1e-6)
    renders = trainer.images(dataset.test)
    for rendered, other in zip(renders, render_views(trainer.scene, expected), strict=True):
        np.testing.assert_allclose(rendered, other, atol=1e-5)
