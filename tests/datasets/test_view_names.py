"""Names of views, which name the files of their images."""

import os

from drgs.datasets.transforms import unique_names


def test_views_are_named_after_their_files_with_folders_if_needed():
    assert unique_names(["./train/r_0", "images/b.png"]) == ["r_0", "b"]
    assert unique_names(["a/0.png", "b\\0.png"]) == ["a_0", "b_0"]
    assert unique_names(["a.png", "a.jpg"]) == ["0000_a", "0001_a"]


def test_names_of_views_do_not_leave_the_folder():
    names = unique_names(["/data/a/0.png", "/data/b/0.png"])
    assert names == ["data_a_0", "data_b_0"]


def test_long_view_names_are_shortened():
    """255 bytes are the limit, of which numbers, suffixes and temporary names take some."""
    long = ["\u4e2d" * 80 + f"{i}.png" for i in range(2)]
    deep = ["/".join(["x" * 100] * 5) + f"/{i}/a.png" for i in range(2)]
    other = [os.fsdecode(b"\xff" * 240) + f"{i}" for i in range(2)]
    for files in (long, deep, other):
        names = unique_names(files)
        assert len(set(names)) == 2
        assert all(len(os.fsencode(name)) <= 220 and "/" not in name for name in names)
