"""Fingerprints compare data by content, wherever it is stored."""

import shutil

import numpy as np
import pytest
from PIL import Image
from support.datasets import edit, load, put

from drgs.core.errors import UserError
from drgs.fit.fingerprint import Fingerprint, fingerprint_of

FRAME = "frames 4"  # of the file, in which the photographs are in reverse order: 05.png


@pytest.fixture
def folder(photographs):
    """Photographs with a lens, and one with a mask, a depth and a camera that moves."""
    Image.new("L", (8, 6), 255).save(photographs / "mask.png")
    np.save(photographs / "depth.npy", np.ones((6, 8)))

    def add_data(meta):
        frame = meta["frames"][4]
        frame.update(mask_path="mask.png", depth_file_path="depth.npy")
        frame["transform_matrix_close"] = [list(row) for row in frame["transform_matrix"]]
        meta["k1"] = 0.01

    edit(photographs / "transforms.json", add_data)
    return photographs


def test_moved_data_has_the_same_fingerprint(folder, tmp_path):
    there = shutil.copytree(folder, tmp_path / "there")
    here, there = (fingerprint_of(load(each)) for each in (folder, there))
    assert not here.differences(there)
    assert here == there == Fingerprint.from_bytes(here.to_bytes())
    assert len(here.train) + len(here.test) == 10


FRAME_CHANGES = [
    ("transform_matrix 1 3", 9, "camera"),
    ("k2", 0.5, "camera"),
    ("shutter", "rolling", "camera"),
    ("transform_matrix_close", None, "camera"),
    ("mask_path", None, "mask"),
    ("depth_file_path", None, "depth"),
]


@pytest.mark.parametrize(("key", "value", "what"), FRAME_CHANGES)
def test_changes_of_a_frame_are_named(folder, key, value, what):
    before = fingerprint_of(load(folder))
    put(folder / "transforms.json", f"{FRAME} {key}", value)
    assert before.differences(fingerprint_of(load(folder))) == [f"the {what} of training view 05"]


def test_contents_of_files_that_are_not_ignored_count(folder):
    settings, changed = {"ignore_masks": True, "ignore_depth": True}, []
    before, fewer = fingerprint_of(load(folder)), fingerprint_of(load(folder, **settings))
    for name, what in (("mask.png", "mask"), ("depth.npy", "depth"), ("images/05.png", "image")):
        assert not fewer.differences(fingerprint_of(load(folder, **settings)))
        with (folder / name).open("ab") as file:
            file.write(b"\0")
        changed.append(f"the {what} of training view 05")
        assert sorted(before.differences(fingerprint_of(load(folder)))) == sorted(changed)
    dataset = load(folder)
    (folder / "images" / "05.png").unlink()
    with pytest.raises(UserError, match=r"05\.png: cannot read the file: No such file"):
        fingerprint_of(dataset)


def test_size_changes_the_fingerprint_and_rounding_does_not(folder):
    before = fingerprint_of(load(folder))
    found = before.differences(fingerprint_of(load(folder, image_size=4)))
    assert "the size (8x6, now 4x3) of training view 05" in found and len(found) == 10
    x = load(folder).train[4].center[0]
    put(folder / "transforms.json", f"{FRAME} transform_matrix 0 3", x * (1 + 1e-14))
    assert not before.differences(fingerprint_of(load(folder)))


def test_unread_files_are_not_compared(folder):
    before = fingerprint_of(load(folder))
    shutil.copy(folder / "images" / "05.png", folder / "images" / "04.png")
    dataset = load(folder)
    for read, other in (({"04"}, ["04.png"]), ({"05"}, [])):
        now = fingerprint_of(dataset, read.__contains__)
        assert [path.name for path in before.other_files(dataset.train, now)] == other
        assert len(before.differences(now)) == len(other)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"train": [7], "test": []}', b"\xff"])
def test_other_text_is_not_a_fingerprint(content):
    with pytest.raises(ValueError, match="no fingerprint of data"):
        Fingerprint.from_bytes(content)
