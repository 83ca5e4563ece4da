"""Keeps the plugins registered for whichever Mitsuba variant is active.

The only global state of drgs: Mitsuba's plugin registry belongs to a variant.
"""

from __future__ import annotations

import mitsuba as mi

from drgs.llvm import ensure_usable_llvm


def register_plugins() -> None:
    """Register for the active variant, if any, and for every one that becomes active later."""
    mi.detail.add_variant_callback(_on_variant)
    if mi.variant() is not None:
        _on_variant(None, mi.variant())


def _on_variant(old: str | None, new: str | None) -> None:
    del old
    if new is None:
        return
    if new.startswith("llvm_"):
        ensure_usable_llvm()
    from drgs import plugins

    plugins.register(new)
