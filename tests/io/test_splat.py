"""``.splat``: rows of 32 bytes, the most important first, and what is refused by the byte."""

import struct

import numpy as np
import pytest
from support.formats import gaussians_within_ranges, refusal

from drgs.core.errors import UserNote
from drgs.gaussians.parameters import Gaussians


def row(
    mean=(1, 2, 3), scale=(0.5, 0.25, 0.125), rgba=(255, 0, 51, 204), quat=(128, 255, 128, 128)
):
    return struct.pack("<6f8B", *mean, *scale, *rgba, *quat)


def test_row_is_read_as_specified(tmp_path):
    others = row(scale=(0, 1, 1), rgba=(0, 0, 0, 255)) + row(rgba=(0, 0, 0, 0))
    (tmp_path / "a.splat").write_bytes(row() + others)
    found = Gaussians.load(tmp_path / "a.splat")
    np.testing.assert_array_equal(found.means[0], [1, 2, 3])
    np.testing.assert_allclose(found.scales[0], [0.5, 0.25, 0.125], rtol=1e-6)
    np.testing.assert_allclose(found.opacities[0], 0.8, rtol=1e-6)
    np.testing.assert_allclose(0.5 + 0.28209479 * found.sh0[0, 0], [1, 0, 0.2], atol=1e-6)
    np.testing.assert_allclose(found.quats[0], [0, 127 / 128, 0, 0])  # wxyz
    assert found.shN.shape == (3, 0, 3)
    assert found.scales[1, 0] <= 2 * np.finfo(np.float32).tiny
    assert 1 - 2.0**-22 < found.opacities[1] < 1
    assert 0 < found.opacities[2] <= 8 * np.finfo(np.float32).tiny


def test_rows_are_sorted_by_opacity_times_volume(tmp_path):
    gaussians = gaussians_within_ranges(100)
    with pytest.warns(UserNote, match=r"the format splat has no room for harmonics: left out"):
        gaussians.save(tmp_path / "a.splat")
    importance = gaussians.opacities * gaussians.scales.prod(axis=1)
    order = np.argsort(-importance)
    np.testing.assert_array_equal(
        Gaussians.load(tmp_path / "a.splat").means, gaussians.means[order]
    )


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "byte 0: the file must have 32 bytes for each Gaussian, at least one"),
        (row() + row()[:31], "byte 63: the file must have 32 bytes for each Gaussian"),
        (
            row() + row(mean=(0, np.nan, 0)),
            "mean of Gaussian 1 must be from -1e+12 to 1e+12, got n",
        ),
        (row(scale=(1, 1, -1)), "scale of Gaussian 0 must be from 0 to 1e+12, got -1.0"),
    ],
)
def test_incomplete_rows_are_refused(tmp_path, content, message):
    (tmp_path / "a.splat").write_bytes(content)
    assert refusal(tmp_path / "a.splat").startswith(message)
