"""Readers of dataset folders: an extension point.

A reader is a subclass of :class:`DatasetReader`, registered by ``READERS.register(NAME)``. A
configuration chooses it by ``data.type: NAME``, or by none: ``auto`` takes the first reader that
recognizes the folder.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import Any

from drgs.config.extensions import READERS
from drgs.config.schema import DataConfig
from drgs.datasets.photographs import Photographs, dataset_of
from drgs.datasets.transforms import Frame
from drgs.datasets.types import Dataset, Keeps, all_of_them

__all__ = ["READERS", "DatasetReader", "Frame", "Photographs", "dataset_of"]


class DatasetReader:
    """Base class of readers of a layout of folders."""

    @classmethod
    def from_config(cls, section: Any) -> DatasetReader:
        """Return the reader; section: the one that it has registered, or None."""
        return cls() if section is None else cls(section)

    def recognizes(self, folder: Path, names: Collection[str]) -> bool:
        """Return whether a folder has this layout; names: of the files and folders in it."""
        del folder, names
        return False

    def photographs(self, config: DataConfig) -> Photographs:
        """Return where the photographs of a folder are, with their cameras.

        A :class:`Frame` for each: ``Frame.from_camera`` makes those of pinhole cameras.
        """
        raise NotImplementedError

    def load(self, config: DataConfig, keeps: Keeps = all_of_them) -> Dataset:
        """Return the dataset, with the images of the views whose names ``keeps`` accepts.

        Splits, sizes, masks and backgrounds follow the section ``data``.
        """
        return dataset_of(config, self.photographs(config), keeps)

    def image_files(self, config: DataConfig) -> Sequence[Path]:
        """Return the files of the photographs, from whose sizes a configuration is chosen."""
        return [frame.files["image"] for frame in self.photographs(config).frames]
