"""PLY files: ours, which are the reference's, and those of others, damaged and hostile ones."""

import os
import resource
from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement
from support.formats import gaussians_within_ranges

from drgs.core.errors import UserError, UserNote
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.io.ply import read_points

POINTS = np.array([(1, 2, 3), (4, 5, 6)], [(name, "f4") for name in "xyz"])
MESH = np.array([(0, [1, 2]), (0, [3])], [("flag", "u1"), ("vertex_indices", object)])
LITTLE, TEXT = b"ply\nformat binary_little_endian 1.0\n", b"ply\nformat ascii 1.0\n"
XYZ = b"property float x\nproperty float y\nproperty float z\n"


def write(path, text=False, **elements):
    described = [PlyElement.describe(rows, name) for name, rows in elements.items()]
    PlyData(described, text=text).write(str(path))


def rows_of(columns):
    rows = np.zeros(len(next(iter(columns.values()))), [(n, v.dtype) for n, v in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    return rows


def points_with(**columns):
    """Two points with further columns."""
    return rows_of({axis: np.array(POINTS[axis]) for axis in "xyz"} | columns)


def columns_of(gaussians):
    """Columns of a file, in another order than ours, one of float64 and one that is not read."""
    g = gaussians
    columns = {"rot_3": g.quats[:, 3].astype(np.float64), "extra": np.full(len(g.means), np.nan)}
    columns |= {f"rot_{i}": g.quats[:, i] for i in range(3)}
    columns |= {f"scale_{i}": g.log_scales[:, i] for i in range(3)}
    columns |= {f"f_dc_{i}": g.sh0[:, 0, i] for i in range(3)}
    columns |= {axis: g.means[:, i] for i, axis in enumerate("xyz")}
    return columns | {"opacity": g.logit_opacities}


def refusal(path, read=Gaussians.load):
    with pytest.raises(UserError) as error:
        read(path)
    assert "\n" not in str(error.value) and len(str(error.value)) < 500
    return str(error.value).removeprefix(f"{path}: ")


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_written_gaussians_are_read_back_bitwise(tmp_path, degree):
    expected = gaussians_within_ranges(5, degree)
    expected.save(tmp_path / "a.ply")
    actual = Gaussians.load(str(tmp_path / "a.ply"))
    assert actual.sh_degree == degree
    for name in PARAMETER_NAMES:
        values = getattr(actual, name)
        assert values.dtype == np.float32
        np.testing.assert_array_equal(values, getattr(expected, name), err_msg=name)


def test_file_layout_matches_the_3dgs_reference(tmp_path):
    g = gaussians_within_ranges(2, 3)
    g.save(tmp_path / "a.ply")
    content = (tmp_path / "a.ply").read_bytes()
    # The order of construct_list_of_attributes in the reference's scene/gaussian_model.py.
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(45)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 2\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    assert content[: len(header)].decode() == header
    rows = np.frombuffer(content[len(header) :], "<f4").reshape(2, len(names))
    # Harmonics are channel-major: coefficient k of channel c is number 15 c + k.
    rest = g.shN.transpose(0, 2, 1).reshape(2, 45)
    columns = [g.means, 0 * g.means, g.sh0[:, 0], rest, g.logit_opacities[:, None]]
    np.testing.assert_array_equal(rows, np.hstack([*columns, g.log_scales, g.quats]))


@pytest.mark.parametrize("text", [False, True])
def test_properties_are_found_by_name_in_any_order_and_type(tmp_path, text):
    g = gaussians_within_ranges(3, 0)
    write(tmp_path / "a.ply", text, vertex=rows_of(columns_of(g)))
    actual = Gaussians.load(tmp_path / "a.ply")
    for name in PARAMETER_NAMES:
        # Text holds at least 8 digits: float32 values come back to 1 unit in the last place.
        np.testing.assert_allclose(getattr(actual, name), getattr(g, name), rtol=1.2e-7)


def test_missing_properties_are_named(tmp_path):
    columns = columns_of(gaussians_within_ranges(3, 0))
    del columns["opacity"], columns["rot_2"]
    write(tmp_path / "a.ply", vertex=rows_of(columns))
    message = "not a PLY of Gaussians: properties opacity, rot_2 are missing"
    assert refusal(tmp_path / "a.ply") == message


def test_a_wrong_number_of_coefficients_is_refused(tmp_path):
    columns = columns_of(gaussians_within_ranges(3, 0))
    columns |= {f"f_rest_{i}": np.zeros(3) for i in range(8)}
    write(tmp_path / "a.ply", vertex=rows_of(columns))
    message = "the number of f_rest properties must be one of [0, 9, 24, 45] (SH degree 0 to 3), "
    assert refusal(tmp_path / "a.ply") == f"{message}got 8"


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("quats", -np.inf, "numbers must be finite: quats of Gaussian 3 is -inf; remove it"),
        ("logit_opacities", np.nan, "numbers must be finite: logit_opacities of Gaussian 3 is nan"),
    ],
)
def test_first_nonfinite_gaussian_is_named(tmp_path, name, value, message):
    g = gaussians_within_ranges(9, 1)
    getattr(g, name)[[3, 5]] = value
    g.save(tmp_path / "a.ply")
    assert refusal(tmp_path / "a.ply").startswith(message)


