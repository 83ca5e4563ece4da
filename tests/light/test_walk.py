"""Splats along rays, against a reference that visits every splat, and one that projects them."""

from dataclasses import replace
from functools import partial

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
from support.rays import Rays, composite_segments, num_met, splats_of
from support.studies import reference_rays as image_reference
from support.views import VIEWS, splats_before

from drgs.reference import splatting
from drgs.splatting.footprint import Cutoffs


def random_gaussians(count, seed=0, spread=1.0, size=0.1, degree=3) -> splatting.Gaussians:
    """Needles, discs and balls of many sizes around the origin; some far out, some large."""
    rng = np.random.default_rng(seed)
    means = rng.normal(0, spread, (count, 3))
    far = rng.random(count) < 0.05
    means[far] *= 10 ** rng.uniform(0, 3, (far.sum(), 1))
    log_scales = np.log(size) + rng.normal(0, 1, (count, 3))
    log_scales[far] += np.log(np.linalg.norm(means[far], axis=1) / spread)[:, None]
    quats, logits = rng.normal(size=(count, 4)), rng.normal(0, 2, count)
    sh = rng.normal(0, 1, (count, 1, 3)), rng.normal(0, 0.3, (count, (degree + 1) ** 2 - 1, 3))
    return single_gaussians(means, quats, log_scales, logits, *sh)


def single_gaussians(*values) -> splatting.Gaussians:
    return splatting.Gaussians(*(np.asarray(value, np.float32) for value in values))


def random_rays(count, seed=1) -> Rays:
    """From inside, outside and far away; some end, some are parallel to axes."""
    rng = np.random.default_rng(seed)
    origins = rng.normal(0, 1, (count, 3)) * 10 ** rng.uniform(-1, 1.5, (count, 1))
    targets = rng.normal(0, 1, (count, 3))
    far = random_lengths(rng, count)
    along = rng.random(count) < 0.2
    axes = np.eye(3)[rng.integers(0, 3, count)] * rng.choice([-1, 1], (count, 1))
    targets[along] = (origins + axes)[along]
    found = unit_rays(origins, targets, far)
    return replace(found, directions=np.where(np.abs(found.directions) < 1e-6, 0, found.directions))


def random_lengths(rng, count):
    """Half of them infinite."""
    return np.where(rng.random(count) < 0.5, np.inf, rng.exponential(3, count))


def unit_rays(origins, targets, far) -> Rays:
    """Unit length in double precision: else distances along rays are not in world units."""
    found = Rays.towards(origins, targets, far)
    lengths = np.linalg.norm(found.directions, axis=1, keepdims=True)
    return replace(found, directions=found.directions / lengths)


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
    ("count", "spread", "size", "cutoffs"),
    [
        *((1, 1, 0.5, Cutoffs()), (30, 1, 0.5, Cutoffs()), (1000, 1, 0.05, Cutoffs())),
        *((3000, 0.3, 0.1, Cutoffs()), (300, 1, 0.2, Cutoffs(0.9, 0.05, 0.01))),
    ],
)
def test_composited_rays_match_the_reference(precision, count, spread, size, cutoffs):
    gaussians, rays = random_gaussians(count, count, spread, size), random_rays(600)
    close = 0 if precision.dtype == np.float64 else 1e-4
    alphas = {"alpha_max": cutoffs.alpha_max, "alpha_cut": cutoffs.alpha_cut}
    composite = partial(composite_segments, gaussians, *vars(rays).values(), **alphas)
    exact = composite(transmittance_stop=cutoffs.transmittance_stop, close=close)
    color, T, alone = passed(splats_of(gaussians, precision, cutoffs), rays, precision)
    sure = ~exact.is_close
    met = num_met(gaussians, *vars(rays).values(), alpha_cut=cutoffs.alpha_cut)
    assert sure.mean() > (0.99 if close == 0 else 0.3) and met.max() > min(count, 2) - 1
    tolerance = TOLERANCE[precision.dtype]
    np.testing.assert_allclose(color[sure], exact.colors[sure], atol=tolerance * 3)
    np.testing.assert_allclose(T[sure], exact.transmittances[sure], atol=tolerance)
    # Asked alone, it is that of all, down to where nothing shows.
    ends = composite(transmittance_stop=0)
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


COUNTS = [1, 2, 3, 10, 60, 300]


KINDS = [
    "plain", "equal", "in a plane", "on a line", "lattice", "clusters", "large", "needles",
    "some transparent", "tiny", "one far", "one beyond squares", "one huge",
]  # fmt: skip


def change(kind, rng, means, log_scales, logits) -> None:
    """Change Gaussians in place to those of a kind."""
    match kind:
        case "equal":
            means[:] = means[0]
        case "in a plane":
            means[:, rng.integers(3)] = 0
        case "on a line":
            means[:, :2] = 0
        case "lattice":
            means[:] = np.round(2 * means) / 2
        case "clusters":
            means[:] = 1e-3 * means + 100 * np.round(means)
        case "large":
            log_scales += rng.uniform(2, 10)
        case "needles":
            log_scales[:, 1:] -= rng.uniform(3, 12)
        case "some transparent":
            logits[rng.random(len(logits)) < 0.5] = -200
        case "tiny":
            log_scales[:] = rng.uniform(-100, -10)
        case "one far":
            means[0] *= 10 ** rng.uniform(1, 12)
        case "one beyond squares":
            # So far that its square overflows single precision. The others exist.
            means[-1] = np.sign(means[-1]) * rng.uniform(0.1, 3) * 1e38
            logits[-1] = -200 if len(means) == 1 else logits[-1]
        case "one huge":
            log_scales[-1] = rng.uniform(45, 80)


