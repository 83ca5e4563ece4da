"""Stores of photographs' pixels while a fit uses them: memory, or a disk.

Photographs that would not fit into memory are in a temporary file, which the system removes with
the process, however that ends.
"""

from __future__ import annotations

import math
import os
import shutil
import tempfile
import threading
import weakref
from functools import partial
from pathlib import Path

import numpy as np
from typing_extensions import override

from drgs.core.errors import UserError
from drgs.core.files import refusal_reason
from drgs.core.memory import format_bytes
from drgs.datasets.types import LazyImage, Pixels, View


class MemoryStore:
    """Keeps pixels in memory."""

    is_on_disk = False

    def keep(self, array: np.ndarray) -> Pixels:
        """Return the array, or a lazy image that becomes the same one."""
        return array


class DiskStore(MemoryStore):
    """Writes pixels to a temporary file in ``TMPDIR`` or else ``/var/tmp``."""

    is_on_disk = True

    def __init__(self, num_bytes: int, num_photographs: int) -> None:
        """num_bytes: to be written.

        Raises :class:`UserError` unless a disk has room for them.
        """
        # Many systems have /tmp in memory.
        self._folder = Path(os.environ.get("TMPDIR", "/var/tmp"))
        self._lock = threading.Lock()
        try:
            free = shutil.disk_usage(self._folder).free
            if num_bytes > free:
                raise UserError(
                    f"{self._folder}: {num_photographs:,} photographs take "
                    f"{format_bytes(num_bytes)} there during the fit, and {format_bytes(free)} are "
                    "free; set TMPDIR to a folder of a larger disk or a smaller data.image_size, "
                    "or use fewer of them"
                )
            self._file = tempfile.TemporaryFile(dir=self._folder, prefix="drgs")  # noqa: SIM115
        except OSError as error:
            raise self._error("cannot write photographs", error) from None
        weakref.finalize(self, self._file.close)

    def _error(self, what: str, error: OSError) -> UserError:
        return UserError(f"{self._folder}: {what} (data.in_memory): {refusal_reason(error)}")

    @override
    def keep(self, array: np.ndarray) -> LazyImage:
        """Write the array; several threads may."""
        try:
            with self._lock:
                position = self._file.seek(0, os.SEEK_END)
                self._file.write(np.ascontiguousarray(array).data)
                self._file.flush()
        except OSError as error:
            raise self._error("cannot write photographs", error) from None
        read = partial(self._read, position, array.shape, array.dtype)
        return LazyImage(array.shape, read, 0, is_on_disk=True)

    def _read(self, position: int, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
        try:
            content = os.pread(self._file.fileno(), math.prod(shape) * dtype.itemsize, position)
        except OSError as error:
            raise self._error("cannot read photographs again", error) from None
        return np.frombuffer(bytearray(content), dtype).reshape(shape)


MEMORY = MemoryStore()


def is_on_disk(view: View) -> bool:
    """Return whether images of the view are read from disk at each use."""
    images = (view.image, view.alpha, view.mask, view.depth)
    return any(isinstance(image, LazyImage) and image.is_on_disk for image in images)
