"""Scenes that are hard for lenses, against the float64 reference."""

import numpy as np
import pytest
from support.helpers import (
    FLOAT64,
    Cotangents,
    assert_arrays_agree,
    assert_images_agree,
    both_precisions,
    clear,
    image_planes,
)
from support.lens_scenes import (
    IMAGE,
    LENSES,
    LensCase,
    camera_behind,
    case_of,
    every_lens,
    gaussians_at_points,
    kernel_gradients,
    scene_behind,
    seen_points,
)
from support.reference_scenes import numeric_gradients

from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import effects
from drgs.reference import splatting as reference


def large_scene(case, rng):
    """Splats as large as the film, most with their means beside it."""
    camera = camera_behind(case, rng)
    size = np.array([case.width, case.height])
    film = rng.uniform(-0.4, 1.4, (case.count, 2)) * size
    points = seen_points(case.lens, camera, film, rng.uniform(1, 3, case.count))
    sizes = rng.uniform(0.1, 0.8, (case.count, 3)) * max(size)
    logits = rng.normal(-1.0, 1.0, case.count)
    return gaussians_at_points(case, rng, camera, points, sizes, logits), camera


@both_precisions
@every_lens
@pytest.mark.parametrize(("recipe", "count"), [(scene_behind, 60), (large_scene, 20)])
def test_image_equals_the_reference(precision, name, recipe, count):
    """The reference evaluates every splat at every pixel."""
    case = clear(case_of(name, recipe=recipe, count=count))
    _, frame = case.render(precision)
    assert_images_agree(image_planes(frame, case), case.rendered, IMAGE[precision])
    splats = effects.project(*case.scene, case.lens)
    x, y = splats.means2d[splats.visible].T
    beside = (x < 0) | (y < 0) | (x > case.width) | (y > case.height)
    assert beside.sum() >= 5 and (case.rendered.alpha > 0.5).mean() > 0.2


def tiny_scene(case, rng):
    """One splat is on the axis, one so far beside the film that its slopes may be clamped."""
    camera = camera_behind(case, rng)
    size = np.array([case.width, case.height])
    film = rng.uniform(0.2, 0.8, (case.count, 2)) * size
    film[0], film[1] = (camera.cx, camera.cy), size * [1.5, 0.4]
    points = seen_points(case.lens, camera, film, rng.uniform(1, 3, case.count))
    sizes = rng.uniform(0.7, 3.0, (case.count, 3))
    sizes[1] = 0.5 * max(size)
    logits = rng.normal(0, 1, case.count)
    return gaussians_at_points(case, rng, camera, points, sizes, logits), camera


# Central differences with a step of 1e-6: the reference's J carries noise of 1e-13, so that a
# quotient is off by 1e-7 of its largest terms; curvature adds less. Measured: 4e-8.
DIFFERENCES = 1e-6


@pytest.mark.slow
@pytest.mark.parametrize("name", ["rational", "fisheye", "orthographic"])
def test_each_gradient_entry_equals_a_difference_of_the_reference(name, monkeypatch):
    lens = LENSES[name]
    case = clear(LensCase("tiny", 13, 11, 1, 5, lens=lens, recipe=tiny_scene, threshold_width=5e-4))
    cotangents = Cotangents.random(case)
    # The camera stays: what its film sees is looked for once, not for each difference.
    bounds = lens.slope_bounds(case.camera)
    monkeypatch.setattr(type(lens), "slope_bounds", lambda *_: bounds)
    weights = [cotangents.d_image, cotangents.d_alpha, cotangents.d_depth]

    def outputs(**parameters):
        rendered = case.reference_image(reference.Gaussians(**parameters))
        return [rendered.image, rendered.alpha, rendered.depth]

    parameters = {n: getattr(case.gaussians, n) for n in PARAMETER_NAMES}
    expected = numeric_gradients(outputs, weights, parameters)
    actual = kernel_gradients(case, FLOAT64, cotangents)
    assert_arrays_agree(actual, expected, DIFFERENCES)
    # The comparison notices one percent, in every array.
    for parameter, values in actual.items():
        with pytest.raises(AssertionError, match=rf"{parameter}\["):
            assert_arrays_agree({**actual, parameter: 1.01 * values}, expected, DIFFERENCES)
