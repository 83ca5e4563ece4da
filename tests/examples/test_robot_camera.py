"""The camera of a robot simulator sees what numpy composites: three opaque balls."""

import re

import numpy as np
import pytest

import drgs
from examples.robot_camera import SplatCamera, main

WIDTH, HEIGHT, FOV = 64, 48, 70.0
FOCAL = WIDTH / 2 / np.tan(np.radians(FOV / 2))  # px
LOW_PASS = 0.3  # px^2, of files without a header

POINTS = np.array([(-0.5, -0.4, 2.0), (0.0, 0.3, 4.0), (1.3, 0.9, 3.0)])  # in the camera
SIZES = np.array([0.12, 0.6, 0.15])  # the first ball hides a part of the second one
LABELS = np.array([3, 1, 2])
COLORS = np.array([(0.9, 0.2, 0.1), (0.2, 0.7, 0.3), (0.1, 0.3, 0.8)])
OPACITY = 0.98  # below the cap of alpha


@pytest.fixture(scope="module")
def pose():
    """Camera to world: turned about all axes, away from the origin."""
    rotation, _ = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation * np.linalg.det(rotation), (1.0, -2.0, 0.5)
    return pose


@pytest.fixture(scope="module")
def path(tmp_path_factory, pose):
    """File of the balls, in the world."""
    path = tmp_path_factory.mktemp("balls") / "balls.ply"
    means = POINTS @ pose[:3, :3].T + pose[:3, 3]
    quats, scales = np.tile([1.0, 0, 0, 0], (3, 1)), np.repeat(SIZES[:, None], 3, axis=1)
    sh = (COLORS[:, None] - 0.5) * np.sqrt(4 * np.pi)
    drgs.Gaussians.from_numpy(means, quats, scales, np.full(3, OPACITY), sh).save(path)
    return path


def composited():
    """(C, H, W) sums of alpha, depth, colours and labels, front to back, at pixels' centres."""
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5 - np.array([HEIGHT, WIDTH])[:, None, None] / 2
    sums, transmittance = np.zeros((8, HEIGHT, WIDTH)), np.ones((HEIGHT, WIDTH))
    for k in np.argsort(POINTS[:, 2]):
        x, y, z = POINTS[k]
        jacobian = FOCAL / z * np.array([[1, 0, -x / z], [0, 1, -y / z]])
        conic = np.linalg.inv(SIZES[k] ** 2 * jacobian @ jacobian.T + LOW_PASS * np.eye(2))
        offset = np.stack([u - FOCAL * x / z, v - FOCAL * y / z])
        alpha = OPACITY * np.exp(-np.einsum("ihw,ij,jhw->hw", offset, conic, offset) / 2)
        alpha[alpha < 1 / 255] = 0
        values = np.array([1, z, *COLORS[k], *(LABELS[k] == np.arange(1, 4))])
        sums += transmittance * alpha * values[:, None, None]
        transmittance *= 1 - alpha
    return sums


def test_pixels_are_those_that_numpy_composites(path, pose):
    frame = SplatCamera(path, LABELS, WIDTH, HEIGHT, FOV).render(pose)
    alpha, depth, *others = composited()
    clear = np.abs(alpha - 0.5) > 1e-3  # elsewhere, rounding may decide
    by_label = np.sort(others[3:], axis=0)
    clear &= (by_label[-1] - by_label[-2] > 1e-3) | (alpha < 0.4)
    assert clear.mean() > 0.98
    seen = alpha >= 0.5
    expected = np.where(seen, depth / np.maximum(alpha, 0.5), 0)
    np.testing.assert_allclose(frame["depth"][clear], expected[clear], rtol=1e-4)
    labels = np.where(seen, 1 + np.argmax(others[3:], axis=0), 0)
    np.testing.assert_array_equal(frame["labels"][clear], labels[clear])
    assert set(np.unique(labels[clear])) == {0, 1, 2, 3}
    rgb = 255 * np.moveaxis(others[:3], 0, -1)
    assert np.abs(frame["rgb"] - rgb).max() < 0.51  # rounded to whole numbers
    assert [frame[name].dtype for name in ("rgb", "depth")] == [np.uint8, np.float32]


def test_camera_moves(path, pose):
    """One unit forward, the depth of the last ball is one unit less."""
    camera = SplatCamera(path, LABELS, WIDTH, HEIGHT, FOV)
    closer = pose.copy()
    closer[:3, 3] += pose[:3, 2]
    for moved, z in ((pose, 3.0), (closer, 2.0), (pose, 3.0)):
        frame = camera.render(moved)
        depth = np.median(frame["depth"][frame["labels"] == 2])
        assert depth == pytest.approx(z, rel=2e-3)  # the second ball's rim is behind


def test_program_prints_the_frame_rate(path, capsys):
    main(path, frames=2)
    assert re.fullmatch(r"3 Gaussians: \d+\.\d frames/s\n", capsys.readouterr().out)
