"""Extensions by name: what registers them, and what messages say."""

import sys
from importlib.metadata import EntryPoint

import pytest

from drgs.core import registry
from drgs.core.errors import UserError
from drgs.core.registry import ExtensionError, Registry


def entry_point(monkeypatch, tmp_path, source):
    """A module outside of drgs, known by an entry point of an installed package."""
    (tmp_path / "outside_extension.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "outside_extension", raising=False)
    point = EntryPoint("outside", "outside_extension", registry.ENTRY_POINT_GROUP)
    monkeypatch.setattr(registry, "entry_points", lambda group: [point])
    monkeypatch.setattr(registry, "_loaded", set())


def test_shipped_extensions_are_imported_when_used(monkeypatch, tmp_path):
    (tmp_path / "shipped_later.py").write_text(
        "from support_registry import KINDS\n@KINDS.register('later')\nclass Later: pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    kinds = Registry("kind", {"later": "shipped_later"})
    monkeypatch.setitem(sys.modules, "support_registry", type(sys)("support_registry"))
    sys.modules["support_registry"].KINDS = kinds
    assert kinds.names() == ["later"]
    assert "shipped_later" not in sys.modules
    found = kinds.get("later")
    assert (found.name, found.value.__name__, found.module) == ("later", "Later", "shipped_later")
    assert kinds.installed_extensions() == []
    del sys.modules["shipped_later"]


def test_an_installed_package_registers_by_its_entry_point(monkeypatch, tmp_path):
    kinds = Registry("kind")
    monkeypatch.setattr(registry, "KINDS_OF_TEST", kinds, raising=False)
    source = (
        "from drgs.core.registry import KINDS_OF_TEST\n"
        "@KINDS_OF_TEST.register('mine')\ndef mine(): raise KeyError('oh')\n"
    )
    entry_point(monkeypatch, tmp_path, source)
    assert kinds.names() == ["mine"]
    assert [each.name for each in kinds.installed_extensions()] == ["mine"]
    extension = kinds.get("mine")
    start = r'^kind "mine" \(outside_extension\): KeyError: '
    with pytest.raises(ExtensionError, match=start), extension.reporting():
        extension.value()


def test_unknown_name_lists_the_registered_ones():
    kinds = Registry("kind")
    kinds.register("adaptive")(object())
    with pytest.raises(UserError) as caught:
        kinds.get("adaptve", "a.yml: densify.strategy")
    start = 'a.yml: densify.strategy: no kind is called "adaptve"; did you mean adaptive?'
    assert str(caught.value).startswith(start)
    assert "there are adaptive" in str(caught.value)
    assert 'entry point of the group "drgs"' in str(caught.value)


def test_a_package_that_cannot_be_imported_is_named(monkeypatch, tmp_path):
    entry_point(monkeypatch, tmp_path, "import no_such_module\n")
    message = r'extension "outside" .*outside_extension.*no_such_mod'
    with pytest.raises(ExtensionError, match=message):
        Registry("kind").names()


def test_name_registered_by_another_module_is_not_replaced():
    kinds = Registry("kind", {"taken": "drgs.somewhere"})
    with pytest.raises(ValueError, match=r"registered by drgs\.somewhere already"):
        kinds.register("taken")(test_unknown_name_lists_the_registered_ones)


def test_two_kinds_cannot_share_a_name():
    """Both would read one section of a configuration."""
    first = Registry("kind")
    first.register("shared_by_two")(test_unknown_name_lists_the_registered_ones)
    with pytest.raises(ValueError, match='a kind is called "shared_by_two" already'):
        Registry("other kind").register("shared_by_two")(object)
    first._extensions.clear()
