"""Scenes that are hard for lenses, against the float64 reference."""

import numpy as np
import pytest
from support.helpers import (
    assert_images_agree,
    both_precisions,
    clear,
    image_planes,
)
from support.lens_scenes import (
    IMAGE,
    camera_behind,
    case_of,
    every_lens,
    gaussians_at_points,
    scene_behind,
    seen_points,
)

from drgs.reference import effects


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
    assert (beside.sum() >= 5 or name == "panorama") and (case.rendered.alpha > 0.5).mean() > 0.2
