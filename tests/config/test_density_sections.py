"""The section ``densify``: what all strategies share, one section for each."""

import pytest
import yaml

from drgs.config.changes import with_iterations
from drgs.config.load import load_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError


@pytest.fixture
def load(tmp_path, monkeypatch):
    """A configuration from its section ``densify`` and overrides."""
    monkeypatch.chdir(tmp_path)

    def loaded(section=None, *overrides):
        values = {"data": {"path": "d"}, **({} if section is None else {"densify": section})}
        (tmp_path / "x.yml").write_text(yaml.safe_dump(values))
        return load_config("x.yml", overrides)

    return loaded


@pytest.mark.parametrize(
    ("section", "overrides", "message"),
    [
        ({"adc": {"split_count": 1}}, (), "x.yml: densify.adc.split_count must be >= 2, got 1"),
        (
            {"adc": {"split_count": 5}},
            ("densify.adc.split_count=1",),
            "--set densify.adc.split_count: densify.adc.split_count must be >= 2, got 1",
        ),
        (
            {"split_count": 5},
            (),
            "x.yml: unknown key densify.split_count; did you mean densify.adc.split_count?",
        ),
        ({"adc": 5}, (), "x.yml: densify.adc must be a section of keys, got 5"),
        (
            {"adc": {"split": 5}},
            (),
            "x.yml: unknown key densify.adc.split; did you mean densify.adc.split_count?",
        ),
        (
            {"splt_count": 5},
            (),
            "x.yml: unknown key densify.splt_count; did you mean densify.adc.split_count?",
        ),
    ],
)
def test_wrong_value_is_reported_as_given(load, section, overrides, message):
    with pytest.raises(UserError) as error:
        load(section, *overrides)
    assert str(error.value) == message


def test_unknown_strategy_is_refused_with_the_known_ones(load):
    with pytest.raises(UserError, match=r"^x.yml: densify.strategy must be .*'adc'.*, got 'abc'$"):
        load({"strategy": "abc"})


def test_number_of_iterations_scales_resets():
    config = FitConfig(data={"path": "."}, iterations=30_000)
    adc = with_iterations(config, 3000).densify.adc
    assert (adc.reset_every, adc.white_background_reset) == (300, 50)
    assert adc.grad_threshold == config.densify.adc.grad_threshold
