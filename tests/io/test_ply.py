from pathlib import Path

import numpy as np
import pytest
from plyfile import PlyData, PlyElement

from drgs.core.errors import UserError
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.io.ply import read_points


def random_gaussians(num, degree, seed=0):
    rng = np.random.default_rng(seed)
    shapes = {
        "means": (num, 3),
        "quats": (num, 4),
        "log_scales": (num, 3),
        "logit_opacities": (num,),
        "sh0": (num, 1, 3),
        "shN": (num, (degree + 1) ** 2 - 1, 3),
    }
    return Gaussians(**{k: rng.normal(size=s).astype(np.float32) for k, s in shapes.items()})


def write_elements(path, text=False, **elements):
    described = [PlyElement.describe(rows, name) for name, rows in elements.items()]
    PlyData(described, text=text).write(str(path))


def rows_of(columns):
    rows = np.zeros(len(next(iter(columns.values()))), [(n, v.dtype) for n, v in columns.items()])
    for name, values in columns.items():
        rows[name] = values
    return rows


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_written_gaussians_are_read_back_bitwise(tmp_path, degree):
    expected = random_gaussians(5, degree)
    expected.save(tmp_path / "a.ply")
    actual = Gaussians.load(tmp_path / "a.ply")
    assert actual.sh_degree == degree
    for name in PARAMETER_NAMES:
        values = getattr(actual, name)
        assert values.dtype == np.float32
        np.testing.assert_array_equal(values, getattr(expected, name), err_msg=name)


def test_a_file_without_gaussians_is_refused(tmp_path):
    random_gaussians(0, 3).save(tmp_path / "a.ply")
    with pytest.raises(UserError, match=r"vertex must have at least 1 row, .* has 0 of vertex$"):
        Gaussians.load(tmp_path / "a.ply")


def test_file_layout_matches_the_3dgs_reference(tmp_path):
    g = random_gaussians(2, 3)
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
    row = dict(zip(names, rows[1], strict=True))
    assert [row["nx"], row["ny"], row["nz"]] == [0, 0, 0]
    assert [row[f"f_dc_{c}"] for c in range(3)] == list(g.sh0[1, 0])
    # Channel-major: coefficient k of channel c is number 15 c + k.
    for c in range(3):
        for k in range(15):
            assert row[f"f_rest_{15 * c + k}"] == g.shN[1, k, c]
    assert row["opacity"] == g.logit_opacities[1]
    assert [row[f"scale_{i}"] for i in range(3)] == list(g.log_scales[1])
    assert [row[f"rot_{i}"] for i in range(4)] == list(g.quats[1])


def test_equal_gaussians_give_equal_bytes(tmp_path):
    for name in ("a", "b"):
        random_gaussians(7, 2).save(tmp_path / f"{name}.ply")
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()


@pytest.mark.parametrize("text", [False, True])
def test_properties_are_found_by_name_in_any_order_and_type(tmp_path, text):
    g = random_gaussians(3, 0)
    columns = {"rot_3": g.quats[:, 3].astype(np.float64), "extra": np.arange(3, dtype=np.uint8)}
    columns |= {f"rot_{i}": g.quats[:, i] for i in range(3)}
    columns |= {f"scale_{i}": g.log_scales[:, i] for i in range(3)}
    columns |= {f"f_dc_{i}": g.sh0[:, 0, i] for i in range(3)}
    columns |= {axis: g.means[:, i] for i, axis in enumerate("xyz")}
    columns["opacity"] = g.logit_opacities
    write_elements(tmp_path / "a.ply", text, vertex=rows_of(columns))
    actual = Gaussians.load(tmp_path / "a.ply")
    for name in PARAMETER_NAMES:
        # Text holds at least 8 digits: float32 values come back to 1 unit in the last place.
        np.testing.assert_allclose(getattr(actual, name), getattr(g, name), rtol=1.2e-7)


def without(tmp_path, *names):
    random_gaussians(1, 1).save(tmp_path / "full.ply")
    rows = PlyData.read(str(tmp_path / "full.ply"))["vertex"].data
    keep = [name for name in rows.dtype.names if name not in names]
    write_elements(tmp_path / "a.ply", vertex=rows_of({name: rows[name] for name in keep}))
    return tmp_path / "a.ply"


def test_missing_properties_are_named(tmp_path):
    path = without(tmp_path, "opacity", "rot_2")
    with pytest.raises(UserError) as error:
        Gaussians.load(path)
    assert str(error.value) == (
        f"{path}: not a PLY of Gaussians: properties opacity, rot_2 are missing"
    )


def test_a_wrong_number_of_coefficients_is_refused(tmp_path):
    path = without(tmp_path, "f_rest_8")
    with pytest.raises(UserError) as error:
        Gaussians.load(path)
    assert str(error.value) == (
        f"{path}: the number of f_rest properties must be one of [0, 9, 24, 45] "
        "(SH degree 0 to 3), got 8"
    )


