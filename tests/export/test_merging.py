"""Merged Gaussians have the moments of those before."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.formats import gaussians_within_ranges

from drgs.export.merging import merge_down


def covariances_of(g):
    rotations = Rotation.from_quat(g.quats[:, [1, 2, 3, 0]].astype(float)).as_matrix()
    return rotations @ (g.scales.astype(float)[:, :, None] ** 2 * np.swapaxes(rotations, 1, 2))


def surface(scales):
    a, b, c = scales.astype(float).T ** 1.6075
    return ((a * b + b * c + a * c) / 3) ** (1 / 1.6075)


def test_a_pair_keeps_mean_covariance_mass_and_mean_colour():
    g = gaussians_within_ranges(2, degree=1)
    means = (0.2 * g.means).astype(np.float32)
    g = replace(g, means=means, log_scales=np.log([[0.3, 0.2, 0.1]] * 2).astype(np.float32))
    found = merge_down(g, 1)
    # Found in float64, and rounded to float32 as logarithms, logits and quaternions.
    masses = g.opacities * surface(g.scales)
    weights = masses / masses.sum()
    mean = weights @ g.means
    offsets = g.means - mean
    second = covariances_of(g) + offsets[:, :, None] * offsets[:, None, :]
    np.testing.assert_allclose(found.means[0], mean, rtol=1e-5)
    expected = np.einsum("k,kij->ij", weights, second)
    np.testing.assert_allclose(covariances_of(found)[0], expected, rtol=1e-5, atol=1e-7)
    np.testing.assert_allclose(found.sh[0], np.einsum("k,kij->ij", weights, g.sh), rtol=1e-5)
    np.testing.assert_allclose(found.opacities * surface(found.scales), masses.sum(), rtol=1e-5)


def test_twins_are_merged_first():
    g = gaussians_within_ranges(100, degree=1)
    g = replace(g, logit_opacities=g.logit_opacities - 4.5)  # whose masses fit into one
    twins = g[np.repeat(np.arange(100), 2)]
    found = merge_down(twins, 100)
    order = [np.argsort(each.means[:, 0]) for each in (g, found)]
    # Float32; a logit near -4.5 keeps six digits of an opacity.
    np.testing.assert_allclose(found.means[order[1]], g.means[order[0]], rtol=1e-6)
    np.testing.assert_allclose(found.opacities[order[1]], 2 * g.opacities[order[0]], rtol=1e-5)


@pytest.mark.parametrize("count", [599, 300, 299, 7, 1])
def test_any_number_can_be_left(count):
    g = gaussians_within_ranges(600)
    found = merge_down(g, count)
    assert found.num_gaussians == count
    assert all(np.isfinite(getattr(found, name)).all() for name in ("means", "quats", "log_scales"))
    np.testing.assert_array_equal(merge_down(g, count).sh, found.sh)
    assert merge_down(g, 600) is g


def test_gaussians_at_one_place_are_merged():
    g = gaussians_within_ranges(300)
    assert merge_down(replace(g, means=0 * g.means), 5).num_gaussians == 5


def test_gaussians_that_are_not_finite_are_left_out():
    g = gaussians_within_ranges(20)
    g.log_scales[4, 1] = np.nan
    found = merge_down(g, 19)
    np.testing.assert_allclose(found.means, np.delete(g.means, 4, axis=0))


def test_gaussians_that_are_not_merged_keep_their_bits():
    g = gaussians_within_ranges(50, degree=1)
    g.logit_opacities[:] = -12 - 0.01 * np.arange(50)  # below what merged ones are clipped to
    found = merge_down(g, 49)
    for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "shN"):
        before, after = ({row.tobytes() for row in getattr(x, name)} for x in (g, found))
        assert len(before & after) >= 48, name
