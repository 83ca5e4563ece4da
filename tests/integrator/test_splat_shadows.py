"""Shadows of surfaces on splats, against closed forms."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.lit_scenes import camera
from support.lit_scenes import scene_of as lit_scene
from support.reference_lenses import gaussians_at

import drgs  # noqa: F401  (registers the plugins)
from drgs.core.errors import PluginError
from drgs.integrator.light import shadows
from drgs.integrator.light.shadows import GAMMA
from drgs.reference import splatting


def scene_of(means, shadows, **objects):
    """Discs that are thin, faint and grey, in the plane of x and y, with some harmonics."""
    splats = gaussians_at(means, [0.02, 0.02, 0.0005], 0.01, colors=0.53)
    splats = replace(splats, shN=np.random.default_rng(0).normal(0, 0.1, (len(means), 3, 3)))
    sensor = camera([0, -2, 1], [0, 0, 0], size=8, up=(0, 0, 1))
    settings = {"light": None, "nested": None, "spp": 1, "shadows": shadows}
    return lit_scene(splats, **settings, sensor=sensor, **objects)


def disc(height, radius):
    T = mi.ScalarTransform4f
    return {"type": "disk", "to_world": T().translate([0, 0, height]).scale(radius)}


def factors(scene):
    """Return factors of the colours 0.5 + 0.282 sh0, and of harmonics."""
    integrator = scene.integrator()
    mi.render(scene)
    own = integrator.state.own.gaussians
    before = 0.5 + splatting.C_00 * np.array(own.sh0)[:, 0]
    after = 0.5 + splatting.C_00 * np.array(integrator.gaussians.sh0)[:, 0]
    higher = np.array(integrator.gaussians.shN) / np.array(own.shN)
    return after / before, higher


SKY = {"type": "constant"}


@pytest.mark.slow
@pytest.mark.parametrize(("height", "radius"), [(1.0, 1.0), (0.5, 0.2), (2.0, 6.0)])
def test_disc_blocks_its_solid_angle_of_the_sky(height, radius, monkeypatch):
    """1 - sin^2 of half the angle under which it is seen (Lambert)."""
    # The quotient of few samples is biased by a hundredth.
    monkeypatch.setattr(shadows, "EMITTER_SAMPLES", 512)
    means = np.random.default_rng(1).normal(0, 0.01, (150, 3)) * [1, 1, 0.01]
    factor, higher = factors(
        scene_of(means, "lid", lid=disc(height, radius), sky=SKY, floor=disc(-0.05, 50.0))
    )
    expected = height**2 / (height**2 + radius**2)
    assert np.mean(factor**GAMMA) == pytest.approx(expected, abs=0.01)
    np.testing.assert_allclose(higher, factor[:, None, :] * np.ones_like(higher), rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("pane", [None, 3.0, 1.0], ids=["alone", "pane above", "pane below"])
def test_object_before_a_lamp_casts_a_shadow(pane):
    """Sharply, as it is a point: behind the edge of the shadow all is as it was. A pane that lets
    everything pass makes no difference."""
    x = np.linspace(-2, 2, 81)
    means = np.stack([x, 0 * x, 0 * x], axis=1)
    lamp = {"type": "point", "position": [0.0, 0.0, 4.0]}
    objects = {"lid": disc(2.0, 0.5), "lamp": lamp, "floor": disc(-0.05, 50.0)}
    if pane is not None:
        objects["pane"] = disc(pane, 50.0) | {"bsdf": {"type": "null"}}
    factor, _ = factors(scene_of(means, "lid", **objects))
    inside = np.abs(x) < 0.98
    np.testing.assert_allclose(factor[inside], 0, atol=1e-6)
    np.testing.assert_array_equal(factor[np.abs(x) > 1.02], 1)


def test_unlisted_objects_cast_no_shadow():
    means = np.zeros((10, 3))
    objects = {"lid": disc(1.0, 1.0), "sky": SKY, "floor": disc(-0.05, 50.0)}
    objects["other"] = disc(3.0, 0.1)
    factor, _ = factors(scene_of(means, "other", **objects))
    np.testing.assert_array_equal(factor, 1)  # it is behind the lid


def test_shadows_are_cached_until_the_scene_changes():
    scene = scene_of(np.zeros((4, 3)), "lid", lid=disc(1.0, 1.0), sky=SKY, floor=disc(-0.05, 50.0))
    mi.render(scene)
    first = scene.integrator().state.cache.shaded
    mi.render(scene)
    assert scene.integrator().state.cache.shaded is first
    params = mi.traverse(scene)
    params["lid.to_world"] = mi.Transform4f().translate([5, 0, 1]).scale(0.1)
    params.update()
    mi.render(scene)
    assert scene.integrator().state.cache.shaded is not first


def test_unknown_shapes_are_refused():
    scene = scene_of(np.zeros((4, 3)), "lit", lid=disc(1.0, 1.0), sky=SKY)
    with pytest.raises(PluginError, match="ids of the scene's shapes, got 'lit'; there are lid"):
        scene.integrator().render(scene)
