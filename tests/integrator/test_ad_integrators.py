"""``splats`` as Mitsuba tests its differentiable integrators: small scenes, of each the image and
its forward and backward derivatives.

Images are compared with stored ones (``tests/references``), derivatives with finite differences
of ``mi.render``. Errors are measured as Mitsuba's ``test_ad_integrators.py`` does, and its
thresholds are upper bounds of those here. Cut-offs are off where they are not what is tested, and
orders do not change: steps that are documented as not differentiated do not occur. Light paths have
the same seed on both sides, so that a derivative is that of the same estimate.

    python tests/integrator/test_ad_integrators.py --write [NAME...]

stores images anew, all or some.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from support.ad_scenes import CONFIGS, IMAGES, Config, DefaultCutoffs, tensor
from support.openexr import read_exr

import drgs  # noqa: F401  (registers the plugins)

REFERENCES = REPOSITORY / "tests" / "references"


SEED = 3


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


# ----------------------------------------------------------------------------------------------
# Scene classes
# ----------------------------------------------------------------------------------------------


all_configs = pytest.mark.parametrize("kind", CONFIGS, ids=lambda kind: kind.__name__)


# ----------------------------------------------------------------------------------------------
# Rendering
# ----------------------------------------------------------------------------------------------


@contextmanager
def initialized(kind: type[Config]) -> Iterator[Config]:
    """A config, whose parameter is put back afterwards."""
    config = kind()
    config.initialize()
    try:
        yield config
    finally:
        config.params[config.key] = config.initial_state
        config.params.update()


def renders(kind: type[Config], thetas: Sequence[float]) -> list[np.ndarray]:
    """(H, W, C) of each theta."""
    images = []
    with initialized(kind) as config:
        for theta in thetas:
            config.update(dr.opaque(mi.Float, theta))
            images.append(np.array(mi.render(config.scene, seed=SEED)).astype(np.float64))
    return images


@contextmanager
def attached(kind: type[Config]) -> Iterator[tuple[mi.Float, mi.TensorXf]]:
    """Theta, and an image that depends on it, whose derivative is that of :func:`images`."""
    theta = mi.Float(0)
    dr.enable_grad(theta)
    with initialized(kind) as config:
        config.update(theta)
        # Mitsuba wants another seed for the image than for its derivative.
        yield theta, mi.render(config.scene, config.params, seed=SEED + 1, seed_grad=SEED)


def forward(kind: type[Config]) -> np.ndarray:
    """Derivative of the image, (H, W, C)."""
    with attached(kind) as (theta, image):
        dr.set_grad(theta, 1.0)
        return np.array(dr.forward_to(image)).astype(np.float64)


def backward(kind: type[Config], weights) -> float:
    """Derivative of the weighted sum of the image."""
    with attached(kind) as (theta, image):
        dr.backward(dr.sum(image * tensor(weights), axis=None))
        return dr.grad(theta)[0]


@cache
def differences(kind: type[Config]) -> np.ndarray:
    """Central ones of fourth order, (H, W, C)."""
    h = kind.epsilon
    a, b, c, d = renders(kind, [-2 * h, -h, h, 2 * h])
    return (8 * (c - b) - (d - a)) / (12 * h)


def weights_of(kind: type[Config]) -> np.ndarray:
    """Random, of the derivative's signs: the terms of the sum do not cancel."""
    numbers = np.random.RandomState(2).normal(size=differences(kind).shape)
    return np.sign(differences(kind)) * np.abs(numbers)


# ----------------------------------------------------------------------------------------------
# Errors
# ----------------------------------------------------------------------------------------------


def relative(actual, expected, floor) -> np.ndarray:
    """Mitsuba's measure: the error over what was expected, or over ``floor`` if that is more."""
    return np.abs(actual - expected) / np.maximum(np.abs(expected), floor)


