"""PLY files: ours, which are the reference's, those of others, damaged and hostile ones; and the
settings that a header records."""

import resource
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from drjit.llvm.ad import TensorXf
from plyfile import PlyData, PlyElement
from support.formats import gaussians_within_ranges, refusal

from drgs.config.approximations import from_ply_header
from drgs.core.errors import UserNote
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
    return np.rec.fromarrays(list(columns.values()), names=list(columns))


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


@pytest.mark.parametrize("degree", range(4))
def test_file_has_the_layout_of_the_3dgs_reference_and_is_read_back_bitwise(tmp_path, degree):
    g = gaussians_within_ranges(5, degree)
    g.save(tmp_path / "a.ply")
    content = (tmp_path / "a.ply").read_bytes()
    num_rest = 3 * g.shN.shape[1]
    # The order of construct_list_of_attributes in the reference's scene/gaussian_model.py.
    names = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"]
    names += [f"f_rest_{i}" for i in range(num_rest)]
    names += ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 5\n"
    header += "".join(f"property float {name}\n" for name in names) + "end_header\n"
    assert content[: len(header)].decode() == header
    rows = np.frombuffer(content[len(header) :], "<f4").reshape(5, len(names))
    # Harmonics are channel-major: of degree 3, coefficient k of channel c is number 15 c + k.
    rest = g.shN.transpose(0, 2, 1).reshape(5, num_rest)
    columns = [g.means, 0 * g.means, g.sh0[:, 0], rest, g.logit_opacities[:, None]]
    np.testing.assert_array_equal(rows, np.hstack([*columns, g.log_scales, g.quats]))
    found = Gaussians.load(str(tmp_path / "a.ply"))
    for name in PARAMETER_NAMES:
        np.testing.assert_array_equal(getattr(found, name), getattr(g, name), err_msg=name)
        assert getattr(found, name).dtype == np.float32


@pytest.mark.parametrize("text", [False, True])
def test_properties_are_found_by_name_in_any_order_and_type(tmp_path, text):
    g = gaussians_within_ranges(3, 0)
    write(tmp_path / "a.ply", text, vertex=rows_of(columns_of(g)))
    actual = Gaussians.load(tmp_path / "a.ply")
    for name in PARAMETER_NAMES:
        # Text holds at least 8 digits: float32 values come back to 1 unit in the last place.
        np.testing.assert_allclose(getattr(actual, name), getattr(g, name), rtol=1.2e-7)


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        (
            {"opacity": None, "rot_2": None},
            "not a PLY of Gaussians: properties opacity, rot_2 are missing",
        ),
        (
            {f"f_rest_{i}": np.zeros(3) for i in range(8)},
            "the number of f_rest properties must be one of [0, 9, 24, 45] (SH degree 0 to 3), "
            "got 8",
        ),
    ],
)
def test_missing_properties_and_a_wrong_number_of_them_are_refused(tmp_path, columns, message):
    columns = columns_of(gaussians_within_ranges(3, 0)) | columns
    columns = {name: values for name, values in columns.items() if values is not None}
    write(tmp_path / "a.ply", vertex=rows_of(columns))
    assert refusal(tmp_path / "a.ply") == message


def test_infinite_logits_become_opacities_distinct_from_0_and_1(tmp_path):
    """Files that went through SPZ or compressed PLY contain opacities 0 and 255 of 8 bits."""
    path, g = tmp_path / "a.ply", gaussians_within_ranges(5)
    g.logit_opacities[:] = [0.5, np.inf, np.nan, np.nan, 1e30]
    g.save(path)
    with pytest.warns(UserNote):
        message = "logit_opacities of Gaussian 2 must be finite, got nan; correct or remove it"
        assert refusal(path) == message
    g.logit_opacities[2:4] = -np.inf, np.inf
    g.save(path)
    with pytest.warns(UserNote) as notes:
        loaded = Gaussians.load(path)
    assert str(notes[0].message).startswith(f"{path}: 3 of 5 opacities are infinite logits")
    logits = loaded.logit_opacities
    assert logits.dtype == np.float32 and logits[1] == logits[3]
    np.testing.assert_array_equal(logits[[0, 4]], np.float32([0.5, 1e30]))  # as they are
    assert 1 - 2.0**-22 < loaded.opacities[1] < 1
    assert np.finfo(np.float32).tiny <= loaded.opacities[2] < 1e-37


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
    if next(iter(elements)) == "face":
        refused = refusal(tmp_path / "a.ply", read_points)
        assert refused.startswith("element vertex must have at least 1 row, no lists, and come")
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
        "come before elements that have; the file has 1 of face",
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


