"""Folders that are fitted without a configuration."""

import pytest
from conftest import REPOSITORY
from support.colmap_models import NAMES, write_dataset, write_images

from drgs.config.load import load_config
from drgs.core.errors import UserError
from drgs.datasets.folders import MAX_PIXELS, config_for

SCENES = REPOSITORY / "scenes"


def test_photographs_use_the_settings_of_photos_yml(tmp_path):
    write_dataset(tmp_path)
    config, reasons = config_for(tmp_path)
    example = load_config(SCENES / "photos.yml")
    assert config.data.path == tmp_path and config.data.type == "colmap"
    assert config.data.image_size == 640 and "as they are" in reasons
    assert config.iterations == example.iterations
    assert "COLMAP's model" in reasons and "4,000 iterations" in reasons
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


def test_largest_image_sets_the_scale(tmp_path):
    write_dataset(tmp_path)
    sizes = [(640, 480), (1600, 1200), (1200, 1600), (700, 500)]
    for name, size in zip(NAMES, sizes, strict=True):
        write_images(tmp_path / "images", [name], size)
    config, reasons = config_for(tmp_path)
    assert config.data.image_size == 600 and MAX_PIXELS >= 600 * 800
    assert "scaled from 1200 x 1600 px, the largest, to a width of 600" in reasons
    for name, size in zip(NAMES, [(640, 480), (480, 640), (900, 20), (64, 48)], strict=True):
        write_images(tmp_path / "images", [name], size)
    assert config_for(tmp_path)[0].data.image_size == 900


def test_images_with_alpha_use_lego_yml():
    config, reasons = config_for(SCENES / "lego")
    example = load_config(SCENES / "lego.yml")
    assert config.data.type == "nerf_synthetic" and config.iterations == example.iterations
    assert config.data.image_size == example.data.image_size
    assert "cut-out images in the layout of NeRF-synthetic, as they are" in reasons


def test_transforms_json_is_recognised(photographs):
    config, reasons = config_for(photographs)
    assert config.data.type == "nerfstudio" and config.data.image_size == 8
    assert "cameras of transforms.json" in reasons


def test_folders_that_are_no_datasets_are_explained(tmp_path):
    write_images(tmp_path / "images")
    with pytest.raises(UserError, match=r"drgs poses"):
        config_for(tmp_path)
    (tmp_path / "transforms.json").write_text('{"frames": []}')
    with pytest.raises(UserError, match=r"transforms\.json: frames"):
        config_for(tmp_path)
