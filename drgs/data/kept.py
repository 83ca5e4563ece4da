"""Pictures of a view as they are kept: bytes where they take less memory than numbers.

A photograph of three times 8 bits becomes four times as large as float32. What is kept is therefore
what the file holds, and the numbers are made when somebody asks for them; only of a picture that is
scaled down so much that its numbers take less, these are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class KeptPicture:
    """A picture whose numbers are made each time that it becomes an array: ``np.asarray(it)``."""

    shape: tuple[int, ...]  # of the array: (H, W) or (H, W, 3), float32
    make: Callable[[], np.ndarray]
    nbytes: int  # that are kept; 0: those of another picture

    def __array__(self, dtype: np.dtype | None = None, copy: bool | None = None) -> np.ndarray:
        """The numbers, as numpy asks for them."""
        if copy is False:
            raise ValueError("a picture that is kept as bytes becomes an array only by a copy")
        return np.asarray(self.make(), dtype)


Pixels = np.ndarray | KeptPicture
"""A picture of a view; ``np.asarray`` makes an array of either."""


def kept_mask(mask: np.ndarray) -> KeptPicture:
    """A mask (H, W) of 1 and 0, in a byte each."""
    kept = mask.astype(np.uint8)
    return KeptPicture(mask.shape, lambda: kept.astype(np.float32), kept.nbytes)
