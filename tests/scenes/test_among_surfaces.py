"""Splats among surfaces with known results: a white furnace, the shadow of a ball."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY


@pytest.fixture
def script(monkeypatch):
    mi.set_variant("llvm_ad_rgb")
    monkeypatch.syspath_prepend(REPOSITORY / "scenes")
    import among_surfaces

    return among_surfaces


@pytest.mark.parametrize("settings", [{"background": [1.0] * 3}, {}], ids=["background", "sky"])
def test_white_cloud_before_white_is_white_in_every_pixel(script, settings):
    mean, error = script.furnace(16, settings, {}, rounds=2)
    assert mean == pytest.approx(1, abs=1e-5) and error < 1e-6


@pytest.mark.slow
def test_white_furnace_is_white_for_every_material_and_light(script):
    """Within four standard errors, and half a thousandth that probes leave."""
    rows = script.furnace_rows(16, rounds=4)
    assert len(rows) == 2 + len(script.MATERIALS) * len(script.LIGHTS)
    for material, light, mean, error in rows:
        assert abs(mean - 1) < 4 * error + 5e-4, (material, light)


@pytest.mark.slow
def test_ball_of_splats_casts_the_shadow_of_a_sphere(script):
    """Its outline is soft, by 4 % of its radius: so much more of the light is gone."""
    for lamp, known, found, difference in script.shadow_rows(16, 4000):
        assert found == pytest.approx(known, abs=0.015), lamp
        assert difference < 0.015 and known < 0.95, lamp
        assert np.isfinite(difference)
