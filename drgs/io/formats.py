"""File formats of Gaussians: an extension point, and reading and writing through it.

A format is a subclass of :class:`FileFormat`, registered under its name::

    @FORMATS.register("npz")
    class Npz(FileFormat): ...

``Gaussians.load`` and ``save``, the plugins' ``filename``, and the commands choose a format by the
suffix of a file's name. :func:`read_gaussians` and :func:`encode` check all arrays.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from drgs.core.errors import UserError, note_user, one_line
from drgs.core.file_kinds import describe_file
from drgs.core.files import open_regular
from drgs.core.origin import WORLD, Origin
from drgs.core.registry import Extension, ExtensionError, Registry

Scalar = bool | int | float | str

SHAPES = {
    "means": [(3,)],
    "quats": [(4,)],
    "log_scales": [(3,)],
    "logit_opacities": [()],
    "sh0": [(1, 3)],
    "shN": [(0, 3), (3, 3), (8, 3), (15, 3)],
    "smoothing": [()],
}
"""Shapes that a Gaussian's part of each array can have; ``smoothing`` may be missing."""

Arrays = Mapping[str, np.ndarray]
"""Float32 arrays (N, *shape) by name, as the fields of ``Gaussians``; quaternions are wxyz."""

Rounding = Callable[[Arrays], Arrays]
"""Function from Gaussians to those that are read from a file of them, in the same order."""

ORIGIN = ("origin_x", "origin_y", "origin_z")  # in ``rendered_with``: world, of the means

PLAYCANVAS = MappingProxyType({"low_pass": 0.075})
"""Approximations of PlayCanvas and SuperSplat; low_pass in px^2, which others take for 0.3."""

UP = "up"  # in ``rendered_with`` of a file that records its axis: ``"y"`` or ``"z"``

MAX_ORIGIN = 1e12  # world units

Z_TO_Y = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Rotation from our worlds, in which z is up, to files in which y is up: x' = R x."""


class FileFormat:
    """Base class of file formats: class attributes state the abilities of the format.

    ``rendered_with`` contains by name the approximations that Gaussians are to be rendered with
    (:class:`drgs.config.approximations.Approximations`), and their origin (:data:`ORIGIN`) if it is
    not the world's. What is read may contain :data:`UP`, which overrides :attr:`up`.
    """

    suffix: str  # end of file names, in small letters, such as ``.npz``

    other_names: frozenset[str] = frozenset()  # of files that are read: whole ones, and suffixes

    description: str  # one phrase, for help texts

    up: str | None = None  # axis that the format defines as up, ``"y"`` or ``"z"``

    has_harmonics = True  # harmonics above degree 0 are kept

    has_smoothing = False  # the smoothing filter of each Gaussian is kept

    allows_nonfinite = False  # numbers that are not finite are written as they are

    metadata: frozenset[str] | None = frozenset()
    """Names of ``rendered_with`` that files can record; None: all. Notes report the others."""

    shown_with: Mapping[str, Scalar] = MappingProxyType({})
    """Approximations of the programs that read the format, where others than the defaults."""

    ranges: Mapping[str, tuple[float, float]] = MappingProxyType({})
    """Smallest and largest value of arrays, by name; :meth:`encode` cuts off what is beyond, and a
    note says how many Gaussians this changes."""

    def recognizes(self, path: Path) -> bool:
        """Return whether the content is of this format, for formats that share a suffix."""
        return True

    def read(self, path: Path) -> tuple[Arrays, Mapping[str, Scalar]]:
        """Return the Gaussians of a file, in its axes, and their ``rendered_with``.

        Raises :class:`UserError` naming the file, the place, what was expected and what was got.
        """
        raise UserError(f"{path}: files of this format can be written, but not read")

    def encode(self, gaussians: Arrays, rendered_with: Mapping[str, Scalar]) -> bytes:
        """Return the content of a file; equal Gaussians give equal bytes.

        gaussians: in the axes of the file, finite unless :attr:`allows_nonfinite`; rendered_with:
        only what :attr:`metadata` names.
        """
        raise UserError("files of this format can be read, but not written")

    def rounding(self, gaussians: Arrays) -> Rounding:
        """Return how files round Gaussians like these, so that a fit can take part in it.

        Optional, for ``output.small_file``, and formats without :attr:`up`. :meth:`encode` keeps
        what was rounded once.
        """
        raise UserError("fits do not know how files of this format are rounded")

    def __init_subclass__(cls) -> None:
        if not getattr(cls, "suffix", "").startswith(".") or cls.suffix != cls.suffix.lower():
            raise TypeError(f"{cls.__name__}.suffix must be a suffix in small letters, as .npz")
        if not getattr(cls, "description", ""):
            raise TypeError(f"{cls.__name__}.description must be a phrase for help texts")

    @classmethod
    def holds(cls, name: str) -> bool:
        """Return whether files hold this value of ``rendered_with``."""
        return cls.metadata is None or name in cls.metadata


