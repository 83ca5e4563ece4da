"""Configurations that leave values to the data, where no fit has decided on them."""

from conftest import REPOSITORY

from drgs.config.changes import is_open, with_changes
from drgs.config.load import load_config
from drgs.config.schema import FitConfig
from drgs.results.files import METRICS
from drgs.results.folder import claim_output_folder, is_finished
from drgs.results.model import load_open_config

PHOTOS = REPOSITORY / "scenes" / "photos.yml"


def test_rendering_uses_the_background_of_the_photographs(photographs):
    config = load_open_config(PHOTOS, [f"data.path={photographs}"], None)
    assert config.data.background_rgb == (0, 0, 0)
    assert config.model.near == 0.2  # a twenty-fifth of 4.1, to one digit
    assert not is_open(config) and is_open(load_config(PHOTOS))


def test_finished_fit_matches_the_configuration_before_defaults(tmp_path):
    given = FitConfig(data={"path": tmp_path})
    decided = with_changes(given, {"data.background": "black", "model.near": 0.3})
    claim_output_folder(tmp_path / "out", decided)
    (tmp_path / "out" / METRICS).write_text("{}")
    assert is_finished(tmp_path / "out", given)
    assert not is_finished(tmp_path / "out", with_changes(given, {"model.near": 0.2}))
