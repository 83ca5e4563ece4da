"""What machine this is."""

from __future__ import annotations

import os
import platform


def processor() -> str:
    """The processor's name, as Linux has it; elsewhere what Python knows of it."""
    if os.path.exists("/proc/cpuinfo"):
        with open("/proc/cpuinfo", encoding="utf-8", errors="replace") as file:
            names = [line.partition(":")[2].strip() for line in file if "model name" in line]
        if names:
            return names[0]
    return platform.processor() or platform.machine()
