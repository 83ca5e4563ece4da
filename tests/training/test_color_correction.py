"""Colour transforms of single photographs: derivatives, what they find, and what stays."""

import json
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import small_fits as fits
from support.helpers import single

from drgs.results.files import COLORS
from drgs.results.metrics import ssim
from drgs.training.effects.base import training_effects

IDENTITY = np.eye(3, 4)


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


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


# Rates of a fit that optimises colours only.
FROZEN_GAUSSIANS = {
    "optimizer__means_lr": 1e-20,
    "optimizer__means_lr_final": 1e-20,
    **{f"optimizer__{name}_lr": 0.0 for name in ("quats", "scales", "opacities", "sh0", "shN")},
}


# ----------------------------------------------------------------------------------------------
# The start
# ----------------------------------------------------------------------------------------------


def test_identity_transform_gives_the_same_loss_and_gradient_bits():
    plain, corrected = fits.make_trainer(fits.plain_dataset()), make_trainer()
    for trainer in (plain, corrected):
        trainer.iteration = 1
    (effect,) = corrected.effects
    for index in (0, 4):
        effect.before_render(corrected, corrected.views[index])
        expected = fits.gradients_of_loss(plain, plain.views[index])
        got = fits.gradients_of_loss(corrected, corrected.views[index])
        for name, values in expected.items():
            np.testing.assert_array_equal(got[name], values, err_msg=name)
    plain, corrected = fits.make_trainer(fits.plain_dataset()), make_trainer()
    first, second = plain.step(), corrected.step()
    assert first.loss == second.loss and first.psnr == second.psnr
    np.testing.assert_array_equal(corrected.gaussians().means, plain.gaussians().means)


def test_every_transform_starts_as_the_identity():
    np.testing.assert_array_equal(matrices_of(make_trainer()), np.tile(IDENTITY, (6, 1, 1)))


def test_colour_correction_is_off_by_default():
    assert training_effects(fits.config_of(), fits.plain_dataset()) == []


# ----------------------------------------------------------------------------------------------
# Loss and derivatives
# ----------------------------------------------------------------------------------------------


def numpy_loss(image, matrix, target, identity_weight) -> float:
    """Return the loss of the transformed image, with the penalty; float64."""
    shown = np.einsum("ij,hwj->hwi", matrix[:, :3], image) + matrix[:, 3]
    loss = 0.8 * np.abs(shown - target).mean() + 0.2 * (1 - ssim(shown, target))
    return loss + identity_weight * np.square(matrix - IDENTITY).mean()


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


def test_penalty_pulls_towards_the_identity():
    """Adam's steps by the penalty alone end there, and have its sign from the start."""
    trainer = with_matrices(make_trainer(colors__lr=0.01, **FROZEN_GAUSSIANS), random_matrices())
    (effect,) = trainer.effects
    view, start = trainer.views[1], random_matrices()[1]
    for iteration in range(60):
        effect.before_render(trainer.fit_state(), view)
        (penalty,) = effect.penalties(view)
        if iteration == 0:
            expected = 0.1 * np.square(start - IDENTITY).mean()
            assert float(penalty[0]) == pytest.approx(expected, rel=1e-5)
        dr.backward(penalty)
        fits.end_view(effect, trainer, view)
        if iteration == 0:
            moved = matrices_of(trainer) - random_matrices()
            step = -0.01 * np.sign(start - IDENTITY)
            np.testing.assert_allclose(moved[1], 5 / 6 * step, atol=1e-6)
            np.testing.assert_allclose(moved[4], -1 / 6 * step, atol=1e-6)
    left = np.abs(matrices_of(trainer)[1] - IDENTITY)
    assert left.max() < 0.25 * np.abs(start - IDENTITY).max()


# ----------------------------------------------------------------------------------------------
# Which views move
# ----------------------------------------------------------------------------------------------


def test_only_the_transform_of_the_current_view_changes():
    """But for what all have in common; the moments of all others stay, bit by bit."""
    trainer = make_trainer()
    (effect,) = trainer.effects
    seen = set()
    for _ in range(8):
        before = effect.state()
        trainer.iteration += 1
        index = trainer.last_step.views[-1].view.index
        trainer.iteration -= 1
        trainer.step()
        after = effect.state()
        for key in ("matrices.value", "matrices.m", "matrices.v"):
            rows = [state[key].reshape(6, 12) for state in (before, after)]
            changed = np.flatnonzero((rows[0] != rows[1]).any(axis=1))
            assert changed.tolist() == [index], key
        seen.add(index)
    assert len(seen) == 6


def test_first_step_is_the_rate_which_decays_like_that_of_the_means():
    for iterations, share in ((1, 0.01), (2, 0.1)):
        trainer = make_trainer(colors__lr=3e-2, iterations=iterations)
        trainer.step()
        moved = np.sort(np.abs(matrices_of(trainer) - IDENTITY), axis=0)
        # Adam's first step is rate * sign(gradient); stored beside a one. All give a part back.
        np.testing.assert_allclose(moved[5], 5 / 6 * share * 3e-2, atol=2e-7)
        np.testing.assert_allclose(moved[:5], 1 / 6 * share * 3e-2, atol=2e-7)


