"""Fewer Gaussians look like all of them."""

import mitsuba as mi
import numpy as np
import pytest
from support.small_capture import blobs, make_dataset

from drgs.cameras.orbits import rings_around
from drgs.config.schema import ModelConfig
from drgs.core.errors import UserNote
from drgs.export import decimation
from drgs.export.decimation import decimate
from drgs.export.merging import merge_down
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.integrator.scene import make_scene, render_views

MODEL, GREY = ModelConfig(near=0.2).with_3dgs_defaults(), (0.5, 0.5, 0.5)


def error(found, expected, views):
    images = [list(render_views(make_scene(g, MODEL, GREY), views)) for g in (found, expected)]
    return float(np.mean([np.square(a - b).mean() for a, b in zip(*images, strict=True)]))


@pytest.mark.slow
@pytest.mark.parametrize(("cameras", "share"), [("of a fit", 0.5), ("around", 0.7)])
def test_fitted_gaussians_are_nearer_than_merged_ones_also_in_other_views(cameras, share):
    g, dataset = blobs(60), make_dataset(12, 5)
    views = (
        dataset.train if cameras == "of a fit" else rings_around(g, np.array([0, 0, 1.0]), 4, 400)
    )
    found = decimate(g, 20, views, MODEL, GREY)
    merged = merge_down(g, 20)
    assert found.num_gaussians == 20
    assert error(found, g, dataset.test) < share * error(merged, g, dataset.test)


def test_no_gaussian_is_changed_where_none_has_to_go(monkeypatch):
    monkeypatch.setattr(mi, "render", None)
    g = blobs(5)
    assert decimate(g, 5, [], MODEL, GREY) is g


@pytest.mark.parametrize("degree", [0, 1])
def test_each_parameter_is_fitted(monkeypatch, degree):
    monkeypatch.setattr(decimation, "ITERATIONS", 2)
    g = blobs(12)
    g = (
        g
        if degree
        else type(g)(**{n: getattr(g, n) for n in PARAMETER_NAMES} | {"shN": g.shN[:, :0]})
    )
    found = decimate(g, 6, make_dataset(3, 1).train, MODEL, GREY)
    merged = merge_down(g, 6)
    for name in PARAMETER_NAMES:
        before, after = getattr(merged, name), getattr(found, name)
        assert before.shape == after.shape and after.dtype == np.float32
        assert before.size == 0 or (before != after).any(), name


def test_numbers_that_become_infinite_leave_the_merged_gaussians(monkeypatch):
    monkeypatch.setattr(decimation, "ITERATIONS", 2)
    monkeypatch.setitem(decimation.TOUCH_UP_RATES, "scales_lr", np.inf)
    g = blobs(12)
    with pytest.warns(UserNote, match="merged, but not fitted"):
        found = decimate(g, 6, make_dataset(3, 1).train, MODEL, GREY)
    np.testing.assert_array_equal(found.means, merge_down(g, 6).means)
