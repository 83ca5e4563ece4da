"""Colour transforms of single photographs: derivatives, what they find, and what stays."""

import json

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import small_fits as fits
from support.helpers import central_difference, single
from support.small_fits import photometric_loss

from drgs.effects.colors import COLORS
from drgs.gaussians.parameters import PARAMETER_NAMES

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


def random_matrices(count=6, seed=1) -> np.ndarray:
    """Their mean is the identity."""
    changes = np.random.default_rng(seed).normal(0, 0.1, (count, 3, 4))
    return IDENTITY + changes - changes.mean(axis=0)


def transformed(image, matrix) -> np.ndarray:
    return image @ matrix[:, :3].T + matrix[:, 3]


def small_image(seed=3) -> np.ndarray:
    """Such that transformed colours stay within 0 and 1, where the metric does not clip."""
    return single(np.random.default_rng(seed).uniform(0.3, 0.6, (24, 32, 3)))


def test_loss_and_derivatives_of_a_transform_match_numpy():
    weight = 0.3
    trainer = fits.with_numbers(
        make_trainer(colors__identity_weight=weight), matrices=random_matrices()
    )
    (effect,) = trainer.effects
    image, target = small_image(), fits.plain_dataset().train[2].image.astype(np.float64)
    view, matrix = trainer.views[2], single(random_matrices()[2])

    def expected_loss(matrix) -> float:
        penalty = weight * np.square(matrix - IDENTITY).mean()
        return photometric_loss(transformed(image, matrix), target) + penalty

    effect.before_render(trainer.fit_state(), view)
    _, loss, _ = trainer.compare(mi.TensorXf(image.astype(np.float32)), view)
    assert float(loss[0]) == pytest.approx(expected_loss(matrix), rel=2e-6)
    dr.backward(loss)
    actual = np.array(dr.grad(effect.parameters(view)["matrices"])).astype(np.float64)
    actual = actual.reshape(3, 4)
    places = np.ndindex(3, 4)
    expected = [central_difference(expected_loss, matrix, index, 1e-6) for index in places]
    expected = np.reshape(expected, (3, 4))
    # Sums of 768 derivatives in single precision; a step crosses the kinks of |x| in few pixels.
    np.testing.assert_allclose(actual, expected, atol=1e-4 * np.abs(expected).max())
    assert np.abs(expected).min() > 0.01 * np.abs(expected).max()
    penalty = 2 * weight * (matrix - IDENTITY) / 12
    assert np.abs(penalty).max() > 0.01 * np.abs(expected).max()


def test_background_is_untransformed_in_transparent_pixels():
    """No camera saw it. Between, the change is as large as the photograph is opaque."""
    dataset = fits.transparent_dataset()
    trainer = fits.with_numbers(make_trainer(dataset), matrices=random_matrices())
    (effect,) = trainer.effects
    image, matrix, view = small_image(), random_matrices()[2], trainer.views[2]
    effect.before_render(trainer.fit_state(), view)
    actual = np.array(dr.detach(effect.adjust(mi.TensorXf(image.astype(np.float32)), view)))
    alpha = dataset.train[2].alpha[:, :, None]
    assert (alpha == 0).any() and (alpha > 0.9).any()
    np.testing.assert_array_equal(actual[alpha[..., 0] == 0], image[alpha[..., 0] == 0])
    expected = (1 - alpha) * image + alpha * transformed(image, matrix)
    np.testing.assert_allclose(actual, expected, atol=1e-6)


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
    # A view that is seen later has its own optimizer. Here the rate stays, as that of the means.
    rates = {"optimizer__means_lr": 1e-4, "optimizer__means_lr_final": 1e-4}
    trainer = fits.steps(make_trainer(colors__lr=3e-2, **rates), 6)  # each view is seen once
    found = trainer.effects[0].state()["matrices.value"].reshape(6, 3, 4)
    np.testing.assert_allclose(np.abs(found - IDENTITY), 3e-2, atol=4e-7)


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
    ("changes", "names"),
    [
        ({"colors__lr": 2e-3}, ["matrices"]),
        (
            {"cameras__optimise": True, **fits.CAMERA_RATES},
            ["turns", "moves", "log_focals", "shifts"],
        ),
    ],
    ids=["colors", "cameras"],
)
def test_only_rows_of_the_current_view_change(changes, names):
    """And what all views share; numbers and moments of all others stay, bit by bit."""
    trainer, seen = fits.make_trainer(fits.plain_dataset(), **changes), set()
    (effect,) = trainer.effects
    for _ in range(8):
        before = effect.state()
        after = fits.steps(trainer, 1).effects[0].state()
        index = trainer.last_step.views[-1].view.index
        for key in (f"{name}.{part}" for name in names for part in ("value", "m", "v")):
            changed = np.flatnonzero((before[key] != after[key]).any(axis=1))
            assert changed.tolist() == [min(index, len(after[key]) - 1)], key
        seen.add(index)
    assert len(seen) == 6
