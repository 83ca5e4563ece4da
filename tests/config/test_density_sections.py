"""The section ``densify``: what all strategies share, one section for each, earlier spellings."""

import pytest
import yaml

from drgs.config.changes import with_iterations
from drgs.config.density import EARLIER_KEYS, AdcConfig, DensifyConfig
from drgs.config.load import dump_config, load_config
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError

OTHERS = {
    "grad_threshold": 3e-4,
    "clone_scale": 0.02,
    "split_count": 3,
    "split_shrink": 1.7,
    "prune_opacity": 0.004,
    "prune_scale": 0.2,
    "reset_every": 2000,
    "reset_opacity": 0.02,
    "white_background_reset": None,
}
"""Values that are not the defaults."""


@pytest.fixture
def load(tmp_path, monkeypatch):
    """A configuration from its section ``densify`` and overrides."""
    monkeypatch.chdir(tmp_path)

    def loaded(section=None, *overrides):
        values = {"data": {"path": "d"}, **({} if section is None else {"densify": section})}
        (tmp_path / "x.yml").write_text(yaml.safe_dump(values))
        return load_config("x.yml", overrides)

    return loaded


def test_every_value_of_earlier_versions_is_one_of_adc():
    assert set(OTHERS) == set(AdcConfig.model_fields)
    assert EARLIER_KEYS["densify.split_count"] == "densify.adc.split_count"


@pytest.mark.parametrize("name", OTHERS)
def test_a_value_beside_the_section_is_one_in_it(load, name):
    value = OTHERS[name]
    now = load({"strategy": "adc", "adc": {name: value}, "every": 70})
    assert getattr(now.densify.adc, name) == value != getattr(AdcConfig(), name)
    assert load({name: value, "every": 70}) == now
    text = "null" if value is None else value
    adc = {"every": 70, "strategy": "adc"}
    for key in (f"densify.{name}", f"densify.adc.{name}"):
        for section in ({}, {name: 0.001}, {"adc": {name: 0.001}}):
            assert load({**adc, **section}, f"{key}={text}") == now
    assert DensifyConfig(**{name: value}) == DensifyConfig(strategy="adc", adc={name: value})


def test_a_configuration_of_an_earlier_version_is_read(load, tmp_path):
    values = load().model_dump(mode="json")
    flat = values["densify"]
    del flat["strategy"]
    flat |= {**flat.pop("adc"), **OTHERS}
    flat = {name: value for name, value in flat.items() if not isinstance(value, dict)}
    (tmp_path / "config.yml").write_text(yaml.safe_dump(values))
    config = load_config("config.yml")
    assert config.densify.strategy == "adc"
    assert config.densify.adc == AdcConfig(**OTHERS)
    dump_config(config, "again.yml")
    assert load_config("again.yml") == config
    assert "split_count" not in yaml.safe_load((tmp_path / "again.yml").read_text())["densify"]


@pytest.mark.parametrize(
    ("section", "overrides", "message"),
    [
        (
            {"split_count": 3, "adc": {"split_count": 3}},
            (),
            "x.yml: densify must hold split_count in the section adc or, as in earlier versions, "
            "beside it, not twice, got {adc: {split_count: 3}, split_count: 3}",
        ),
        (
            {"strategy": "budget", "prune_opacity": 0.1},
            (),
            "x.yml: densify must hold prune_opacity in the section adc, to which it belongs, where "
            "strategy is budget, got {prune_opacity: 0.1, strategy: budget}",
        ),
        ({"split_count": 1}, (), "x.yml: densify.split_count must be >= 2, got 1"),
        ({"adc": {"split_count": 1}}, (), "x.yml: densify.adc.split_count must be >= 2, got 1"),
        (
            {},
            ("densify.split_count=1",),
            "--set densify.split_count: densify.split_count must be >= 2, got 1",
        ),
        (
            {"split_count": 5},
            ("densify.adc.split_count=1",),
            "--set densify.adc.split_count: densify.adc.split_count must be >= 2, got 1",
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
def test_a_wrong_value_is_named_as_it_was_given(load, section, overrides, message):
    with pytest.raises(UserError) as error:
        load(section, *overrides)
    assert str(error.value) == message


def test_an_unknown_strategy_is_refused_with_those_that_there_are(load):
    with pytest.raises(UserError, match=r"^x.yml: densify.strategy must be .*'adc'.*, got 'abc'$"):
        load({"strategy": "abc"})


def test_other_iterations_scale_resets():
    config = FitConfig(data={"path": "."}, iterations=30_000)
    adc = with_iterations(config, 3000).densify.adc
    assert (adc.reset_every, adc.white_background_reset) == (300, 50)
    assert adc.grad_threshold == config.densify.adc.grad_threshold