def test_infinite_logits_become_opacities_distinct_from_0_and_1(tmp_path):
    """Files that went through SPZ or compressed PLY contain opacities 0 and 255 of 8 bits."""
    path, g = tmp_path / "a.ply", gaussians_within_ranges(5)
    g.logit_opacities[:] = [0.5, np.inf, -np.inf, np.inf, 1e30]
    g.save(path)
    with pytest.warns(UserNote) as notes:
        loaded = Gaussians.load(path)
    assert str(notes[0].message).startswith(f"{path}: 3 of 5 opacities are infinite logits")
    logits = loaded.logit_opacities
    assert logits.dtype == np.float32 and logits[1] == logits[3]
    np.testing.assert_array_equal(logits[[0, 4]], np.float32([0.5, 1e30]))  # as they are
    assert 1 - 2.0**-22 < loaded.opacities[1] < 1
    assert np.finfo(np.float32).tiny <= loaded.opacities[2] < 1e-37


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    gaussians_within_ranges(1).save(path)
    before = path.read_bytes()

    def fail(self, content):
        with self.open("wb") as file:
            file.write(content[:10])
        raise OSError("disk full")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(UserError, match=r"a.ply: cannot write the file: disk full"):
        gaussians_within_ranges(2).save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


@pytest.mark.parametrize(
    "values",
    [
        *(np.array([255, 51], kind) for kind in ("u1", "i2", "i4", "u4")),
        *(np.array([65535, 13107], "u2"), np.array([1, 0.2], "f4"), None),
    ],
    ids=["uint8", "int16", "int32", "uint32", "uint16", "float32", "none"],
)
def test_points_are_read_with_their_colours_of_any_type(tmp_path, values):
    columns = {} if values is None else dict.fromkeys(("red", "green", "blue"), values)
    write(tmp_path / "a.ply", vertex=points_with(weight=np.full(2, np.nan), **columns))
    positions, colors = read_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(positions, [[1, 2, 3], [4, 5, 6]])
    if values is None:
        assert colors is None
    else:
        # One float32 division: half a unit in the last place.
        np.testing.assert_allclose(colors, [[1, 1, 1], [0.2, 0.2, 0.2]], rtol=6e-8)
        assert colors.dtype == np.float32


