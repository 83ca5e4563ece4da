"""SPZ: versions, steps of positions, flags, extensions, and what is refused by the byte."""

import gzip
import struct
import sys
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from support.formats import FLOAT32, distance_of_ellipsoids, gaussians_within_ranges, refusal

from drgs.core.errors import UserError, UserNote
from drgs.gaussians.parameters import Gaussians
from drgs.io.spz import Spz

VERSION, NUM, DEGREE, BITS, FLAGS = 4, 8, 12, 13, 14  # bytes of the header


def unpacked(gaussians):
    return bytearray(gzip.decompress(gaussians.to_bytes("spz")))


def written(path, content):
    path.write_bytes(gzip.compress(bytes(content)))
    return path


def with_largest_coordinate(size):
    gaussians = gaussians_within_ranges(20)
    gaussians.means[:] *= size / np.abs(gaussians.means).max()
    return gaussians


@pytest.mark.parametrize(
    ("size", "bits"),
    [(1e-6, 24), (0.9, 16), (1.0, 15), (15.9, 12), (2000, 12), (3000, 11), (8.3e6, 0)],
)
def test_fractional_bits_of_positions_depend_on_the_scene_size(tmp_path, size, bits):
    gaussians = with_largest_coordinate(size)
    gaussians.save(tmp_path / "a.spz")
    assert unpacked(gaussians)[BITS] == bits
    found = Gaussians.load(tmp_path / "a.spz")
    # Half a step; a whole one at the end of the range, which has one more number below zero.
    half = 2.0**-bits / 2 + FLOAT32 * size
    assert np.abs(found.means - gaussians.means).max() <= 2 * half
    assert np.median(np.abs(found.means - gaussians.means)) <= half / 2 * 1.5


def test_positions_beyond_24_bits_are_refused():
    with pytest.raises(UserError, match=r"positions of at most 8,388,608, got 1e\+07"):
        with_largest_coordinate(1e7).to_bytes("spz")


def test_scales_beyond_their_range_are_cut_off_or_refused_if_they_are_most():
    log_scales = np.full((30, 3), -5, np.float32)
    small = replace(gaussians_within_ranges(30), log_scales=log_scales - 8)
    with pytest.raises(UserError, match=r"from 4.5e-05 to 379, and those of 30 of 30 Gaussians"):
        small.to_bytes("spz")
    few, thin = log_scales.copy(), log_scales.copy()
    few[:3] = -12
    with pytest.warns(UserNote, match="those of 3 of 30 Gaussians are outside: cut off"):
        replace(small, log_scales=few).to_bytes("spz")
    thin[:, 0] = -12  # flat Gaussians are a little thicker, which nobody sees
    replace(small, log_scales=thin).to_bytes("spz")


def test_rotations_of_version_2_are_three_bytes(tmp_path):
    gaussians = gaussians_within_ranges(50, degree=0)
    content = unpacked(gaussians)
    arrays, _ = Spz().read(written(tmp_path / "a.spz", content))
    w, x, y, z = arrays["quats"].T * np.sign(arrays["quats"][:, 0])
    xyz = np.floor(np.column_stack([x, y, z]) * 127.5 + 128).clip(0, 255).astype("u1")
    start = 16 + 50 * (9 + 1 + 3 + 3)
    content[start : start + 50 * 4] = xyz.tobytes()
    content[VERSION] = 2
    found, _ = Spz().read(written(tmp_path / "b.spz", content))
    # Half a step of 1 / 127.5 in each; the fourth follows, the less precisely the smaller it is.
    amplified = np.sqrt(3) / 255 / np.maximum(np.abs(w), 0.1)
    assert (distance_of_ellipsoids(arrays["quats"], found["quats"]) <= 2 * amplified).all()


@pytest.mark.parametrize("values", [{"antialiased": True}, None])
def test_antialiasing_is_stored_as_a_flag(tmp_path, values):
    gaussians = replace(gaussians_within_ranges(5), rendered_with=values)
    gaussians.save(tmp_path / "a.spz")
    assert Gaussians.load(tmp_path / "a.spz").rendered_with == values
    assert unpacked(gaussians)[FLAGS] == (1 if values else 0)


def test_extensions_are_skipped(tmp_path):
    content = unpacked(gaussians_within_ranges(5))
    expected, _ = Spz().read(written(tmp_path / "a.spz", content))
    path = written(tmp_path / "b.spz", content + b"of a vendor" * 99)
    assert "the end was expected after 5 Gaussians" in refusal(path)
    content[FLAGS] |= 2
    with pytest.warns(UserNote, match=r"b.spz: has extensions of a vendor, which are passed over"):
        found, _ = Spz().read(written(path, content + b"of a vendor" * 99))
    assert all((found[name] == expected[name]).all() for name in expected)