@pytest.mark.parametrize("read", [Gaussians.load, read_points])
def test_unreadable_files_are_named(tmp_path, read):
    with pytest.raises(UserError, match=r"none.ply: cannot read the file: No such file"):
        read(tmp_path / "none.ply")
    (tmp_path / "text.ply").write_text("hello\n")
    with pytest.raises(UserError, match=r"text.ply: not a valid PLY file: "):
        read(tmp_path / "text.ply")
    (tmp_path / "bytes.ply").write_bytes(bytes(range(256)))
    with pytest.raises(UserError, match=r"bytes.ply: not a valid PLY file: "):
        read(tmp_path / "bytes.ply")
    random_gaussians(2, 0).save(tmp_path / "full.ply")
    (tmp_path / "short.ply").write_bytes((tmp_path / "full.ply").read_bytes()[:-4])
    with pytest.raises(UserError, match=r"short.ply: not a valid PLY file: "):
        read(tmp_path / "short.ply")
    write_elements(tmp_path / "faces.ply", face=np.zeros(1, [("a", "f4")]))
    with pytest.raises(UserError, match=r"faces.ply: element vertex must .* has 1 of face$"):
        read(tmp_path / "faces.ply")


def test_a_failed_write_leaves_the_old_file(tmp_path, monkeypatch):
    path = tmp_path / "a.ply"
    random_gaussians(1, 0).save(path)
    before = path.read_bytes()

    def fail(self, content):
        with self.open("wb") as file:
            file.write(content[:10])
        raise OSError("disk full")

    monkeypatch.setattr(Path, "write_bytes", fail)
    with pytest.raises(UserError, match=r"a.ply: cannot write the file: disk full"):
        random_gaussians(2, 0).save(path)
    assert path.read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["a.ply"]


def points(**colors):
    return rows_of({axis: np.array([0.5, -2], np.float64) for axis in "xyz"} | colors)


def channels(values):
    return {name: np.asarray(values) for name in ("red", "green", "blue")}


def test_points_without_colours_are_read(tmp_path):
    write_elements(tmp_path / "a.ply", vertex=points())
    positions, colors = read_points(tmp_path / "a.ply")
    np.testing.assert_array_equal(positions, [[0.5] * 3, [-2] * 3])
    assert colors is None


@pytest.mark.parametrize(
    "values",
    [
        *(np.array([255, 51], kind) for kind in ("u1", "i2", "i4", "u4")),
        *(np.array([65535, 13107], "u2"), np.array([1, 0.2], "f4")),
    ],
    ids=["uint8", "int16", "int32", "uint32", "uint16", "float32"],
)
def test_point_colours_are_scaled_to_0_1(tmp_path, values):
    write_elements(tmp_path / "a.ply", vertex=points(**channels(values)))
    _, colors = read_points(tmp_path / "a.ply")
    # One float32 division: half a unit in the last place.
    np.testing.assert_allclose(colors, [[1, 1, 1], [0.2, 0.2, 0.2]], rtol=6e-8)
    assert colors.dtype == np.float32


def test_point_colours_out_of_range_are_refused(tmp_path):
    write_elements(tmp_path / "a.ply", vertex=points(**channels(np.array([0, 255], "f4"))))
    expected = r"row 1: red must be an integer in 0..255 or a float in 0..1, got 255"
    with pytest.raises(UserError, match=expected):
        read_points(tmp_path / "a.ply")


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e39])
def test_nonfinite_points_are_refused(tmp_path, value):
    rows = points()
    rows["y"][1] = value
    write_elements(tmp_path / "a.ply", vertex=rows)
    with pytest.raises(UserError) as error:
        read_points(tmp_path / "a.ply")
    assert str(error.value) == (
        f"{tmp_path}/a.ply: element vertex, row 1: y must be finite, got {value}"
    )


def test_first_nonfinite_gaussian_is_named(tmp_path):
    g = random_gaussians(9, 1)
    g.quats[3, 2] = g.quats[5, 1] = -np.inf
    g.save(tmp_path / "a.ply")
    with pytest.raises(UserError) as error:
        Gaussians.load(tmp_path / "a.ply")
    assert str(error.value) == (
        f"{tmp_path}/a.ply: numbers must be finite: quats of Gaussian 3 is -inf; remove it"
    )


def test_unused_property_may_be_anything(tmp_path):
    write_elements(tmp_path / "a.ply", vertex=points(weight=np.full(2, np.nan)))
    assert len(read_points(tmp_path / "a.ply")[0]) == 2


@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
@pytest.mark.parametrize("change", [-1, 1], ids=["fewer", "more"])
def test_row_count_that_differs_from_the_header_is_refused(tmp_path, text, change):
    path = tmp_path / "a.ply"
    write_elements(path, text, vertex=points())
    content = path.read_bytes()
    path.write_bytes(content.replace(b"vertex 2", b"vertex %d" % (2 + change)))
    message = (
        "element vertex must have the 3 rows that the header promises, got 2: the file is cut off"
        if change > 0
        else r"must end after the rows that its header promises \(1 of vertex\), got \d+ bytes more"
    )
    with pytest.raises(UserError, match=message):
        read_points(path)


@pytest.mark.parametrize("count", [10**4, 10**12, 10**30])
@pytest.mark.parametrize("text", [False, True], ids=["binary", "text"])
def test_impossible_row_count_takes_no_memory(tmp_path, text, count):
    path = tmp_path / "a.ply"
    write_elements(path, text, vertex=points())
    path.write_bytes(path.read_bytes().replace(b"vertex 2", b"vertex %d" % count))
    with pytest.raises(UserError, match=rf"the {count:,} rows that the header promises, got"):
        read_points(path)


def test_a_header_without_an_end_is_refused(tmp_path):
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply\nformat ascii 1.0\n" + b"comment x\n" * 200_000)
    with pytest.raises(UserError, match="the header must end with end_header within the first"):
        read_points(path)


@pytest.mark.slow
def test_reading_and_writing_needs_no_libllvm(tmp_path, run_python):
    random_gaussians(2, 1).save(tmp_path / "a.ply")
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
