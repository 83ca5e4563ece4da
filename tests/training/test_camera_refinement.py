"""Cameras that are refined: derivatives against differences in numpy, what is found, what stays."""

import json
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import small_fits as fits
from support.helpers import single

from drgs.cameras.fisheye import Fisheye
from drgs.cameras.radial_tangential import RadialTangential
from drgs.cameras.thin_prism_fisheye import ThinPrismFisheye
from drgs.core.errors import UserError
from drgs.datasets.images import smaller_view
from drgs.datasets.types import CameraMotion
from drgs.datasets.viewpoints import read_viewpoints
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.integrator.scene import render_views
from drgs.reference import splatting as reference
from drgs.results.files import CAMERAS
from drgs.results.metrics import ssim
from drgs.results.refined_cameras import refined_dataset
from drgs.training.effects.base import training_effects
from drgs.training.effects.cameras import INTRINSICS


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


ALL_RATES = {
    "cameras__rotation_lr": 1e-3,
    "cameras__translation_lr": 2e-3,
    "cameras__focal_lr": 3e-3,
    "cameras__principal_lr": 4e-3,
}


def make_trainer(dataset=None, gaussians=None, **changes):
    return fits.make_trainer(
        dataset or fits.plain_dataset(), gaussians, **{"cameras__optimise": True, **changes}
    )


def effect_of(trainer):
    return next(effect for effect in trainer.effects if effect.name == "cameras")


def with_numbers(trainer, **values):
    """Continue from other numbers of the cameras, by name: rows for all views."""
    effect = effect_of(trainer)
    state = effect.state()
    for name, value in values.items():
        assert state[f"{name}.value"].shape == np.shape(value)
        state[f"{name}.value"] = np.asarray(value, np.float32)
    effect.restore(state)
    return trainer


def moved(view, turns=(0, 0, 0), moves=(0, 0, 0), log_focals=(0, 0), shifts=(0, 0)):
    """A view whose camera is turned and moved in its own axes, in numpy."""
    change = np.eye(4)
    change[:3, :3] = Rotation.from_rotvec(turns).as_matrix()
    change[:3, 3] = moves
    fx, fy = np.array([view.fx, view.fy]) * np.exp(log_focals)
    cx, cy = np.array([view.cx, view.cy]) + np.array(shifts) * [view.width, view.height]
    pose = view.camera_to_world @ change
    return replace(view, camera_to_world=pose, fx=fx, fy=fy, cx=cx, cy=cy)


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


# ----------------------------------------------------------------------------------------------
# The camera
# ----------------------------------------------------------------------------------------------


def test_sensor_matches_the_camera_moved_in_numpy():
    """In Mitsuba's axes: x to the left, y up."""
    trainer = with_numbers(make_trainer(**ALL_RATES), **random_numbers())
    trainer.iteration = 1
    for index in (0, 5):
        view = trainer.views[index]
        effect_of(trainer).before_render(trainer.fit_state(), view)
        expected = moved(fits.plain_dataset().train[index], **row_of(random_numbers(), index))
        params = mi.traverse(view.sensor)
        to_world = np.array(params["to_world"].matrix)[..., 0]
        # Single precision, of numbers up to 4.
        np.testing.assert_allclose(
            to_world, expected.camera_to_world @ np.diag([-1, -1, 1, 1]), atol=2e-6
        )
        for name in ("fx", "fy", "cx", "cy"):
            assert float(params[name][0]) == pytest.approx(getattr(expected, name), rel=1e-6)


def test_unmoved_cameras_give_the_plain_loss():
    plain, refined = fits.make_trainer(fits.plain_dataset()), make_trainer()
    # The same camera by a product of matrices in single precision.
    assert refined.step().loss == pytest.approx(plain.step().loss, rel=2e-6)


# ----------------------------------------------------------------------------------------------
# Derivatives
# ----------------------------------------------------------------------------------------------


