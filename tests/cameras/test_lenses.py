"""Scenes that are hard for lenses, against the float64 reference."""

from functools import partial

import numpy as np
import pytest
from support.cases import edges_behind, large_behind, reference_camera, with_lens
from support.helpers import both_precisions
from support.lens_scenes import IMAGE, LENSES, every_lens

from drgs.reference import effects
from drgs.reference import splatting as reference


@both_precisions
@every_lens
@pytest.mark.parametrize(("scene", "count"), [(edges_behind, 60), (large_behind, 30)])
def test_image_equals_the_reference(precision, name, scene, count):
    """The reference evaluates every splat at every pixel."""
    lens = LENSES[name]
    case = with_lens(name, scene=partial(scene, lens), count=count)
    expected, marked = case.reference_image
    found = case.planes(case.values, precision.Float)
    for plane, values in zip(found, expected, strict=True):
        tolerance = IMAGE[precision] * np.abs(values).max()
        np.testing.assert_allclose(plane[~marked], values[~marked], rtol=0, atol=tolerance)
    splats = effects.project(reference.Gaussians(**case.values), reference_camera(case), lens)
    x, y = splats.means2d[splats.visible].T
    beside = (x < 0) | (y < 0) | (x > case.width) | (y > case.height)
    assert (beside.sum() >= 5 or name == "panorama") and (expected[0] < 0.5).mean() > 0.2
    assert marked.mean() < 0.01
