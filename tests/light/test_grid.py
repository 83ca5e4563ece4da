"""Grids of all kinds of clouds: rays meet in them what they meet without."""

import numpy as np
import pytest
from support.helpers import FLOAT32, FLOAT64, rows
from support.rays import Rays, splats_of

from drgs.reference import light as reference
from drgs.reference import splatting

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
    values = means, rng.normal(size=(n, 4)), log_scales, logits
    sh = rng.normal(size=(n, 1, 3)), np.zeros((n, 0, 3))
    return splatting.Gaussians(*(np.asarray(value, np.float32) for value in (*values, *sh)))


def rays_at(gaussians: splatting.Gaussians, seed, count=8) -> Rays:
    """Most of them through a Gaussian; half of them end."""
    rng = np.random.default_rng(seed)
    origins = rng.normal(0, 1, (count, 3)) * 10 ** rng.uniform(-1, 1, (count, 1))
    picked = rng.integers(0, len(gaussians.means), count)
    sizes = np.exp(np.clip(gaussians.log_scales[picked], -80, 5))
    targets = gaussians.means[picked] + sizes * rng.normal(0, 0.5, (count, 3))
    far = np.where(rng.random(count) < 0.5, np.inf, rng.exponential(3, count))
    found = Rays.towards(origins, targets, far)
    directions = found.directions / np.linalg.norm(found.directions, axis=1, keepdims=True)
    return Rays(found.origins, directions, found.far)


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
            exact = reference.composite_segments(seen, *vars(rays).values(), close=1e-4)
            sure = ~exact.is_close
            expected, double = exact.transmittances, segment_transmittances(splats, rays, FLOAT64)
            np.testing.assert_allclose(double[sure], expected[sure], atol=1e-9)
            single = segment_transmittances(splats, rays, FLOAT32)
            assert ((single >= 0) & (single <= 1)).all()
            if condition(seen, rays) < 1000:
                np.testing.assert_allclose(single[sure], expected[sure], atol=1e-3)
                num_single += 1
            num_met += (exact.counts[sure] > 0).sum()
    assert num_met > 3 * len(seeds) and num_single > len(seeds) / 4
