"""Extensions by name; ``test_format_from_outside.py`` checks installed packages and messages."""

import sys
from types import SimpleNamespace

import pytest

from drgs.config.extensions import EFFECTS
from drgs.core.registry import Registry, temporary_registrations


def test_shipped_extensions_are_imported_when_used(monkeypatch, tmp_path):
    (tmp_path / "shipped_later.py").write_text(
        "from support_registry import KINDS\n@KINDS.register('later')\nclass Later: pass\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    kinds = Registry("kind", {"later": "shipped_later"})
    monkeypatch.setitem(sys.modules, "support_registry", SimpleNamespace(KINDS=kinds))
    assert kinds.names() == ["later"]
    assert "shipped_later" not in sys.modules
    found = kinds.get("later")
    assert (found.name, found.value.__name__, found.module) == ("later", "Later", "shipped_later")
    assert kinds.installed_extensions() == []
    del sys.modules["shipped_later"]


def test_name_registered_by_another_module_is_not_replaced():
    kinds = Registry("kind", {"taken": "drgs.somewhere"})
    with pytest.raises(ValueError, match=r"registered by drgs\.somewhere already"):
        kinds.register("taken")(object)


def test_two_kinds_cannot_share_a_name():
    """Both would read one section of a configuration."""
    first = Registry("kind")
    first.register("shared_by_two")(object)
    with pytest.raises(ValueError, match='a kind is called "shared_by_two" already'):
        Registry("other kind").register("shared_by_two")(object)
    first._extensions.clear()


def test_extensions_registered_again_for_a_while_are_back_afterwards():
    before = EFFECTS.get("depth")
    with temporary_registrations():
        replaced = type("Replaced", (), {"__module__": before.module})
        EFFECTS.register("depth")(replaced)
        assert EFFECTS.get("depth").value is replaced
    assert EFFECTS.get("depth") is before
