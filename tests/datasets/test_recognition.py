"""A folder that is no dataset: what it is recognised as, and what its user is told to do."""

import pytest
from support.datasets import load, refusal

from drgs.core.errors import UserError
from drgs.datasets.folders import GUIDE
from drgs.poses.structure_from_motion import photographs_in


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")


NOTHING = (
    "neither transforms_train.json nor transforms.json is there, nor a model of COLMAP in sparse/0 "
    f"with its photographs in images; see {GUIDE}"
)
PHOTOGRAPHS = f"but no cameras: find out where each was taken: drgs poses {{0}}; see {GUIDE}"
SEVERAL = "one scene into {0}/images, "

FOLDERS = {
    "empty": ([], NOTHING),
    "model": (["0/cameras.bin", "0/images.bin"], NOTHING),
    "flat model": (["cameras.txt", "images.txt"], NOTHING),
    "video": (["walk.MOV"], NOTHING),
    "no training views": (["transforms_test.json", "transforms_val.json"], NOTHING),
    "output of a fit": (["config.yml", "point_cloud.ply"], NOTHING),
    "photographs": (["IMG_0.JPG", "notes.txt"], f"holds photographs (scans), {PHOTOGRAPHS}"),
    "in images": (["images/a.JPG"], f"holds photographs (scans/images), {PHOTOGRAPHS}"),
    "in input": (["input/a.JPG"], "drgs poses {0}/input;"),
    "in one folder": (["cam 1/a.jpg", "notes/b.txt"], "/cam 1), but no cameras"),
    "quoted": (["cam 1/a.jpg", ".thumbs/a.jpg", "._a.jpg"], "drgs poses '{0}/cam 1'"),
    "in folders": (["b/a.jpg", "a/a.jpg"], SEVERAL),
    "in a folder of images": (["images/b/a.jpg"], "/images/b), but no cameras"),
    "a dataset below": (
        ["a/notes.txt", "scene/transforms.json", "b.jpg"],
        "holds a dataset in its folder scene; give {0}/scene",
    ),
    "a model below": (
        ["my scene/sparse/0/cameras.bin", "my scene/sparse/0/images.bin", "my scene/images/a.jpg"],
        "holds a dataset in its folder my scene; give '{0}/my scene'",
    ),
}


@pytest.mark.parametrize(("files", "message"), FOLDERS.values(), ids=FOLDERS)
def test_folder_that_is_no_dataset_is_explained(tmp_path, files, message):
    folder = tmp_path / "scans"
    folder.mkdir()
    touch(folder, *files)
    refused = refusal(folder)
    assert refused.startswith(f"{folder}: ") and message.format(folder) in refused


@pytest.mark.parametrize(
    ("files", "message"),
    [(["cam 1/a.jpg"], r"drgs poses '.*/cam 1'"), (["b/a.jpg", "a/a.jpg"], "one scene into")],
)
def test_folder_of_folders_of_photographs_is_refused_by_poses(tmp_path, files, message):
    touch(tmp_path, *files)
    with pytest.raises(UserError, match=f"got one that holds photographs .*{message}"):
        photographs_in(tmp_path)


def test_file_in_place_of_the_folder_is_refused(tmp_path):
    touch(tmp_path, "transforms.json")
    assert refusal(tmp_path / "transforms.json") == (
        f"data.path: cannot open the folder {tmp_path}/transforms.json: Not a directory"
    )


@pytest.mark.parametrize(
    ("options", "end"), [({}, ""), ({"source": "our server"}, ", or get it from our server")]
)
def test_missing_folder_is_refused(tmp_path, options, end):
    folder = tmp_path / "none"
    assert refusal(folder, **options) == (
        f"data.path: there is no folder {folder}; say where it is (--data DIR){end}"
    )


def test_dataset_is_read_beside_other_files(photographs):
    touch(photographs, "sparse/0/cameras.bin", "sparse/0/images.bin", "walk.mp4")
    assert len(load(photographs).test) == 2
