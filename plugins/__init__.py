"""Mitsuba plugins of drgs, one file each; importable as ``drgs.plugins``.

A plugin file is a class that derives from a class of the active variant, and a registration that
closes the file. The files are executed once for each variant that becomes active. Mitsuba 3.10
imports this package by its entry point (group ``mitsuba``), and reloads it after each change.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import mitsuba as mi

from drgs.core.llvm import ensure_usable_llvm

PLUGINS = ("splats", "splatpath", "calibrated", "minimal")


def register(variant: str) -> None:
    """Register all plugins for the active variant; LLVMVersionError without a usable libLLVM."""
    if variant.startswith("llvm_"):
        ensure_usable_llvm()
    for name in PLUGINS:
        module_name = f"{__name__}.{variant}.{name}"
        if module_name in sys.modules:
            continue
        file = Path(__file__).with_name(f"{name}.py")
        spec = importlib.util.spec_from_file_location(module_name, file)
        assert spec is not None and spec.loader is not None, "of a Python file"
        module = importlib.util.module_from_spec(spec)
        sys.modules[module_name] = module
        try:
            spec.loader.exec_module(module)
        except BaseException:
            del sys.modules[module_name]
            raise


if (variant := mi.variant()) is not None:
    register(variant)