def loss_in_numpy(gaussians, view, image) -> float:
    """Return the loss of the reference's image and a photograph; float64."""
    rendered = reference.render(gaussians, fits.reference_camera(view), np.ones(3))
    shown = np.clip(rendered.image, 0, 1)
    return 0.8 * np.abs(rendered.image - image).mean() + 0.2 * (1 - ssim(shown, image))


@pytest.mark.parametrize("index", [1, 4])
def test_derivatives_of_the_loss_equal_differences_in_numpy(index):
    """Each of the ten numbers of a view, away from the camera's start."""
    numbers = random_numbers()
    start = fits.true_blobs()
    # Colours that no pixel clips: only then are both losses the same.
    start = replace(start, sh0=0.4 * start.sh0, shN=0.3 * start.shN)
    trainer = with_numbers(make_trainer(gaussians=start, **ALL_RATES), **numbers)
    trainer.iteration = 1
    effect, view = effect_of(trainer), trainer.views[index]
    photo, row = fits.plain_dataset().train[index], row_of(numbers, index)
    rendered = fits.photograph(fits.double(start), moved(photo, **row))
    assert not rendered.near_threshold.any() and rendered.image.max() <= 1
    effect.before_render(trainer.fit_state(), view)
    leaves = effect.parameters(view)
    trainer.params.update(trainer.optimizer)
    image = mi.render(trainer.scene, trainer.params, sensor=view.sensor, spp=1)
    _, loss, _ = trainer.compare(image, view)
    dr.backward(loss)
    fits.end_view(effect, trainer, view)
    gaussians, step = fits.double(start), 1e-7
    target = np.asarray(photo.image, np.float64)
    assert float(dr.detach(loss)[0]) == pytest.approx(
        loss_in_numpy(gaussians, moved(photo, **row), target), rel=1e-5
    )
    for name, values in row.items():
        actual = np.array(dr.grad(leaves[name])).astype(np.float64)
        expected = []
        for k in range(len(values)):
            both = []
            for sign in (1, -1):
                other = values.copy()
                other[k] += sign * step
                view_there = moved(photo, **{**row, name: other})
                both.append(loss_in_numpy(gaussians, view_there, target))
            expected.append((both[0] - both[1]) / (2 * step))
        # Sums over the film of terms of both signs, in single precision: measured 2e-5; and some
        # of the kinks of |x| lie within a step.
        np.testing.assert_allclose(
            actual, expected, atol=5e-4 * np.abs(expected).max(), err_msg=name
        )
        assert np.abs(actual).max() > 0


# ----------------------------------------------------------------------------------------------
# Which numbers move
# ----------------------------------------------------------------------------------------------


def test_intrinsics_with_zero_rates_are_left_out():
    """They have no number, and are not computed."""
    trainer = make_trainer()
    assert set(effect_of(trainer).numpy()) == {"turns", "moves"}
    fits.steps(trainer, 3)
    for view, photo in zip(trainer.views, fits.plain_dataset().train, strict=True):
        params = mi.traverse(view.sensor)
        for name in ("fx", "fy", "cx", "cy"):
            assert float(params[name][0]) == np.float32(getattr(photo, name))
    only_focal = make_trainer(cameras__focal_lr=1e-3)
    assert set(effect_of(only_focal).numpy()) == {"turns", "moves", "log_focals"}


@pytest.mark.slow
def test_only_the_current_view_and_shared_intrinsics_change():
    """The numbers and the moments of all other views stay, bit by bit."""
    trainer = make_trainer(**ALL_RATES)
    effect, seen = effect_of(trainer), set()
    for iteration in range(1, 9):
        before = effect.state()
        trainer.iteration = iteration
        index = trainer.last_step.views[-1].view.index
        trainer.iteration = iteration - 1
        trainer.step()
        after = effect.state()
        for name, count, expected in (
            ("turns", 6, [index]),
            ("moves", 6, [index]),
            ("log_focals", 1, [0]),
            ("shifts", 1, [0]),
        ):
            for what in ("value", "m", "v"):
                key = f"{name}.{what}"
                rows = [state[key].reshape(count, -1) for state in (before, after)]
                changed = np.flatnonzero((rows[0] != rows[1]).any(axis=1))
                assert changed.tolist() == expected, key
        seen.add(index)
    assert len(seen) == 6


