"""Extensions by name; ``test_format_from_outside.py`` checks installed packages and messages."""

import sys
from types import SimpleNamespace
from unittest import mock

import pytest

from drgs.config.extensions import EFFECTS, STRATEGIES
from drgs.core import registry
from drgs.core.errors import UserError
from drgs.core.registry import Registry, shipped_modules, temporary_registrations

POINTS = {"kinds": {"later": "shipped_later", "taken": "drgs.core.errors", "gone": "drgs.gone"}}


@pytest.fixture
def kinds(monkeypatch):
    """A registry with two shipped extensions, and an entry point of a module that is missing."""
    registries = list(registry._registries)
    with mock.patch.object(registry, "_project_points", lambda: POINTS):
        shipped_modules.cache_clear()
        yield Registry("kind", "kinds")
    shipped_modules.cache_clear()
    registry._registries[:] = registries


def test_shipped_extensions_are_imported_when_used(kinds, monkeypatch, tmp_path):
    (tmp_path / "shipped_later.py").write_text(
        "from support_registry import KINDS\n@KINDS.register('later')\nclass Later: pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(sys.modules, "support_registry", SimpleNamespace(KINDS=kinds))
    assert kinds.names() == ["later", "taken"]
    assert "shipped_later" not in sys.modules
    found = kinds.get("later")
    assert (found.name, found.value.__name__, found.module) == ("later", "Later", "shipped_later")
    assert kinds.installed_extensions() == []
    del sys.modules["shipped_later"]


def test_name_registered_by_another_module_is_not_replaced(kinds):
    with pytest.raises(ValueError, match=r"registered by drgs\.core\.errors already"):
        kinds.register("taken")(object)
    with pytest.raises(UserError, match='"taken" of the group kinds registers no kind'):
        kinds.get("taken")


def test_two_kinds_cannot_share_a_name(kinds):
    """Both would read one section of a configuration."""
    kinds.register("shared_by_two")(object)
    with pytest.raises(ValueError, match='a kind is called "shared_by_two" already'):
        Registry("other kind", "others").register("shared_by_two")(object)


def test_extensions_registered_again_for_a_while_are_back_afterwards():
    before = EFFECTS.get("depth")
    with temporary_registrations():
        replaced = type("Replaced", (), {"__module__": before.module})
        EFFECTS.register("depth")(replaced)
        assert EFFECTS.get("depth").value is replaced
    assert EFFECTS.get("depth") is before


@pytest.fixture
def no_checkout(tmp_path):
    with mock.patch.object(registry, "PROJECT", tmp_path / "pyproject.toml"):
        for function in (registry._project_points, registry._metadata_points, shipped_modules):
            function.cache_clear()
        yield
    for function in (registry._project_points, registry._metadata_points, shipped_modules):
        function.cache_clear()


def test_without_a_checkout_the_installed_metadata_counts(no_checkout):
    point = SimpleNamespace(group=STRATEGIES.group, name="mcmc", value="drgs.training.density.mcmc")
    with mock.patch.object(
        registry, "distribution", lambda name: SimpleNamespace(entry_points=[point])
    ):
        assert STRATEGIES.shipped_names == ["mcmc"]


def test_a_package_that_is_not_installed_is_refused(no_checkout):
    def find_none(name):
        raise registry.PackageNotFoundError(name)

    with (
        mock.patch.object(registry, "distribution", find_none),
        pytest.raises(UserError, match=r'^drgs is not installed: .* run "pip install"'),
    ):
        _ = STRATEGIES.shipped_names
