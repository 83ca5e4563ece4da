"""The 3D smoothing filter: Gaussians no smaller than the training cameras can resolve.

A scene that was photographed with a sampling rate nu (pixels per scene unit, focal length over
depth) holds no detail below its Nyquist limit. Mip-Splatting (Yu et al. 2024, section 4.1)
therefore convolves each Gaussian with one of variance 0.2 / nu^2, nu being the largest rate of all
cameras that see it, and keeps its integral.

:func:`bake_smoothing` and :func:`bake_for_viewers` change Gaussians in closed form so that other
viewers, which add 0.3 square pixels to each splat's covariance and leave its opacity as it is, show
them about as they were fitted. The variance that viewers add is first subtracted from the
Gaussians, as far as they have any, and opacities make up for the rest, such that a splat keeps its
integral over the film (section 5).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from typing_extensions import override

from drgs.cameras.camera import Camera
from drgs.config.approximations import Approximations
from drgs.config.extensions import EFFECTS
from drgs.core.arrays import types_of
from drgs.core.types import Array3f, Float, TensorXf
from drgs.effects.base import SimulatedEffect, TrainingEffect, antialiasing_effect
from drgs.gaussians.parameters import Gaussians
from drgs.splatting.projection import (
    GaussianRows,
    compensated_opacity,
    load_rows,
    plain_opacity,
    project,
)

if TYPE_CHECKING:
    from drgs.config.schema import FitConfig
    from drgs.datasets.types import Dataset
    from drgs.training.views import FitState

FILTER_VARIANCE = 0.2
"""Variance of the filter, in squared distances between samples (Mip-Splatting, equation 9)."""

FILM_MARGIN = 0.15
"""Share of the film's size by which a camera is taken to see beyond it (Mip-Splatting's code)."""


def apply_smoothing(rows: GaussianRows) -> GaussianRows:
    """Widen the covariance of Gaussians by ``rows.smoothing``^2, and dim them in proportion."""
    assert rows.smoothing is not None, "composed where there is a filter"
    variance = dr.square(rows.smoothing)
    log_scales = dr.log(dr.exp(2 * rows.log_scales) + variance) / 2
    compensation = dr.exp(dr.sum(rows.log_scales - log_scales))
    return replace(rows, log_scales=log_scales, smoothing=None, opacity_compensation=compensation)


def smoothing_of(means: TensorXf, cameras: Iterable[Camera]) -> Float:
    """Return the standard deviation of the filter, (N,), scene units, as ``cameras`` need it.

    means: (N, 3). A mean that no camera sees gets the widest filter of all that one sees. Detached.
    """
    flat = dr.detach(means).array
    t = types_of(type(flat))
    row = dr.arange(t.UInt32, means.shape[0])
    points = t.Array3f([dr.gather(t.Float, flat, row * 3 + k) for k in range(3)])
    rates = dr.zeros(t.Float, means.shape[0])
    for camera in cameras:
        rates = dr.maximum(rates, _rates(points, camera))
        dr.eval(rates)
    lowest = dr.min(dr.select(rates > 0, rates, dr.inf))
    return math.sqrt(FILTER_VARIANCE) / dr.select(rates > 0, rates, lowest)


def _rates(points: Array3f, camera: Camera) -> Float:
    lens = camera.lens
    seen, position, depth = lens.visibility(camera, camera.rotation @ (points - camera.center))
    film = lens.project_point(camera, position)
    margin = FILM_MARGIN * (camera.film_end - camera.film_start)
    beside = (film < camera.film_start - margin) | (film > camera.film_end + margin)
    # Written such that NaN is not seen.
    seen &= (film.x == film.x) & (film.y == film.y) & ~(beside.x | beside.y)
    return dr.select(seen, dr.max(camera.lens.focal_lengths(camera)) / depth, 0)


UPDATE_EVERY = 100
"""Iterations, as in Mip-Splatting; also where a stage begins, and after each change of rows."""


@EFFECTS.register("smoothing")
class TrainingSmoothing(TrainingEffect):
    """The filter, computed from the training cameras at the image size in use."""

    order = 50  # places the sensors of all views
    by_row = frozenset({"filter"})

    @classmethod
    @override
    def is_used(cls, config: FitConfig, dataset: Dataset) -> bool:
        return config.model.smoothing

    @classmethod
    @override
    def summarize(cls, config: FitConfig, dataset: Dataset) -> list[SimulatedEffect]:
        keys = ("model.antialiased", "model.smoothing")
        given = (config.model.antialiased, config.model.smoothing)
        why = (key if is_given else None for key, is_given in zip(keys, given, strict=True))
        return [antialiasing_effect(*why)]

    def __init__(self) -> None:
        self.filter: Float | None = None

    @override
    def begin(self, fit: FitState) -> None:
        is_due = any(iteration % UPDATE_EVERY == 1 for iteration in fit.iterations_of_step)
        if self.filter is None or fit.begins_phase or is_due:
            self.filter = smoothing_of(fit.means, fit.cameras())
        fit.integrator.smoothing = self.filter

    @override
    def finish(self, fit: FitState) -> None:
        """Set the filter of the current means; the fit continues with the previous one."""
        fit.integrator.smoothing = smoothing_of(fit.means, fit.cameras())

    @override
    def on_population_change(self, fit: FitState) -> None:
        self.filter = fit.integrator.smoothing = None

    @override
    def state(self) -> dict[str, np.ndarray]:
        return {} if self.filter is None else {"filter": np.array(self.filter)}

    @override
    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        self.filter = cast(Float, mi.Float(state["filter"])) if "filter" in state else None


def bake_smoothing(gaussians: Gaussians) -> Gaussians:
    """Return the Gaussians (numpy) with the filter in their scales, and opacities below 1."""
    g = gaussians.numpy()
    if g.smoothing is None:
        return g
    variances = np.exp(2 * g.log_scales.astype(np.float64))
    widened = variances + np.square(g.smoothing.astype(np.float64))[:, None]
    odds = np.exp(-g.logit_opacities.astype(np.float64))
    opacities = np.sqrt(np.prod(variances / widened, axis=1)) / (1 + odds)
    log_scales = (np.log(widened) / 2).astype(np.float32)
    logits = _finite_logits(opacities)
    return replace(g, log_scales=log_scales, logit_opacities=logits, smoothing=None)


def _finite_logits(opacities: np.ndarray) -> np.ndarray:
    opacities = np.clip(opacities, np.finfo(np.float32).tiny, 1 - np.finfo(np.float32).eps)
    return (np.log(opacities) - np.log1p(-opacities)).astype(np.float32)


MIN_VARIANCE_SHARE = 0.04
"""Share of its variance that a Gaussian keeps along each axis: flatter ones would have next to no
derivatives by their scales."""


def bake_for_viewers(
    gaussians: Gaussians,
    cameras: Iterable[Camera],
    fitted: Approximations,
    shown: Approximations = Approximations(),  # noqa: B008  (frozen)
) -> Gaussians:
    """Return Gaussians (numpy) that look the same with other approximations.

    These are ``low_pass`` and ``antialiased`` of ``shown``, in place of those of ``fitted``.

    With l and L the low-pass of ``fitted`` and of ``shown``, and nu the largest rate (px per scene
    unit) of the ``cameras`` that see a Gaussian,

        s'^2 = max(s^2 - (L - l) / nu^2, 0.04 s^2),   o' = o sum(a sqrt(det C)) / sum(sqrt(det C')),

    where C and C' are the covariances on the film, low-pass included, a is what compensation leaves
    of the opacity, and the sums go over the cameras that see the Gaussian. Unseen ones keep theirs.

    gaussians: Dr.Jit arrays, without a smoothing filter. Detached.
    """
    cameras = list(cameras)
    host = dr.detach(gaussians).numpy()
    nyquist = np.array(smoothing_of(gaussians.means, cameras), np.float64)
    difference = shown.low_pass - fitted.low_pass
    taken = difference * np.square(nyquist) / FILTER_VARIANCE
    variances = np.exp(2 * host.log_scales.astype(np.float64))
    left = np.maximum(variances - taken[:, None], MIN_VARIANCE_SHARE * variances)
    baked = replace(host, log_scales=(np.log(left) / 2).astype(np.float32))
    before = _integrals(gaussians, cameras, fitted)
    after = _integrals(baked.to(type(gaussians.means)), cameras, shown)
    factor = np.divide(before, after, out=np.ones_like(after), where=after > 0)
    opacities = factor / (1 + np.exp(-host.logit_opacities.astype(np.float64)))
    return replace(baked, logit_opacities=_finite_logits(opacities))


def _integrals(
    gaussians: Gaussians, cameras: Iterable[Camera], approximations: Approximations
) -> np.ndarray:
    """Integrate each splat's alpha over the film, over 2 pi, summed over ``cameras``: (N,)."""
    rule = compensated_opacity if approximations.antialiased else plain_opacity
    rows = load_rows(gaussians, 0)
    total = dr.zeros(type(rows.logit_opacities), gaussians.num_gaussians)
    for camera in cameras:
        splats = project(rows, camera, 0, rule, low_pass=approximations.low_pass, least_alpha=0.0)
        beside = (splats.means2d < camera.film_start) | (splats.means2d > camera.film_end)
        p, _, s = splats.conic_factor
        seen = splats.visible & ~(beside.x | beside.y)
        total += dr.select(seen, splats.opacities / dr.abs(p * s), 0)
        dr.eval(total)
    return np.array(total, np.float64)
