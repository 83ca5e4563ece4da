"""Vignetting and response of cameras: derivatives, what they find, and what stays."""

import json
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from pydantic import ValidationError
from support import small_fits as fits
from support.helpers import central_difference, single
from support.small_fits import photometric_loss

from drgs.core.errors import UserError
from drgs.effects.colors import ColorConfig
from drgs.effects.photometry import PHOTOMETRY
from drgs.gaussians.parameters import PARAMETER_NAMES

VIGNETTING = np.array([[-0.3, 0.1, -0.15], [0.05, -0.1, 0.02]])
RESPONSE = np.array([[0.2, 0.1], [-0.2, -0.1]])  # their mean is zero

RATES = {"colors__vignetting_lr": 2e-3, "colors__response_lr": 3e-3}


def make_trainer(dataset=None, gaussians=None, **changes):
    return fits.make_trainer(
        dataset or fits.two_camera_dataset(), gaussians, **{**RATES, **changes}
    )


def falloff(vignetting, r) -> np.ndarray:
    legendre = np.polynomial.legendre.legval(2 * r**2 - 1, vignetting)
    return 1 + r**2 * legendre


def taken(image, view, vignetting, response) -> np.ndarray:
    """The image (H, W, 3) as a camera takes it, in float64."""
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    r = np.hypot(x - view.cx, y - view.cy) / np.hypot(view.width / 2, view.height / 2)
    seen = image * falloff(vignetting, r)[:, :, None]
    base = np.clip(seen, 1e-3, 1)
    return seen * base ** (np.exp(response[0] + response[1] * base) - 1)


def small_image(seed=3) -> np.ndarray:
    """With colours that f maps, and a dark corner that it scales."""
    image = single(np.random.default_rng(seed).uniform(0.3, 0.9, (24, 32, 3)))
    image[:4, :4] *= 1e-3
    return image


@pytest.mark.parametrize("index", [2, 3])
def test_loss_and_derivatives_match_numpy(index):
    trainer = fits.with_numbers(make_trainer(), vignetting=VIGNETTING, response=RESPONSE)
    (effect,) = trainer.effects
    image, target = small_image(), fits.plain_dataset().train[index].image.astype(np.float64)
    view, data = trainer.views[index], fits.two_camera_dataset().train[index]
    numbers = np.concatenate([single(VIGNETTING[index % 2]), single(RESPONSE[index % 2])])

    def expected_loss(numbers, image=image) -> float:
        return photometric_loss(taken(image, data, numbers[:3], numbers[3:]), target)

    effect.before_render(trainer.fit_state(), view)
    rendered = mi.TensorXf(image.astype(np.float32))
    dr.enable_grad(rendered)
    _, loss, _ = trainer.compare(rendered, view)
    # Means over 768 pixels in single precision.
    assert float(loss[0]) == pytest.approx(expected_loss(numbers), rel=2e-6)
    dr.backward(loss)
    leaves = effect.leaves(view)
    actual = np.concatenate([np.array(dr.grad(leaves[n])) for n in ("vignetting", "response")])
    expected = [central_difference(expected_loss, numbers, k, 1e-6) for k in range(5)]
    # Sums of 768 derivatives in single precision; a step crosses the kinks of |x| in few pixels.
    np.testing.assert_allclose(actual, expected, atol=2e-4 * np.abs(expected).max())
    assert np.abs(expected).min() > 0.003 * np.abs(expected).max()
    places = [(12, 16, 0), (23, 31, 2), (1, 2, 1)]  # the last one is dark
    actual = np.array(dr.grad(rendered))
    expected = [
        central_difference(lambda image: expected_loss(numbers, image), image, place, 1e-7)
        for place in places
    ]
    # Through SSIM's windows in single precision.
    np.testing.assert_allclose([actual[p] for p in places], expected, rtol=2e-3)