def test_first_steps_equal_the_rates():
    """Moves in units of the scene's extent; all rates fall as that of the means does."""
    trainer = make_trainer(**ALL_RATES, iterations=1)  # the means' rate is the last one at once
    trainer.step()
    numbers = effect_of(trainer).numpy()
    extent, decay = fits.plain_dataset().extent, 0.01
    rates = {"turns": 1e-3, "moves": 2e-3 * extent, "log_focals": 3e-3, "shifts": 4e-3}
    for name, rate in rates.items():
        values = numbers[name][numbers[name].any(axis=1)]
        assert len(values) == 1
        np.testing.assert_allclose(np.abs(values), decay * rate, rtol=1e-4)


def test_cameras_are_unchanged_before_the_start():
    trainer = make_trainer(cameras__start=3)
    effect = effect_of(trainer)
    plain = fits.make_trainer(fits.plain_dataset())
    for iteration in range(1, 6):
        report, expected = trainer.step(), plain.step()
        numbers = effect.numpy()
        has_moved = any(value.any() for value in numbers.values())
        assert has_moved == (iteration > 3)
        if iteration <= 3:
            assert report.loss == pytest.approx(expected.loss, rel=1e-5)


def test_camera_derivatives_are_not_computed_before_the_start():
    """Kernels are those of cameras that stay."""

    def operations(start):
        trainer = make_trainer(cameras__start=start)
        trainer.step()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            dr.kernel_history_clear()
            trainer.step()
            kernels = dr.kernel_history([dr.KernelType.JIT])
        return sum(kernel["operation_count"] for kernel in kernels)

    assert operations(100) < operations(0) - 100


# ----------------------------------------------------------------------------------------------
# Recovered cameras
# ----------------------------------------------------------------------------------------------

# Rates of a fit that optimises cameras only.
FROZEN_GAUSSIANS = {
    "optimizer__means_lr": 1e-20,
    "optimizer__means_lr_final": 1e-20,
    **{f"optimizer__{name}_lr": 0.0 for name in ("quats", "scales", "opacities", "sh0", "shN")},
}


def errors(view, true) -> tuple[float, float]:
    """Degrees, and world units."""
    turn = view.camera_to_world[:3, :3].T @ true.camera_to_world[:3, :3]
    angle = np.degrees(Rotation.from_matrix(turn).magnitude())
    return float(angle), float(np.linalg.norm(view.center - true.center))


@pytest.mark.slow
def test_disturbed_camera_is_recovered_with_true_gaussians():
    """Two degrees and a fiftieth of its distance away."""
    true = fits.plain_dataset().train[2]
    disturbed = moved(true, turns=(0.02, -0.025, 0.015), moves=(0.05, -0.04, 0.06))
    dataset = replace(fits.plain_dataset(), train=(disturbed,))
    trainer = make_trainer(
        dataset,
        fits.true_blobs(),
        cameras__rotation_lr=3e-3,
        cameras__translation_lr=1e-2 / dataset.extent,
        **FROZEN_GAUSSIANS,
    )
    start = trainer.step().loss
    end = fits.steps(trainer, 150).step().loss
    (found,) = effect_of(trainer).refined_views(dataset.train)
    assert errors(disturbed, true)[0] > 1.9 and errors(disturbed, true)[1] > 0.08
    assert errors(found, true)[0] < 0.3 and errors(found, true)[1] < 0.025, errors(found, true)
    assert end < 0.05 * start


