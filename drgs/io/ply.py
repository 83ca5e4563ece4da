"""PLY files: Gaussians in the layout of the 3DGS reference, and plain point clouds.

The reference (Kerbl et al. 2023, ``save_ply``) writes one float32 row per Gaussian::

    x y z  nx ny nz  f_dc_0..2  f_rest_0..3(K-1)-1  opacity  scale_0..2  rot_0..3

with zero normals, the raw values that are optimised (logit opacity, natural logarithm of the
scales, unnormalised wxyz quaternion), and ``f_rest`` channel-major: all coefficients of red,
then of green, then of blue. K = (degree + 1)^2. Gaussians with a smoothing filter have one property
more, ``filter_3D``, the filter's standard deviation, as in Mip-Splatting's files.

What Gaussians are to be rendered with stands in comments of the header, a line for each value that
viewers would not take by themselves::

    comment drgs antialiased true
    comment drgs low_pass 0.1

What positions are relative to, where that is far from the world's origin, stands there as well::

    comment drgs origin_x 4200000.0
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import IO

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty

from drgs.core.errors import UserError, UserNote, listed, one_line
from drgs.core.files import open_regular
from drgs.core.memory import require_memory
from drgs.core.origin import WORLD, near_means
from drgs.io.formats import FORMATS, ORIGIN, FileFormat, Scalar, pop_origin
from drgs.io.quantization import LARGEST_LOGIT, SMALLEST_LOGIT

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
OPACITY = ("opacity",)
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
SMOOTHING = ("filter_3D",)
COLOR = ("red", "green", "blue")

NUM_REST = {3 * ((degree + 1) ** 2 - 1): degree for degree in range(4)}
"""Number of ``f_rest`` properties -> degree: 0, 9, 24, 45 -> 0, 1, 2, 3."""

ROWS_AND_COPIES = 3
"""Memory that reading takes, in rows: Gaussians take 2.8 times theirs, from text as well."""

MAX_HEADER_BYTES = 1 << 20
"""The header of 62 properties takes 1.5 kB; the rest is room for comments."""

STATEMENT = re.compile(r"drgs ([a-z][a-z_]{0,39}) ([!-~]{1,40})")
"""A comment of ours: a name and its value. Others are somebody else's."""


