"""PLY files of others: lists, infinite logits, pipes, and more rows than the file holds."""

import os
import resource
import time
import warnings

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from support.formats import gaussians_within_ranges

from drgs.core.errors import UserError, UserNote
from drgs.gaussians.parameters import Gaussians
from drgs.io.ply import read_points

POINTS = np.array([(1, 2, 3), (4, 5, 6)], [(name, "f4") for name in "xyz"])


def gaussians_with(logits):
    num = len(logits)
    return Gaussians(
        means=np.zeros((num, 3), np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (num, 1)),
        log_scales=np.zeros((num, 3), np.float32),
        logit_opacities=np.float32(logits),
        sh0=np.zeros((num, 1, 3), np.float32),
        shN=np.zeros((num, 0, 3), np.float32),
    )


# Infinite logits


def test_infinite_logits_become_opacities_distinct_from_0_and_1(tmp_path):
    """Files that went through SPZ or compressed PLY contain opacities 0 and 255 of 8 bits."""
    path = tmp_path / "a.ply"
    gaussians_with([0.5, np.inf, -np.inf, np.inf, 80.0]).save(path)
    with pytest.warns(UserNote) as notes:
        loaded = Gaussians.load(path)
    assert str(notes[0].message).startswith(f"{path}: 3 of 5 opacities are infinite logits")
    logits = loaded.logit_opacities
    assert logits.dtype == np.float32
    np.testing.assert_array_equal(logits[[0, 4]], np.float32([0.5, 80]))  # as they are
    assert logits[1] == logits[3]
    one, less = loaded.opacities[1], np.nextafter(np.float32(1), np.float32(0))
    assert 1 - 2.0**-22 < one < 1 and less < 1
    assert np.finfo(np.float32).tiny <= loaded.opacities[2] < 1e-37


def test_finite_logits_are_read_without_a_note(tmp_path):
    gaussians_with([0.5, -80.0, 1e30, -1e30]).save(tmp_path / "a.ply")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        loaded = Gaussians.load(tmp_path / "a.ply")
        opacities = loaded.opacities
    np.testing.assert_array_equal(loaded.logit_opacities, np.float32([0.5, -80, 1e30, -1e30]))
    np.testing.assert_array_equal(opacities[2:], [1, 0])


def test_nan_opacity_is_refused(tmp_path):
    gaussians_with([np.inf, np.nan]).save(tmp_path / "a.ply")
    with pytest.raises(UserError, match=r"finite: logit_opacities of Gaussian 1 is nan"):
        Gaussians.load(tmp_path / "a.ply")


# Lists


def lists(count):
    """Rows of an element that holds lists."""
    rows = np.empty(count, [("vertex_indices", object)])
    for row in range(count):
        rows["vertex_indices"][row] = np.arange(row + 1, dtype=np.int32)
    return PlyElement.describe(rows, "face")


def test_vertices_of_a_mesh_are_read(tmp_path):
    vertices = PlyElement.describe(POINTS, "vertex")
    for text in (False, True):
        PlyData([vertices, lists(3)], text=text).write(str(tmp_path / "a.ply"))
        np.testing.assert_array_equal(
            read_points(tmp_path / "a.ply")[0], [[1, 2, 3], [4, 5, 6]], err_msg=f"text {text}"
        )


def test_elements_before_the_vertices_are_skipped(tmp_path):
    cameras = PlyElement.describe(np.zeros(3, [("f", "f8"), ("n", "u1")]), "camera")
    vertices = PlyElement.describe(POINTS, "vertex")
    for text in (False, True):
        PlyData([cameras, vertices], text=text).write(str(tmp_path / "a.ply"))
        np.testing.assert_array_equal(read_points(tmp_path / "a.ply")[0], [[1, 2, 3], [4, 5, 6]])
    PlyData([lists(1), vertices], text=True).write(str(tmp_path / "a.ply"))
    assert len(read_points(tmp_path / "a.ply")[0]) == 2  # rows of a text are lines
    PlyData([lists(1), vertices]).write(str(tmp_path / "a.ply"))
    with pytest.raises(UserError, match=r"element vertex must .* come before elements that have; "):
        read_points(tmp_path / "a.ply")