def cloud(seed) -> splatting.Gaussians:
    """One of a kind."""
    rng, kind = np.random.default_rng(seed), KINDS[seed % len(KINDS)]
    n = int(rng.choice(COUNTS))
    means, logits = rng.uniform(-1, 1, (n, 3)), rng.normal(0, 2, n)
    log_scales = rng.uniform(-4, 0.5) + rng.normal(0, rng.choice([0, 0.4, 1]), (n, 3))
    change(kind, rng, means, log_scales, logits)
    quats, sh = rng.normal(size=(n, 4)), (rng.normal(size=(n, 1, 3)), np.zeros((n, 0, 3)))
    return single_gaussians(means, quats, log_scales, logits, *sh)


def rays_at(gaussians: splatting.Gaussians, seed, count=8) -> Rays:
    """Most of them through a Gaussian; half of them end."""
    rng = np.random.default_rng(seed)
    origins = rng.normal(0, 1, (count, 3)) * 10 ** rng.uniform(-1, 1, (count, 1))
    picked = rng.integers(0, len(gaussians.means), count)
    sizes = np.exp(np.clip(gaussians.log_scales[picked], -80, 5))
    targets = gaussians.means[picked] + sizes * rng.normal(0, 0.5, (count, 3))
    return unit_rays(origins, targets, random_lengths(rng, count))


def existing(gaussians: splatting.Gaussians) -> splatting.Gaussians:
    """Without those that single precision has no squares of."""
    lengths = np.abs(gaussians.means).max(axis=1) + np.exp(gaussians.log_scales.max(axis=1))
    return splatting.Gaussians(*(values[lengths < 1e18] for values in vars(gaussians).values()))


def condition(gaussians: splatting.Gaussians, rays: Rays) -> float:
    """The longest offset from a Gaussian, in units of the smallest standard deviation."""
    offsets = np.linalg.norm(rays.origins[:, None] - gaussians.means, axis=2)
    return offsets.max(initial=0) / np.exp(np.float64(gaussians.log_scales.min(initial=0)))


def segment_transmittances(gaussians: splatting.Gaussians, rays: Rays, precision) -> np.ndarray:
    return rows(splats_of(gaussians, precision).composite_segment(rays.segments(precision))[1])


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [range(104), range(104, 1000)], ids=["some", "many"])
def test_rays_hit_the_same_gaussians_with_and_without_a_grid(seeds):
    """In double precision all that the reference meets, in single where that is well defined.

    In single precision, an offset of 1,000 sizes is rounded by 6e-5 of one, which moves alpha by
    its slope of 0.6 times that, and a product of several transmittances by some times as much.
    """
    num_met, num_single = 0, 0
    with np.errstate(all="ignore"):
        for seed in seeds:
            splats = cloud(seed)
            seen, rays = existing(splats), rays_at(splats, seed)
            exact = composite_segments(seen, *vars(rays).values(), close=1e-4)
            sure = ~exact.is_close
            expected, double = exact.transmittances, segment_transmittances(splats, rays, FLOAT64)
            np.testing.assert_allclose(double[sure], expected[sure], atol=1e-9)
            single = segment_transmittances(splats, rays, FLOAT32)
            assert ((single >= 0) & (single <= 1)).all()
            if condition(seen, rays) < 1000:
                np.testing.assert_allclose(single[sure], expected[sure], atol=1e-3)
                num_single += 1
            num_met += (exact.transmittances[sure] < 1).sum()
    assert num_met > 3 * len(seeds) and num_single > len(seeds) / 4


# Tolerances of images, relative to the largest value: see ``image_tolerance`` in drgs.testing.
PLANES = {FLOAT64: 1e-12, FLOAT32: 2e-5}

MARKED = {FLOAT64: 1e-9, FLOAT32: NEAR_THRESHOLD}
"""Relative distance from a decision within which a pixel is left out."""

AS_ALONG_RAYS = image_reference.ImageModel("exact", order="pixel", sh_direction="pixel", low_pass=0)
"""An image that shows what rays pass. Two things differ by definition, and are configured away:

- The low-pass of a film. Rays have none, so that images are made without.
- What is near. Images show Gaussians whose mean is beyond the near plane, rays those whose peak
  is before them. Here, both are the same ones.
"""


def primary_rays(camera) -> Rays:
    """Rays of unit length through the middles of pixels, row by row."""
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    slopes = [(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy]
    directions = np.stack([*slopes, np.ones_like(x)], axis=-1).reshape(-1, 3) @ camera.rotation
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origins = np.broadcast_to(camera.center, directions.shape)
    return Rays(origins, directions, np.full(len(directions), np.inf))


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
    rendered = image_reference.render(
        gaussians, camera, model=AS_ALONG_RAYS, threshold_width=MARKED[precision]
    )
    kept = ~rendered.near_threshold.ravel()
    expected = np.column_stack([rendered.transmittance.ravel(), rendered.image.reshape(-1, 3)])
    rays = primary_rays(camera)
    color, T, _ = passed(splats_of(gaussians, precision), rays, precision)
    actual = {"kernels": np.column_stack([T, color])}
    if precision is FLOAT64:
        exact = composite_segments(gaussians, *vars(rays).values())
        actual["reference of rays"] = np.column_stack([exact.transmittances, exact.colors])
        assert num_met(gaussians, *vars(rays).values()).max() > 20
    assert kept.mean() > 0.9 and expected[:, 0].min() < 0.01 and expected[:, 1:].max() > 0.9
    assert_arrays_agree(
        {name: planes[kept] for name, planes in actual.items()},
        dict.fromkeys(actual, expected[kept]),
        PLANES[precision],
    )
