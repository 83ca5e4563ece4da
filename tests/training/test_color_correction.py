"""Colour transforms of single photographs: derivatives, what they find, and what stays."""

import json
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import small_fits as fits
from support.helpers import single

from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.results.files import COLORS
from drgs.results.metrics import ssim

IDENTITY = np.eye(3, 4)


def make_trainer(dataset=None, gaussians=None, **changes):
    return fits.make_trainer(
        dataset or fits.plain_dataset(),
        gaussians,
        **{"colors__lr": 2e-3, "colors__identity_weight": 0.1, **changes},
    )


def matrices_of(trainer) -> np.ndarray:
    """(V, 3, 4)."""
    (effect,) = trainer.effects
    return effect.transforms().astype(np.float64)


def with_matrices(trainer, matrices):
    """Continue from other transforms, whose mean is the identity; moments stay."""
    (effect,) = trainer.effects
    state = effect.state()
    state["matrices.value"] = matrices.reshape(-1, 12).astype(np.float32)
    effect.restore(state)
    return trainer


def random_matrices(count=6, seed=1) -> np.ndarray:
    """Their mean is the identity."""
    changes = np.random.default_rng(seed).normal(0, 0.1, (count, 3, 4))
    return IDENTITY + changes - changes.mean(axis=0)


def numpy_loss(image, matrix, target, identity_weight) -> float:
    """Return the loss of the transformed image, with the penalty; float64."""
    shown = np.einsum("ij,hwj->hwi", matrix[:, :3], image) + matrix[:, 3]
    loss = 0.8 * np.abs(shown - target).mean() + 0.2 * (1 - ssim(shown, target))
    return loss + identity_weight * np.square(matrix - IDENTITY).mean()


def transformed(image, matrix) -> np.ndarray:
    return (image @ matrix[:, :3].T + matrix[:, 3]).astype(np.float32)


def small_image(seed=3) -> np.ndarray:
    """Such that transformed colours stay within 0 and 1, where the metric does not clip."""
    return single(np.random.default_rng(seed).uniform(0.3, 0.6, (24, 32, 3)))


def test_loss_and_derivatives_of_a_transform_match_numpy():
    weight = 0.3
    trainer = with_matrices(make_trainer(colors__identity_weight=weight), random_matrices())
    (effect,) = trainer.effects
    image, target = small_image(), fits.plain_dataset().train[2].image.astype(np.float64)
    view, matrix = trainer.views[2], single(random_matrices()[2])
    effect.before_render(trainer.fit_state(), view)
    _, loss, _ = trainer.compare(mi.TensorXf(image.astype(np.float32)), view)
    assert float(loss[0]) == pytest.approx(numpy_loss(image, matrix, target, weight), rel=2e-6)
    dr.backward(loss)
    actual = np.array(dr.grad(effect.parameters(view)["matrices"])).astype(np.float64)
    actual = actual.reshape(3, 4)
    expected, step = np.zeros((3, 4)), 1e-6
    for index in np.ndindex(3, 4):
        both = []
        for sign in (1, -1):
            moved = matrix.copy()
            moved[index] += sign * step
            both.append(numpy_loss(image, moved, target, weight))
        expected[index] = (both[0] - both[1]) / (2 * step)
    # Sums of 768 derivatives in single precision; a step crosses the kinks of |x| in few pixels.
    np.testing.assert_allclose(actual, expected, atol=1e-4 * np.abs(expected).max())
    assert np.abs(expected).min() > 0.01 * np.abs(expected).max()
    penalty = 2 * weight * (matrix - IDENTITY) / 12
    assert np.abs(penalty).max() > 0.01 * np.abs(expected).max()


def test_background_is_untransformed_in_transparent_pixels():
    """No camera saw it. Between, the change is as large as the photograph is opaque."""
    dataset = fits.with_views(fits.true_dataset(), lambda v: replace(v, depth=None))
    trainer = with_matrices(make_trainer(dataset), random_matrices())
    (effect,) = trainer.effects
    image, matrix, view = small_image(), random_matrices()[2], trainer.views[2]
    effect.before_render(trainer.fit_state(), view)
    actual = np.array(dr.detach(effect.adjust(mi.TensorXf(image.astype(np.float32)), view)))
    alpha = dataset.train[2].alpha[:, :, None]
    assert (alpha == 0).any() and (alpha > 0.9).any()
    np.testing.assert_array_equal(actual[alpha[..., 0] == 0], image[alpha[..., 0] == 0])
    expected = (1 - alpha) * image + alpha * transformed(image, matrix)
    np.testing.assert_allclose(actual, expected, atol=1e-6)


