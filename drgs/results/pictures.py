"""The folder into which pictures are rendered: nothing is replaced but what was rendered before."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from drgs.core.errors import UserError, listed
from drgs.core.files import read_text
from drgs.core.folders import FolderRecord, sole_writer
from drgs.results.files import METRICS, ORBIT, ORBIT_GIF

COMMAND = "render"

PHOTOGRAPHS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr")
"""Suffixes, in small letters, of what a dataset may consist of."""

MAX_BYTES = 1 << 28
"""Of ``metrics.json``."""

EARLIER_ORBIT = re.compile(r"orbit_\d{3,}\.png")

Picture = TypeVar("Picture")


def claiming(
    out: Path, names: Iterable[str], pictures: Iterable[Picture], keep: Callable[[], object]
) -> Iterator[Picture]:
    """The pictures, after the files ``names`` of the folder ``out`` were claimed for them.

    keep: what :func:`sealing` yields.

    Raises :class:`UserError`, before the first picture is made, where one of these files is there
    and was not rendered.
    """
    names, record, earlier = list(names), FolderRecord(out, COMMAND), _of_earlier_version(out)
    record.check(names, earlier)
    for index, picture in enumerate(pictures):
        if index == 0:  # which has shown that there is something to write
            keep()
            record.claim(names, earlier=earlier)
        yield picture


@contextmanager
def sealing(out: Path) -> Iterator[Callable[[], object]]:
    """After the block, note what the pictures in ``out`` are; also where Ctrl-C ended it.

    Yields what keeps the folder from other commands: see :func:`drgs.core.folders.sole_writer`.
    """
    with sole_writer(out) as keep:
        try:
            yield keep
        finally:
            with suppress(UserError):  # of a disk that is full: all are still known to be ours
                record = FolderRecord(out, COMMAND)
                if record.exists:
                    keep()  # or it is another command's
                    record.seal()


def refuse_photographs(out: Path, dataset: Path) -> None:
    """Raise :class:`UserError` where ``out`` holds pictures of the folder ``dataset``."""
    if not out.is_dir() or not out.resolve().is_relative_to(dataset.resolve()):
        return
    pictures = [name for name in sorted(os.listdir(out)) if name.lower().endswith(PHOTOGRAPHS)]
    record = FolderRecord(out, COMMAND)
    known = () if record.exists else _of_earlier_version(out)
    photographs = [name for name in record.strangers(pictures) if name not in known]
    if photographs:
        raise UserError(
            f"--out {out}: holds pictures of the dataset ({listed(photographs)}); choose a folder "
            "of its own"
        )


def _of_earlier_version(out: Path) -> set[str]:
    """Files of a version that kept no record, where they tell by themselves what they are."""
    found = set()
    if (out / ORBIT).is_file() and (out / ORBIT_GIF).is_file():
        frames = filter(EARLIER_ORBIT.fullmatch, os.listdir(out))
        found |= {ORBIT, ORBIT_GIF, *frames}
    if (out / METRICS).is_file():
        try:
            metrics = json.loads(read_text(out / METRICS, "metrics", MAX_BYTES))
            if {"split", "num_views", "num_gaussians", "mean"} <= set(metrics):
                found |= {METRICS, *(f"{name}.png" for name in metrics["views"])}
        except (ValueError, TypeError, KeyError, RecursionError):  # another file of this name
            pass
    return found