def test_view_seen_later_starts_with_the_full_rate():
    """Its optimizer counts its own steps. The rate stays, as that of the means does here."""
    rates = {"optimizer__means_lr": 1e-4, "optimizer__means_lr_final": 1e-4}
    trainer = make_trainer(colors__lr=3e-2, **rates)
    (effect,) = trainer.effects
    for _ in range(6):
        trainer.step()
    # Each was seen once.
    values = effect.state()["matrices.value"].reshape(6, 3, 4)
    np.testing.assert_allclose(np.abs(values - IDENTITY), 3e-2, atol=4e-7)


@pytest.mark.slow
def test_the_mean_of_all_transforms_is_the_identity():
    """After any iteration; rounding of numbers of 1."""
    trainer = make_trainer(colors__lr=3e-2)
    for _ in range(20):
        trainer.step()
        matrices = matrices_of(trainer)
        np.testing.assert_allclose(matrices.mean(axis=0), IDENTITY, atol=5e-7)
    assert np.abs(matrices - IDENTITY).max() > 0.02


@pytest.mark.slow
def test_common_colour_change_is_attributed_to_the_splats():
    """Photographs that are all darker by the same factor change no transform.

    Each photograph's own pull is down, by some 7 steps of the rate.
    """
    darker = fits.with_views(
        fits.plain_dataset((0.0, 0.0, 0.0)), lambda v: replace(v, image=np.float32(0.5) * v.image)
    )
    trainer = fits.steps(make_trainer(darker, fits.true_blobs(), colors__lr=1e-2), 40)
    gains = np.diagonal(matrices_of(trainer)[:, :, :3], axis1=1, axis2=2)
    np.testing.assert_allclose(gains, 1, atol=0.015)
    (effect,) = trainer.effects
    assert (np.array(effect.common)[[0, 5, 10]] < -0.03).all()


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


# ----------------------------------------------------------------------------------------------
# Recovered transforms
# ----------------------------------------------------------------------------------------------

WARM = np.array([[1.2, 0.05, 0.0, 0.02], [0.0, 0.9, 0.1, -0.03], [0.05, 0.0, 0.7, 0.05]])


def transformed(image, matrix) -> np.ndarray:
    return (image @ matrix[:, :3].T + matrix[:, 3]).astype(np.float32)


@pytest.mark.slow
def test_color_change_of_a_photograph_is_recovered():
    """Before true blobs that stay. Few colours are all that tell of its 12 numbers.

    The mean of the two transforms is the identity.
    """
    dataset = fits.plain_dataset()
    photos, matrices = (dataset.train[3], dataset.train[4]), (WARM, 2 * IDENTITY - WARM)
    changed = tuple(
        replace(photo, image=transformed(photo.image, matrix))
        for photo, matrix in zip(photos, matrices, strict=True)
    )
    trainer = make_trainer(
        replace(dataset, train=changed),
        fits.true_blobs(),
        colors__lr=6e-3,
        colors__identity_weight=0.0,
        **FROZEN_GAUSSIANS,
    )
    fits.steps(trainer, 500)
    for photo, target, matrix in zip(photos, changed, matrices_of(trainer), strict=True):
        found = transformed(photo.image, matrix) - target.image
        covered = next(v for v in fits.true_dataset().train if v.name == photo.name).alpha > 0.2
        before = np.abs(photo.image - target.image)
        # Adam keeps stepping by its rate around the end.
        assert np.abs(found).mean() < 0.05 * before.mean()
        assert np.abs(found[covered]).mean() < 0.1 * before[covered].mean()


def exposed_dataset():
    """Each photograph with an exposure and a white balance of its own, 1 on average."""
    dataset = fits.plain_dataset()
    gains = np.exp(np.random.default_rng(5).normal(0, 0.15, (6, 3)))
    gains /= gains.mean(axis=0)
    views = [
        replace(view, image=(view.image * gain).astype(np.float32))
        for view, gain in zip(dataset.train, gains, strict=True)
    ]
    return replace(dataset, train=tuple(views))


@pytest.mark.slow
def test_transforms_improve_fits_with_varying_exposure():
    """Measured on held-out photographs of one exposure, without a transform."""
    quality = {}
    for lr in (None, 1e-2):
        trainer = make_trainer(exposed_dataset(), colors__lr=lr)
        quality[lr] = fits.test_psnr(fits.steps(trainer, 90), exposed_dataset())
    assert quality[1e-2] > quality[None] + 1, quality


# ----------------------------------------------------------------------------------------------
# Files and checkpoints
# ----------------------------------------------------------------------------------------------


def test_transforms_are_written_by_view_name(tmp_path):
    trainer = fits.steps(make_trainer(), 9)
    (effect,) = trainer.effects
    dataset = fits.plain_dataset()
    effect.write(tmp_path, dataset)
    written = json.loads((tmp_path / COLORS).read_text())
    assert list(written) == [view.name for view in dataset.train]
    np.testing.assert_array_equal(list(written.values()), matrices_of(trainer))
    assert len({str(matrix) for matrix in written.values()}) == 6


def test_a_fit_resumes_to_the_same_bytes():
    fits.assert_resumes_to_the_same_bytes(make_trainer, 4, 5)


def test_transforms_are_part_of_the_state():
    trainer = fits.steps(make_trainer(), 2)
    state = trainer.state()
    values = state["colors/matrices.value"]
    values = (values - state["colors/common"]).reshape(6, 3, 4)
    np.testing.assert_array_equal(values, matrices_of(trainer))


def test_no_kernel_is_compiled_after_all_views_were_seen():
    fits.assert_no_new_kernels(make_trainer())