def read_gaussians(path: str | Path) -> tuple[dict[str, np.ndarray], dict[str, Scalar]]:
    """Gaussians as numpy float32 arrays, and by name what its header says they are rendered with.

    The arrays have the values and the SH degree that the file holds. They come by the names of the
    fields of :class:`drgs.gaussians.parameters.Gaussians`, whose ``load`` calls this; ``smoothing``
    is missing where the file has none. Properties are found by name, in any order and of any
    numeric type; others are ignored. Positions of float64 that are far from the origin are relative
    to another one, which is then among what the header says. Infinite logits, which formats with
    opacities of 8 bits leave for 1 and 0, become the ends of what sigmoids tell apart, with a
    :class:`UserNote`. What the header says is not checked: its names and limits are not known here.

    Raises :class:`UserError` naming the file and what it lacks: it must be whole, hold at least
    one row, and otherwise nothing but finite numbers.
    """
    vertex, statements = _read_vertices(path)
    num_rest = sum(name.startswith("f_rest_") for name in vertex.dtype.names)
    if num_rest not in NUM_REST:
        raise UserError(
            f"{path}: the number of f_rest properties must be one of {sorted(NUM_REST)} "
            f"(SH degree 0 to 3), got {num_rest}"
        )
    names = (*POSITION, *SH0, *_rest(num_rest), *OPACITY, *SCALE, *ROTATION)
    _require(path, vertex, names, "Gaussians", infinite=OPACITY)
    sh_rest = _columns(vertex, _rest(num_rest)).reshape(len(vertex), 3, num_rest // 3)
    means = _columns(vertex, POSITION, np.float64)
    if vertex.dtype["x"] == np.float64:
        means, origin = near_means(means)
        if origin != WORLD:
            statements |= zip(ORIGIN, origin, strict=True)
    gaussians = {
        "means": means.astype(np.float32),
        "quats": _columns(vertex, ROTATION),
        "log_scales": _columns(vertex, SCALE),
        "logit_opacities": _finite_logits(path, _columns(vertex, OPACITY)[:, 0]),
        "sh0": _columns(vertex, SH0)[:, None, :],
        "shN": np.ascontiguousarray(sh_rest.transpose(0, 2, 1)),
    }
    if set(SMOOTHING) <= set(vertex.dtype.names):
        _require(path, vertex, SMOOTHING, "Gaussians")
        gaussians["smoothing"] = _columns(vertex, SMOOTHING)[:, 0]
    return gaussians, statements


def encode(
    gaussians: Mapping[str, np.ndarray], rendered_with: Mapping[str, Scalar] | None = None
) -> bytes:
    """A file of Gaussians as the 3DGS reference writes it, binary little-endian.

    gaussians: numpy arrays by the names that :func:`read_gaussians` gives; rendered_with: for the
    header, None: nothing is said. Equal Gaussians give equal bytes.

    Raises ValueError for what :data:`STATEMENT` cannot say.
    """
    g = gaussians
    num, num_rest = len(g["means"]), 3 * g["shN"].shape[1]
    names = (*POSITION, *NORMAL, *SH0, *_rest(num_rest), *OPACITY, *SCALE, *ROTATION)
    names += SMOOTHING if "smoothing" in g else ()
    rows = np.concatenate(
        [
            g["means"],
            np.zeros((num, 3)),
            g["sh0"].reshape(num, 3),
            g["shN"].transpose(0, 2, 1).reshape(num, num_rest),
            g["logit_opacities"].reshape(num, 1),
            g["log_scales"],
            g["quats"],
            *([g["smoothing"].reshape(num, 1)] if "smoothing" in g else []),
        ],
        axis=1,
    ).astype("<f4")
    vertex = rows.view([(name, "<f4") for name in names]).reshape(num)
    return encode_elements({"vertex": vertex}, rendered_with)


def encode_elements(
    elements: Mapping[str, np.ndarray], rendered_with: Mapping[str, Scalar] | None = None
) -> bytes:
    """A binary little-endian file of structured arrays by name, in their order.

    rendered_with and errors: as of :func:`encode`.
    """
    comments = [_statement(name, value) for name, value in (rendered_with or {}).items()]
    described = [PlyElement.describe(rows, name) for name, rows in elements.items()]
    file = io.BytesIO()
    PlyData(described, byte_order="<", comments=comments).write(file)
    return file.getvalue()


def _statement(name: str, value: Scalar) -> str:
    """The comment that says it."""
    comment = f"drgs {name} {str(value).lower() if isinstance(value, bool) else value}"
    if STATEMENT.fullmatch(comment) is None:
        raise ValueError(
            f"rendered_with must be names and values of one word, got {name!r}: {value!r}"
        )
    return comment


def _statements(path: str | Path, lines: list[bytes]) -> dict[str, Scalar]:
    """Return the values in the comments of a header; lines: of the header."""
    found: dict[str, str] = {}
    for line in lines:
        match = STATEMENT.fullmatch(
            line.decode("ascii", "replace").removeprefix("comment ").strip()
        )
        if match is None or not line.startswith(b"comment "):
            continue
        name, text = match.groups()
        if found.setdefault(name, text) != text:
            raise UserError(
                f"{path}: the header's comments must give {name} once, got {found[name]} and "
                f"{text}; remove one of the lines"
            )
    return {name: _scalar(text) for name, text in found.items()}


def _scalar(text: str) -> Scalar:
    """A truth value or a number, if ``text`` is one."""
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def read_points(path: str | Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Positions (N, 3) float64, world, and colours (N, 3) float32 in 0..1, or None without any.

    Integer colours count from 0 to 255, or to 65535 in unsigned 16 bits; floats are taken as they
    are.

    Raises :class:`UserError` naming the file and what it lacks, as :func:`read_gaussians` does.
    """
    vertex, statements = _read_vertices(path)
    _require(path, vertex, POSITION, "points")
    positions = _columns(vertex, POSITION, np.float64) + pop_origin(path, statements)
    if not set(COLOR) <= set(vertex.dtype.names):
        return positions, None
    _require(path, vertex, COLOR, "coloured points")
    colors = _columns(vertex, COLOR)
    kind = vertex.dtype["red"]
    if np.issubdtype(kind, np.integer):
        colors = colors / np.float32(65535 if kind == np.uint16 else 255)
    bad = np.argwhere(~((colors >= 0) & (colors <= 1)))
    if len(bad):
        row, channel = bad[0]
        raise UserError(
            f"{path}: element vertex, row {row}: red, green, blue must be integers in 0..255 or "
            f"floats in 0..1, got {COLOR[channel]} = {vertex[COLOR[channel]][row]}"
        )
    return positions, colors


def properties_of(path: str | Path) -> dict[str, tuple[str, ...]]:
    """Return the names of the properties of each element, as the header has them.

    Raises :class:`UserError` as :func:`read_gaussians` does for a header.
    """
    with _opened(path) as (_, layout):
        return {e.name: tuple(p.name for p in e.properties) for e in layout.elements}


def has_packed_vertices(path: str | Path) -> bool:
    """Return whether a PLY file is one of :mod:`drgs.io.compressed_ply`.

    Raises :class:`UserError` as :func:`properties_of` does.
    """
    elements = properties_of(path)
    return "chunk" in elements and "packed_position" in elements["vertex"]


def read_elements(
    path: str | Path, names: Collection[str]
) -> tuple[dict[str, np.ndarray], dict[str, Scalar]]:
    """Return the rows of some elements of a binary file, and the values in the header's comments.

    names: of elements that are there, among them ``vertex``. The rows are structured arrays of
    numbers.

    Raises :class:`UserError` as :func:`read_gaussians` does, and for a text file.
    """
    with _opened(path) as (file, layout):
        if layout.text:
            raise UserError(f"{path}: the file must be binary, got text; convert it")
        return _rows(path, file, layout, names), layout.statements


def _read_vertices(path: str | Path) -> tuple[np.ndarray, dict[str, Scalar]]:
    """Return the rows of element ``vertex``, at least one, and the values in the comments."""
    with _opened(path) as (file, layout):
        if layout.text:
            return _text_rows(path, file, layout), layout.statements
        return _rows(path, file, layout, ["vertex"])["vertex"], layout.statements


@contextmanager
def _opened(path: str | Path) -> Iterator[tuple[IO[bytes], _Layout]]:
    """Open a file and read its header; whatever fails in the block becomes a :class:`UserError`."""
    try:
        with open_regular(path) as file:
            yield file, _read_layout(path, file)
    except (UserError, MemoryError):
        raise
    except OSError as error:
        raise UserError(f"{path}: cannot read the file: {error.strerror or error}") from None
    except Exception as error:  # plyfile and NumPy raise many types for a broken file
        reason = one_line(error) or type(error).__name__
        raise UserError(f"{path}: not a valid PLY file: {reason}") from None


@dataclass(frozen=True)
class _Layout:
    """Content of a header. The elements have no rows; ``counts`` has their promised numbers."""

    elements: tuple[PlyElement, ...]
    counts: tuple[int, ...]
    statements: dict[str, Scalar]
    text: bool
    byte_order: str  # NumPy's: < or >
    start: int  # byte: end of the header
    end: int  # byte: of the file

    @property
    def vertex(self) -> int:
        """Index of the element that is read."""
        return [element.name for element in self.elements].index("vertex")

    def promised(self) -> str:
        """The rows, as messages name them."""
        return listed([f"{n} of {e.name}" for e, n in zip(self.elements, self.counts, strict=True)])


def _read_layout(path: str | Path, file: IO[bytes]) -> _Layout:
    """Read and check the header, by plyfile.

    Refuses counts of rows that the file cannot hold, each row being a byte or more, before memory
    is allocated for them.
    """
    content = file.read(MAX_HEADER_BYTES)
    newline = next((n for n in (b"\r\n", b"\r") if content.startswith(b"ply" + n)), b"\n")
    header, end, _ = content.partition(newline + b"end_header" + newline)
    if not end:
        raise UserError(
            f"{path}: not a valid PLY file: the header must end with end_header within the first "
            f"{MAX_HEADER_BYTES:,} bytes"
        )
    size = file.seek(0, io.SEEK_END)
    lines, counts = header.split(newline), []
    for index, line in enumerate(lines):
        words = line.split()
        if words[:1] == [b"element"] and len(words) == 3:
            counts.append(int(words[2]))
            lines[index] = b"element %s 0" % words[1]  # plyfile is to read no rows
            if counts[-1] > size:
                raise UserError(
                    f"{path}: the file is cut off: its header promises {counts[-1]:,} rows of "
                    f"element {one_line(words[1].decode(), 60)}, got {size:,} bytes in all"
                )
    ply = PlyData.read(io.BytesIO(b"\n".join([*lines, b"end_header", b""])))
    start = len(header) + len(end)
    said = _statements(path, lines)
    layout = _Layout(ply.elements, tuple(counts), said, ply.text, ply.byte_order, start, size)
    _check_layout(path, layout)
    return layout


def _check_layout(path: str | Path, layout: _Layout) -> None:
    """Refuse a file without vertices, or whose vertices are not rows of equal length."""
    names = [element.name for element in layout.elements]
    if "vertex" not in names:
        raise UserError(
            f"{path}: element vertex is missing; elements are: {listed(names) or 'none'}"
        )
    if layout.counts[layout.vertex] < 1:
        raise UserError(
            f"{path}: element vertex must have at least 1 row, got {layout.counts[layout.vertex]}"
        )
    if found := _lists(layout.elements[layout.vertex]):
        raise UserError(
            f"{path}: element vertex: properties {listed(found)} must be numbers, got lists; "
            "write the file without them"
        )
    for element in layout.elements[: layout.vertex]:
        if not layout.text and _lists(element):
            raise UserError(
                f"{path}: element {one_line(element.name, 60)}, which has lists, must come behind "
                "element vertex; write the file with its vertices first"
            )


def _lists(element: PlyElement) -> list[str]:
    return [p.name for p in element.properties if isinstance(p, PlyListProperty)]


def _rows(
    path: str | Path, file: IO[bytes], layout: _Layout, names: Collection[str]
) -> dict[str, np.ndarray]:
    """Read some elements of a binary file. What follows an element with lists is not read."""
    position, places = layout.start, {}
    for element, count in zip(layout.elements, layout.counts, strict=True):
        if _lists(element):  # behind the vertices: where these end, nobody knows
            break
        dtype = element.dtype(layout.byte_order)
        width = max(1, dtype.itemsize)
        if element.name in names:
            places[element.name] = position, dtype, count
        if position + count * width > layout.end:
            _refuse_end(path, element, count, (layout.end - position) // width)
        position += count * width
    else:
        _check_end(path, layout, layout.end - position)
    if missing := [name for name in names if name not in places]:
        raise UserError(
            f"{path}: element {missing[0]} must have no lists, and come before elements that have"
        )
    of_rows = sum(dtype.itemsize * count for _, dtype, count in places.values())
    require_memory(path, ROWS_AND_COPIES * of_rows, layout.promised())
    rows = {}
    for name, (start, dtype, count) in places.items():
        file.seek(start)
        rows[name] = np.fromfile(file, dtype, count)
    return rows


def _text_rows(path: str | Path, file: IO[bytes], layout: _Layout) -> np.ndarray:
    """Read the vertices of a text file, in which each row is a line."""
    file.seek(layout.start)
    lines = io.TextIOWrapper(file, "ascii")
    rows = None
    for index, (element, count) in enumerate(zip(layout.elements, layout.counts, strict=True)):
        if index == layout.vertex:
            with warnings.catch_warnings():  # of no rows, which are refused below
                warnings.simplefilter("ignore")
                kind = element.dtype()
                require_memory(path, ROWS_AND_COPIES * kind.itemsize * count, layout.promised())
                rows = np.loadtxt(islice(lines, count), kind, comments=None, ndmin=1)
            found = len(rows)
        else:
            found = sum(1 for _ in islice(lines, count))
        if found < count:
            _refuse_end(path, element, count, found)
    rest = [len(line) for line in lines if line.strip()]
    _check_end(path, layout, sum(rest))
    return rows


def _refuse_end(path: str | Path, element: PlyElement, promised: int, got: int) -> None:
    raise UserError(
        f"{path}: not a valid PLY file: element {one_line(element.name, 60)} must have the "
        f"{promised:,} rows that the header promises, got {got:,}: the file is cut off; get it "
        "again"
    )


def _check_end(path: str | Path, layout: _Layout, more: int) -> None:
    """Refuse what follows the last row; more: bytes."""
    if more:
        raise UserError(
            f"{path}: the file must end after the rows that its header promises "
            f"({layout.promised()}), got {more:,} bytes more; correct the header's counts, or get "
            "the file again"
        )


def _finite_logits(path: str | Path, logits: np.ndarray) -> np.ndarray:
    """Logits with infinite ones at the ends of what sigmoids in float32 tell apart."""
    if count := np.count_nonzero(np.isinf(logits)):
        note = (
            f"{path}: {count:,} of {len(logits):,} opacities are infinite logits, as formats of 8 "
            f"bits leave them for 1 and 0; read as {LARGEST_LOGIT:.2f} and {SMALLEST_LOGIT:.2f}"
        )
        warnings.warn(UserNote(note), stacklevel=2)
    ends = {"posinf": np.float32(LARGEST_LOGIT), "neginf": np.float32(SMALLEST_LOGIT)}
    return np.nan_to_num(logits, nan=np.nan, **ends)


def _require(
    path: str | Path,
    vertex: np.ndarray,
    names: tuple[str, ...],
    what: str,
    infinite: tuple[str, ...] = (),
) -> None:
    """Refuse properties that are missing, or whose numbers are not all finite.

    infinite: those of ``names`` that may be infinite, but not NaN.
    """
    missing = [name for name in names if name not in vertex.dtype.names]
    if missing:
        raise UserError(f"{path}: not a PLY of {what}: properties {', '.join(missing)} are missing")
    bad = []
    for name in names:
        column = _columns(vertex, (name,))[:, 0]
        wrong = np.isnan(column) if name in infinite else ~np.isfinite(column)
        bad.append((np.flatnonzero(wrong), name))
    found = [(rows[0], name) for rows, name in bad if len(rows)]
    if found:
        row, name = min(found, key=lambda item: item[0])
        num_bad = len(np.unique(np.concatenate([rows for rows, _ in bad])))
        raise UserError(
            f"{path}: element vertex, row {row}: {name} must be a finite float32 number, got "
            f"{vertex[name][row]} ({num_bad:,} of {len(vertex):,} rows are not finite; remove them)"
        )


def _rest(num_rest: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(num_rest))


def _columns(vertex: np.ndarray, names: tuple[str, ...], kind: type = np.float32) -> np.ndarray:
    """(N, len(names)) of a float type, a copy."""
    rows = np.empty((len(vertex), len(names)), kind)
    with np.errstate(over="ignore"):  # a float64 beyond float32 becomes inf, which is refused
        for column, name in enumerate(names):
            rows[:, column] = vertex[name]
    return rows


@FORMATS.register("ply")
class Ply(FileFormat):
    """The 3DGS reference's PLY."""

    suffix = ".ply"
    description = "the 3DGS reference's PLY, which every program reads"
    has_smoothing = True
    allows_nonfinite = True
    metadata = None
    read = staticmethod(read_gaussians)
    encode = staticmethod(encode)

    def recognizes(self, path: Path) -> bool:
        """Return whether the vertices are not packed."""
        return not has_packed_vertices(path)
