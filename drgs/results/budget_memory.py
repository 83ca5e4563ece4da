"""Choices for error budgets, remembered beside the file of Gaussians that they were made for.

``NAME.error_budgets.json`` maps digests of the Gaussians, the cameras and all settings to choices.
It is never required: where it is missing, damaged or somebody else's, the choice is made again, and
where it cannot be written, or a file of another kind has its name, nothing is written.
"""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import drgs
from drgs.accuracy.error_budget import SAMPLES, BudgetReport, Choice
from drgs.config.approximations import Approximations
from drgs.core.errors import UserError
from drgs.core.files import read_text, write_json

CHOICES = ("chosen", "better", "faster")
KIND = "choices of drgs for error budgets"
MAX_CHOICES = 64  # of a file: the last ones
MAX_BYTES = 1 << 20


def memory_path(gaussians: Path) -> Path | None:
    """Return the file of a file's choices; None for those that are shipped."""
    if gaussians.resolve().is_relative_to(Path(drgs.__file__).resolve().parent):
        return None
    return gaussians.with_name(f"{gaussians.name}.error_budgets.json")


def recall(path: Path | None, digest: str, given: Approximations) -> BudgetReport | None:
    """Return the choice for a digest; given: approximations that it changes. None: unknown."""
    try:
        found: dict[str, Any] = dict(_read(path)[digest])
        for name in CHOICES:
            if (values := found[name]) is not None:
                changes = {k: v for k, v in values["changes"].items() if k != SAMPLES}
                found[name] = Choice(replace(given, **changes), **values)
        found["errors"] = tuple(found["errors"])
        report = BudgetReport(**found)
        report.line()  # which fails for values of a wrong type
    except (KeyError, TypeError, ValueError, AttributeError):
        return None
    return report


def remember(path: Path | None, digest: str, report: BudgetReport) -> None:
    """Write a choice for a digest, where that is possible."""
    if path is None or (not (choices := _read(path)) and os.path.lexists(path)):
        return
    record = asdict(report)
    for name in CHOICES:
        if record[name] is not None:
            del record[name]["approximations"]
    choices = dict([*choices.items(), (digest, record)][-MAX_CHOICES:])
    with suppress(UserError):
        write_json(path, {"kind": KIND, "choices": choices})


def _read(path: Path | None) -> Mapping[str, Any]:
    """Return all choices of a file; empty for none and for a file of another kind."""
    with suppress(UserError, ValueError, TypeError, KeyError, RecursionError):
        if path is not None and path.is_file() and not path.is_symlink():
            content = json.loads(read_text(path, "choices for error budgets", MAX_BYTES))
            return dict(content["choices"]) if content["kind"] == KIND else {}
    return {}