def test_bright_colours_are_scaled_and_backgrounds_of_transparent_pixels_unchanged():
    dataset = fits.two_camera_dataset(fits.transparent_dataset())
    trainer = fits.with_numbers(make_trainer(dataset), vignetting=VIGNETTING, response=RESPONSE)
    (effect,) = trainer.effects
    image, view, data = small_image(), trainer.views[2], dataset.train[2]
    image[10:14, 14:18] *= 3  # brighter than what f maps
    effect.before_render(trainer.fit_state(), view)
    actual = np.array(dr.detach(effect.adjust(mi.TensorXf(image.astype(np.float32)), view)))
    alpha = data.alpha[:, :, None]
    expected = (1 - alpha) * image + alpha * taken(image, data, VIGNETTING[0], RESPONSE[0])
    np.testing.assert_allclose(actual, expected, atol=1e-6)  # float32, of values up to 2.7
    assert (alpha == 0).any() and (alpha > 0.9).any()


def test_no_vignetting_and_the_same_response_give_the_same_bits():
    plain = fits.make_trainer(fits.two_camera_dataset())
    first, second = plain.step(), (effect := make_trainer()).step()
    assert first.loss == second.loss and first.psnr == second.psnr
    for name in PARAMETER_NAMES:
        values = [getattr(trainer.gaussians(), name) for trainer in (plain, effect)]
        np.testing.assert_array_equal(*values, err_msg=name)


def test_numbers_are_those_of_cameras_and_written_by_view(tmp_path):
    """A step changes one camera's; the mean response stays that of none."""
    dataset = fits.two_camera_dataset()
    trainer = fits.steps(make_trainer(dataset), 1)
    (effect,) = trainer.effects
    row = trainer.last_step.views[-1].view.index % 2
    changed = effect.state()["vignetting.value"].any(axis=1)
    assert changed[row] and not changed[1 - row]
    effect = fits.steps(trainer, 8).effects[0]
    effect.write(tmp_path, dataset)
    written = json.loads((tmp_path / PHOTOMETRY).read_text())
    assert list(written) == [view.name for view in dataset.train]
    found = [list(map(tuple, each.values())) for each in written.values()]
    assert found[0] == found[2] == found[4] != found[1] == found[3] == found[5]
    responses = np.array([each["response"] for each in written.values()])
    assert np.abs(responses).min() > 1e-4
    np.testing.assert_allclose(responses[0], -responses[1], atol=1e-7)  # float32 of 0.02


def test_response_of_one_camera_is_refused():
    with pytest.raises(UserError, match="needs photographs by several cameras"):
        make_trainer(fits.plain_dataset())


@pytest.mark.slow
def test_vignetting_and_responses_of_photographs_are_found():
    """The fit optimises nothing else; the curves are off by about its last steps."""
    dataset = fits.two_camera_dataset()
    train = [
        replace(v, image=taken(v.image, v, VIGNETTING[k % 2], RESPONSE[k % 2]).astype(np.float32))
        for k, v in enumerate(dataset.train)
    ]
    dataset = replace(dataset, train=tuple(train))
    changes = {"colors__vignetting_lr": 0.05, "colors__response_lr": 0.01, "iterations": 500}
    changes |= {**fits.FROZEN_GAUSSIANS, "optimizer__means_lr_final": 1e-22}
    trainer = fits.steps(make_trainer(dataset, fits.true_blobs(), **changes), 480)
    found = trainer.effects[0].coefficients()
    r = np.linspace(0, 1, 11)
    curves = [[falloff(row, r) for row in rows] for rows in (found["vignetting"], VIGNETTING)]
    np.testing.assert_allclose(*curves, atol=0.01)
    exponents = [
        np.exp(rows @ np.array([[1.0, 1.0, 1.0], [0.3, 0.6, 0.9]]))
        for rows in (found["response"], RESPONSE)
    ]
    np.testing.assert_allclose(*exponents, atol=0.02)


@pytest.mark.parametrize("key", ["vignetting_lr", "response_lr"])
@pytest.mark.parametrize(
    ("value", "message"),
    [
        (0, "greater than 0"),
        (-0.1, "greater than 0"),
        (11, "less than or equal to 10"),
        (float("nan"), "finite number"),
        ("fast", "valid number"),
    ],
)
def test_rates_that_are_none_are_refused(key, value, message):
    with pytest.raises(ValidationError, match=message):
        ColorConfig(**{key: value})
