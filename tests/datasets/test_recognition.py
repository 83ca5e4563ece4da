"""A folder that is no dataset: what it is recognised as, and what its user is told to do."""

import json
import re

import pytest
from support.datasets import refusal

from drgs.core.errors import UserError
from drgs.datasets.folders import GUIDE
from drgs.poses.structure_from_motion import photographs_in


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")


NO_DATASET = (
    "neither transforms_train.json nor transforms.json is there, nor a model of COLMAP in sparse/0 "
    f"with its photographs in images; see {GUIDE}"
)


@pytest.mark.parametrize(
    "names",
    [
        [],
        ["0/cameras.bin", "0/images.bin"],
        ["cameras.txt", "images.txt"],
        ["walk.MOV"],
        ["transforms_test.json", "transforms_val.json"],
        ["config.yml", "point_cloud.ply"],
    ],
    ids=["empty", "model", "flat model", "video", "no training views", "output of a fit"],
)
def test_folders_that_are_no_dataset_are_explained(tmp_path, names):
    touch(tmp_path, *names)
    assert refusal(tmp_path) == f"{tmp_path}: {NO_DATASET}"


@pytest.mark.parametrize(("below", "there"), [("", ""), ("images/", ""), ("input/", "/input")])
def test_photographs_without_cameras_are_refused_with_drgs_poses(tmp_path, below, there):
    touch(tmp_path, *(f"{below}IMG_{i}.JPG" for i in range(3)), f"{below}notes.txt")
    place = f"{tmp_path.name}/{below}".removesuffix("/")
    assert refusal(tmp_path) == (
        f"{tmp_path}: holds photographs ({place}), but no cameras: find out where each was taken: "
        f"drgs poses {tmp_path}{there}; see {GUIDE}"
    )


def test_suggested_command_quotes_folder_names(tmp_path):
    touch(tmp_path / "my photos", "a.png")
    assert f"drgs poses '{tmp_path}/my photos';" in refusal(tmp_path / "my photos")


def test_dataset_one_folder_below_is_suggested(tmp_path):
    touch(tmp_path, "a/notes.txt", "scene/transforms.json", "b.jpg")
    assert refusal(tmp_path) == (
        f"{tmp_path}: holds a dataset in its folder scene; give {tmp_path}/scene"
    )


def test_model_one_folder_below_is_suggested(tmp_path):
    touch(tmp_path, *(f"my scene/sparse/0/{name}.bin" for name in ("cameras", "images")))
    touch(tmp_path, "my scene/images/a.jpg")
    assert refusal(tmp_path) == (
        f"{tmp_path}: holds a dataset in its folder my scene; give '{tmp_path}/my scene'"
    )


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (["cam 1/a.jpg", "notes/b.txt"], "/cam 1\\), but no .*: drgs poses '{0}/cam 1'"),
        (["b/a.jpg", "a/a.jpg"], "/a, .*/b\\), .* one scene into {0}/images, .*: drgs poses {0};"),
        (["images/b/a.jpg"], "/images/b\\), but no .*: drgs poses {0};"),
    ],
    ids=["one", "several", "of images"],
)
def test_images_in_subfolders_are_recognised(tmp_path, files, message):
    touch(tmp_path, *files, ".thumbs/a.jpg", "._a.jpg")
    pattern = message.format(tmp_path)
    assert re.search(f"holds photographs .*{pattern}", refusal(tmp_path))
    if "images/b/a.jpg" not in files:
        with pytest.raises(UserError, match=f"got one that holds photographs .*{pattern}"):
            photographs_in(tmp_path)


def test_file_in_place_of_the_folder_is_refused(tmp_path):
    (tmp_path / "transforms.json").write_text(json.dumps({}))
    assert refusal(tmp_path / "transforms.json") == (
        f"data.path: cannot open the folder {tmp_path}/transforms.json: Not a directory"
    )


def test_dataset_is_read_beside_other_files(photographs):
    touch(photographs, "sparse/0/cameras.bin", "sparse/0/images.bin", "walk.mp4")
    from support.datasets import load

    assert len(load(photographs).test) == 2