@pytest.mark.slow
def test_wrong_focal_length_and_principal_point_are_recovered():
    true = fits.plain_dataset().train[2]
    disturbed = moved(true, log_focals=(0.04, 0.03), shifts=(0.02, -0.015))
    trainer = make_trainer(
        replace(fits.plain_dataset(), train=(disturbed,)),
        fits.true_blobs(),
        cameras__rotation_lr=0.0,
        cameras__translation_lr=0.0,
        cameras__focal_lr=2e-3,
        cameras__principal_lr=1e-3,
        **FROZEN_GAUSSIANS,
    )
    fits.steps(trainer, 100)
    (found,) = effect_of(trainer).refined_views([disturbed])
    for name in ("fx", "fy", "cx", "cy"):
        before, after = (abs(getattr(v, name) - getattr(true, name)) for v in (disturbed, found))
        assert before > 0.3 and after < 0.3 * before, name
    # Rates of zero: the pose stays.
    np.testing.assert_allclose(found.camera_to_world, disturbed.camera_to_world, atol=1e-6)


@pytest.mark.slow
def test_refined_cameras_make_better_images():
    """Training cameras are disturbed; held-out cameras, which see the blobs, are right."""
    rng = np.random.default_rng(6)
    dataset = fits.with_views(
        fits.plain_dataset(),
        lambda v: moved(v, turns=rng.normal(0, 0.01, 3), moves=rng.normal(0, 0.03, 3)),
    )
    quality = {}
    for is_refined in (False, True):
        trainer = make_trainer(
            dataset,
            fits.true_blobs(),
            cameras__optimise=is_refined,
            cameras__rotation_lr=1e-3,
            cameras__translation_lr=1e-3,
        )
        quality[is_refined] = fits.test_psnr(fits.steps(trainer, 60), fits.plain_dataset())
    assert quality[True] > quality[False] + 2, quality


# ----------------------------------------------------------------------------------------------
# Files and checkpoints
# ----------------------------------------------------------------------------------------------

LENSES = {
    "pinhole": None,
    "opencv": RadialTangential.from_coefficients(k1=0.1, p2=-0.02),
    "rational": RadialTangential.from_coefficients(k1=0.1, k4=0.25),
    "fisheye": Fisheye.from_coefficients(k1=0.05, k2=-0.01),
    "thin prism": ThinPrismFisheye.from_coefficients(k1=0.05, p2=-0.01, sx1=0.02),
}


@pytest.mark.parametrize("lens", LENSES)
def test_refined_cameras_survive_a_round_trip(lens, tmp_path):
    dataset = fits.with_views(fits.plain_dataset(), lambda v: replace(v, lens=LENSES[lens]))
    trainer = with_numbers(make_trainer(dataset, **ALL_RATES), **random_numbers())
    effect_of(trainer).write(tmp_path, dataset)
    cameras = read_viewpoints(tmp_path / CAMERAS, None)
    names = [f["file_path"] for f in json.loads((tmp_path / CAMERAS).read_text())["frames"]]
    assert names == [view.name for view in dataset.train]
    for index, (camera, view) in enumerate(zip(cameras, dataset.train, strict=True)):
        expected = moved(view, **row_of(random_numbers(), index))
        # Single precision, of numbers up to 4.
        np.testing.assert_allclose(camera.camera_to_world, expected.camera_to_world, atol=2e-6)
        for name in ("fx", "fy", "cx", "cy"):
            assert getattr(camera, name) == pytest.approx(getattr(expected, name), rel=1e-6)
        assert (camera.width, camera.height) == (view.width, view.height)
        assert camera.lens == view.lens


def test_views_use_the_refined_intrinsics():
    """Their poses are not changed."""
    trainer = with_numbers(make_trainer(**ALL_RATES), **random_numbers())
    lens = {name: random_numbers()[name][0] for name in ("log_focals", "shifts")}
    dataset = fits.plain_dataset()
    expected = [moved(view, **lens) for view in dataset.test]
    for view, other in zip(effect_of(trainer).correct_views(dataset.test), expected, strict=True):
        np.testing.assert_array_equal(view.camera_to_world, other.camera_to_world)
        for name in ("fx", "fy", "cx", "cy"):
            assert getattr(view, name) == pytest.approx(getattr(other, name), rel=1e-7)
    renders = trainer.images(dataset.test)
    for rendered, other in zip(renders, render_views(trainer.scene, expected), strict=True):
        np.testing.assert_allclose(rendered, other, atol=1e-5)


