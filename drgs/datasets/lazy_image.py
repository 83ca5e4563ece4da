"""Pictures of a view as they are kept: bytes where they take less memory than numbers.

A photograph of three times 8 bits becomes four times as large as float32. What is kept is therefore
what the file holds, and the numbers are made when somebody asks for them; only of a picture that is
scaled down so much that its numbers take less, these are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin


@dataclass(frozen=True, eq=False)
class KeptPicture(NDArrayOperatorsMixin):
    """A picture whose numbers are made each time that somebody asks: ``np.asarray`` makes an array.

    So do an index, arithmetic and numpy's functions.
    """

    shape: tuple[int, ...]  # of the array: (H, W) or (H, W, 3), float32
    make: Callable[[], np.ndarray]
    nbytes: int  # that are kept; 0: those of another picture

    dtype: ClassVar = np.dtype(np.float32)

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> np.ndarray:
        """The numbers, as numpy asks for them."""
        if copy is False:
            raise ValueError("a picture that is kept as bytes becomes an array only by a copy")
        return np.asarray(self.make(), dtype)

    def __array_ufunc__(
        self, ufunc: np.ufunc, method: str, *inputs: object, **options: object
    ) -> object:
        """Of the numbers, as of those of any array among ``inputs``."""
        arrays = [np.asarray(x) if isinstance(x, KeptPicture) else x for x in inputs]
        return getattr(ufunc, method)(*arrays, **options)

    def __getitem__(self, index: object) -> np.ndarray:
        """Some of the numbers."""
        return self.make()[index]

    def __len__(self) -> int:
        """Rows."""
        return self.shape[0]


Pixels = np.ndarray | KeptPicture
"""A picture of a view; ``np.asarray`` makes an array of either."""


def kept_mask(mask: np.ndarray) -> KeptPicture:
    """A mask (H, W) of 1 and 0, in a byte each."""
    kept = mask.astype(np.uint8)
    return KeptPicture(mask.shape, lambda: kept.astype(np.float32), kept.nbytes)
