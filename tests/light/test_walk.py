"""Splats along rays, against a reference that visits every splat."""

from dataclasses import replace

import numpy as np
import pytest
from support.helpers import both_precisions, rows
from support.rays import Rays, splats_of

from drgs.reference import light as reference
from drgs.reference import splatting


def random_gaussians(count, seed=0, spread=1.0, size=0.1, degree=3) -> splatting.Gaussians:
    """Needles, discs and balls of many sizes around the origin; some far out, some large."""
    rng = np.random.default_rng(seed)
    means = rng.normal(0, spread, (count, 3))
    far = rng.random(count) < 0.05
    means[far] *= 10 ** rng.uniform(0, 3, (far.sum(), 1))
    log_scales = np.log(size) + rng.normal(0, 1, (count, 3))
    log_scales[far] += np.log(np.linalg.norm(means[far], axis=1) / spread)[:, None]
    return splatting.Gaussians(
        *(
            np.asarray(values, np.float32)
            for values in (
                means,
                rng.normal(size=(count, 4)),
                log_scales,
                rng.normal(0, 2, count),
                rng.normal(0, 1, (count, 1, 3)),
                rng.normal(0, 0.3, (count, (degree + 1) ** 2 - 1, 3)),
            )
        )
    )


def random_rays(count, seed=1) -> Rays:
    """From inside, outside and far away; some end, some are parallel to axes."""
    rng = np.random.default_rng(seed)
    origins = rng.normal(0, 1, (count, 3)) * 10 ** rng.uniform(-1, 1.5, (count, 1))
    targets = rng.normal(0, 1, (count, 3))
    far = np.where(rng.random(count) < 0.5, np.inf, rng.exponential(3, count))
    along = rng.random(count) < 0.2
    axes = np.eye(3)[rng.integers(0, 3, count)] * rng.choice([-1, 1], (count, 1))
    targets[along] = (origins + axes)[along]
    found = Rays.towards(origins, targets, far)
    # Unit length in double precision: else distances along rays are not in world units.
    directions = found.directions / np.linalg.norm(found.directions, axis=1, keepdims=True)
    return Rays(found.origins, np.where(np.abs(directions) < 1e-6, 0, directions), found.far)


def passed(splats, rays, precision):
    color, passed = splats.composite_segment(rays.segments(precision))
    transmittance = splats.transmittance(rays.segments(precision), precision.array([1e-4]))
    return rows(color), rows(passed), rows(transmittance)


TOLERANCE = {np.float64: 1e-11, np.float32: 2e-4}
"""Tolerance of a transmittance. An offset of 30 from a needle 1e-3 thick is 3e4 standard
deviations, whose rounding of 6e-8 moves its alpha by 2e-3 of itself; of colours up to 3, three
times as much."""


@pytest.mark.slow
@both_precisions
@pytest.mark.parametrize(
    ("count", "spread", "size"), [(1, 1, 0.5), (30, 1, 0.5), (1000, 1, 0.05), (3000, 0.3, 0.1)]
)
def test_composited_rays_match_the_reference(precision, count, spread, size):
    gaussians, rays = random_gaussians(count, count, spread, size), random_rays(600)
    close = 0 if precision.dtype == np.float64 else 1e-4
    exact = reference.composite_segments(
        gaussians, rays.origins, rays.directions, rays.far, close=close
    )
    color, T, alone = passed(splats_of(gaussians, precision), rays, precision)
    sure = ~exact.is_close
    assert sure.mean() > (0.99 if close == 0 else 0.3) and exact.counts.max() > min(count, 2) - 1
    tolerance = TOLERANCE[precision.dtype]
    np.testing.assert_allclose(color[sure], exact.colors[sure], atol=tolerance * 3)
    np.testing.assert_allclose(T[sure], exact.transmittances[sure], atol=tolerance)
    # Asked alone, it is that of all, down to where nothing shows.
    ends = reference.composite_segments(gaussians, rays.origins, rays.directions, rays.far, stop=0)
    np.testing.assert_allclose(alone[sure], ends.transmittances[sure], atol=tolerance + 1e-4)


@both_precisions
def test_invisible_splats_have_full_transmittance(precision):
    """And so do Gaussians that are not finite, beside one that is."""
    gaussians, rays = random_gaussians(20), random_rays(50)
    faint = replace(gaussians, logit_opacities=np.full(20, -9.0))
    color, T, alone = passed(splats_of(faint, precision), rays, precision)
    assert not color.any() and (T == 1).all() and (alone == 1).all()

    broken = replace(gaussians, means=np.where(np.arange(20)[:, None] > 0, np.nan, gaussians.means))
    first = splatting.Gaussians(**{k: v[:1] for k, v in vars(gaussians).items()})
    found, expected = (passed(splats_of(g, precision), rays, precision) for g in (broken, first))
    for array, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(array, other, atol=TOLERANCE[precision.dtype])