def errors_of_image(actual, expected) -> tuple[float, float]:
    """The mean, and the part of the pixels that differ by more than what storing changes.

    float16 rounds by 2^-11. Single precision is off by 1e-5, 5e-4 of Mitsuba's floor of 0.02.
    """
    errors = relative(actual, expected, 2e-2)
    return errors.mean(), np.mean(errors.max(axis=-1) > 2**-11 + 1e-3)


def errors_of_forward(kind, actual) -> tuple[float, float]:
    """Mean and maximum. Mitsuba's floor of 0.2 is lowered where derivatives are small."""
    expected = differences(kind)
    errors = relative(actual, expected, min(0.2, 0.1 * np.abs(expected).max()))
    return errors.mean(), errors.max()


def error_of_backward(kind, actual) -> float:
    """Relative, of the weighted sum."""
    expected = np.sum(weights_of(kind) * differences(kind))
    return abs(actual - expected) / abs(expected)


# ----------------------------------------------------------------------------------------------
# Tests
# ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", IMAGES)
def test_images_equal_the_stored_ones(name):
    """The second, which is as the first: nothing is left behind by one that it could show.

    Machines round differently, so that a light path or a splat's end may fall otherwise.
    """
    first, actual = renders(IMAGES[name], [0.0, 0.0])
    np.testing.assert_allclose(actual, first, rtol=0, atol=1e-5)  # filters add in any order
    expected = read_reference(name)
    assert actual.shape == expected.shape
    error_mean, differing = errors_of_image(actual, expected)
    assert differing <= 0.01
    # Rounding to float16 is 2^-12 of a value at most, on the mean; pixels that differ may do so by
    # Mitsuba's maximum.
    assert error_mean <= 2**-12 + 0.5 * differing


@pytest.mark.parametrize("name", IMAGES)
def test_images_one_percent_brighter_differ(name):
    expected = read_reference(name)
    _, differing = errors_of_image(1.01 * expected, expected)
    assert differing > 0.01


@pytest.mark.slow
@all_configs
def test_forward_derivatives_equal_differences(kind):
    error_mean, error_max = errors_of_forward(kind, forward(kind))
    print(f"mean {error_mean:.1e}, maximum {error_max:.1e}")
    assert error_mean <= kind.error_mean_threshold
    assert error_max <= kind.error_max_threshold


@pytest.mark.slow
@all_configs
def test_backward_derivatives_equal_differences(kind):
    error = error_of_backward(kind, backward(kind, weights_of(kind)))
    print(f"{error:.1e}")
    assert error <= kind.error_mean_threshold_bwd


@all_configs
def test_thresholds_are_below_mitsubas_and_detect_one_percent_errors(kind):
    assert kind.error_mean_threshold <= 0.05
    assert kind.error_max_threshold <= 0.5
    assert kind.error_mean_threshold_bwd <= 0.05
    if kind is not DefaultCutoffs:
        error_mean, _ = errors_of_forward(kind, 1.01 * differences(kind))
        assert error_mean > kind.error_mean_threshold
        assert kind.error_mean_threshold_bwd < 0.01


# ----------------------------------------------------------------------------------------------
# Stored images
# ----------------------------------------------------------------------------------------------


def read_reference(name: str) -> np.ndarray:
    return np.array(read_exr(REFERENCES / f"{name}.exr")).astype(np.float64)


def write_reference(name: str) -> None:
    (image,) = renders(IMAGES[name], [0.0])
    bitmap = mi.Bitmap(tensor(image))
    bitmap = bitmap.convert(component_format=mi.Struct.Type.Float16)
    bitmap.write(str(REFERENCES / f"{name}.exr"))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Store images anew, by name, or all.")
    parser.add_argument("--write", nargs="*", choices=IMAGES, metavar="NAME", required=True)
    mi.set_variant("llvm_ad_rgb")
    REFERENCES.mkdir(exist_ok=True)
    for name in parser.parse_args().write or IMAGES:
        write_reference(name)
