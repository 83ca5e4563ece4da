"""``.ksplat``: each compression level, sections, buckets, and what is refused by the byte."""

import numpy as np
import pytest
from support.attacks.mutations import mutate_bytes
from support.formats import (
    FLOAT32,
    PRECISION,
    Precision,
    assert_within,
    gaussians_within_ranges,
    half_step,
    refusal,
)
from support.ksplat import BLOCK, HIGH, LOW, RANGE, content_of

from drgs.core.errors import UserError
from drgs.gaussians.parameters import Gaussians

HALF = 2.0**-11  # half of float16's step, relative

LEVELS = {
    0: Precision(
        0, 8 * FLOAT32, 16 * FLOAT32, half_step(1, 8), half_step(1, 8), harmonics=4 * FLOAT32
    ),
    1: Precision(
        means=BLOCK / 2 / RANGE / 2 + 8 * FLOAT32,
        quats=2 * HALF,
        log_scales=2 * HALF,
        opacities=half_step(1, 8),
        colors=half_step(1, 8),
        harmonics=0.35 * HALF,
    ),
}
LEVELS[2] = Precision(**{**vars(LEVELS[1]), "harmonics": half_step(HIGH - LOW, 8)})


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("level", LEVELS)
def test_levels_are_read_within_their_precision(tmp_path, level, degree):
    gaussians = gaussians_within_ranges(30, degree)
    (tmp_path / "a.ksplat").write_bytes(content_of([(gaussians, 3)], level))
    assert_within(LEVELS[level], gaussians, Gaussians.load(tmp_path / "a.ksplat"))


def test_sections_of_several_degrees_are_joined(tmp_path):
    parts = [gaussians_within_ranges(9, degree, seed=degree) for degree in (1, 0, 2)]
    (tmp_path / "a.ksplat").write_bytes(content_of([(g, 1) for g in parts], 0))
    found = Gaussians.load(tmp_path / "a.ksplat")
    np.testing.assert_array_equal(found.means, np.concatenate([g.means for g in parts]))
    assert found.sh_degree == 2
    np.testing.assert_allclose(found.shN[:9, :3], parts[0].shN, rtol=1e-6)
    np.testing.assert_allclose(found.shN[18:], parts[2].shN, rtol=1e-6)
    assert not found.shN[:9, 3:].any() and not found.shN[9:18].any()


FIRST, DATA = 4096, 4096 + 1024


@pytest.mark.parametrize(
    ("at", "data", "message"),
    [
        (0, b"\1", "byte 0: version 0.1 of .ksplat was expected, got 1.1; the file is damaged"),
        (4, b"\0\0\1", "byte 4: 65,536 headers of sections was expected, got"),
        (16, b"\x13", "byte 16: the number of Gaussians in sections, 20, at least 1 was expected"),
        (20, b"\3", "byte 20: a compression level from 0 to 2 was expected, got 3"),
        (FIRST, b"\x15", "byte 5,120: a section of 21 Gaussians in"),
        (FIRST + 4, b"\xff", "byte 5,120: a section of 255 Gaussians in"),
        (FIRST + 12, b"\1", "byte 4,104: buckets of 12 bytes, of which 2 are full and 1 not was"),
        (FIRST + 40, b"\4", "byte 4,136: a degree of harmonics from 0 to 3 was expected, got 4"),
        (DATA, b"\1", "byte 5,120: room for 20 Gaussians in buckets was expected, got 15"),
        (DATA + 4, b"\0\0\xc0\x7f", "means of Gaussian 0 must be finite, got nan"),
    ],
)
def test_wrong_numbers_are_refused(tmp_path, at, data, message):
    content = bytearray(content_of([(gaussians_within_ranges(20, 1), 2)], 1))
    content[at : at + len(data)] = data
    (tmp_path / "a.ksplat").write_bytes(content)
    assert refusal(tmp_path / "a.ksplat").startswith(message)


def test_damaged_and_short_files_are_read_or_refused(tmp_path):
    path, content = tmp_path / "a.ksplat", content_of([(gaussians_within_ranges(20, 1), 2)], 1)
    for end in range(0, len(content), 397):
        path.write_bytes(content[:end])
        assert refusal(path)
    for seed in range(40):
        path.write_bytes(mutate_bytes(np.random.default_rng(seed), content))
        try:
            found = Gaussians.load(path)
        except UserError:
            continue
        assert np.isfinite(found.means).all() and np.isfinite(found.log_scales).all()


def test_it_is_not_written(tmp_path):
    with pytest.raises(UserError, match="files of this format can be read, but not written"):
        gaussians_within_ranges(2).save(tmp_path / "a.ksplat")
    assert "ksplat" not in PRECISION and not list(tmp_path.iterdir())
