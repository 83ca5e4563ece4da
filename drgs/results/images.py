"""A folder into which images are rendered: only files that were rendered before are replaced."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from drgs.core.errors import UserError, listed
from drgs.core.folders import FolderRecord, sole_writer

COMMAND = "render"

PHOTOGRAPHS = (".png", ".jpg", ".jpeg", ".webp", ".tif", ".tiff", ".bmp", ".exr")
"""Suffixes, in small letters, of a dataset's files."""

Image = TypeVar("Image")


@dataclass(frozen=True)
class ImageFolder:
    """The folder that a command renders into; see :func:`open_image_folder`."""

    path: Path
    keep: Callable[[], object]  # see :func:`drgs.core.folders.sole_writer`

    def claim(self, names: Iterable[str], images: Iterable[Image]) -> Iterator[Image]:
        """Yield the images after the files ``names`` were claimed for them.

        Raises :class:`UserError`, before the first image is made, where one of these files is there
        and was not rendered.
        """
        names, record = list(names), FolderRecord(self.path, COMMAND)
        record.check(names)
        for index, image in enumerate(images):
            if index == 0:  # there is something to write
                self.keep()
                record.claim(names)
            yield image

    def refuse_photographs(self, dataset: Path) -> None:
        """Raise :class:`UserError` where the folder contains images of the folder ``dataset``."""
        if not self.path.is_dir() or not self.path.resolve().is_relative_to(dataset.resolve()):
            return
        images = [n for n in sorted(os.listdir(self.path)) if n.lower().endswith(PHOTOGRAPHS)]
        if photographs := FolderRecord(self.path, COMMAND).strangers(images):
            raise UserError(
                f"--out {self.path}: holds pictures of the dataset ({listed(photographs)}); choose "
                "a folder of its own"
            )


@contextmanager
def open_image_folder(path: Path) -> Iterator[ImageFolder]:
    """Render into a folder within the block; then record the images, also after Ctrl-C."""
    with sole_writer(path) as keep:
        try:
            yield ImageFolder(path, keep)
        finally:
            with suppress(UserError):  # a full disk: all are still known to be ours
                record = FolderRecord(path, COMMAND)
                if record.exists:
                    keep()  # or it is another command's
                    record.seal()