FORMATS: Registry[type[FileFormat]] = Registry("file format", "drgs.formats", unique="suffix")


def readable_formats() -> list[Extension[type[FileFormat]]]:
    """Return the formats whose files can be read."""
    return [each for each in FORMATS.all() if each.value.read is not FileFormat.read]


def writable_formats() -> list[Extension[type[FileFormat]]]:
    """Return the formats whose files can be written."""
    return [each for each in FORMATS.all() if each.value.encode is not FileFormat.encode]


def fitted_formats() -> list[Extension[type[FileFormat]]]:
    """Return the formats whose rounding a fit can take part in."""
    return [each for each in FORMATS.all() if each.value.rounding is not FileFormat.rounding]


def _shipped_formats() -> list[Extension[type[FileFormat]]]:
    return [FORMATS.get(name) for name in FORMATS.shipped_names]


def format_for(path: str | Path) -> Extension[type[FileFormat]] | None:
    """Return the format with the longest suffix that a file's name ends in; None: there is none.

    Installed packages are imported only if no shipped format has such a suffix.
    """
    for formats in (_shipped_formats, FORMATS.installed_extensions):
        known = [each for each in formats() if Path(path).name.lower().endswith(each.value.suffix)]
        if known:
            return max(known, key=lambda each: len(each.value.suffix))
    return None


def format_to_read(path: str | Path) -> Extension[type[FileFormat]] | None:
    """Return the format of :func:`format_for`, or one that reads files of such a name."""
    names = {Path(path).name.lower(), Path(path).suffix.lower()}
    others = (each for each in _shipped_formats() if names & each.value.other_names)
    return format_for(path) or next(others, None)


def read_gaussians(
    path: str | Path,
) -> tuple[Extension[type[FileFormat]], dict[str, np.ndarray], dict[str, Scalar]]:
    """Return a file's format, its Gaussians in the axes of the file, and their ``rendered_with``.

    A file with an unknown suffix is read as PLY. Where shipped formats share the last part of a
    suffix, the content decides. Raises as :meth:`FileFormat.read`.
    """
    open_regular(path).close()
    named = format_to_read(path) or FORMATS.get("ply")
    if named.name == "ply" and (kind := describe_file(Path(path))):
        raise UserError(f"{path}: {kind}")
    last = "." + named.value.suffix.rpartition(".")[2]
    others = [each for each in _shipped_formats() if each.value.suffix.endswith(last)]
    for extension in (named, *(each for each in others if each is not named)):
        try:
            with extension.reporting():
                if not extension.value().recognizes(Path(path)):
                    continue
                arrays, rendered_with = extension.value().read(Path(path))
                return extension, _check_arrays(path, arrays), dict(rendered_with)
        except ExtensionError as error:
            raise ExtensionError(f"{path}: {error}") from error.__cause__
    raise UserError(f"{path}: not a {named.name} file")


def encode(name: str, gaussians: Arrays, rendered_with: Mapping[str, Scalar]) -> bytes:
    """Return the content of a file in the format ``name``, as :meth:`FileFormat.encode`.

    Values of ``rendered_with`` that the format cannot hold are left out.
    """
    extension = FORMATS.get(name)
    check(name, gaussians)
    kept = {k: v for k, v in rendered_with.items() if extension.value.holds(k)}
    beyond = []
    for field, (low, high) in extension.value.ranges.items():
        values = gaussians[field].reshape(len(gaussians[field]), -1)
        if number := np.count_nonzero(((values < low) | (values > high)).any(axis=1)):
            beyond.append(f"{field} of {number:,} (it holds {low:.4g} to {high:.4g})")
    if beyond:
        num = len(gaussians["means"])
        note_user(f"the format {name} cuts off, of {num:,} Gaussians: {'; '.join(beyond)}")
    with extension.reporting():
        content = extension.value().encode(gaussians, kept)
        if not isinstance(content, (bytes, bytearray, memoryview)):
            raise TypeError(f"encode() must return bytes, got {type(content).__name__}")
        return content


