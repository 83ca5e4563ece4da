"""The laws of ``drgs.testing``, on the lens and an image of it that numpy computes."""

import numpy as np
import pytest
from equisolid import MIN_COSINE, Equisolid

import drgs  # noqa: F401  comes first: it selects the LLVM that Dr.Jit will load
from drgs.reference import splatting as reference
from drgs.testing import Case, laws_of

LOW_PASS = 0.3  # px^2
MARGIN = 1e-4  # relative: nearer to a threshold, rounding may decide otherwise


def film_points(camera, points):
    """(N, 2) px, from the angle to the axis, unlike the lens; points: (N, 3), camera axes."""
    around = np.arctan2(points[:, 1], points[:, 0])
    theta = np.arctan2(np.hypot(points[:, 0], points[:, 1]), points[:, 2])
    radius = 2 * np.sin(theta / 2)
    unit = np.column_stack([np.cos(around), np.sin(around)])
    return camera.focal * radius[:, None] * unit + camera.principal


def jacobians(camera, points, step=1e-3):
    """(N, 2, 3), by central differences of order 4."""
    columns = []
    for axis in step * np.eye(3):
        near = film_points(camera, points + axis) - film_points(camera, points - axis)
        far = film_points(camera, points + 2 * axis) - film_points(camera, points - 2 * axis)
        columns.append((8 * near - far) / (12 * step))
    return np.stack(columns, axis=-1)


def image_of(case, values):
    """Return the planes (5, H W) of a case, and the pixels (H W,) near a threshold.

    It is the sum of what every approximation of drgs stands for: splats of the covariance
    J Sigma J^T + 0.3, front to back, with colours from spherical harmonics.
    """
    (rotation, center), K = case.pose, case.K
    numbers = K[0, 0], K[1, 1], K[0, 2], K[1, 2], case.width, case.height
    camera = reference.Camera(rotation, center, *numbers)
    gaussians = reference.Gaussians(**values)
    points = (gaussians.means - center) @ rotation.T
    distance = np.linalg.norm(points, axis=1)
    spread = rotation @ reference.quat_to_rotation(gaussians.quats)
    axes = jacobians(camera, points) @ (spread * np.exp(gaussians.log_scales)[:, None, :])
    cov2d = axes @ axes.transpose(0, 2, 1) + LOW_PASS * np.eye(2)
    opacities = reference.sigmoid(gaussians.logit_opacities)
    splats = reference.Projection(
        means2d=film_points(camera, points),
        cov2d=cov2d,
        conics=np.linalg.inv(cov2d),
        depths=distance,  # a lens of wide angles sorts by distance
        opacities=opacities,
        visible=(points[:, 2] > MIN_COSINE * distance) & (opacities > reference.ALPHA_CUT),
    )
    colors = reference.sh_colors(gaussians, camera, case.degree)
    size = case.width, case.height
    found = reference.composite(splats, colors, np.zeros(3), *size, MARGIN)
    planes = [found.transmittance, *np.moveaxis(found.image, -1, 0), found.depth]
    return np.reshape(planes, (5, -1)), found.near_threshold.ravel()


CASE = Case(
    "equisolid",
    lens=Equisolid(),
    reference=image_of,
    count=15,
    width=17,
    height=13,
    focal=9.0,
    image_tolerance=1e-8,
)  # fmt: skip  differences of order 4


@pytest.mark.parametrize("law", laws_of(CASE), ids=lambda law: law.__name__)
def test_law_holds(law):
    """Each law is a property of images and derivatives."""
    law(CASE)


def test_solid_angles_keep_their_areas():
    """Areas of the film per solid angle, |det J| d^2, are focal^2 at any angle."""
    camera = reference.Camera(np.eye(3), np.zeros(3), 9.0, 9.0, 0, 0, 1, 1)
    points = np.random.default_rng(0).normal(size=(50, 3)) + np.array([0, 0, 0.5])
    distance = np.linalg.norm(points, axis=1)
    minors = np.cross(*np.moveaxis(jacobians(camera, points, 1e-3), 1, 0))
    areas = np.linalg.norm(minors, axis=1) * distance**2
    np.testing.assert_allclose(areas, 81.0, rtol=1e-6)
