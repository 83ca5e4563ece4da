"""An asymmetric, coloured scene looks the same in a file, from a camera turned with its axes."""

from dataclasses import replace

import numpy as np
import pytest
from support.small_capture import FOCUS, photograph, pose_around, view

from drgs.gaussians.parameters import Gaussians
from drgs.io.formats import read_gaussians, readable_formats

Z_TO_Y = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Our z axis is the file's y axis: right, up, back."""

ROUNDING = {"ply": 0, "compressed-ply": 1 / 64, "spz": 9 / 256, "glb": 0, "splat": 1 / 255}
"""Largest error of an SH coefficient by format, which exceeds any other error of a colour; for
``splat``, which has none, of a base colour."""


def asymmetric_scene() -> Gaussians:
    """Three long ellipsoids of different lengths along x, y and z, each with a colour of its own
    that depends on where one looks from; no symmetry of the world leaves them as they are."""
    rng = np.random.default_rng(2)
    colors = np.array([[0.9, 0.2, 0.1], [0.1, 0.8, 0.3], [0.2, 0.3, 0.9]])
    return Gaussians(
        means=(FOCUS + np.diag([0.7, 0.5, 0.6])).astype(np.float32),
        quats=np.float32([[1, 0.1, 0, 0], [1, 0, 0.2, 0], [1, 0, 0.1, 0.3]]),
        log_scales=np.log(np.float32([[0.5, 0.1, 0.05], [0.1, 0.4, 0.2], [0.15, 0.07, 0.3]])),
        logit_opacities=np.float32([2, 1.5, 1]),
        sh0=((colors - 0.5) / 0.28209479177387814)[:, None].astype(np.float32),
        shN=rng.uniform(-0.35, 0.35, (3, 15, 3)).astype(np.float32),
    )


def rendered(gaussians: Gaussians, rotation: np.ndarray) -> np.ndarray:
    """Render by the float64 reference, from a camera turned about the origin."""
    pose = pose_around(0.7, 0.4)
    pose[:3] = rotation @ pose[:3]
    black = np.zeros((1, 1, 3), np.float32)
    return photograph(gaussians, view("a", pose, black), np.zeros(3)).image


def difference(found: np.ndarray, expected: np.ndarray) -> float:
    seen = expected.max(axis=2) > 0.1
    return float(np.sqrt(np.square(found - expected)[seen].mean()))


@pytest.mark.parametrize("each", readable_formats(), ids=lambda each: each.name)
@pytest.mark.filterwarnings("ignore:.*left out")
def test_scene_renders_the_same_in_the_axes_of_the_file(tmp_path, each):
    scene = asymmetric_scene()
    scene.save(tmp_path / f"a{each.value.suffix}")
    if not each.value.has_harmonics:
        scene = replace(scene, shN=scene.shN[:, :0])
    expected = rendered(scene, np.eye(3))
    _, arrays, _ = read_gaussians(tmp_path / f"a{each.value.suffix}")
    rotation = Z_TO_Y if each.value.up == "y" else np.eye(3)
    found = rendered(Gaussians(**arrays), rotation)
    # Rounding errors are uniform: of a third of their largest square; the squares of the 15
    # harmonics add up to 15 / (4 pi). Three times that, and what float32 leaves.
    limit = 3 * ROUNDING[each.name] * np.sqrt(15 / (4 * np.pi) / 3) + 1e-5
    assert difference(found, expected) <= limit
    again = rendered(Gaussians.load(tmp_path / f"a{each.value.suffix}"), np.eye(3))
    assert difference(again, expected) <= limit
    assert difference(rendered(scene, Z_TO_Y), expected) > 0.1  # what no turn would be
    if each.value.up == "y":
        unturned = Gaussians(**{**arrays, "shN": scene.shN})
        np.testing.assert_allclose(arrays["means"], scene.means @ Z_TO_Y.T, atol=1e-3)  # same rows
        assert difference(rendered(unturned, rotation), expected) > limit  # harmonics as before
