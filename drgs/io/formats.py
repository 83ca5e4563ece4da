"""The file formats of Gaussians, declared once: what each is called, holds and loses.

A format is a module with two functions, imported when it is used::

    read_gaussians(path) -> (arrays by the names of Gaussians' fields, what it is rendered with)
    encode(gaussians, rendered_with) -> bytes

with arrays as :mod:`drgs.io.ply` has them, in the axes of the file. Where means are relative to an
origin (:mod:`drgs.core.origin`), its coordinates stand among the values of ``rendered_with``, by
the names :data:`drgs.io.ply.ORIGIN`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

import numpy as np

from drgs.core.errors import UserError
from drgs.io.ply import Scalar

Z_TO_Y = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""From our worlds, where datasets have z up, to files of formats that have y up: x' = R x."""


@dataclass(frozen=True)
class Format:
    """One of them."""

    name: str  # as options have it
    suffix: str  # of files, in small letters
    module: str  # reads and writes it
    text: str  # what it is, one phrase
    y_up: bool = False  # whether y is up, as the format is specified; None of the others says
    has_harmonics: bool = True  # above degree 0
    has_smoothing: bool = False  # the filter of each Gaussian
    keeps: frozenset[str] | None = None  # what it can say of rendering, by name; None: everything
    any_number: bool = False  # whether what is no finite number is written as it is

    @property
    def has_origin(self) -> bool:
        """True where the format can record what means are relative to."""
        return self.keeps is None

    def encode(
        self, gaussians: Mapping[str, np.ndarray], rendered_with: Mapping[str, Scalar] | None
    ) -> bytes:
        """A file of Gaussians; equal ones give equal bytes. What has no room is left out.

        gaussians: by the names of the fields of ``Gaussians``, in the axes of the file.

        Raises :class:`UserError` where the format cannot hold them.
        """
        if "smoothing" in gaussians and not self.has_smoothing:
            raise UserError(
                f"the format {self.name} has no room for the smoothing of Gaussians: bake it into "
                "them first, with drgs.effects.smoothing.baked or drgs export"
            )
        if not self.any_number:
            check_finite(gaussians, self.name)
        said = {
            name: value
            for name, value in (rendered_with or {}).items()
            if self.keeps is None or name in self.keeps
        }
        return import_module(self.module).encode(gaussians, said)

    def unsaid(self, rendered_with: Mapping[str, Scalar] | None) -> dict[str, Scalar]:
        """What the format cannot say of how Gaussians are rendered."""
        said = rendered_with or {}
        return {k: v for k, v in said.items() if self.keeps is not None and k not in self.keeps}


FORMATS = (
    Format(
        "ply",
        ".ply",
        "drgs.io.ply",
        "the 3DGS reference's PLY, which every program reads",
        has_smoothing=True,
        any_number=True,
    ),
    Format(
        "compressed-ply",
        ".compressed.ply",
        "drgs.io.compressed_ply",
        "PlayCanvas's compressed PLY, for SuperSplat and PlayCanvas",
    ),
    Format(
        "spz",
        ".spz",
        "drgs.io.spz",
        "Niantic's SPZ, the smallest",
        y_up=True,
        keeps=frozenset({"antialiased"}),
    ),
    Format(
        "glb",
        ".glb",
        "drgs.io.glb",
        "binary glTF with KHR_gaussian_splatting, in full precision",
        y_up=True,
    ),
    Format(
        "splat",
        ".splat",
        "drgs.io.splat",
        "antimatter15's .splat, for old viewers: no harmonics",
        has_harmonics=False,
        keeps=frozenset(),
    ),
)
"""All that are read and written."""


def format_named(name: str) -> Format:
    """The format of that name, which must be one of :data:`FORMATS`."""
    return next(each for each in FORMATS if each.name == name)


def format_of(path: str | Path) -> Format | None:
    """The format that a file's name says; None: no known one."""
    name = Path(path).name.lower()
    found = [each for each in FORMATS if name.endswith(each.suffix)]
    return max(found, key=lambda each: len(each.suffix), default=None)


def read_gaussians(
    path: str | Path,
) -> tuple[Format, dict[str, np.ndarray], dict[str, Scalar]]:
    """The format of a file, its Gaussians as numpy float32 arrays, and what they are rendered with.

    A name that says no known format is that of a PLY file. Of PLY files, the content says whether
    they are compressed.

    Raises :class:`UserError` naming the file, the place and what is wrong there.
    """
    found = format_of(path) or format_named("ply")
    if found.suffix.endswith(".ply"):
        from drgs.io.compressed_ply import is_compressed

        found = format_named("compressed-ply" if is_compressed(path) else "ply")
    return found, *import_module(found.module).read_gaussians(path)


def check_finite(gaussians: Mapping[str, np.ndarray], name: str) -> None:
    """Refuse what formats have no code for: what is not finite, and nothing at all.

    gaussians: by the names of the fields of ``Gaussians``; name: of the format.
    """
    if not len(gaussians["means"]):
        raise UserError(f"the format {name} needs at least one Gaussian, got none")
    for field, values in gaussians.items():
        bad = np.argwhere(~np.isfinite(values))
        if len(bad):
            raise UserError(
                f"the format {name} holds finite numbers: {field} of Gaussian {bad[0][0]} is "
                f"{values[tuple(bad[0])]}; remove it"
            )
