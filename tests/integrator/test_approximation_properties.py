"""The approximations are declared once, and whoever lists them agrees with that."""

import annotated_types
import pytest
from plugin_parameters import parameters_of
from support.viewer_rendering import VIEWER_RENDERING

from drgs.config.approximations import DECLARED, Approximations
from drgs.config.schema import ModelConfig

KINDS = {bool: "bool", int: "int", float: "float", str: "string"}


@pytest.mark.parametrize("name", DECLARED)
def test_splats_page_documents_declared_properties(name):
    (row,) = (row for row in parameters_of("splats") if name in row.names)
    declared = DECLARED[name]
    assert row.type == KINDS[declared.kind]
    assert row.description.replace("`", "") == declared.description
    for word in declared.words:
        assert f"``{word}``:" in row.description


@pytest.mark.parametrize("name", DECLARED)
def test_configuration_has_declared_properties(name):
    field, declared = ModelConfig.model_fields[name], DECLARED[name]
    assert field.description.startswith(declared.description)
    assert ModelConfig(**VIEWER_RENDERING).approximations == Approximations()
    limits = declared.limits.finite if declared.limits else {}
    assert field.metadata == [getattr(annotated_types, k.title())(v) for k, v in limits.items()]


def test_unrounded_default_counts_as_default():
    """A configuration writes 0.99 for the float32 next to it."""
    written = ModelConfig(alpha_max=0.99, alpha_cut=1 / 255, extent=None, **VIEWER_RENDERING)
    assert written.approximations == Approximations()
    assert written.approximations.non_default == {}
    chosen = ModelConfig(alpha_max=0.98, extent=3.0, **VIEWER_RENDERING).approximations
    assert chosen.non_default == {"alpha_max": 0.98, "extent": 3.0}