@pytest.mark.parametrize(
    ("name", "values", "message"),
    [
        *(("y", [0, v], f"y must be finite, got {v}") for v in (np.nan, np.inf, 1e39)),
        ("red", [0, 255], "red must be an integer in 0..255 or a float in 0..1, got 255"),
    ],
)
def test_invalid_points_are_refused_by_their_row(tmp_path, name, values, message):
    colors = dict.fromkeys(("red", "green", "blue"), np.zeros(2))
    write(tmp_path / "a.ply", vertex=points_with(**colors | {name: np.array(values, float)}))
    refused = refusal(tmp_path / "a.ply", read_points)
    assert refused.startswith(f"element vertex, row 1: {message}")


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize(
    "elements",
    [
        {"vertex": POINTS, "face": MESH},
        {"camera": np.zeros(3, [("f", "f8"), ("n", "u1")]), "vertex": POINTS},
        {"face": MESH, "vertex": POINTS},
    ],
    ids=["lists after", "numbers before", "lists before"],
)
def test_other_elements_are_skipped(tmp_path, text, elements):
    write(tmp_path / "a.ply", text, **elements)
    if next(iter(elements)) == "face" and not text:  # the rows of a text are lines
        message = "element vertex must "
        refused = refusal(tmp_path / "a.ply", read_points)
        assert refused.startswith(message) and "come before elements that have; " in refused
    else:
        positions, _ = read_points(tmp_path / "a.ply")
        np.testing.assert_array_equal(positions, [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize("line_end", ["\r\n", "\r", "\n"])
@pytest.mark.parametrize("order", ["<", ">"])
def test_all_line_ends_and_byte_orders_are_read(tmp_path, line_end, order):
    name = {"<": "little", ">": "big"}[order]
    header = f"ply\nformat binary_{name}_endian 1.0\ncomment end_header\nelement vertex 2\n"
    header += XYZ.decode() + "end_header\n"
    rows = POINTS.astype([(axis, f"{order}f4") for axis in "xyz"]).tobytes()
    (tmp_path / "a.ply").write_bytes(header.replace("\n", line_end).encode() + rows)
    np.testing.assert_array_equal(read_points(tmp_path / "a.ply")[0], [[1, 2, 3], [4, 5, 6]])


def binary_points(count):
    return LITTLE + b"element vertex %d\n" % count + XYZ + b"end_header\n" + POINTS.tobytes()


def text_points(count):
    return TEXT + b"element vertex %d\n" % count + XYZ + b"end_header\n1 2 3\n4 5 6\n"


NOT_VALID = "not a valid PLY file: "
CUT_OFF = "element vertex must have the {:,} rows that the header promises, got "
TOO_LONG = "must end after the rows that its header promises (1 of vertex), got "

DAMAGED = {
    "text": (b"hello\n", NOT_VALID),
    "bytes": (bytes(range(256)), NOT_VALID),
    "cut off": (binary_points(2)[:-4], NOT_VALID),
    "no end of the header": (
        TEXT + b"comment x\n" * 200_000,
        "the header must end with end_header within the first",
    ),
    "no vertices": (
        LITTLE + b"element face 1\nproperty float a\nend_header\n" + bytes(4),
        "element vertex must have at least 1 row, no lists, and come before elements that have; "
        "the file has 1 of face",
    ),
    "no rows": (binary_points(0)[:-24], "element vertex must have at least 1 row"),
    "a negative count": (text_points(-1), ""),
    "a count of a word": (TEXT + b"element vertex x\n" + XYZ + b"end_header\n1 2 3\n", ""),
    "a count of 5000 digits": (
        TEXT + b"element vertex " + b"9" * 5000 + b"\n" + XYZ + b"end_header\n1 2 3\n",
        "",
    ),
    **{
        f"{count} of 2 rows, {kind}": (
            points(count),
            TOO_LONG if count < 2 else CUT_OFF.format(count),
        )
        for count in (1, 3, 10**4, 10**12, 10**30)
        for kind, points in (("binary", binary_points), ("text", text_points))
    },
}


@pytest.mark.parametrize(("content", "message"), DAMAGED.values(), ids=DAMAGED)
def test_damaged_file_is_refused_in_one_line(tmp_path, content, message):
    (tmp_path / "a.ply").write_bytes(content)
    for read in (Gaussians.load, read_points):
        assert message in refusal(tmp_path / "a.ply", read)


def test_missing_file_and_pipe_are_refused(tmp_path):
    assert refusal(tmp_path / "a.ply").startswith("cannot read the file: No such file")
    os.mkfifo(tmp_path / "a.ply")
    assert "must be a regular file, got a named pipe" in refusal(tmp_path / "a.ply")


def test_lists_allocate_no_memory(tmp_path):
    """4 MB of empty lists became 4.9 GB of objects."""
    lists = b"".join(b"property list uchar uchar l%d\n" % i for i in range(300))
    header = LITTLE + b"element vertex 13000\n" + XYZ + lists + b"end_header\n"
    (tmp_path / "vertices.ply").write_bytes(header + bytes(13_000 * (12 + 300)))
    header = LITTLE + b"element vertex 1\n" + XYZ + b"element face 4000000\n"
    header += b"property list uchar int vertex_indices\nend_header\n"
    (tmp_path / "faces.ply").write_bytes(header + bytes(12 + 4_000_000))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    message = "element vertex must have at least 1 row, no lists, and"
    assert refusal(tmp_path / "vertices.ply", read_points).startswith(message)
    assert read_points(tmp_path / "faces.ply")[0].shape == (1, 3)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB


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


@pytest.mark.parametrize("name", ["ply", "compressed-ply"])
def test_malformed_headers_are_refused(tmp_path, name):
    header, end, rows = gaussians_within_ranges(300, 1).to_bytes(name).partition(b"end_header\n")
    lines = (header + end).splitlines()
    edits = dict(edited_headers(lines))
    assert len(edits) > 3 * len(lines)
    if name == "compressed-ply":
        at = [index for index, line in enumerate(lines) if line.startswith(b"element")]
        last = lines[at[-1] : -1]
        edits["reordered"] = [*lines[: at[0]], *last, *lines[at[0] : at[-1]], lines[-1]]
    for edit, edited in edits.items():
        (tmp_path / "a.ply").write_bytes(b"\n".join([*edited, b""]) + rows)
        assert refusal(tmp_path / "a.ply"), edit


@pytest.mark.slow
def test_reading_and_writing_needs_no_libllvm(tmp_path, run_python):
    gaussians_within_ranges(2, 1).save(tmp_path / "a.ply")
    code = f"""
import drjit as dr
from drgs.gaussians.parameters import Gaussians
from drgs.io.ply import read_points
assert dr.detail.llvm_version()[0] == -1, "this test must run without a libLLVM"
Gaussians.load({str(tmp_path / "a.ply")!r}).save({str(tmp_path / "b.ply")!r})
print(read_points({str(tmp_path / "b.ply")!r})[0].shape)
"""
    result = run_python(code, DRJIT_LIBLLVM_PATH="/nonexistent")
    assert (result.returncode, result.stdout) == (0, "(2, 3)\n"), result.stderr
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
