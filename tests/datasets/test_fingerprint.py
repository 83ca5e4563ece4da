"""Fingerprints compare data by content, wherever it is stored."""

import json
import shutil

import numpy as np
import pytest
from PIL import Image
from support.datasets import load

from drgs.core.errors import UserError
from drgs.datasets.fingerprint import Fingerprint, fingerprint_of


@pytest.fixture
def rich(photographs):
    """Photographs with a lens, and one with a mask, a depth and a camera that moves."""
    Image.new("L", (8, 6), 255).save(photographs / "mask.png")
    np.save(photographs / "depth.npy", np.ones((6, 8)))
    frame = {"mask_path": "mask.png", "depth_file_path": "depth.npy"}
    change(photographs, lambda meta: meta.update(k1=0.01))
    change(photographs, lambda meta: meta["frames"][4].update(frame))
    close = json.loads((photographs / "transforms.json").read_text())["frames"][4]
    close = {"transform_matrix_close": close["transform_matrix"]}
    change(photographs, lambda meta: meta["frames"][4].update(close))
    return photographs


def change(folder, function):
    path = folder / "transforms.json"
    meta = json.loads(path.read_text())
    function(meta)
    path.write_text(json.dumps(meta))


def differences(folder, function, **settings):
    before = fingerprint_of(load(folder))
    function()
    return before.differences(fingerprint_of(load(folder, **settings)))


def test_moved_data_has_the_same_fingerprint(rich, tmp_path):
    there = shutil.copytree(rich, tmp_path / "there")
    here, there = (fingerprint_of(load(folder)) for folder in (rich, there))
    assert not here.differences(there)
    assert here == there == Fingerprint.from_bytes(here.to_bytes())
    assert len(here.train) + len(here.test) == 10


FRAME = 4  # of the file, in which the photographs are in reverse order: 05.png

CHANGES = {
    "the camera of training view 05": lambda frame: frame["transform_matrix"][1].__setitem__(3, 9),
    "the camera of training view 05 ": lambda frame: frame.update(k2=0.5),
    "the camera of training view 05  ": lambda frame: frame.update(shutter="rolling"),
    "the camera of training view 05   ": lambda frame: frame.pop("transform_matrix_close"),
    "the mask of training view 05": lambda frame: frame.pop("mask_path"),
    "the depth of training view 05": lambda frame: frame.pop("depth_file_path"),
}


@pytest.mark.slow
@pytest.mark.parametrize("text", CHANGES)
def test_changes_of_a_frame_are_named(rich, text):
    function = CHANGES[text]
    found = differences(rich, lambda: change(rich, lambda meta: function(meta["frames"][FRAME])))
    assert found == [text.strip()]


@pytest.mark.parametrize(
    ("name", "what"), [("mask.png", "mask"), ("depth.npy", "depth"), ("images/05.png", "image")]
)
def test_content_of_each_file_changes_the_fingerprint(rich, name, what):
    found = differences(rich, lambda: (rich / name).open("ab").write(b"\0"))
    assert found == [f"the {what} of training view 05"]


def test_ignored_files_do_not_count(rich):
    settings = {"ignore_masks": True, "ignore_depth": True}
    prints = [fingerprint_of(load(rich, **settings))]
    for name in ("mask.png", "depth.npy"):
        (rich / name).write_bytes(b"damaged")
    prints.append(fingerprint_of(load(rich, **settings)))
    assert not prints[0].differences(prints[1])


def test_configured_size_changes_the_fingerprint(rich):
    found = differences(rich, lambda: None, image_size=4)
    assert "the size (8x6, now 4x3) of training view 05" in found and len(found) == 10


def test_rounding_does_not_change_the_fingerprint(rich):
    def round_off(meta):
        meta["frames"][FRAME]["transform_matrix"][0][3] *= 1 + 1e-14

    assert not differences(rich, lambda: change(rich, round_off))


def test_unread_files_are_not_compared(rich):
    before = fingerprint_of(load(rich))
    shutil.copy(rich / "images" / "05.png", rich / "images" / "04.png")
    dataset = load(rich)
    for read, other in (({"04"}, ["04.png"]), ({"05"}, [])):
        now = fingerprint_of(dataset, read.__contains__)
        assert [path.name for path in before.other_files(dataset.train, now)] == other
        assert len(before.differences(now)) == len(other)


def test_missing_file_is_named(rich):
    dataset = load(rich)
    (rich / "images" / "05.png").unlink()
    with pytest.raises(UserError, match=r"05\.png: cannot read the file: No such file"):
        fingerprint_of(dataset)


@pytest.mark.parametrize("content", [b"", b"{", b"[]", b'{"train": [7], "test": []}', b"\xff"])
def test_other_text_is_not_a_fingerprint(content):
    with pytest.raises(ValueError, match="no fingerprint of data"):
        Fingerprint.from_bytes(content)
