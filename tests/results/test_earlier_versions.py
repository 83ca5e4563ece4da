"""Files of an earlier version are read as that version did.

``references/earlier_version`` was made by the version of November 2026, before classes and
functions were renamed: a fit stopped after 50 of 80 iterations (``config.yml``,
``checkpoint.npz``), its final ``point_cloud.ply``, and an image of that file by ``scene.xml``.
"""

import shutil

import mitsuba as mi
import numpy as np
import pytest
import yaml
from conftest import REPOSITORY
from support.fit_command import assert_fits
from support.openexr import read_exr
from support.small_capture import make_dataset, write_dataset

from drgs.config.load import load_config
from drgs.io.ply import Ply

EARLIER_VERSION = REPOSITORY / "tests" / "references" / "earlier_version"

ROUNDING = 1e-4
"""Relative: instructions of other processors round differently, and 30 iterations follow."""


@pytest.fixture
def fitted(tmp_path):
    """The folder of the stopped fit, beside its data."""
    for name in ("config.yml", "checkpoint.npz"):
        (tmp_path / "out").mkdir(exist_ok=True)
        shutil.copy(EARLIER_VERSION / name, tmp_path / "out" / name)
    write_dataset(tmp_path / "data", make_dataset(train=3, test=2))
    return tmp_path


@pytest.mark.slow
def test_a_checkpoint_is_continued(fitted):
    assert_fits("--resume", fitted / "out", "--data", fitted / "data")
    after, header = Ply().read(fitted / "out" / "point_cloud.ply")
    expected, earlier_header = Ply().read(EARLIER_VERSION / "point_cloud.ply")
    assert header == earlier_header and after.keys() == expected.keys()
    for name, values in expected.items():
        np.testing.assert_allclose(after[name], values, ROUNDING, ROUNDING, err_msg=name)


def test_a_configuration_keeps_its_values(fitted):
    values = yaml.safe_load((EARLIER_VERSION / "config.yml").read_text())
    config = load_config(EARLIER_VERSION / "config.yml").model_dump(mode="json")
    assert config == values


def test_scene_and_ply_header_render_the_same_image():
    image = mi.render(mi.load_file(str(EARLIER_VERSION / "scene.xml")), seed=0)
    np.testing.assert_allclose(image, read_exr(EARLIER_VERSION / "scene.exr"), ROUNDING, ROUNDING)
