"""Splats that rays draw, whose light is on average that of all."""

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import FLOAT32, rows
from support.rays import Rays, splats_of
from support.reference_lenses import gaussians_at

import drgs  # noqa: F401  (registers the plugin)
from drgs.integrator.light.rays import PathSegment
from drgs.integrator.light.splat_transport import DECODING, ROULETTE_TRANSMITTANCE, RayTransport
from drgs.light.walk import _hashes
from drgs.splatting.footprint import Cutoffs

RAYS, PATHS = 4, 8192

ROUNDING = 3e-6
"""Error of coverages: products of up to 100 transmittances in single precision, and their means."""


@dataclass(frozen=True)
class Fog:
    """Balls of one opacity around the origin."""

    count: int
    opacity: float
    is_contrasty: bool  # black and white splats
    radius: float = 0.3
    spread: float = 0.3

    def light(self, num_samples):
        rng = np.random.default_rng(self.count)
        colors = rng.uniform(0, 1, (self.count, 3))
        colors = np.round(colors) if self.is_contrasty else colors
        means = rng.normal(0, self.spread, (self.count, 3))
        splats = gaussians_at(means, self.radius, self.opacity, colors)
        cutoffs = Cutoffs(transmittance_stop=0.0)
        return RayTransport(splats_of(splats, FLOAT32, cutoffs), mi.Float(1), num_samples)


FOGS = [
    Fog(2, 0.1, True),
    Fog(3, 0.02, True),
    Fog(10, 0.05, True),
    Fog(40, 0.02, True),
    Fog(200, 0.01, False),
    Fog(1000, 0.005, True),
    Fog(10000, 0.005, True, spread=3),
    Fog(5, 0.9, False),
    Fog(5, 0.99, True),
    Fog(40, 0.5, False),
]


def segments(num_paths):
    """Rays from one point past the origin, each ``num_paths`` times."""
    rng = np.random.default_rng(1)
    targets = np.repeat(rng.normal(0, 0.3, (RAYS, 3)), num_paths, axis=0)
    return Rays.towards(np.broadcast_to([0, 0, 20], targets.shape), targets).segments(FLOAT32)


def samples():
    """Return numbers like those of a sampler, of which there are 2^23."""
    rng = np.random.default_rng(2)
    return mi.Float(rng.integers(0, 2**23, RAYS * PATHS).astype(np.float32) / 2**23)


def decode(color):
    return sum(factor * color**k for k, factor in enumerate(DECODING, 1))


def missed(coverage):
    """Share of a mean that is left out if roulette ends in one of two ways for under 20 paths."""
    share = np.minimum(coverage**3, 1 - coverage)  # of at least three draws
    return np.where(share * PATHS < 20, share, 0)


def assert_mean(values, expected, missed):
    """Compare means of paths, (RAYS PATHS, channels), within 4 standard errors; these are chance.

    The mean square of distances in standard errors is 1 on average; of four independent ones, it is
    beyond 4 once in 300 times. expected: (RAYS, channels); missed: what chance may leave out.
    """
    values = values.reshape(RAYS, PATHS, -1)
    error = values.std(axis=1, ddof=1) / np.sqrt(PATHS)
    distance = np.maximum(np.abs(values.mean(axis=1) - expected) - ROUNDING - missed, 0)
    z = np.divide(distance, error, out=np.where(distance > 0, np.inf, 0), where=error > 0)
    assert (z <= 4).all() and np.square(z).mean() <= 4, z


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fog", "num_samples"), [*((fog, 4) for fog in FOGS), (FOGS[2], 1), (FOGS[7], 2)]
)
def test_sampled_splats_have_the_mean_light_of_all_splats(fog, num_samples):
    """The same polynomial decodes both, which is sRGB's curve within its distance."""
    light = fog.light(num_samples)
    seen, T = map(rows, light.splats.composite_segment(segments(1)))
    coverage = 1 - T[:, None]
    color = seen / np.maximum(coverage, 1e-9)
    assert coverage.max() > fog.opacity / 2
    for is_open, expected in ((False, coverage * decode(color)), (True, decode(seen))):
        which = dr.full(mi.Bool, is_open, RAYS * PATHS)
        drawn, covered = map(rows, light._composite_sampled(segments(PATHS), which, samples()))
        assert_mean(covered, coverage, missed(coverage))
        assert_mean(drawn, expected, missed(coverage))
        exact, _ = light._composite_all(segments(1), mi.Bool(is_open))
        assert (np.abs(rows(exact) - expected) < 2e-3).all()


def test_roulette_preserves_mean_light_of_an_emitter():
    light = Fog(40, 0.12, True).light(4)
    T = rows(light.splats.composite_segment(segments(1))[1])[:, None]
    assert T.min() < ROULETTE_TRANSMITTANCE / 2 and T.max() > ROULETTE_TRANSMITTANCE, T
    found = segments(PATHS)
    ray = mi.Ray3f(mi.Point3f(found.origin), found.direction)
    ends = dr.zeros(mi.ShapePtr), dr.zeros(mi.EmitterPtr)
    segment = PathSegment(ray, *ends, mi.Float(1), is_open=mi.Bool(False))
    assert_mean(rows(light.transmittance(segment, samples(), mi.Bool(True))), T, 0)


@pytest.mark.parametrize("apart", [1, 2, 255])
def test_samples_of_two_splats_are_independent(apart):
    """Neighbours in memory are tested, and indices that differ in one bit.

    As often as by chance: within 5 standard errors of 2^20 seeds.
    """
    seed = dr.reinterpret_array(mi.UInt32, 8 * dr.arange(mi.Float, 2**20) / 2**23)
    row = mi.UInt32(12345)
    words = [*_hashes(row, seed, 4), *_hashes(row ^ mi.UInt32(apart), seed, 4)]
    for alpha in (1 / 255, 0.1, 0.6):
        below = [word < mi.UInt32(int(alpha * 2**32)) for word in words]
        pairs = [(one, other) for k, one in enumerate(below) for other in below[:k]]
        counts = [*(dr.count(one & other) for one, other in pairs), *map(dr.count, below)]
        chances = np.array([alpha**2] * len(pairs) + [alpha] * len(below))
        error = np.sqrt(chances * (1 - chances) / 2**20)
        found = np.array([int(count[0]) for count in counts]) / 2**20
        assert (np.abs(found - chances) <= 5 * error).all()
