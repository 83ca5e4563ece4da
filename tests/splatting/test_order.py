"""Many features, composited in groups, against as many images of few."""

from functools import partial

import numpy as np
import pytest
from support.helpers import Case, clear
from support.kernels import kernels_of

import drgs
from drgs.reference import splatting as reference
from drgs.splatting.order import FEATURES_AT_ONCE

CASE = clear(Case("feature groups", 37, 29, 0, seed=3))
NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
FILM = {"width": CASE.width, "height": CASE.height, "near_plane": 0.25}


def arrays(kind, channels):
    """Return arrays by the names of drgs.rasterization."""
    g, c, rng = CASE.gaussians, CASE.camera, np.random.default_rng(4)
    viewmat, K = np.eye(4), np.eye(3)
    viewmat[:3, :3], viewmat[:3, 3] = c.rotation, -c.rotation @ c.center
    K[:2] = [[c.fx, 0, c.cx], [0, c.fy, c.cy]]
    colors = rng.uniform(size=(len(g.means), channels))
    opacities, scales = reference.sigmoid(g.logit_opacities), np.exp(g.log_scales)
    values = g.means, g.quats, scales, opacities, colors, viewmat[None], K[None]
    return {name: value.astype(kind) for name, value in zip(NAMES, values, strict=True)}


@pytest.mark.parametrize("size", FEATURES_AT_ONCE)
def test_grouped_channels_equal_channels_rendered_alone(size):
    """Two whole groups, and a part of one."""
    kind, most = {4: np.float32, 8: np.float64}[size], FEATURES_AT_ONCE[size]
    given = arrays(kind, 2 * most + 3 if size == 8 else most + 3)
    many, alphas, _ = drgs.rasterization(**given, **FILM)
    for start in range(0, many.shape[-1], most):
        few = {**given, "colors": given["colors"][:, start : start + most]}
        expected, expected_alphas, _ = drgs.rasterization(**few, **FILM)
        np.testing.assert_array_equal(many[..., start : start + most], expected)
        np.testing.assert_array_equal(alphas, expected_alphas)


def test_groups_share_their_kernels():
    """The largest, which composites, is that of a whole group, however many there are."""
    found = []
    for groups in (2, 3):
        given = arrays(np.float64, groups * FEATURES_AT_ONCE[8])
        kernels = kernels_of(partial(drgs.rasterization, **given, **FILM))
        found.append(max(kernels, key=lambda kernel: kernel[1]))
    assert found[0] == found[1]
