"""Notes for the user on the photographs of a dataset, a line for each kind of finding."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path

import numpy as np

from drgs.core.errors import UserNote, format_names, one_line
from drgs.core.folders import digest
from drgs.datasets.types import View
from drgs.io.images import colour_profile

MAX_NOTE_CHARACTERS = 1000


class Notices:
    """Collects findings while photographs are read, on several threads."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._findings: dict[str, list[str]] = {}  # names of photographs

    def inspect(self, file: Path, pixels: np.ndarray) -> None:
        """Record findings on a photograph; pixels: (H, W, C), as they were read."""
        findings = []
        if profile := colour_profile(file):
            findings.append(f"with the colour profile {profile}, which is not applied")
        if pixels.shape[2] == 4 and not pixels[:, :, 3].any():
            findings.append("that are transparent everywhere")
        for finding in findings:
            self._findings.setdefault(finding, []).append(self._name(file))

    def emit(self, notes: Sequence[str], train: Sequence[View], test: Sequence[View]) -> None:
        """Emit ``notes`` and the findings, each as a :class:`UserNote`."""
        texts = [f"photographs {what}: {_format_files(n)}" for what, n in self._findings.items()]
        texts += self._duplicate_notes(train, test)
        for note in (*notes, *(f"{self._folder}: {text}" for text in texts)):
            warnings.warn(UserNote(one_line(note, MAX_NOTE_CHARACTERS)), stacklevel=2)

    def _name(self, file: Path) -> str:
        is_below = file.is_relative_to(self._folder)
        return str(file.relative_to(self._folder) if is_below else file)

    def _duplicate_notes(self, train: Sequence[View], test: Sequence[View]) -> list[str]:
        """Return a note on duplicate photographs, or none."""
        groups = [[*train, *test]]
        for key in (os.path.getsize, digest):
            groups = [part for group in groups for part in _group_duplicates(group, cache(key))]
        if not groups:
            return []
        pairs = [" = ".join(self._name(v.files["image"]) for v in group) for group in groups]
        note = f"the same photograph more than once: {_format_files(pairs)}"
        in_train, in_test = ({view.files["image"] for view in views} for views in (train, test))
        files = [{view.files["image"] for view in group} for group in groups]
        both = sum(bool(group & in_train and group & in_test) for group in files)
        return [note + (f"; {both:,} of them both trained and measured on" if both else "")]


def _format_files(names: Sequence[str]) -> str:
    ordered = sorted(names)
    return f"{len(ordered):,} ({format_names(ordered)})"


def _group_duplicates(views: Sequence[View], key: Callable[[Path], object]) -> list[list[View]]:
    """Return groups of several views whose photographs have the same key."""
    groups: dict[object, list[View]] = {}
    for view in views:
        groups.setdefault(key(view.files["image"]), []).append(view)
    return [group for group in groups.values() if len(group) > 1]
