"""NumPy's ``.npz`` as a file format of drgs: an archive with one array per field."""

import io
import json
from pathlib import Path

import numpy as np

from drgs.io.formats import FORMATS, Arrays, FileFormat, Scalar


@FORMATS.register("npz")
class Npz(FileFormat):
    """Full precision, not compressed."""

    suffix = ".npz"
    description = "NumPy's archive of arrays"
    has_smoothing = True
    metadata = None  # holds everything in rendered_with

    def read(self, path: Path) -> tuple[Arrays, dict[str, Scalar]]:
        """Return the arrays, and what they are rendered with."""
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        return arrays, json.loads(str(arrays.pop("rendered_with")))

    def encode(self, gaussians: Arrays, rendered_with: dict[str, Scalar]) -> bytes:
        """Return the content of a file."""
        content = io.BytesIO()
        np.savez(content, **gaussians, rendered_with=json.dumps(rendered_with))
        return content.getvalue()
