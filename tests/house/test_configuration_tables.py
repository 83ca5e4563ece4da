"""The tables of the page of the configuration list every key once, as the schema has it."""

import importlib.util

import pytest
from conftest import REPOSITORY

from drgs.config.load import known_keys
from drgs.config.schema import FitConfig

nodes = pytest.importorskip("docutils.nodes")
pytest.importorskip("sphinx")

IN_LISTS = ("coarse.",)


@pytest.fixture(scope="module")
def rows():
    """Texts of the columns by dotted key."""
    path = REPOSITORY / "docs" / "_ext" / "configuration.py"
    spec = importlib.util.spec_from_file_location("configuration", path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    found = {}
    for section in module.make_sections():
        title = section.next_node(nodes.title).astext()
        prefix = "" if title == "Top level" else f"{title}."
        for row in section.next_node(nodes.tbody).findall(nodes.row):
            key, *columns = (entry.astext() for entry in row)
            assert prefix + key not in found
            found[prefix + key] = columns
    return found


def test_every_key_has_a_row(rows):
    keys = {key for key in known_keys() if not key.startswith(IN_LISTS)}
    sections = {key for key in keys if any(other.startswith(f"{key}.") for other in keys)}
    assert rows.keys() == keys - sections
    assert all(cell for columns in rows.values() for cell in columns)


def test_rows_have_type_default_and_description(rows):
    description = FitConfig.model_fields["iterations"].description
    assert rows["iterations"] == ["integer ≥ 1", "30000", " ".join(description.split())]
    assert rows["data.path"][:2] == ["path", "required"]
    assert rows["data.background"][:2] == ["color", "null"]
    assert rows["densify.adc.prune_opacity"][:2] == ["number ≥ 0, < 1", "0.005"]
    assert rows["init.start"][:2] == ["auto, masks, points, sweep, random", "auto"]
    assert rows["coarse"][:2] == ["list of {until, factor}, or null", "null"]
