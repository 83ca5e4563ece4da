"""gsply, another reader and writer of compressed PLY and SPZ, finds the same numbers in files."""

import numpy as np
import pytest
from support.formats import FLOAT32, gaussians_within_ranges

from drgs.io.compressed_ply import CompressedPly
from drgs.io.spz import Spz

gsply = pytest.importorskip("gsply")

READERS = {
    ".compressed.ply": (gsply.plyread, CompressedPly().read),
    ".spz": (gsply.read_spz, Spz().read),
}


def assert_found_alike(path, degree):
    """Check that both readers agree, in the axes of the file; logits of opacities 0 and 1 are a
    choice."""
    theirs, ours = (read(path) for read in READERS["".join(path.suffixes[-2:])])
    ours = ours[0]
    pairs = {
        "means": (theirs.means, ours["means"]),
        "quats": (theirs.quats, ours["quats"]),
        "scales": (theirs.scales, ours["log_scales"]),
        "opacities": tuple(
            1 / (1 + np.exp(-np.asarray(logits, np.float64).ravel()))
            for logits in (theirs.opacities, ours["logit_opacities"])
        ),
        "sh0": (theirs.sh0, ours["sh0"][:, 0]),
    }
    if degree:
        pairs["shN"] = (theirs.shN, ours["shN"])
    for name, (expected, found) in pairs.items():
        # A few operations in float32 on numbers up to 10; gsply keeps opacities from 1e-6 on.
        np.testing.assert_allclose(found, expected, atol=40 * FLOAT32, err_msg=name)


@pytest.mark.parametrize("suffix", READERS)
@pytest.mark.parametrize("degree", [0, 3])
def test_our_files_are_read_by_it(tmp_path, suffix, degree):
    path = tmp_path / f"ours{suffix}"
    gaussians_within_ranges(degree=degree).save(path)
    assert_found_alike(path, degree)


@pytest.mark.parametrize("version", [3, 4])
def test_its_spz_files_are_read_here(tmp_path, version):
    if version == 4:
        pytest.importorskip("zstandard")
    gaussians_within_ranges().save(tmp_path / "ours.spz")
    path = tmp_path / "theirs.spz"
    gsply.write_spz(path, gsply.read_spz(tmp_path / "ours.spz"), version=version)
    assert_found_alike(path, 3)
