"""Gaussians for the file formats, how precisely each format holds them, and refusals."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import pytest
from scipy.spatial import cKDTree

from drgs.core.errors import UserError
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.gaussians.similarity import Similarity

SH_C0 = 0.28209479177387814

Z_TO_Y = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From our z up to the y up of a file: right, up, back."""

FLOAT32 = 2.0**-23
"""One rounding and one of the next, relative: what comes through float32 arithmetic."""


def gaussians_within_ranges(num=600, degree=3, seed=0) -> Gaussians:
    """Such that no format has to cut anything off; 600: three groups of a compressed PLY.

    Harmonics: when a degree is turned, seven coefficients may add up to sqrt(7) 0.35 < 1.
    """
    rng = np.random.default_rng(seed)
    opacities = rng.uniform(0.02, 0.98, num)
    colors = rng.uniform(0, 1, (num, 1, 3))
    return Gaussians(
        means=rng.uniform(-2, 2, (num, 3)).astype(np.float32),
        quats=rng.normal(size=(num, 4)).astype(np.float32),
        log_scales=rng.uniform(-7, -1, (num, 3)).astype(np.float32),
        logit_opacities=np.log(opacities / (1 - opacities)).astype(np.float32),
        sh0=((colors - 0.5) / SH_C0).astype(np.float32),
        shN=rng.uniform(-0.35, 0.35, (num, (degree + 1) ** 2 - 1, 3)).astype(np.float32),
    )


@dataclass(frozen=True)
class Precision:
    """The largest differences that a format may make in :func:`gaussians_within_ranges`."""

    means: float
    quats: float  # see distance_of_ellipsoids
    log_scales: float
    opacities: float
    colors: float  # 0.5 + SH_C0 sh0
    harmonics: float


def half_step(span: float, bits: int) -> float:
    """Return half the largest rounding of a span in 2^bits - 1 steps, and of float32."""
    return span / (2**bits - 1) / 2 + 4 * FLOAT32


def smallest_three(step: float) -> float:
    """Distance of quaternions three of whose components are off by half a step each.

    The largest, w >= 1/2, follows from the other three, o with |o| <= sqrt(3) / 2:
    |dw| = |o . do| / w <= sqrt(3) |do|, so |dq| <= 2 |do| = sqrt(3) step.
    """
    return np.sqrt(3) * step + 4 * FLOAT32


PRECISION = {
    "ply": Precision(0, 4 * FLOAT32, 0, 4 * FLOAT32, 4 * FLOAT32, 0),
    "compressed-ply": Precision(
        means=half_step(4, 10),  # y has 10 bits, of at most the whole box
        quats=smallest_three(np.sqrt(2) / 1023),
        log_scales=half_step(6, 10),
        opacities=half_step(1, 8),
        colors=half_step(1, 8),
        harmonics=8 / 256 / 2 + 4 * FLOAT32,
    ),
    "spz": Precision(
        means=2.0**-13 / 2 + 4 * FLOAT32,  # 16 bits for less than 2^2 before the point, and a sign
        quats=smallest_three(1 / (np.sqrt(2) * 511)),
        log_scales=1 / 16 / 2 + 4 * FLOAT32,
        opacities=half_step(1, 8),
        colors=half_step(SH_C0 / 0.15, 8),
        # To 1/128, then to 5 of 8 bits. Turning back adds up to sqrt(7) of one row of a rotation.
        harmonics=np.sqrt(7) * (1 / 256 + 8 / 256) + 4 * FLOAT32,
    ),
    "glb": Precision(
        means=0,  # axes change their names and signs
        quats=8 * FLOAT32,
        log_scales=2 * FLOAT32 * 7,
        opacities=4 * FLOAT32,
        colors=0,
        harmonics=8 * FLOAT32,
    ),
    "sog": Precision(
        # 16 bits of log(1 + |x|), whose span is 2 log 3, and dx = (1 + |x|) d log(1 + |x|).
        means=3 * half_step(2 * np.log(3), 16),
        quats=smallest_three(np.sqrt(2) / 255),
        # Codebooks of 256 numbers for a few hundred: cells that are twice as wide as equal steps.
        log_scales=2 * half_step(6, 8),
        opacities=half_step(1, 8),
        colors=2 * half_step(1, 8),
        harmonics=2 * half_step(0.7, 8),
    ),
    "splat": Precision(
        means=0,
        # Four components off by 1/256, 1 itself by 1/128, before the quaternion is normalised.
        quats=2 * np.sqrt(3 / 256**2 + 1 / 128**2),
        log_scales=2 * FLOAT32 * 7,
        opacities=half_step(1, 8),
        colors=half_step(1, 8),
        harmonics=0,
    ),
}
PRECISION["usd"] = PRECISION["glb"]
"""Precision of each format, from its bits."""


def each_of(formats):
    """Return parameters of tests for formats; those of OpenUSD are skipped without it."""
    missing = pytest.mark.skipif(not find_spec("pxr"), reason="usd-core is not installed")
    return [pytest.param(f, id=f.name, marks=[missing] * (f.name == "usd")) for f in formats]


def turned(gaussians: Gaussians, rotation: np.ndarray) -> Gaussians:
    """All of them after x' = R x, by the package's own similarity, which has tests of its own."""
    return Similarity(1.0, np.asarray(rotation, np.float64), np.zeros(3)).of_gaussians(gaussians)


def matched(expected: Gaussians, found: Gaussians) -> Gaussians:
    """``found`` in the order of ``expected``, by the nearest mean; each is the nearest of one."""
    _, rows = cKDTree(found.means).query(expected.means)
    assert sorted(rows) == list(range(len(expected.means)))
    return Gaussians(**{name: getattr(found, name)[rows] for name in PARAMETER_NAMES})


def distance_of_ellipsoids(quats: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Distances (N,) of unit quaternions wxyz; half a turn about an ellipsoid's axis is none."""
    a, b = (
        q / np.linalg.norm(q, axis=1, keepdims=True)
        for q in (quats.astype(np.float64), others.astype(np.float64))
    )
    w, x, y, z = b.T
    turns = [(w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w)]  # b 1, b i, b j, b k
    apart = [np.linalg.norm(a - sign * np.array(t).T, axis=1) for t in turns for sign in (1, -1)]
    return np.min(apart, axis=0)


def assert_within(precision: Precision, expected: Gaussians, found: Gaussians) -> None:
    """Row by row; harmonics that ``found`` lacks are not looked at."""
    kept = found.shN.shape[1]
    differences = {
        "means": expected.means - found.means,
        "quats": distance_of_ellipsoids(expected.quats, found.quats),
        "log_scales": expected.log_scales - found.log_scales,
        "opacities": expected.opacities - found.opacities,
        "colors": SH_C0 * (expected.sh0 - found.sh0),
        "harmonics": expected.shN[:, :kept] - found.shN,
    }
    for name, difference in differences.items():
        worst = np.abs(difference).max(initial=0)
        assert worst <= getattr(precision, name), (name, worst)


def refusal(path, read=Gaussians.load) -> str:
    """Return the line that refuses a file, and contains its path, without the path at its start."""
    with pytest.raises(UserError) as error:
        read(path)
    (line,) = str(error.value).splitlines()
    assert str(path) in line and len(line) < 400
    return line.removeprefix(f"{path}: ")
