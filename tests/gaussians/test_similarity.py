"""A model that is moved, against the reference with the camera moved the other way."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.formats import gaussians_within_ranges
from support.views import Scene

from drgs.core.errors import UserError
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.gaussians.similarity import Similarity, shortest_rotation
from drgs.reference import splatting as reference

SCALE, TRANSLATION = 1.75, np.array([0.5, -2.0, 1.25])
ROTATION = Rotation.random(random_state=5).as_matrix()


def matrix_of(linear, translation=(0, 0, 0)) -> np.ndarray:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = linear, translation
    return matrix


MATRIX = matrix_of(SCALE * ROTATION, TRANSLATION)


@pytest.mark.parametrize(("digits", "tolerance"), [(16, 1e-14), (5, 1e-5)])
def test_matrix_is_decomposed_with_the_nearest_rotation(digits, tolerance):
    similarity = Similarity.from_matrix(np.round(MATRIX, digits), "x")
    assert similarity.scale == pytest.approx(SCALE, rel=tolerance)
    np.testing.assert_allclose(similarity.rotation, ROTATION, atol=tolerance)
    np.testing.assert_allclose(similarity.rotation @ similarity.rotation.T, np.eye(3), atol=1e-14)
    np.testing.assert_array_equal(similarity.translation, TRANSLATION)


REFUSED = {
    "scales that differ": matrix_of(np.diag([1, 1, 1.01])),
    "a shear": matrix_of([[1, 0.01, 0], [0, 1, 0], [0, 0, 1]]),
    "a mirror": matrix_of(np.diag([-1, 1, 1])),
    "a projection to a plane": matrix_of(np.diag([1, 1, 0])),
    "not a number": matrix_of(np.eye(3), [np.nan, 0, 0]),
    "infinite": matrix_of(np.where(np.eye(3) > 0, np.inf, 0)),
    "perspective": np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 1, 1.0]]),
}


@pytest.mark.parametrize("matrix", REFUSED.values(), ids=REFUSED)
def test_anything_but_a_similarity_is_refused(matrix):
    message = (
        r"^splats: to_world must be made of rotations, translations and scales that are the same "
        r"along all axes and positive, got the matrix \["
    )
    with pytest.raises(ValueError, match=message):
        Similarity.from_matrix(matrix, "splats: to_world")


@pytest.mark.parametrize("degree", [0, 1, 3])
def test_model_and_camera_moved_together_give_the_same_image(degree):
    """Depths are multiplied. float32 parameters of a moved model are rounded anew: 1e-7 each."""
    scene, camera = Scene(degree=degree), Scene().camera
    fields = {name: getattr(scene.gaussians, name).astype(np.float32) for name in PARAMETER_NAMES}
    filters = np.linspace(0.01, 0.2, len(fields["means"]), dtype=np.float32)
    similarity = Similarity.from_matrix(MATRIX, "x")
    moved = similarity.of_gaussians(Gaussians(**fields, smoothing=filters))
    np.testing.assert_allclose(moved.smoothing, SCALE * filters, rtol=1e-6)
    names = (*PARAMETER_NAMES, "smoothing")
    assert {getattr(moved, name).dtype for name in names} == {np.dtype(np.float32)}
    follower = replace(
        camera,
        rotation=camera.rotation @ ROTATION.T,
        center=SCALE * ROTATION @ camera.center + TRANSLATION,
        near=SCALE * camera.near,
    )
    expected = reference.render(scene.gaussians, camera, np.zeros(3), degree)
    fields = {name: np.float64(getattr(moved, name)) for name in PARAMETER_NAMES}
    actual = reference.render(reference.Gaussians(**fields), follower, np.zeros(3), degree)
    np.testing.assert_allclose(actual.image, expected.image, atol=1e-5 * expected.image.max())
    np.testing.assert_allclose(
        actual.depth, SCALE * expected.depth, atol=1e-5 * SCALE * expected.depth.max()
    )


def test_positions_that_overflow_float32_are_refused():
    turn = Rotation.from_euler("z", 45, degrees=True).as_matrix()
    similarity = Similarity.from_matrix(matrix_of(turn), "it")
    far = gaussians_within_ranges(9)
    far.quats[:] = 3e38
    assert np.isfinite(similarity.of_gaussians(far).quats).all()
    far.means[2] = 3e38, 3e38, 0
    with pytest.raises(UserError, match=r"means of Gaussian 2 is 4.24264e\+38 once it is moved"):
        similarity.of_gaussians(far)


AXES = np.concatenate([np.eye(3), -np.eye(3)])


@pytest.mark.parametrize("direction", [*AXES, np.array([0.6, 0, 0.8])], ids=str)
def test_shortest_rotation_axis_is_perpendicular_to_both_directions(direction):
    for towards in AXES:
        rotation = shortest_rotation(direction, towards)
        np.testing.assert_allclose(rotation @ direction, towards, atol=1e-15)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-15)
        assert np.linalg.det(rotation) > 0
        angle = Rotation.from_matrix(rotation).magnitude()
        assert angle == pytest.approx(np.arccos(direction @ towards), abs=1e-7)