def test_harmonics_of_degree_4_are_read_to_degree_3(tmp_path):
    content = unpacked(gaussians_within_ranges(5))
    expected, _ = Spz().read(written(tmp_path / "a.spz", content))
    rows = np.frombuffer(bytes(content[-5 * 45 :]), "u1").reshape(5, 45)
    longer = np.concatenate([rows, np.full((5, 27), 7, "u1")], axis=1)  # 9 coefficients more
    content[-5 * 45 :] = longer.tobytes()
    content[DEGREE] = 4
    with pytest.warns(UserNote, match=r"b.spz: harmonics of degree 4: read to degree 3"):
        found, _ = Spz().read(written(tmp_path / "b.spz", content))
    assert all((found[name] == expected[name]).all() for name in expected)


@pytest.mark.parametrize(
    ("at", "data", "message"),
    [
        (0, b"XGSP", "byte 0: the header must begin with NGSP, got b'XGSP'"),
        (VERSION, struct.pack("<I", 1), "byte 0: the version must be from 2 to 3, got 1"),
        (NUM, struct.pack("<I", 0), "byte 0: the number of Gaussians must be from 1 to"),
        (NUM, struct.pack("<I", 2**31), "a scene of 2,147,483,648 Gaussians takes about"),
        (NUM, struct.pack("<I", 6), "byte 136 of the unpacked stream: 270 bytes were expected"),
        (DEGREE, b"\5", "byte 0: the degree of harmonics must be from 0 to 4, got 5"),
        (BITS, b"\x19", "byte 0: the number of fractional bits of positions must be from 0 to 24"),
    ],
)
def test_a_wrong_header_is_refused(tmp_path, at, data, message):
    content = unpacked(gaussians_within_ranges(5))
    content[at : at + len(data)] = data
    assert refusal(written(tmp_path / "a.spz", content)).startswith(message)


def test_wrong_checksum_and_trailing_bytes_are_refused(tmp_path):
    content = gaussians_within_ranges(5).to_bytes("spz")
    (tmp_path / "a.spz").write_bytes(content[:-8] + b"1234" + content[-4:])
    assert "the gzip stream is damaged" in refusal(tmp_path / "a.spz")
    (tmp_path / "a.spz").write_bytes(content + b"more")
    assert "the gzip stream is damaged: Not a gzipped file" in refusal(tmp_path / "a.spz")


def test_a_grid_of_equal_gaussians_is_read(tmp_path):
    """It is packed so tightly that its size alone does not tell that it is damaged."""
    grid = np.stack(np.meshgrid(*[np.arange(30) / 10] * 3), axis=-1).reshape(-1, 3)
    one = gaussians_within_ranges(1)
    names = ("quats", "log_scales", "logit_opacities", "sh0", "shN")
    same = {n: np.repeat(getattr(one, n), len(grid), axis=0) for n in names}
    Gaussians(means=grid.astype(np.float32), **same).save(tmp_path / "a.spz")
    assert (tmp_path / "a.spz").stat().st_size * 20 < 65 * len(grid)
    found = Gaussians.load(tmp_path / "a.spz").means
    np.testing.assert_allclose(found, grid, atol=2.0**-13 + FLOAT32 * 3)


def streams_of(gaussians, compress) -> bytes:
    """A file of version 4: attribute by attribute, in a stream each."""
    content = unpacked(gaussians)
    num, degree = len(gaussians.means), content[DEGREE]
    ends = 16 + num * np.cumsum([0, 9, 1, 3, 3, 4, 3 * ((degree + 1) ** 2 - 1)])
    parts = [bytes(content[a:b]) for a, b in pairwise(ends) if b > a]
    packed = [compress(part) for part in parts]
    header = bytes(content[:4]) + struct.pack("<I", 4) + bytes(content[8:15])
    header += bytes([len(parts)]) + struct.pack("<I12x", 32)
    table = [struct.pack("<QQ", len(p), len(part)) for p, part in zip(packed, parts, strict=True)]
    return b"".join([header, *table, *packed])


@pytest.mark.parametrize("degree", [0, 2])
def test_version_4_contains_the_same_gaussians(tmp_path, degree):
    zstandard = pytest.importorskip("zstandard")
    gaussians = gaussians_within_ranges(2, degree)
    (tmp_path / "a.spz").write_bytes(gaussians.to_bytes("spz"))
    content = streams_of(gaussians, zstandard.ZstdCompressor().compress)
    (tmp_path / "b.spz").write_bytes(content)
    (expected, _), (found, _) = (Spz().read(tmp_path / name) for name in ("a.spz", "b.spz"))
    assert all((found[name] == expected[name]).all() for name in expected)
    for end in range(len(content)):
        (tmp_path / "b.spz").write_bytes(content[:end])
        assert refusal(tmp_path / "b.spz").startswith("byte ")


def test_version_4_without_zstandard_reports_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "zstandard", None)
    (tmp_path / "a.spz").write_bytes(streams_of(gaussians_within_ranges(2), bytes))
    message = "version 4: needs zstandard, which is not installed; pip install 'drgs[spz]'"
    assert refusal(tmp_path / "a.spz").endswith(message)
