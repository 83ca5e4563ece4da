"""Files of depth that lie about what they hold."""

import io
import os

import numpy as np
import pytest

from drgs.core.errors import UserError
from drgs.datasets.images import read_depth


def header(shape, kind="<f8"):
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": kind, "fortran_order": False, "shape": shape}
    )
    return stream.getvalue()


def write_several_arrays(path):
    with path.open("wb") as file:
        np.savez(file, a=np.ones(3))


INVALID_DEPTHS = {
    "of 8 TB": (lambda p: p.write_bytes(header((10**6, 10**6))), "cannot read the depth"),
    "of more than there is": (lambda p: p.write_bytes(header((2**40, 2**40))), "cannot read the"),
    "cut off": (lambda p: p.write_bytes(header((4, 6)) + bytes(80)), "cannot read the depth"),
    "of another size": (lambda p: np.save(p, np.ones((6, 4))), "must be 6 x 4 px"),
    "of text": (lambda p: np.save(p, np.full((4, 6), "x")), "depth must be (height, width)"),
    "complex": (
        lambda p: np.save(p, np.ones((4, 6), complex)),
        "depth must be (height, width)",
    ),
    "of records": (
        lambda p: np.save(p, np.ones((4, 6), [("a", "f4")])),
        "depth must be (height, width)",
    ),
    "of objects": (lambda p: np.save(p, np.full((4, 6), None)), "cannot read the depth"),
    "of several arrays": (
        write_several_arrays,
        "depth must be (height, width)",
    ),
    "no numbers": (lambda p: p.write_bytes(b"hello"), "cannot read the depth"),
    "empty": (lambda p: p.write_bytes(b""), "cannot read the depth"),
    "a pipe": (os.mkfifo, "cannot read the depth: must be a regular file, got a named pipe"),
}


@pytest.mark.parametrize(("make", "message"), INVALID_DEPTHS.values(), ids=INVALID_DEPTHS)
def test_invalid_depth_file_is_refused_in_one_line(tmp_path, make, message):
    make(tmp_path / "a.npy")
    with pytest.raises(UserError) as error:
        read_depth(tmp_path / "a.npy", 1.0, (6, 4))
    assert f"{tmp_path}/a.npy: {message}" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["f2", "f4", "f8", ">f4", "u1", "i4"])
def test_depth_of_any_real_type_is_read(tmp_path, kind):
    values = np.arange(24).reshape(4, 6).astype(kind)
    for array in (values, values[:, :, None]):
        np.save(tmp_path / "a.npy", array)
        depth = read_depth(tmp_path / "a.npy", 0.5, (6, 4))
        np.testing.assert_array_equal(depth, values.astype(np.float32) / 2)