def test_views_are_unchanged_without_intrinsics_rates():
    views = fits.plain_dataset().test
    for view, other in zip(effect_of(make_trainer()).correct_views(views), views, strict=True):
        assert [getattr(view, n) for n in INTRINSICS] == [getattr(other, n) for n in INTRINSICS]


def test_dataset_is_read_with_refined_cameras(tmp_path):
    """Also at another size, and with both poses of a camera that moves."""
    dataset = fits.plain_dataset()
    close = moved(dataset.train[1], turns=(0.02, 0.01, 0), moves=(0.1, 0, 0)).camera_to_world
    first = replace(dataset.train[0], motion=CameraMotion(close, "rolling"))
    dataset = replace(dataset, train=(first, *dataset.train[1:]))
    trainer = with_numbers(make_trainer(dataset, **ALL_RATES), **random_numbers())
    effect_of(trainer).write(tmp_path, dataset)
    smaller = replace(
        dataset, **{k: tuple(smaller_view(v, 2) for v in getattr(dataset, k)) for k in SPLITS}
    )
    found = refined_dataset(smaller, tmp_path)
    for index, (view, start) in enumerate(zip(found.train, smaller.train, strict=True)):
        expected = moved(start, **row_of(random_numbers(), index))
        np.testing.assert_allclose(view.camera_to_world, expected.camera_to_world, atol=2e-6)
        for name in INTRINSICS:
            assert getattr(view, name) == pytest.approx(getattr(expected, name), rel=1e-6)
    between = np.linalg.inv(first.camera_to_world) @ close
    begin, end = found.train[0].camera_to_world, found.train[0].motion.close_to_world
    np.testing.assert_allclose(np.linalg.inv(begin) @ end, between, atol=1e-9)
    for view, start in zip(found.test, smaller.test, strict=True):
        np.testing.assert_array_equal(view.camera_to_world, start.camera_to_world)
        assert view.fx == pytest.approx(effect_of(trainer).correct_views((start,))[0].fx)


SPLITS = ("train", "test")


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
    (tmp_path / CAMERAS).write_text(text)
    with pytest.raises(UserError, match=r"cameras\.json: must hold .* remove it"):
        refined_dataset(fits.plain_dataset(), tmp_path)


def test_dataset_without_refined_cameras_is_unchanged(tmp_path):
    dataset = fits.plain_dataset()
    assert refined_dataset(dataset, tmp_path) is dataset


@pytest.mark.slow
def test_a_fit_resumes_to_the_same_bytes():
    coarse = [{"until": 5, "factor": 2}]
    fits.assert_resumes_to_the_same_bytes(lambda: make_trainer(**ALL_RATES, coarse=coarse), 4, 5)


@pytest.mark.slow
def test_a_fit_with_smoothing_resumes_to_the_same_bytes():
    """The filter depends on where all cameras are, also on those not seen since."""

    def make():
        densify = {"start": 2, "stop": 90, "every": 4}
        densify |= {"adc__grad_threshold": 1e-6, "adc__reset_every": 80}
        changes = {f"densify__{key}": value for key, value in densify.items()}
        return make_trainer(**ALL_RATES, model__smoothing=True, **changes)

    fits.assert_resumes_to_the_same_bytes(make, 6, 5)


@pytest.mark.slow
def test_filter_uses_refined_cameras():
    """Also after a coarse stage, before its views were seen again."""
    trainer = make_trainer(
        cameras__focal_lr=0.1, model__smoothing=True, coarse=[{"until": 5, "factor": 2}]
    )
    fits.steps(trainer, 7)
    refined = effect_of(trainer).refined_views(fits.plain_dataset().train)
    plain = fits.make_trainer(
        replace(fits.plain_dataset(), train=tuple(refined)), model__smoothing=True
    )
    plain.step()  # with the cameras where they are
    plain.optimizer["means"] = mi.TensorXf(trainer.gaussians().means)
    np.testing.assert_allclose(
        trainer.gaussians().smoothing, plain.gaussians().smoothing, rtol=1e-4
    )


