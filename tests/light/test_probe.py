"""Probes, against a reference that visits every splat."""

import itertools

import drjit as dr
import numpy as np
import pytest
from support.helpers import FLOAT32, both_precisions, device_gaussians, rows
from support.rays import Rays, composite_segments
from support.reference_lenses import gaussians_at

from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.core.arrays import types_of
from drgs.light import probe
from drgs.reference import splatting
from drgs.splatting.rendering import color_features, depth_feature

CENTERS = np.array([[0.0, 0, 0], [0.25, -0.1, 0.2]])


def balls(means, sizes, colors, opacity=0.98) -> splatting.Gaussians:
    return gaussians_at(np.float32(means), np.reshape(sizes, (-1, 1)), opacity, colors)


def shell(count=24000, radius=1.5) -> splatting.Gaussians:
    """An opaque one around the origin, whose colours vary slowly."""
    k = np.arange(count)
    z, angle = 1 - (2 * k + 1) / count, k * np.pi * (3 - np.sqrt(5))
    flat = np.sqrt(1 - z * z)
    means = radius * np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1)
    return balls(means, 0.025, 0.5 + 0.3 * np.sin(4 * means))


def probes_of(gaussians, precision, centers=CENTERS) -> probe.Probes:
    """Linear in what splats show: nothing is decoded."""
    ours = device_gaussians(gaussians, precision)
    approximations = Approximations(projection="exact", low_pass=1e-3)
    pipeline = pipeline_of(approximations, gaussians.sh_degree, (color_features, depth_feature))
    return probe.Probes.render(ours, pipeline, centers, 1e-3, lambda color: color)


def look(probes, rays, precision, number=0, level=0):
    segments, UInt32 = rays.segments(precision), types_of(precision.Float).UInt32
    size = len(rays.far)
    numbers, levels = (dr.full(UInt32, value, size) for value in (number, level))
    ray = segments.origin, segments.direction, segments.far
    seen = probes.look(numbers, *ray, levels, segments.active)
    return rows(seen.color), rows(seen.coverage), rows(seen.is_known).astype(bool)


def directions(count, seed=0):
    found = np.random.default_rng(seed).normal(size=(count, 3))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


@pytest.mark.slow
@both_precisions
@pytest.mark.parametrize("number", [0, 1])
def test_probe_matches_rays_from_its_centre(precision, number):
    """Fourteen balls side by side, also across the edges of the cube.

    Between texels, 2/256 of a distance apart, a Gaussian of 0.08 of it differs from a line by less
    than (2/256 / 0.08)^2 / 8 = 1.2e-3 of itself; where it is cut off, it jumps by 1/255.
    """
    axes = np.concatenate([np.eye(3), -np.eye(3)])
    corners = np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3) / np.sqrt(3)
    means = 3 * np.concatenate([axes, corners])
    gaussians = balls(means, 0.3, np.random.default_rng(3).random((len(means), 3)))
    probes = probes_of(gaussians, precision)
    origins = np.tile(CENTERS[number], (2000, 1))
    rays = Rays.towards(origins, CENTERS[number] + directions(2000, 5))
    expected = composite_segments(gaussians, rays.origins, rays.directions, rays.far)
    color, coverage, is_known = look(probes, rays, precision, number)
    assert is_known.all() and (expected.transmittances < 0.5).sum() > 50
    np.testing.assert_allclose(coverage, 1 - expected.transmittances, atol=1.2e-3 + 1 / 255)
    np.testing.assert_allclose(color, expected.colors, atol=1.2e-3 + 1 / 255)


@pytest.mark.slow
def test_probe_shows_the_same_surface_off_its_centre_to_rays_that_reach_it():
    """A shell is seen without gaps: all is known, and where it is met decides about its colour.

    A shell of thickness 0.025, whose colours change by up to 1.2 a unit, is met half of that
    before or behind where its colour is kept.
    """
    probes, gaussians = probes_of(shell(), FLOAT32), shell()
    starts = 0.5 * directions(600, 6) * np.random.default_rng(7).random((600, 1))
    rays = Rays.towards(starts, starts + directions(600, 8))
    expected = composite_segments(gaussians, rays.origins, rays.directions, rays.far)
    color, coverage, is_known = look(probes, rays, FLOAT32)
    unmoved, _, _ = look(probes, Rays.towards(0 * starts, rays.directions), FLOAT32)
    errors = [np.abs(seen - expected.colors).mean() for seen in (color, unmoved)]
    assert is_known.all() and coverage.min() > 0.95
    assert errors[0] < 1.2 * 0.5 * 0.025 < 0.2 * errors[1]
    towards = directions(300, 9)
    for far, end in ((1.2, 0), (1.8, 1)):  # before the shell, and behind it
        rays = Rays.towards(0.1 * towards, towards, far - 0.1)
        _, found, is_known = look(probes, rays, FLOAT32)
        assert is_known.all()
        np.testing.assert_allclose(found, end, atol=0.1)


def test_mip_levels_are_means_of_the_finer_level():
    """From the centre, at the middles of texels of level 5, on all faces."""
    probes = probes_of(shell(count=500), FLOAT32, CENTERS[:1])
    middles = np.linspace(-1, 1, 17)[1::2]
    places = np.stack(np.meshgrid(middles, middles), -1).reshape(-1, 2)
    quarters = np.stack(np.meshgrid([-1, 1], [-1, 1]), -1).reshape(-1, 2) / 16

    def seen(places, axis, sign, level):
        towards = np.roll(np.insert(places, 0, 1, axis=1), axis, axis=1) * sign
        rays = Rays.towards(np.zeros_like(towards), towards)
        return np.column_stack(look(probes, rays, FLOAT32, level=level)[:2])

    for axis, sign in itertools.product(range(3), (-1, 1)):
        finer = [seen(places + quarter, axis, sign, 4) for quarter in quarters]
        np.testing.assert_allclose(seen(places, axis, sign, 5), np.mean(finer, 0), atol=1e-5)


def test_regions_hidden_from_the_centre_are_unknown():
    """A wall hides what is behind it; a ray that is there from the start on, or gets there."""
    place = np.linspace(-1, 1, 21)
    y, z = (p.ravel() for p in np.meshgrid(place, place))
    wall = balls(np.stack([np.ones_like(y), y, z], axis=1), 0.08, 0.5 + 0 * y[:, None] * np.ones(3))
    probes = probes_of(wall, FLOAT32, CENTERS[:1])
    starts = np.array([[0.1, 0.2, -0.1], [1.5, 0.1, 0.1], [0.5, 2.5, 0], [0.5, 0, 0.1]])
    targets = np.array([[1, 0.3, 0.2], [2, 0, 0], [3, 0.5, 0], [-1, 0, 0]])
    color, coverage, is_known = look(probes, Rays.towards(starts, targets), FLOAT32)
    np.testing.assert_array_equal(is_known, [True, False, False, True])
    np.testing.assert_allclose(coverage, [1, 0, 0, 0], atol=0.05)
    np.testing.assert_allclose(color[0], 0.5, atol=0.05)
