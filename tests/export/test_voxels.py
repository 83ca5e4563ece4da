"""Floaters and clusters against loops over all voxels."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.formats import gaussians_within_ranges

from drgs.export.voxels import FLOATERS, VoxelRule, find_cluster, find_non_floaters
from drgs.gaussians.parameters import Gaussians


def two_balls(num=60, seed=3):
    """Two balls of Gaussians with some between and around them."""
    g, rng = gaussians_within_ranges(num, degree=0, seed=seed), np.random.default_rng(seed)
    means = rng.normal(0, 0.25, (num, 3)) + np.where(np.arange(num)[:, None] < num // 2, 0, 2.0)
    means[::5] = rng.uniform(-2, 4, (len(means[::5]), 3))
    scales = rng.uniform(0.05, 0.4, (num, 3))
    return replace(g, means=means.astype(np.float32), log_scales=np.log(scales).astype(np.float32))


def loops(gaussians, rule):
    """Return opacities of voxels, and contributions at their centers, by Gaussian."""
    g, size = gaussians, rule.size
    sums, centers = {}, [{} for _ in range(g.num_gaussians)]
    for i in range(g.num_gaussians):
        mean, scales = g.means[i].astype(float), g.scales[i].astype(float)
        rotation = Rotation.from_quat(g.quats[i, [1, 2, 3, 0]].astype(float)).as_matrix()
        inverse = np.linalg.inv(rotation @ np.diag(scales**2) @ rotation.T)
        corners = np.array(list(product([-3, 3], repeat=3))) * scales @ rotation.T
        low, high = mean + corners.min(axis=0), mean + corners.max(axis=0)

        def value(point, mean=mean, inverse=inverse, opacity=float(g.opacities[i])):
            return opacity * np.exp(-0.5 * (point - mean) @ inverse @ (point - mean))

        ranges = (
            range(int(a), int(b) + 1)
            for a, b in zip(np.floor(low / size), np.floor(high / size), strict=True)
        )
        for voxel in product(*ranges):
            start = np.array(voxel) * size
            nearest = np.minimum(np.maximum(mean, start), start + size)
            sums[voxel] = sums.get(voxel, 0.0) + value(nearest)
            centers[i][voxel] = value(start + size / 2)
    return {voxel: 1 - np.exp(-total) for voxel, total in sums.items()}, centers


def loop_mask(gaussians, solid, centers, rule, is_cluster):
    kept = []
    for i, own in enumerate(centers):
        home = tuple(np.floor(gaussians.means[i].astype(float) / rule.size).astype(int))
        hits = sum(v >= rule.contribution for voxel, v in own.items() if voxel in solid)
        needed = 1
        if is_cluster:
            rotation = Rotation.from_quat(gaussians.quats[i, [1, 2, 3, 0]].astype(float))
            sides = 6 * np.abs(rotation.as_matrix()) @ gaussians.scales[i].astype(float) / rule.size
            needed = max(1, np.ceil(0.1 * sides.prod())) if sides.max() > 2 else 1
        kept.append(home in solid or hits >= needed)
    return np.array(kept)


def flood(solid, start):
    found, edge = {start}, [start]
    while edge:
        here = edge.pop()
        for axis, step in product(range(3), (-1, 1)):
            there = tuple(x + step * (k == axis) for k, x in enumerate(here))
            if there in solid and there not in found:
                found.add(there)
                edge.append(there)
    return found


RULES = [VoxelRule(0.3, 0.6, 0.05), VoxelRule(0.5, 0.9, 0.2), VoxelRule(0.25, 0.3, 0.5)]


@pytest.mark.slow
@pytest.mark.parametrize("rule", RULES, ids=str)
def test_masks_agree_with_loops_over_voxels(rule):
    g = two_balls()
    opacities, centers = loops(g, rule)
    solid = {voxel for voxel, opacity in opacities.items() if opacity >= rule.opacity}
    expected = loop_mask(g, solid, centers, rule, is_cluster=False)
    np.testing.assert_array_equal(find_non_floaters(g, rule), expected)
    assert 0 < expected.sum() < g.num_gaussians
    for seed in (np.zeros(3), np.full(3, 2.0)):
        distance = {v: np.linalg.norm((np.array(v) + 0.5) * rule.size - seed) for v in solid}
        cluster = flood(solid, min(distance, key=distance.get))
        expected = loop_mask(g, cluster, centers, rule, is_cluster=True)
        np.testing.assert_array_equal(find_cluster(g, rule, seed), expected)


def test_a_faint_gaussian_alone_is_a_floater_and_an_opaque_one_is_not():
    g = Gaussians.from_numpy(
        means=[[0, 0, 0], [0.01, 0, 0], [5, 5, 5], [9, 0, 0]],
        quats=np.tile([1.0, 0, 0, 0], (4, 1)),
        scales=np.full((4, 3), 0.02),
        opacities=[0.9, 0.05, 0.05, 0.5],
        sh=np.zeros((4, 1, 3)),
    )
    rule = VoxelRule(0.05, 0.1, 0.004)
    assert find_non_floaters(g, rule).tolist() == [True, True, False, True]
    assert find_cluster(g, rule).tolist() == [True, True, False, False]
    assert find_cluster(g, rule, np.array([9.0, 1, 0])).tolist() == [False, False, False, True]
    assert find_cluster(g[[0, 1]], replace(rule, opacity=0.999)).tolist() == [False, False]


@pytest.mark.parametrize("name", ["log_scales", "quats", "logit_opacities"])
def test_gaussians_that_are_not_finite_fill_no_voxel(name):
    g = two_balls(20)
    values = getattr(g, name).copy()
    values[3] = np.nan
    rule, rest = RULES[1], np.delete(np.arange(20), 3)
    found = find_non_floaters(replace(g, **{name: values}), rule)
    np.testing.assert_array_equal(found[rest], find_non_floaters(g[rest], rule))


def test_default_sizes_follow_the_scene():
    g = two_balls()
    larger = replace(g, means=8 * g.means, log_scales=g.log_scales + np.float32(np.log(8)))
    rules = [FLOATERS.scale_to(each, e) for each, e in ((g, 1.0), (larger, 8.0))]
    assert rules[1].size == 8 * rules[0].size > 0


def test_default_sizes_stay_small_beside_sky_and_grow_for_what_is_far():
    g = two_balls()
    rule = FLOATERS.scale_to(g, 1.0)
    means, far_means = (np.append(g.means[:-1], [[x, 0, 0]], axis=0) for x in (50, 1e6))
    sky = replace(g, means=means, log_scales=np.append(g.log_scales[:-1], [[5, 5, 5.0]], axis=0))
    assert FLOATERS.scale_to(sky, 1.0) == rule and find_non_floaters(sky, rule)[-1]
    assert not find_cluster(sky, RULES[0])[-1]
    far = replace(g, means=far_means)
    assert FLOATERS.scale_to(far, 1.0).size > 2 * rule.size
    assert not find_non_floaters(far, replace(RULES[0], opacity=0.999, size=1.0))[-1]