@pytest.mark.parametrize("line_end", ["\r\n", "\r", "\n"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_all_line_ends_and_byte_orders_are_read(tmp_path, line_end, order):
    name = {"<": "little", ">": "big"}[order]
    header = f"ply\nformat binary_{name}_endian 1.0\ncomment end_header\nelement vertex 2\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    rows = POINTS.astype([(axis, f"{order}f4") for axis in "xyz"]).tobytes()
    (tmp_path / "a.ply").write_bytes(header.replace("\n", line_end).encode() + rows)
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply")[0], [[1, 2, 3], [4, 5, 6]])


def test_vertices_with_lists_are_refused_before_allocation(tmp_path):
    """4 MB of empty lists became 4.9 GB of objects."""
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 13000\n"
    header += b"".join(b"property float %s\n" % axis for axis in (b"x", b"y", b"z"))
    header += b"".join(b"property list uchar uchar l%d\n" % i for i in range(300))
    content = header + b"end_header\n" + bytes(13_000 * (12 + 300))
    (tmp_path / "a.ply").write_bytes(content)
    before, started = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.perf_counter()
    with pytest.raises(UserError, match="element vertex must have at least 1 row, no lists, and"):
        read_points(tmp_path / "a.ply")
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown < 50_000 and time.perf_counter() - started < 2  # kB


def test_faces_allocate_no_memory(tmp_path):
    """Elements that are not needed are not made into objects."""
    header = b"ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
    header += b"".join(b"property float %s\n" % axis for axis in (b"x", b"y", b"z"))
    header += b"element face 4000000\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_bytes(header + bytes(12 + 4_000_000))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert read_points(tmp_path / "a.ply")[0].shape == (1, 3)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


# Headers that say something else than what follows


def edited_headers(lines):
    """Return headers, by edit, of a structure that the rows do not have, or of none."""
    for at, line in enumerate(lines):
        word, *words = line.split()
        if words[:1] != [b"sh"]:  # without it, its properties are the vertices': another file
            yield f"without {line}", lines[:at] + lines[at + 1 :]
        yield f"twice {line}", [*lines[: at + 1], *lines[at:]]
        others = []
        if word == b"property":
            others = [b"list uchar %s %s" % tuple(words), b"double %s" % words[1]]
        if word == b"element":
            others = [b"%s %s" % (words[0], n) for n in (b"1", b"299", b"301", b"99999999999")]
        for other in others:
            yield f"{line} as {other}", [*lines[:at], word + b" " + other, *lines[at + 1 :]]


def elements_reordered(lines):
    at = [index for index, line in enumerate(lines) if line.startswith(b"element")]
    return [*lines[: at[0]], *lines[at[-1] : -1], *lines[at[0] : at[-1]], lines[-1]]


@pytest.mark.parametrize("name", ["ply", "compressed-ply"])
def test_malformed_headers_are_refused(tmp_path, name):
    path = tmp_path / "a.ply"
    header, end, rows = gaussians_within_ranges(300, 1).to_bytes(name).partition(b"end_header\n")
    lines = (header + end).splitlines()
    edits = dict(edited_headers(lines))
    assert len(edits) > 3 * len(lines)
    if name == "compressed-ply":
        edits["reordered"] = elements_reordered(lines)
    for done, edited in edits.items():
        path.write_bytes(b"\n".join([*edited, b""]) + rows)
        with pytest.raises(UserError) as error:
            Gaussians.load(path)
            pytest.fail(f"read: {done}")
        assert str(error.value).startswith(f"{path}: ") and "\n" not in str(error.value), done


# Other files


def test_pipe_is_refused_without_blocking(tmp_path):
    os.mkfifo(tmp_path / "a.ply")
    with pytest.raises(UserError, match="must be a regular file, got a named pipe"):
        read_points(tmp_path / "a.ply")


@pytest.mark.parametrize("count", ["-1", "0", "x", "9" * 5000])
def test_invalid_counts_are_refused(tmp_path, count):
    header = f"ply\nformat ascii 1.0\nelement vertex {count}\nproperty float x\nend_header\n1\n"
    (tmp_path / "a.ply").write_text(header)
    with pytest.raises(UserError, match=r"a.ply: ") as error:
        read_points(tmp_path / "a.ply")
    assert "\n" not in str(error.value) and len(str(error.value)) < 500