def check(name: str, gaussians: Arrays) -> None:
    """Raise :class:`UserError` for Gaussians that the format ``name`` cannot hold."""
    extension = FORMATS.get(name)
    check_shapes(name, gaussians)
    if "smoothing" in gaussians and not extension.value.has_smoothing:
        raise UserError(
            f"the format {name} has no room for the smoothing of Gaussians: bake it into them "
            "first, with drgs.effects.smoothing.bake_smoothing or drgs export"
        )
    if not extension.value.allows_nonfinite:
        if not len(gaussians["means"]):
            raise UserError(f"the format {name} needs at least one Gaussian, got none")
        for field, values in gaussians.items():
            check_range(f"the format {name}", field, values)


def check_shapes(name: str, gaussians: Arrays) -> None:
    """Raise :class:`UserError` for Gaussians to write that are not :data:`Arrays`."""
    try:
        _check_shapes(gaussians, 0)
    except ValueError as error:
        raise UserError(f"the format {name}: {error}") from None


def _check_shapes(arrays: Arrays, least: int = 1) -> None:
    """Raise ValueError if arrays do not have the names and shapes of :data:`Arrays`."""
    if set(arrays) - {"smoothing"} != set(SHAPES) - {"smoothing"}:
        raise ValueError(f"arrays must be {', '.join(SHAPES)}, got {', '.join(arrays)}")
    num = len(arrays["means"])
    for name, values in arrays.items():
        if num < least or np.shape(values) not in [(num, *shape) for shape in SHAPES[name]]:
            listed = " or ".join(map(str, SHAPES[name]))
            raise ValueError(f"{name}: {listed} per Gaussian expected, got {np.shape(values)}")
        if np.asarray(values).dtype.kind not in "fiu":
            raise ValueError(f"{name} must be real numbers, got {np.asarray(values).dtype}")


def _check_arrays(path: str | Path, arrays: Arrays) -> dict[str, np.ndarray]:
    """Return a format's arrays as float32; raise ValueError if they are not :data:`Arrays`."""
    _check_shapes(arrays)
    with np.errstate(over="ignore", invalid="ignore"):  # what becomes infinite is refused below
        arrays = {name: np.asarray(values, np.float32) for name, values in arrays.items()}
    for name, values in arrays.items():
        check_range(path, name, values)
    return arrays


def check_range(
    where: str | Path, name: str, values: np.ndarray, least: float = -np.inf, most: float = np.inf
) -> None:
    """Raise :class:`UserError` for a value (N, ...) that is not finite, or out of range.

    where, name: of the values, for the message.
    """
    bad = np.argwhere(~(np.isfinite(values) & (values >= least) & (values <= most)))
    if len(bad):
        limits = "finite" if least == -np.inf else f"at least {least:g}"
        limits = limits if most == np.inf else f"from {least:g} to {most:g}"
        raise UserError(
            f"{where}: {name} of Gaussian {bad[0][0]:,} must be {limits}, got "
            f"{values[tuple(bad[0])]}; correct or remove it"
        )


def pop_origin(path: str | Path, rendered_with: dict[str, Scalar]) -> Origin:
    """Remove the coordinates of the origin from ``rendered_with``, and return them.

    Raises :class:`UserError` for missing or invalid ones.
    """
    values = [rendered_with.pop(name, None) for name in ORIGIN]
    if values == [None, None, None]:
        return WORLD
    numbers = [v for v in values if type(v) is int or type(v) is float]
    if len(numbers) < 3 or not all(abs(number) <= MAX_ORIGIN for number in numbers):
        got = ", ".join("nothing" if value is None else str(value) for value in values)
        raise UserError(
            f"{path}: {', '.join(ORIGIN)} must be three numbers of at most {MAX_ORIGIN:g} in size, "
            f"got {one_line(got, 80)}; correct the header, or remove them"
        )
    x, y, z = map(float, numbers)
    return x, y, z
