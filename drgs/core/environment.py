"""Environment of a process: its processor, packages of extras, variants of Mitsuba."""

from __future__ import annotations

import os
import platform
from importlib import import_module
from types import ModuleType

from drgs.core.errors import PluginError, UserError

VARIANTS = ("llvm_ad_rgb", "cuda_ad_rgb")
"""Variants that can render and differentiate Gaussians; the first is the default."""


def check_variant(plugin: str, variant: str) -> None:
    """Raise PluginError that begins with the plugin's name for any other variant."""
    if variant not in VARIANTS:
        raise PluginError(
            f"{plugin}: the variant '{variant}' is not supported, "
            f"use mi.set_variant('{VARIANTS[0]}')"
        )


def required(module: str, extra: str, asker: str) -> ModuleType:
    """Import and return a module of an extra of ``pyproject.toml``.

    asker: what needs it, as the user has written it: ``--view``.

    Raises :class:`UserError` with the line that installs it, where it is not there.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        missing = (error.name or module).partition(".")[0]
        raise UserError(
            f"{asker}: needs {missing}, which is not installed; pip install 'drgs[{extra}]'"
        ) from None


def processor() -> str:
    """Return the processor's name: on Linux its model, elsewhere what Python knows of it."""
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            names = [line.partition(":")[2].strip() for line in file if "model name" in line]
        if names:
            return names[0]
    return platform.processor() or platform.machine()
