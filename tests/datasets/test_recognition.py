"""A folder that is no dataset: what it is recognised as, and what its user is told to do."""

import json
import re

import pytest
from support.datasets import refusal

from drgs.core.errors import UserError
from drgs.datasets.recognition import GUIDE
from drgs.poses.structure_from_motion import pictures_in


def touch(folder, *names):
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(b"")


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("below", ["0", "."])
def test_a_model_of_colmap_without_photographs(tmp_path, below, suffix):
    touch(tmp_path, f"{below}/cameras{suffix}", f"{below}/images{suffix}")
    where = "" if below == "." else f"{below}/"
    assert refusal(tmp_path) == (
        f"{tmp_path}: is a model of COLMAP ({where}cameras{suffix}) without photographs; give the "
        "folder that has it in sparse/0 and the photographs in images"
    )


@pytest.mark.parametrize(("below", "there"), [("", ""), ("images/", ""), ("input/", "/input")])
def test_photographs_without_cameras(tmp_path, below, there):
    touch(tmp_path, *(f"{below}IMG_{i}.JPG" for i in range(3)), f"{below}notes.txt")
    assert refusal(tmp_path) == (
        f"{tmp_path}: holds 3 pictures (IMG_0.JPG and 2 more), but no cameras: where each was "
        f"taken must be known; find it out: drgs poses {tmp_path}{there}; see {GUIDE}"
    )


def test_a_command_names_folders_as_a_shell_reads_them(tmp_path):
    touch(tmp_path / "my photos", "a.png")
    assert "holds 1 picture (a.png), but" in (message := refusal(tmp_path / "my photos"))
    assert f"drgs poses '{tmp_path}/my photos';" in message


def test_a_video(tmp_path):
    touch(tmp_path, "walk.MOV")
    message = refusal(tmp_path)
    assert "holds a video (walk.MOV), but no photographs: take two frames of each second" in message
    assert f"ffmpeg -i {tmp_path}/walk.MOV -r 2 DIR/%04d.jpg" in message


def test_a_dataset_one_folder_below(tmp_path):
    touch(tmp_path, "a/notes.txt", "scene/transforms.json", "b.jpg")
    assert refusal(tmp_path) == (
        f"{tmp_path}: holds a dataset in its folder scene; give {tmp_path}/scene"
    )


def test_a_model_with_its_photographs_one_folder_below(tmp_path):
    touch(tmp_path, *(f"my scene/sparse/0/{name}.bin" for name in ("cameras", "images")))
    assert "holds a dataset" not in refusal(tmp_path)
    touch(tmp_path, "my scene/images/a.jpg")
    assert refusal(tmp_path) == (
        f"{tmp_path}: holds a dataset in its folder my scene; give '{tmp_path}/my scene'"
    )


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (["cam 1/a.jpg", "notes/b.txt"], "folder cam 1, but .*: drgs poses '{0}/cam 1'"),
        (["b/a.jpg", "a/a.jpg"], "folders a, b, .* into {0}/images and .*: drgs poses {0}"),
        (["images/b/a.jpg"], "folders of its folder images, but no .*: drgs poses {0}"),
    ],
    ids=["one", "several", "of images"],
)
def test_pictures_in_folders_of_the_folder(tmp_path, files, message):
    touch(tmp_path, *files, ".thumbs/a.jpg", "._a.jpg")
    pattern = message.format(tmp_path)
    assert re.search(f"holds pictures only in .*{pattern}; see ", refusal(tmp_path))
    if "images/b/a.jpg" not in files:
        with pytest.raises(UserError, match=f"got some only in its {pattern}"):
            pictures_in(tmp_path)


def test_a_split_without_the_training_views(tmp_path):
    touch(tmp_path, "transforms_test.json", "transforms_val.json")
    assert "holds transforms_test.json and 1 more of the NeRF-synthetic layout, but not " in (
        refusal(tmp_path)
    )


def test_the_output_of_a_fit(tmp_path):
    touch(tmp_path, "config.yml", "point_cloud.ply", "curves.png")
    assert "is the output folder of a fit, not a dataset; data.path must be" in refusal(tmp_path)


def test_poses_of_llff(tmp_path):
    touch(tmp_path, "poses_bounds.npy", "images/a.jpg")
    assert "is in the layout of LLFF (poses_bounds.npy), which is not read" in refusal(tmp_path)


def test_a_file_in_the_folders_place(tmp_path):
    (tmp_path / "transforms.json").write_text(json.dumps({}))
    assert refusal(tmp_path / "transforms.json") == (
        f"data.path: {tmp_path}/transforms.json is a file; give the folder of the dataset, such "
        f"as {tmp_path}"
    )


def test_a_dataset_is_read_whatever_else_lies_beside_it(photographs):
    touch(photographs, "sparse/0/cameras.bin", "sparse/0/images.bin", "walk.mp4")
    from support.datasets import load

    assert len(load(photographs).test) == 2