def test_lists_allocate_no_memory(tmp_path):
    """4 MB of empty lists became 4.9 GB of objects."""
    header = LITTLE + b"element vertex 1\n" + XYZ + b"element face 4000000\n"
    header += b"property list uchar int vertex_indices\nend_header\n"
    (tmp_path / "faces.ply").write_bytes(header + bytes(12 + 4_000_000))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
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
    content = gaussians_within_ranges(300, 1).to_bytes(name)
    (tmp_path / "a.ply").write_bytes(content)
    assert Gaussians.load(tmp_path / "a.ply").num_gaussians == 300  # whatever its suffix
    header, end, rows = content.partition(b"end_header\n")
    lines = (header + end).splitlines()
    edits = dict(edited_headers(lines))
    if name == "compressed-ply":
        first, *_, last = (at for at, line in enumerate(lines) if line.startswith(b"element"))
        edits["reordered"] = [*lines[:first], *lines[last:-1], *lines[first:last], lines[-1]]
        lists = [b"element foo 1", b"property list uchar int bar"]  # whose end is unknown
        edits["harmonics after lists"] = [*lines[:last], *lists, *lines[last:]]
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


# Settings that a header records

VALUES = {
    "antialiased": True,
    "low_pass": 0.1,
    "order_window": 8,
    "projection": "exact",
    "alpha_cut": 1 / 255,
    "extent": np.inf,
}
LINES = [
    b"comment drgs antialiased true",
    b"comment drgs low_pass 0.1",
    b"comment drgs order_window 8",
    b"comment drgs projection exact",
    b"comment drgs alpha_cut 0.00392156862745098",
    b"comment drgs extent inf",
]


def with_lines(path, *lines):
    """A file of Gaussians whose header has these lines."""
    content = gaussians_within_ranges(2).to_bytes("ply").removeprefix(LITTLE)
    path.write_bytes(LITTLE + b"".join(line + b"\n" for line in lines) + content)
    return path


def test_each_value_is_a_comment_and_is_read_back_with_its_type(tmp_path):
    replace(gaussians_within_ranges(2), rendered_with=VALUES).save(tmp_path / "a.ply")
    expected = with_lines(tmp_path / "b.ply", *LINES, b"comment SplatRenderMode: mip").read_bytes()
    assert (tmp_path / "a.ply").read_bytes() == expected
    found = Gaussians.load(tmp_path / "a.ply")
    assert found.rendered_with == VALUES
    assert [type(v) for v in found.rendered_with.values()] == [bool, float, int, str, float, float]
    assert from_ply_header("a.ply", found.rendered_with) == VALUES
    assert found.to(TensorXf).numpy().rendered_with == VALUES


@pytest.mark.parametrize(
    ("lines", "expected"),
    [
        ([b"comment SplatRenderMode: mip"], {"antialiased": True}),
        ([b"comment splatrendermode:mip "], {"antialiased": True}),
        ([b"comment Postshot v1.0.0", b"comment postshot.anti_aliasing=1"], {"antialiased": True}),
        ([b"comment antialiased 1"], {"antialiased": True}),
        ([b"comment SplatRenderMode: default"], None),
        ([b"comment postshot.anti_aliasing=0"], None),
        (
            [b"comment SplatRenderMode: mip", b"comment drgs antialiased false"],
            {"antialiased": False},
        ),
    ],
)
def test_marks_of_other_programs_are_read_as_antialiased(tmp_path, lines, expected):
    assert Gaussians.load(with_lines(tmp_path / "a.ply", *lines)).rendered_with == expected


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply"])
@pytest.mark.parametrize("values", [VALUES, {"low_pass": 0.1}, {"antialiased": False}])
def test_antialiased_is_marked_for_other_programs(tmp_path, suffix, values):
    path = tmp_path / f"a{suffix}"
    replace(gaussians_within_ranges(2), rendered_with=values).save(path)
    marked = b"\ncomment SplatRenderMode: mip\n" in path.read_bytes()
    assert marked == (values is VALUES)


