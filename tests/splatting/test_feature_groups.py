"""Many features, composited in groups, against as many pictures of few."""

import drjit as dr
import drjit.llvm.ad as llvm
import numpy as np
import pytest
from support.helpers import Case, clear
from support.kernels import drain_kernels

import drgs
from drgs.reference import splatting as reference
from drgs.splatting.feature_groups import FEATURES_AT_ONCE

CASE = clear(Case("feature groups", 37, 29, 0, seed=3))
CHANNELS = 2 * FEATURES_AT_ONCE[8] + 3
"""Two whole groups and a part of one, in float64."""

NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
FILM = {"width": CASE.width, "height": CASE.height, "near_plane": 0.25}


def arrays(kind=np.float64, channels=CHANNELS):
    """By the names of drgs.rasterization."""
    g, c, rng = CASE.gaussians, CASE.camera, np.random.default_rng(4)
    viewmat, K = np.eye(4), np.eye(3)
    viewmat[:3, :3], viewmat[:3, 3] = c.rotation, -c.rotation @ c.center
    K[:2] = [[c.fx, 0, c.cx], [0, c.fy, c.cy]]
    colors = rng.uniform(size=(len(g.means), channels))
    opacities, scales = reference.sigmoid(g.logit_opacities), np.exp(g.log_scales)
    values = g.means, g.quats, scales, opacities, colors, viewmat[None], K[None]
    return {name: value.astype(kind) for name, value in zip(NAMES, values, strict=True)}


def parts_of(given, size):
    """The same with ``size`` channels at a time."""
    for start in range(0, given["colors"].shape[1], size):
        yield slice(start, start + size), {
            **given, "colors": given["colors"][:, start : start + size]
        }  # fmt: skip


@pytest.mark.parametrize("order", [{}, {"order": "pixel"}, {"projection": "exact"}])
def test_many_channels_have_the_bytes_of_few(order):
    many, alphas, _ = drgs.rasterization(**arrays(), **FILM, **order)
    assert many.shape[-1] == CHANNELS
    for part, few in parts_of(arrays(), FEATURES_AT_ONCE[8]):
        expected, expected_alphas, _ = drgs.rasterization(**few, **FILM, **order)
        np.testing.assert_array_equal(many[..., part], expected)
        np.testing.assert_array_equal(alphas, expected_alphas)


def test_float32_has_larger_groups():
    given = arrays(np.float32, FEATURES_AT_ONCE[4] + 3)
    many, _, _ = drgs.rasterization(**given, **FILM)
    for part, few in parts_of(given, FEATURES_AT_ONCE[4]):
        expected, _, _ = drgs.rasterization(**few, **FILM)
        np.testing.assert_array_equal(many[..., part], expected)


def derivatives(given, weights):
    """Of a weighted sum of all channels and alphas, in reverse and along one direction."""
    rng = np.random.default_rng(6)
    values = {name: llvm.TensorXf64(value) for name, value in given.items()}
    dr.enable_grad(values)
    pictures, alphas, _ = drgs.rasterization(**values, **FILM)
    loss = dr.sum(pictures * llvm.TensorXf64(weights)) + dr.sum(alphas * alphas)
    dr.backward(loss)
    found = {name: np.array(value.grad) for name, value in values.items()}

    moving = {name: llvm.TensorXf64(given[name]) for name in ("means", "scales", "colors")}
    dr.enable_grad(moving)
    for name, value in moving.items():
        shape = arrays()[name].shape
        direction = rng.normal(size=shape)[..., : value.shape[-1]]
        dr.set_grad(value, llvm.TensorXf64(np.ascontiguousarray(direction)))
    pictures, _, _ = drgs.rasterization(**{**given, **moving}, **FILM)
    return found, np.array(dr.forward_to(pictures))


def test_derivatives_of_many_channels_are_the_sums_of_those_of_few():
    """In reverse; the loss of alphas is in each part, and is taken off where it is too often."""
    rng = np.random.default_rng(5)
    weights = rng.normal(size=(1, CASE.height, CASE.width, CHANNELS))
    many, tangents = derivatives(arrays(), weights)
    alone, _ = derivatives(arrays(channels=1), 0 * weights[..., :1])
    total, number, colors = {}, 0, []
    for part, few in parts_of(arrays(), FEATURES_AT_ONCE[8]):
        found, _ = derivatives(few, weights[..., part])
        colors.append(found.pop("colors"))
        total = {name: total.get(name, 0) + value for name, value in found.items()}
        number += 1
    np.testing.assert_allclose(many["colors"], np.concatenate(colors, axis=1), rtol=1e-12)
    for name, value in total.items():
        expected = value - (number - 1) * alone[name]
        scale = np.abs(expected).max()
        np.testing.assert_allclose(many[name], expected, rtol=0, atol=1e-11 * scale, err_msg=name)
    assert np.isfinite(tangents).all() and np.abs(tangents).max() > 0
    # <weights, J v> = <J^T weights, v>, v being the direction above.
    rng = np.random.default_rng(6)
    direction = {name: rng.normal(size=arrays()[name].shape) for name in ("means", "scales")}
    direction["colors"] = rng.normal(size=arrays()["colors"].shape)
    of_alphas = sum(np.vdot(alone[name], v) for name, v in direction.items() if name != "colors")
    reverse = sum(np.vdot(many[name], v) for name, v in direction.items()) - of_alphas
    assert np.vdot(weights, tangents) == pytest.approx(reverse, rel=1e-10)


def test_groups_share_their_kernels():
    """The largest, which composites, is that of a whole group, however many there are."""
    found = []
    for groups in (2, 3):
        given = arrays(channels=groups * FEATURES_AT_ONCE[8])
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            dr.kernel_history()
            drgs.rasterization(**given, **FILM)
            found.append(max(drain_kernels(), key=lambda kernel: kernel[1]))
    assert found[0] == found[1]
