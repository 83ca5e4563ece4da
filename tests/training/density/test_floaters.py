"""Floaters: which they are, by the float64 reference, and what removing them leaves."""

from types import SimpleNamespace

import numpy as np
import pytest
from drjit.llvm.ad import TensorXf64
from support.populations import make, moments, rows_of, values

from drgs.cameras.viewpoints import Viewpoint, look_at, pinhole
from drgs.config.schema import FitConfig
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.reference import splatting as reference
from drgs.training.density.floaters import Floaters
from drgs.training.density.phases import density_strategy
from drgs.training.density.strategy import DensityReport

NUM_VIEWS, SIDE, NEAR = 16, 40, 0.2
DIRECT = {"near": NEAR, "antialiased": False, "low_pass": 0.3}


class OpaqueView(Viewpoint):
    alpha = None


def floaters_of(views, iterations):
    config = FitConfig(data={"path": "."}, iterations=iterations, model=DIRECT)
    train = [OpaqueView(**vars(view)) for view in views]
    return Floaters(config, SimpleNamespace(train=train))


def ring():
    angles = 2 * np.pi * np.arange(NUM_VIEWS) / NUM_VIEWS
    centers = np.stack([4 * np.cos(angles), 4 * np.sin(angles), 0.5 + 0 * angles], axis=1)
    return [
        pinhole(f"{k}", look_at(center, (0, 0, 0), (0, 0, 1)), SIDE, SIDE, 40)
        for k, center in enumerate(centers)
    ]


def scene(rng):
    """A cloud in the middle; before four cameras what they alone see, and a wall behind it."""
    middle = rng.normal(0, 0.4, (40, 3))
    views = ring()
    close = [v.center + (0.6 + 0.2 * k) * v.camera_to_world[:3, 2] for k, v in enumerate(views[:4])]
    behind = [v.center + 7 * v.camera_to_world[:3, 2] for v in views[:4]]
    means = np.concatenate([middle, close, behind])
    sizes = np.concatenate([np.full(40, 0.25), np.full(4, 0.03), np.full(4, 1.0)])
    n = len(means)
    return reference.Gaussians(
        means=means,
        quats=rng.normal(size=(n, 4)),
        log_scales=np.log(sizes[:, None] * rng.uniform(0.7, 1.4, (n, 3))),
        logit_opacities=rng.uniform(-1, 2, n),
        sh0=rng.normal(0, 0.5, (n, 1, 3)),
        shN=np.zeros((n, 0, 3)),
    )


def weights_in(view, gaussians):
    """Return sums of weights (N,), and the same with each pixel over its mean depth, by z."""
    rotation = view.camera_to_world[:3, :3].T
    intrinsics = view.fx, view.fy, view.cx, view.cy, view.width, view.height
    camera = reference.Camera(rotation, view.center, *intrinsics, NEAR)
    splats = reference.project(gaussians, camera)
    inputs = splats, np.ones((len(splats.depths), 3)), np.zeros(3)
    image = reference.composite(*inputs, SIDE, SIDE)
    shown = image.alpha > 0.01
    inverse = np.where(shown, image.alpha / np.where(shown, image.depth, 1), 0)
    planes = np.stack([shown, inverse, 0 * inverse], axis=-1)
    sums = reference.composite_gradients(*inputs, planes)["colors"]
    return sums[:, 0], sums[:, 1] * splats.depths


@pytest.mark.parametrize("seed", range(3))
def test_floaters_are_those_that_few_cameras_see_close_before_them(seed):
    gaussians = scene(np.random.default_rng(seed))
    weights, relative = np.swapaxes([weights_in(view, gaussians) for view in ring()], 0, 1)
    cameras = weights.sum(axis=0) ** 2 / np.maximum((weights**2).sum(axis=0), 1e-300)
    depths = relative.sum(axis=0) / np.maximum(weights.sum(axis=0), 1e-300)
    assert np.abs(cameras - 3).min() > 1e-6 and np.abs(depths - 0.9).min() > 1e-6
    expected = (cameras < 3) & (depths < 0.9) & (weights.sum(axis=0) > 0)
    assert expected[40:44].all() and not expected[44:].any()
    device = Gaussians(**{k: getattr(gaussians, k) for k in PARAMETER_NAMES}).to(TensorXf64)
    found = floaters_of(ring(), 100).find(device)
    np.testing.assert_array_equal(found, expected)


def test_floaters_are_removed_three_times_and_the_others_keep_their_moments(monkeypatch):
    strategy = floaters_of(ring(), 1000)
    assert [i for i in range(2000) if strategy.is_due(i)] == [500, 700, 900]
    optimizer = make([0.05] * 5, 0.5)
    before, former = values(optimizer), moments(optimizer, "means")
    for floats, kept in (([0, 1, 0, 0, 1], [0, 2, 3]), ([0, 0, 0], None), ([1, 1, 1], None)):
        monkeypatch.setattr(strategy, "find", lambda gaussians, f=floats: np.array(f, bool))
        report = strategy.refine(rows_of(optimizer), 500)
        assert report == (kept and DensityReport(num_gaussians=3, pruned=2))
    for name in PARAMETER_NAMES:
        np.testing.assert_array_equal(values(optimizer)[name], before[name][[0, 2, 3]])
    for moment, expected in zip(moments(optimizer, "means"), former, strict=True):
        np.testing.assert_array_equal(moment, expected[[0, 2, 3]])


@pytest.mark.parametrize(("alpha", "is_due"), [(None, True), (np.ones((SIDE, SIDE)), False)])
def test_nothing_floats_before_what_is_cut_out(alpha, is_due):
    views = [SimpleNamespace(**vars(view), alpha=alpha) for view in ring()]
    config = FitConfig(data={"path": "."}, iterations=100)
    strategy = Floaters(config, SimpleNamespace(train=views))
    assert strategy.is_due(70) == is_due


def test_few_views_and_a_setting_leave_them():
    assert not any(map(floaters_of(ring()[:11], 100).is_due, range(200)))
    config = FitConfig(data={"path": "."}, densify={"remove_floaters": False})
    assert not hasattr(density_strategy(config), "phases")
    phases = density_strategy(replace_setting(config, True)).phases
    assert [type(phase).__name__ for phase in phases] == ["GrowthToNumber", "Floaters"]


def replace_setting(config, value):
    densify = config.densify.model_copy(update={"remove_floaters": value})
    return config.model_copy(update={"densify": densify})
