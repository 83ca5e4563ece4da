"""PlayCanvas's splat-transform reads what is written here, and the other way round.

Its tests run where ``splat-transform`` is found: ``npm install -g @playcanvas/splat-transform``, or
the environment variable DRGS_SPLAT_TRANSFORM with the path of its ``cli.mjs``.
"""

import os
import shutil
import subprocess
from dataclasses import replace

import numpy as np
import pytest
from support.formats import (
    FLOAT32,
    PRECISION,
    assert_within,
    gaussians_within_ranges,
    matched,
    turned,
)

from drgs.gaussians.parameters import Gaussians

CLI = os.environ.get("DRGS_SPLAT_TRANSFORM") or shutil.which("splat-transform")

pytestmark = [
    pytest.mark.skipif(
        not CLI or not shutil.which("node"),
        reason="splat-transform is not here (npm, or DRGS_SPLAT_TRANSFORM=cli.mjs)",
    ),
    pytest.mark.filterwarnings("ignore:.*left out"),
]

Z_TO_Y = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])

RIGHT_DOWN_FORWARD = np.diag([1, -1, -1])
"""Turns right, up, back, as SPZ has it, into what it takes PLY files for."""

HALF_TURN = np.diag([-1, -1, 1])
"""Rotation by splat-transform when it converts PLY files."""

ALIKE = replace(
    PRECISION["glb"], means=4 * FLOAT32, quats=1e-6, colors=4 * FLOAT32, harmonics=16 * FLOAT32
)
"""The same numbers, through two programs' arithmetic in float32."""

READ = {
    ".compressed.ply": (np.eye(3), ALIKE),
    ".splat": (
        np.eye(3),
        replace(ALIKE, quats=PRECISION["splat"].quats),
    ),  # divides by 255, not 256
    ".spz": (RIGHT_DOWN_FORWARD @ Z_TO_Y, ALIKE),
}
"""Rotation from our world to that of the converted PLY file, and precision, by suffix."""

COARSE = replace(
    PRECISION["spz"],
    means=2.0**-12 / 2 + 4 * FLOAT32,  # always 12 bits behind the point
    harmonics=np.sqrt(7) * (1 / 256 + 16 / 256) + 4 * FLOAT32,  # 4 of 8 bits
)

WRITTEN = {
    ".compressed.ply": ([], np.eye(3), PRECISION["compressed-ply"]),
    ".spz of version 3": (["--spz-version", "3"], (RIGHT_DOWN_FORWARD @ Z_TO_Y).T, COARSE),
    ".spz of version 4": (["--spz-version", "4"], (RIGHT_DOWN_FORWARD @ Z_TO_Y).T, COARSE),
    ".glb": ([], Z_TO_Y.T @ HALF_TURN, ALIKE),
}
"""Options, rotation from the world of a PLY file to ours after conversion, and precision."""


def convert(*arguments) -> None:
    command = ["node", CLI, "--overwrite", "--quiet", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize("suffix", READ)
def test_our_files_are_read_by_it(tmp_path, suffix):
    rotation, precision = READ[suffix]
    path = tmp_path / f"ours{suffix}"
    gaussians_within_ranges().save(path)
    convert(path, tmp_path / "theirs.ply")
    expected = turned(Gaussians.load(path), rotation)
    assert_within(precision, expected, matched(expected, Gaussians.load(tmp_path / "theirs.ply")))


@pytest.mark.parametrize("case", WRITTEN)
def test_its_files_are_read_here(tmp_path, case):
    if "4" in case:
        pytest.importorskip("zstandard")
    options, rotation, precision = WRITTEN[case]
    path = tmp_path / f"theirs{case.split()[0]}"
    gaussians_within_ranges().save(tmp_path / "ours.ply")
    convert(tmp_path / "ours.ply", path, *options)
    expected = turned(Gaussians.load(tmp_path / "ours.ply"), rotation)
    assert_within(precision, expected, matched(expected, Gaussians.load(path)))