@pytest.mark.parametrize(
    "line",
    [
        b"comment Generated by somebody else",
        b"comment drgs",
        b"comment drgs low_pass",
        b"comment drgs low_pass 0.1 px",
        b"comment drgs Low-Pass 0.1",
        b"comment drgs " + b"a" * 41 + b" 1",
        b"comment drgs low_pass " + b"1" * 41,
        b"comment drgs low_pass \x1b[2J\x07",
        b"obj_info drgs low_pass 0.1",
        b"comment drgs __class__ 1",
    ],
)
def test_other_comments_are_ignored(tmp_path, line):
    assert Gaussians.load(with_lines(tmp_path / "a.ply", line)).rendered_with is None


def test_contradictory_values_are_refused(tmp_path):
    path = with_lines(tmp_path / "a.ply", LINES[1], LINES[1])
    assert Gaussians.load(path).rendered_with == {"low_pass": 0.1}
    with_lines(path, LINES[1], b"comment drgs low_pass 0.2")
    message = "the header's comments must give low_pass once, got 0.1 and 0.2; remove one of the"
    assert refusal(path).startswith(message)


@pytest.mark.parametrize(
    ("name", "text", "expected"),
    [
        ("low_pass", "-1", "finite and not negative, got -1.0"),
        ("low_pass", "nan", "finite and not negative, got nan"),
        ("low_pass", "1e999", "finite and not negative, got inf"),
        ("low_pass", "true", "finite and not negative, got True"),
        ("order_window", "9" * 40, f"from 1 to 64, got {'9' * 40}"),
        ("order_window", "4.0", "from 1 to 64, got 4.0"),
        ("antialiased", "1", "true or false, got 1"),
        ("projection", "fish", "one of ewa, exact, unscented (others come with installed packages"),
        ("alpha_max", "0.99999999999", "above 0 and below 1 in float32, got 0.99999999999"),
    ],
)
def test_values_outside_their_limits_are_refused_on_use(tmp_path, name, text, expected):
    path = with_lines(tmp_path / "a.ply", f"comment drgs {name} {text}".encode())
    values = Gaussians.load(path).rendered_with  # reading the Gaussians does not depend on it
    refused = refusal(path, lambda path: from_ply_header(str(path), values))
    assert refused.startswith(f"the header's {name} must be {expected}")
    assert refused.endswith("; correct the line, or remove it")


def test_unknown_names_are_noted_in_a_line_however_many_they_are(tmp_path):
    names = ["".join(letters) for letters in product("abcdefghijklmnopqrst", repeat=3)]
    lines = [f"comment drgs {name} 1".encode() for name in ("low_pas", *names)]
    path = with_lines(tmp_path / "a.ply", *lines)
    with pytest.warns(UserNote) as notes:
        assert from_ply_header(str(path), Gaussians.load(path).rendered_with) == {}
    (note,) = notes
    assert str(note.message) == (
        f"{path}: specifies low_pas, aaa, aab and 7,998 more, which is not known here and "
        "ignored; did you mean low_pass?"
    )


@pytest.mark.parametrize(
    ("name", "value"), [("a b", 1), ("low_pass", "0.1\nelement face 1"), ("A", 1)]
)
def test_values_that_a_comment_cannot_hold_are_not_written(tmp_path, name, value):
    with pytest.raises(ValueError, match="must be names and values of one word"):
        replace(gaussians_within_ranges(2), rendered_with={name: value}).save(tmp_path / "a.ply")
    assert not list(tmp_path.iterdir())
