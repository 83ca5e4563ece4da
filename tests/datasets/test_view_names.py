"""Names of views, which name the files of their images."""

import os

import pytest

from drgs.datasets.transforms import unique_names


@pytest.mark.parametrize(
    ("files", "names"),
    [
        (["./train/r_0", "images/b.png"], ["r_0", "b"]),
        (["a/0.png", "b\\0.png"], ["a_0", "b_0"]),
        (["a.png", "a.jpg"], ["0000_a", "0001_a"]),
        (["/data/a/0.png", "/data/b/0.png"], ["data_a_0", "data_b_0"]),
    ],
)
def test_views_are_named_after_their_files_with_folders_if_needed(files, names):
    assert unique_names(files) == names


@pytest.mark.parametrize(
    "file",
    ["\u4e2d" * 80 + "{0}.png", "/".join(["x" * 100] * 5) + "/{0}/a.png", "\udcff" * 240 + "{0}"],
)
def test_long_view_names_are_shortened(file):
    """255 bytes are the limit, of which numbers, suffixes and temporary names take some."""
    names = unique_names([file.format(i) for i in range(2)])
    assert len(set(names)) == 2
    assert all(len(os.fsencode(name)) <= 220 and "/" not in name for name in names)