@pytest.mark.slow
def test_color_change_of_a_photograph_is_recovered():
    """Before true blobs that stay. Few colours are all that tell of its 12 numbers.

    The mean of the two transforms is the identity.
    """
    dataset = fits.plain_dataset()
    warm = np.array([[1.2, 0.05, 0.0, 0.02], [0.0, 0.9, 0.1, -0.03], [0.05, 0.0, 0.7, 0.05]])
    photos, matrices = (dataset.train[3], dataset.train[4]), (warm, 2 * IDENTITY - warm)
    changed = tuple(
        replace(photo, image=transformed(photo.image, matrix))
        for photo, matrix in zip(photos, matrices, strict=True)
    )
    trainer = make_trainer(
        replace(dataset, train=changed),
        fits.true_blobs(),
        colors__lr=6e-3,
        colors__identity_weight=0.0,
        **fits.FROZEN_GAUSSIANS,
    )
    fits.steps(trainer, 500)
    for photo, target, matrix in zip(photos, changed, matrices_of(trainer), strict=True):
        found = transformed(photo.image, matrix) - target.image
        covered = next(v for v in fits.true_dataset().train if v.name == photo.name).alpha > 0.2
        before = np.abs(photo.image - target.image)
        # Adam keeps stepping by its rate around the end.
        assert np.abs(found).mean() < 0.05 * before.mean()
        assert np.abs(found[covered]).mean() < 0.1 * before[covered].mean()


def test_identity_transform_gives_the_same_bits():
    plain, corrected = fits.make_trainer(fits.plain_dataset()), make_trainer()
    first, second = plain.step(), corrected.step()
    assert first.loss == second.loss and first.psnr == second.psnr
    for name in PARAMETER_NAMES:
        values = [getattr(trainer.gaussians(), name) for trainer in (plain, corrected)]
        np.testing.assert_array_equal(*values, err_msg=name)


def test_first_step_is_the_rate_which_decays_like_that_of_the_means():
    for iterations, share in ((1, 0.01), (2, 0.1)):
        trainer = make_trainer(colors__lr=3e-2, iterations=iterations)
        trainer.step()
        moved = np.sort(np.abs(matrices_of(trainer) - IDENTITY), axis=0)
        # Adam's first step is rate * sign(gradient); the mean of all views stays the identity.
        np.testing.assert_allclose(moved[5], 5 / 6 * share * 3e-2, atol=2e-7)
        np.testing.assert_allclose(moved[:5], 1 / 6 * share * 3e-2, atol=2e-7)


def test_view_seen_later_starts_with_the_full_rate():
    """Its optimizer counts its own steps. The rate stays, as that of the means does here."""
    rates = {"optimizer__means_lr": 1e-4, "optimizer__means_lr_final": 1e-4}
    trainer = fits.steps(make_trainer(colors__lr=3e-2, **rates), 6)  # each view is seen once
    (effect,) = trainer.effects
    values = effect.state()["matrices.value"].reshape(6, 3, 4)
    np.testing.assert_allclose(np.abs(values - IDENTITY), 3e-2, atol=4e-7)


def test_transforms_are_written_by_view_name(tmp_path):
    trainer = fits.steps(make_trainer(), 9)
    (effect,) = trainer.effects
    effect.write(tmp_path, fits.plain_dataset())
    written = json.loads((tmp_path / COLORS).read_text())
    assert list(written) == [view.name for view in fits.plain_dataset().train]
    np.testing.assert_array_equal(list(written.values()), matrices_of(trainer))
    assert len({str(matrix) for matrix in written.values()}) == 6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "numbers"),
    [
        ({"colors__lr": 2e-3}, {"matrices": 6}),
        (
            {"cameras__optimise": True, "cameras__focal_lr": 3e-3, "cameras__principal_lr": 4e-3},
            {"turns": 6, "moves": 6, "log_focals": 1, "shifts": 1},
        ),
    ],
    ids=["colors", "cameras"],
)
def test_only_rows_of_the_current_view_change(changes, numbers):
    """And what all views share; numbers and moments of all others stay, bit by bit."""
    trainer, seen = fits.make_trainer(fits.plain_dataset(), **changes), set()
    (effect,) = trainer.effects
    for _ in range(8):
        before = effect.state()
        trainer.step()
        after = effect.state()
        index = trainer.last_step.views[-1].view.index
        for name, count in numbers.items():
            for key in (f"{name}.value", f"{name}.m", f"{name}.v"):
                rows = [state[key].reshape(count, -1) for state in (before, after)]
                changed = np.flatnonzero((rows[0] != rows[1]).any(axis=1))
                assert changed.tolist() == [index if count > 1 else 0], key
        seen.add(index)
    assert len(seen) == 6
