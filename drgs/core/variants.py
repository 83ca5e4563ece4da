"""Variants of Mitsuba that the plugins and the commands work in."""

from __future__ import annotations

from drgs.core.errors import PluginError

VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
"""Variants that can render and differentiate Gaussians; the first is the default."""


def check_variant(plugin: str, variant: str) -> None:
    """Raise PluginError that begins with the plugin's name for any other variant."""
    if variant not in VARIANTS:
        raise PluginError(
            f"{plugin}: the variant '{variant}' is not supported, "
            f"use mi.set_variant('{VARIANTS[0]}')"
        )
