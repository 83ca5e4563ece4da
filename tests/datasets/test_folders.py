"""Folders that are fitted without a configuration, and what others are recognised as."""

import pytest
from conftest import REPOSITORY
from support.colmap_models import write_dataset, write_images
from support.datasets import refusal

from drgs.config.load import load_config
from drgs.core.errors import UserError
from drgs.datasets.folders import GUIDE, MAX_PIXELS, config_for
from drgs.poses.structure_from_motion import photographs_in

SCENES = REPOSITORY / "scenes"


def test_photographs_use_the_settings_of_photos_yml(tmp_path):
    write_dataset(tmp_path)
    config, reasons = config_for(tmp_path)
    example = load_config(SCENES / "photos.yml")
    assert config.data.path == tmp_path and config.data.type == "colmap"
    assert config.data.image_size == 640 and "as they are" in reasons
    assert config.iterations == example.iterations
    assert "COLMAP's model" in reasons and "4,500 iterations" in reasons
    for section in ("init", "model", "optimizer", "loss", "densify", "coarse"):
        assert getattr(config, section) == getattr(example, section)
    given, _ = config_for(tmp_path, ["data.image_size=100", "iterations=30", "seed=3"])
    assert (given.data.image_size, given.iterations, given.seed) == (100, 30, 3)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1600, 1200), (4032, 3024), (3023, 4031), (41, 60001)])
def test_widths_are_divided_by_the_smallest_sufficient_integer(tmp_path, size):
    write_dataset(tmp_path)
    write_images(tmp_path / "images", size=size)
    config, reasons = config_for(tmp_path)
    width, height = size
    factor = width // config.data.image_size
    fitted, larger = width // factor, width // (factor - 1)
    assert config.data.image_size == fitted
    assert f"scaled from {width} x {height} px to a width of {fitted}" in reasons
    assert fitted * round(height * fitted / width) <= MAX_PIXELS
    assert larger * round(height * larger / width) > MAX_PIXELS


def test_images_with_alpha_use_lego_yml():
    config, reasons = config_for(SCENES / "lego")
    example = load_config(SCENES / "lego.yml")
    assert config.data.type == "nerf_synthetic" and config.iterations == example.iterations
    assert config.data.image_size == example.data.image_size
    assert "cut-out images in the layout of NeRF-synthetic, as they are" in reasons


@pytest.mark.parametrize("with_model", [False, True])
def test_transforms_json_is_recognised_also_beside_a_model_of_colmap(photographs, with_model):
    if with_model:
        write_dataset(photographs)
    config, reasons = config_for(photographs)
    assert config.data.type == "nerfstudio" and config.data.image_size == 8
    assert "cameras of transforms.json" in reasons


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
    "video": (["notes.txt", "walk.MOV"], "holds a file that is a video: take photographs from it"),
    "realityscan": (["a.jpg", "cameras.csv"], "and cameras.csv, whose cameras are not read: in Re"),
    "3DGS": (["a.jpg", "cameras.json"], "where the photographs are in the folder images"),
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


def test_missing_folder_and_file_in_its_place_are_refused(tmp_path):
    touch(tmp_path, "a")
    expected = f"data.path: cannot open the folder {tmp_path}/a: Not a directory"
    assert refusal(tmp_path / "a") == expected
    message = f"data.path: there is no folder {tmp_path}/none; say where it is (--data DIR)"
    assert refusal(tmp_path / "none") == message
    source = {"source": "our server"}
    assert refusal(tmp_path / "none", **source) == f"{message}, or get it from our server"
