"""Panoramas: what the matrix of cases does not show. A turned camera sees a rolled image."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.helpers import FLOAT64, both_precisions, device_camera, device_gaussians, rows
from support.reference_lenses import camera_at_origin, gaussians_at

from drgs.cameras.equirectangular import Equirectangular
from drgs.core.constants import LOW_PASS
from drgs.splatting import rendering
from drgs.splatting.rendering import Pipeline

WIDTH, HEIGHT = 88, 40  # px: the last column of tiles is half of one


def planes_of(gaussians, turned_px=0.0, crop=None, precision=FLOAT64) -> np.ndarray:
    """Transmittance and colour (4, H, W) of a camera that is turned to the right."""
    angle = 2 * np.pi * turned_px / WIDTH
    rotation = Rotation.from_rotvec([0, -angle, 0]).as_matrix()
    camera = camera_at_origin(rotation=rotation, width=WIDTH, height=HEIGHT)
    camera = device_camera(camera, precision).with_lens(Equirectangular())
    if crop is not None:
        x, y, width, height = crop
        start = type(camera.film_start)(x, y)
        camera = replace(
            camera,
            film_start=camera.film_start - start,
            film_end=camera.film_end - start,
            width=width,
            height=height,
        )
    frame = rendering.render(device_gaussians(gaussians, precision), camera, Pipeline(0))
    return np.array([rows(p) for p in frame.planes()]).reshape(4, camera.height, camera.width)


def scene(scale, count=60):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(count, 3))
    scales = scale * rng.uniform(0.3, 1.5, (count, 3)) * np.linalg.norm(points, axis=1)[:, None]
    quats = rng.normal(size=4)
    return gaussians_at(points, scales, rng.uniform(0.2, 0.9, count), rng.random((count, 3)), quats)


@both_precisions
@pytest.mark.parametrize("scale", [0.02, 0.2, 1.0])
def test_image_of_a_turned_camera_is_rolled(precision, scale):
    gaussians = scene(scale)
    straight = planes_of(gaussians, precision=precision)
    tolerance = 1e-12 if precision is FLOAT64 else 5e-5
    for turned in (1, 16, 44, 87):
        rolled = np.roll(straight, -turned, axis=2)
        found = planes_of(gaussians, turned, precision=precision)
        # An alpha at a cut may be on its other side, in a few pixels of the float32 image.
        off = np.abs(found - rolled).max(axis=0) > tolerance
        assert off.mean() <= (0 if precision is FLOAT64 else 0.002)


@pytest.mark.parametrize("scale", [0.02, 0.2, 1.0])
@pytest.mark.parametrize("crop", [(0, 0, 20, 40), (70, 3, 18, 9), (33, 8, 5, 32), (1, 0, 86, 40)])
def test_crop_window_is_part_of_the_panorama(crop, scale):
    gaussians, (x, y, width, height) = scene(scale), crop
    whole = planes_of(gaussians)[:, y : y + height, x : x + width]
    np.testing.assert_allclose(planes_of(gaussians, crop=crop), whole, rtol=0, atol=1e-12)


def test_splat_over_a_pole_is_round():
    """Seen from the middle of a sphere: all longitudes show the same of a splat around the axis."""
    planes = planes_of(gaussians_at([[1e-3, 2.0, 1e-3]], 0.2, 0.8))
    alpha = 1 - planes[0, -12:]
    assert alpha.max() > 0.7
    angles = np.pi * (np.arange(12)[::-1] + 0.5) / HEIGHT  # from the pole
    variance = 0.1**2 + LOW_PASS * (np.pi / HEIGHT) ** 2
    expected = 0.8 * np.exp(-0.5 * angles**2 / variance)
    np.testing.assert_allclose(alpha, np.tile(expected[:, None], WIDTH), atol=0.004)
    # A mean on the axis itself has no longitude.
    assert planes_of(gaussians_at([[0, 2.0, 0]], 0.2, 0.8))[0].min() == 1
