"""Splats along primary rays, against images of them by other renderers.

A camera's rays meet Gaussians as images of the projection ``exact`` show them, whose order and
colours are those along a pixel's ray. Two things differ by definition, and are configured away:

- The low-pass of a film. Rays have none, so that images are made without.
- What is near. Images show Gaussians whose mean is beyond the near plane, rays those whose peak
  is before them. Here, both are the same ones.

Mitsuba's ``volprim_rf_basic`` takes the peak along a ray as well. It clamps alpha at 0.9999, cuts
it nowhere, and ends a ray behind the Gaussian that takes its transmittance below 0.01: here, none
is behind that one. It orders Gaussians by where a ray enters their shells, which here is the order
of their peaks. Alpha is the value at the peak in all of them, never an integral along the ray.
"""

from __future__ import annotations

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.helpers import (
    FLOAT32,
    FLOAT64,
    NEAR_THRESHOLD,
    assert_arrays_agree,
    both_precisions,
    rows,
    single,
)
from support.rays import DEFAULT, Rays, splats_of
from support.views import VIEWS, splats_before
from support.volprim import (
    SCENES,
    assert_within,
    footprints,
    volprim_image,
)

import drgs  # noqa: F401  (registers the plugin)
from drgs.reference import light as reference_light
from drgs.reference import rays as reference_rays
from drgs.splatting.cutoffs import Cutoffs

# Tolerances of images, relative to the largest value: see ``image_tolerance`` in drgs.testing.
PLANES = {FLOAT64: 1e-12, FLOAT32: 2e-5}

MARKED = {FLOAT64: 1e-9, FLOAT32: NEAR_THRESHOLD}
"""Relative distance from a decision within which a pixel is left out."""

RAY_APPROXIMATIONS = {
    "projection": "exact",
    "order": "pixel",
    "sh_direction": "pixel",
    "low_pass": 0.0,
}
"""The approximations of an image that shows what rays pass."""

VOLPRIM_CUTOFFS = Cutoffs(alpha_max=0.9999, alpha_cut=0.0, transmittance_stop=0.0)


def rays_of(camera) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions (H W, 3) through the middles of pixels, row by row."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    slopes = [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy]
    directions = np.stack([*slopes, np.ones_like(x)], axis=-1).reshape(-1, 3) @ camera.rotation
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return np.broadcast_to(camera.center, directions.shape), directions


def rays_of_sensor(view) -> tuple[np.ndarray, np.ndarray]:
    """The same, as Mitsuba's sensor has them."""
    y, x = np.mgrid[: view.height, : view.width] + 0.5
    places = FLOAT32.vectors(np.stack([x / view.width, y / view.height], axis=-1).reshape(-1, 2))
    ray, _ = mi.load_dict(view.sensor()).sample_ray(0.0, 0.5, mi.Point2f(places), mi.Point2f(0.5))
    directions = rows(ray.d)
    return np.broadcast_to(rows(ray.o), directions.shape), directions


def composite_all(gaussians, rays, precision, view, cutoffs=DEFAULT) -> np.ndarray:
    """Transmittance and colour (H, W, 4) of what rays pass on their whole length."""
    segments = Rays(*rays, np.full(len(rays[0]), np.inf)).segments(precision)
    color, T = splats_of(gaussians, precision, cutoffs).composite_segment(segments)
    planes = np.column_stack([rows(T), rows(color)])
    return planes.reshape(view.height, view.width, 4)


@pytest.mark.slow
@both_precisions
@pytest.mark.parametrize("view", [VIEWS[1], VIEWS[3], VIEWS[10]], ids=lambda v: v.name)
def test_primary_rays_match_the_exact_image(precision, view):
    """The reference of images projects; rays, and the reference of rays, do not.

    Splats of all shapes and sizes are behind each other. Within what images by the kernels are.
    """
    gaussians = splats_before(view, degree=3, count=60, seed=0)
    gaussians = replace(gaussians, log_scales=single(gaussians.log_scales + 1))
    # Orthogonal in double precision too, so that axes of the camera and the world agree.
    left, _, right = np.linalg.svd(view.camera.rotation)
    camera = replace(view.camera, rotation=left @ right)
    model = reference_rays.ImageModel(**RAY_APPROXIMATIONS)
    rendered = reference_rays.render(
        gaussians, camera, model=model, threshold_width=MARKED[precision]
    )
    expected = np.concatenate([rendered.transmittance[..., None], rendered.image], axis=-1)
    kept = ~rendered.near_threshold
    rays = rays_of(camera)
    actual = {"kernels": composite_all(gaussians, rays, precision, view)}
    if precision is FLOAT64:
        far = np.full(len(rays[0]), np.inf)
        passed = reference_light.composite_segments(gaussians, *rays, far)
        planes = np.column_stack([passed.transmittances, passed.colors])
        actual["reference of rays"] = planes.reshape(expected.shape)
        assert passed.counts.max() > 20
    assert kept.mean() > 0.9 and expected[..., 0].min() < 0.01 and expected[..., 1:].max() > 0.9
    assert_arrays_agree(
        {name: planes[kept] for name, planes in actual.items()},
        dict.fromkeys(actual, expected[kept]),
        PLANES[precision],
    )


@pytest.mark.slow
@pytest.mark.parametrize("splats", SCENES.values(), ids=SCENES.keys())
def test_primary_rays_match_volprim(splats):
    """Within rounding, as the image of ``splats``."""
    gaussians, view = splats.gaussians, splats.view
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    expected = volprim_image(gaussians, view, np.exp(gaussians.log_scales), quats[:, [1, 2, 3, 0]])
    passed = composite_all(gaussians, rays_of_sensor(view), FLOAT32, view, VOLPRIM_CUTOFFS)
    allowed = footprints(gaussians, view.camera).image_rounding
    assert expected.max() > 1000 * allowed.max()
    assert_within(passed[..., 1:] - expected, allowed)
