"""How far float32 may be from the float64 reference: the noise that one rounding everywhere makes.

Rounding errors are modelled as in Monte Carlo arithmetic (Parker 1997, "Monte Carlo Arithmetic:
exploiting randomness in floating-point arithmetic"): the float64 reference is evaluated again and
again while every number that a float32 implementation has to round -- the inputs, the camera,
and what each stage hands to the next -- is moved by at most one rounding, 2^-24 of its size. The
root mean square change of a result is its *noise*: what the problem's conditioning turns one
rounding everywhere into. It is a property of the scene and of the reference alone; the kernels
have no part in it.

A float32 implementation makes k roundings where the model makes one. By the probabilistic error
analysis of Higham and Mary (2019, "A new approach to probabilistic rounding error analysis"),
their sum exceeds lambda sqrt(k) noise with a probability of at most 2 exp(-lambda^2 / 2).
"""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import dataclass, replace
from unittest import mock

import numpy as np

from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import splatting as reference
from support.helpers import Case, Cotangents

U = 2.0**-24
"""Unit roundoff of float32."""

SAMPLES = 16

EXP2 = 4.0
"""Roundings in the exponential: the short exp2 has a relative error of 2.2e-7."""


@dataclass(frozen=True)
class Noise:
    """Root mean square change of each result under one rounding everywhere."""

    rendered: dict[str, np.ndarray]
    gradients: dict[str, np.ndarray]


def noise(case: Case, cotangents: Cotangents, samples: int = SAMPLES) -> Noise:
    """The noise of a case's image and gradients, arrays in the shapes of the results."""
    images, gradients = [], []
    base = _results(case.gaussians, case.camera, case, cotangents)
    splats = reference.project(case.gaussians, case.camera, case.antialiased)
    order = reference.depth_order(splats.depths, splats.visible)
    for sample in range(samples):
        rng = np.random.default_rng([sample, 17])
        gaussians, camera = rounded_inputs(rng, case.gaussians, case.camera)
        weights = Cotangents(
            *(rounded(rng, getattr(cotangents, name)) for name in vars(cotangents))
        )
        with _rounded_stages(rng, order):
            rendered, gradient = _results(gaussians, camera, case, weights)
        images.append(rendered)
        gradients.append(gradient)
    return Noise(rms(images, base[0]), rms(gradients, base[1]))


def _results(gaussians, camera, case, cotangents) -> tuple[dict, dict]:
    rendered = reference.render(
        gaussians, camera, case.background, case.rendered_degree, case.antialiased
    )
    gradients = reference.render_gradients(
        gaussians, camera, case.background, cotangents.d_image, cotangents.d_alpha,
        cotangents.d_depth, case.rendered_degree, case.antialiased,
    )  # fmt: skip
    planes = {n: getattr(rendered, n) for n in ("image", "alpha", "depth", "transmittance")}
    return planes, gradients


def rms(samples: list[dict], base: dict) -> dict[str, np.ndarray]:
    """Over the samples; vectors (colours, rows of a matrix) have one noise, their largest."""
    result = {}
    for name, value in base.items():
        noise = np.sqrt(np.mean([(s[name] - value) ** 2 for s in samples], axis=0))
        if noise.ndim > 1 and noise.shape[-1] in (2, 3, 4):
            noise = np.broadcast_to(noise.max(axis=-1, keepdims=True), noise.shape)
        result[name] = noise
    return result


def rounded(rng, values, roundings=1.0) -> np.ndarray:
    """Each value moved by up to ``roundings`` roundings, in either direction."""
    values = np.asarray(values, dtype=np.float64)
    return values * (1 + roundings * U * rng.uniform(-1, 1, values.shape))


def rounded_inputs(rng, gaussians, camera):
    """Gaussians and camera, every number moved by up to one rounding."""
    fields = {name: rounded(rng, getattr(gaussians, name)) for name in PARAMETER_NAMES}
    # The difference of mean and camera centre is rounded, not the two: they are given exactly.
    offset = gaussians.means - camera.center
    fields["means"] = camera.center + rounded(rng, offset)
    numbers = {
        name: float(rounded(rng, getattr(camera, name))) for name in ("fx", "fy", "cx", "cy")
    }
    # Gaussians at the near plane stay in front of it.
    near = camera.near * (1 - 1e-5)
    camera = replace(camera, rotation=rounded(rng, camera.rotation), near=near, **numbers)
    return reference.Gaussians(**fields), camera


def opacity_size(opacities) -> np.ndarray:
    """Return numbers that are rounded with an opacity: alpha's exponential, and T (1 - alpha), one
    rounding of T however small alpha is.
    """
    return np.maximum(EXP2 * opacities, opacities > reference.ALPHA_CUT)


def color_share(opacities) -> np.ndarray:
    """Return the factor from a rounding of the sum of a splat's light to one of its colour."""
    return np.maximum(opacities, reference.ALPHA_CUT)


@contextmanager
def _rounded_stages(rng, order):
    """The reference, with a rounding of what each stage hands to the next.

    order: visible Gaussians by depth. A decision is not a rounding: it stays what it is.
    The same numbers are rounded the same way wherever a function is called again, as the
    gradient's functions do: noise is a function of the call's place, not of the call.
    """
    seed = int(rng.integers(2**62))
    original_affine, original_sigmoid = reference.local_affine, reference.sigmoid
    original_colors = reference.unclamped_colors

    def affine(gaussians, camera):
        result = original_affine(gaussians, camera)
        own = np.random.default_rng([seed, 1])
        scales = rounded(own, result.scales)
        return replace(result, axes2d=rounded(own, result.axes2d), scales=scales)

    def sigmoid(logits):
        own = np.random.default_rng([seed, 2])
        opacities = original_sigmoid(logits)
        return opacities + opacity_size(opacities) * U * own.uniform(-1, 1, np.shape(logits))

    def colors(gaussians, directions, degree):
        own = np.random.default_rng([seed, 3])
        result = original_colors(gaussians, directions, degree)
        share = color_share(original_sigmoid(gaussians.logit_opacities))
        return result + U / share[:, None] * own.uniform(-1, 1, result.shape)

    with (
        mock.patch.object(reference, "local_affine", affine),
        mock.patch.object(reference, "sigmoid", sigmoid),
        mock.patch.object(reference, "unclamped_colors", colors),
        mock.patch.object(reference, "depth_order", lambda depths, visible: order),
    ):
        yield
