"""gsply and PlayCanvas's splat-transform find the same numbers in files, and the other way round.

Tests of the latter run where ``splat-transform`` is found: ``npm install -g
@playcanvas/splat-transform``, or the environment variable DRGS_SPLAT_TRANSFORM with the path of its
``cli.mjs``.
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
    Z_TO_Y,
    Precision,
    assert_within,
    gaussians_within_ranges,
    matched,
    turned,
)
from support.ksplat import content_of

from drgs.gaussians.parameters import Gaussians
from drgs.io.compressed_ply import CompressedPly
from drgs.io.spz import Spz

CLI = os.environ.get("DRGS_SPLAT_TRANSFORM") or shutil.which("splat-transform")

splat_transform = pytest.mark.skipif(
    not CLI or not shutil.which("node"),
    reason="splat-transform is not here (npm, or DRGS_SPLAT_TRANSFORM=cli.mjs)",
)

pytestmark = pytest.mark.filterwarnings("ignore:.*left out")

SAME = np.eye(3)
SPZ_WORLD = np.diag([1, -1, -1]) @ Z_TO_Y
"""From our world to right, up, back, as SPZ has it, and on to right, down, forward, as
splat-transform takes PLY files to be."""

HALF_TURN = np.diag([-1, -1, 1])
"""Rotation by splat-transform when it converts PLY files."""

ALIKE = replace(
    PRECISION["glb"], means=4 * FLOAT32, quats=1e-6, colors=4 * FLOAT32, harmonics=16 * FLOAT32
)
"""The same numbers, through two programs' arithmetic in float32."""

COARSE = replace(
    PRECISION["spz"],
    means=2.0**-12 / 2 + 4 * FLOAT32,  # always 12 bits behind the point
    harmonics=np.sqrt(7) * (1 / 256 + 16 / 256) + 4 * FLOAT32,  # 4 of 8 bits
)

TRUNCATED = replace(
    PRECISION["sog"],
    **{name: 2 * getattr(PRECISION["sog"], name) for name in ("means", "quats", "opacities")},
    harmonics=0.7,  # its palette has 512 entries for 600 Gaussians
)
"""Values cut off where ours are rounded."""


def convert(*arguments) -> None:
    command = ["node", CLI, "--overwrite", "--quiet", *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stdout + done.stderr


@splat_transform
@pytest.mark.parametrize(
    ("suffix", "rotation", "precision"),  # from our world to that of the converted PLY file
    [
        (".compressed.ply", SAME, ALIKE),
        (".splat", SAME, replace(ALIKE, quats=PRECISION["splat"].quats)),  # it divides by 255
        (".spz", SPZ_WORLD, ALIKE),
        (".sog", SAME, ALIKE),
    ],
)
def test_our_files_are_read_by_splat_transform(tmp_path, suffix, rotation, precision):
    path = tmp_path / f"ours{suffix}"
    gaussians_within_ranges().save(path)
    convert(path, tmp_path / "theirs.ply")
    expected = turned(Gaussians.load(path), rotation)
    assert_within(precision, expected, matched(expected, Gaussians.load(tmp_path / "theirs.ply")))


@splat_transform
@pytest.mark.parametrize(
    ("suffix", "options", "rotation", "precision"),  # from the world of a PLY file to ours
    [
        (".compressed.ply", [], SAME, PRECISION["compressed-ply"]),
        (".spz", ["--spz-version", "3"], SPZ_WORLD.T, COARSE),
        (".spz", ["--spz-version", "4"], SPZ_WORLD.T, COARSE),
        (".sog", ["--gpu", "cpu"], SAME, TRUNCATED),
        (".glb", [], Z_TO_Y.T @ HALF_TURN, ALIKE),
    ],
)
def test_files_of_splat_transform_are_read(tmp_path, suffix, options, rotation, precision):
    if "4" in options:
        pytest.importorskip("zstandard")
    path = tmp_path / f"theirs{suffix}"
    gaussians_within_ranges().save(tmp_path / "ours.ply")
    convert(tmp_path / "ours.ply", path, *options)
    expected = turned(Gaussians.load(tmp_path / "ours.ply"), rotation)
    assert_within(precision, expected, matched(expected, Gaussians.load(path)))


@splat_transform
@pytest.mark.parametrize("level", [0, 1, 2])
def test_ksplat_files_are_read_as_splat_transform_reads_them(tmp_path, level):
    gaussians = gaussians_within_ranges(100, degree=2)
    (tmp_path / "a.ksplat").write_bytes(content_of([(gaussians, 5)], level))
    convert(tmp_path / "a.ksplat", tmp_path / "theirs.ply")
    found, expected = (Gaussians.load(tmp_path / name) for name in ("a.ksplat", "theirs.ply"))
    assert_within(ALIKE, expected, matched(expected, found))


FLOATS = Precision(*(40 * FLOAT32,) * 4, 10 * FLOAT32, 40 * FLOAT32)
"""A few operations in float32 on numbers up to 10; gsply keeps opacities from 1e-6 on."""


def assert_found_alike(theirs, ours):
    """Check that both readers agree, in the axes of the file; logits of opacities 0 and 1 are a
    choice."""
    expected = Gaussians(
        means=theirs.means,
        quats=theirs.quats,
        log_scales=theirs.scales,
        logit_opacities=np.ravel(theirs.opacities),
        sh0=theirs.sh0[:, None],
        shN=theirs.shN if ours["shN"].size else ours["shN"],
    )
    assert_within(FLOATS, expected, Gaussians(**ours))


@pytest.mark.parametrize("degree", [0, 3])
def test_our_files_are_read_by_gsply(tmp_path, degree):
    gsply = pytest.importorskip("gsply")
    for suffix, theirs, ours in (
        (".compressed.ply", gsply.plyread, CompressedPly()),
        (".spz", gsply.read_spz, Spz()),
    ):
        path = tmp_path / f"ours{suffix}"
        gaussians_within_ranges(degree=degree).save(path)
        assert_found_alike(theirs(path), ours.read(path)[0])


@pytest.mark.parametrize("version", [3, 4])
def test_spz_files_of_gsply_are_read(tmp_path, version):
    gsply = pytest.importorskip("gsply")
    if version == 4:
        pytest.importorskip("zstandard")
    gaussians_within_ranges().save(tmp_path / "ours.spz")
    path = tmp_path / "theirs.spz"
    gsply.write_spz(path, gsply.read_spz(tmp_path / "ours.spz"), version=version)
    assert_found_alike(gsply.read_spz(path), Spz().read(path)[0])
