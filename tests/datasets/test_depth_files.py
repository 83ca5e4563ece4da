"""Files of depth that lie about what they hold."""

import io
import os

import numpy as np
import pytest

from drgs.core.errors import UserError
from drgs.datasets.images import read_depth


def header(shape):
    stream = io.BytesIO()
    description = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, description)
    return stream.getvalue()


def archive():
    stream = io.BytesIO()
    np.savez(stream, a=np.ones(3))
    return stream.getvalue()


UNREADABLE, NO_NUMBERS = "cannot read the depth: ", "depth must be (height, width) real numbers"

INVALID_DEPTHS = {
    "of 8 TB": (header((10**6, 10**6)), UNREADABLE),
    "of more than there is": (header((2**40, 2**40)), UNREADABLE),
    "cut off": (header((4, 6)) + bytes(80), UNREADABLE),
    "no numbers": (b"hello", UNREADABLE),
    "empty": (b"", UNREADABLE),
    "of objects": (np.full((4, 6), None), UNREADABLE),
    "of several arrays": (archive(), NO_NUMBERS),
    "of text": (np.full((4, 6), "x"), NO_NUMBERS),
    "complex": (np.ones((4, 6), complex), NO_NUMBERS),
    "of records": (np.ones((4, 6), [("a", "f4")]), NO_NUMBERS),
    "of colours": (np.ones((4, 6, 3)), NO_NUMBERS),
    "of another size": (np.ones((6, 4)), "must be 6 x 4 px"),
    "a pipe": (None, f"{UNREADABLE}must be a regular file, got a named pipe"),
}


@pytest.mark.parametrize(("content", "message"), INVALID_DEPTHS.values(), ids=INVALID_DEPTHS)
def test_invalid_depth_file_is_refused_in_one_line(tmp_path, content, message):
    path = tmp_path / "a.npy"
    if content is None:
        os.mkfifo(path)
    elif isinstance(content, bytes):
        path.write_bytes(content)
    else:
        np.save(path, content)
    with pytest.raises(UserError) as error:
        read_depth(path, 1.0, (6, 4))
    assert f"{path}: {message}" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["f2", "f4", "f8", ">f4", "u1", "i4"])
def test_depth_of_any_real_type_is_read(tmp_path, kind):
    values = np.arange(24).reshape(4, 6).astype(kind)
    for array in (values, values[:, :, None]):
        np.save(tmp_path / "a.npy", array)
        depth = read_depth(tmp_path / "a.npy", 0.5, (6, 4))
        np.testing.assert_array_equal(depth, values.astype(np.float32) / 2)