@pytest.mark.slow
def test_two_fits_have_the_same_bytes():
    """Derivatives of a camera are sums over all splats: in the same order in every run."""
    first, second = (fits.steps(make_trainer(**ALL_RATES), 7) for _ in range(2))
    assert fits.everything_of(first) == fits.everything_of(second)
    for name in PARAMETER_NAMES:
        assert np.array_equal(getattr(first.gaussians(), name), getattr(second.gaussians(), name))


def test_no_kernel_is_compiled_after_all_views_were_seen():
    fits.assert_no_new_kernels(make_trainer(**ALL_RATES))


def test_camera_with_motion_blur_is_refined():
    """Both its poses move together."""
    dataset = fits.plain_dataset()
    start = dataset.train[0]
    close = moved(start, turns=(0.02, 0.01, 0), moves=(0.1, 0, 0)).camera_to_world
    dataset = replace(dataset, train=(replace(start, motion=CameraMotion(close, "rolling")),))
    trainer = make_trainer(dataset)
    numbers = {"turns": [[0.01, 0.02, -0.01]], "moves": [[0.1, -0.2, 0.05]]}
    with_numbers(trainer, **numbers)
    trainer.iteration = 1
    effect_of(trainer).before_render(trainer.fit_state(), trainer.views[0])
    params = mi.traverse(trainer.views[0].sensor)
    first, last = (
        np.array(params[name].matrix)[..., 0] @ np.diag([-1, -1, 1, 1])
        for name in ("to_world", "to_world_close")
    )
    expected = np.linalg.inv(start.camera_to_world) @ close
    np.testing.assert_allclose(np.linalg.inv(first) @ last, expected, atol=1e-5)


def test_moving_cameras_survive_a_round_trip(tmp_path):
    dataset = fits.plain_dataset()
    close = moved(dataset.train[1], turns=(0.02, 0.01, 0), moves=(0.1, 0, 0)).camera_to_world
    view = replace(dataset.train[0], motion=CameraMotion(close, "rolling"))
    dataset = replace(dataset, train=(view,))
    effect_of(make_trainer(dataset)).write(tmp_path, dataset)
    (frame,) = json.loads((tmp_path / CAMERAS).read_text())["frames"]
    opengl = np.array(frame["transform_matrix_close"]) * [1, -1, -1, 1]
    np.testing.assert_allclose(opengl, close, atol=2e-6)
    assert frame["shutter"] == "rolling"


def test_static_camera_has_the_derivatives_of_a_moving_one_with_equal_poses():
    """Its two poses being the same; both depend on the numbers."""
    found = []
    for shutter in (None, "rolling", "global"):
        dataset = fits.plain_dataset()
        photo = dataset.train[1]
        motion = None if shutter is None else CameraMotion(photo.camera_to_world, shutter)
        trainer = make_trainer(replace(dataset, train=(replace(photo, motion=motion),)))
        trainer.iteration = 1
        effect, view = effect_of(trainer), trainer.views[0]
        effect.before_render(trainer.fit_state(), view)
        leaves = effect.parameters(view)
        fits.gradients_of_loss(trainer, view)
        fits.end_view(effect, trainer, view)
        found.append(np.concatenate([np.array(dr.grad(leaves[n])) for n in ("turns", "moves")]))
    assert np.abs(found[0]).max() > 0
    for other in found[1:]:
        # Sums of terms of both signs in single precision.
        np.testing.assert_allclose(other, found[0], atol=5e-4 * np.abs(found[0]).max())


def test_refinement_is_off_by_default():
    assert training_effects(fits.config_of(), fits.plain_dataset()) == []
