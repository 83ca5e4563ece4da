"""PLY files: Gaussians in the layout of the 3DGS reference, and plain point clouds.

The reference (Kerbl et al. 2023, ``save_ply``) writes one float32 row per Gaussian::

    x y z  nx ny nz  f_dc_0..2  f_rest_0..3(K-1)-1  opacity  scale_0..2  rot_0..3

with zero normals, the raw values that are optimised (logit opacity, natural logarithm of the
scales, unnormalised wxyz quaternion), and ``f_rest`` channel-major: all coefficients of red,
then of green, then of blue. K = (degree + 1)^2. Gaussians with a smoothing filter have one property
more, ``filter_3D``, the filter's standard deviation, as in Mip-Splatting's files.

Rendering settings that differ from those of viewers are comments of the header, a line each, and so
is an origin other than the world's::

    comment drgs antialiased true
    comment drgs low_pass 0.1
    comment drgs origin_x 4200000.0

Compensated opacities are marked for other programs as well, and read from their marks: ``comment
SplatRenderMode: mip`` (Brush, gsplat) and ``comment postshot.anti_aliasing=1``.
"""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import islice, takewhile
from pathlib import Path
from typing import IO, NoReturn

import numpy as np
from plyfile import PlyData, PlyElement, PlyListProperty
from typing_extensions import override

from drgs.core.errors import UserError, format_names, note_user, one_line
from drgs.core.files import open_regular, refuse_damage
from drgs.core.memory import require_memory
from drgs.core.origin import WORLD, recenter_means
from drgs.io.formats import FORMATS, ORIGIN, Arrays, FileFormat, Scalar, pop_origin
from drgs.io.quantization import MAX_LOGIT, MIN_LOGIT

POSITION = ("x", "y", "z")
NORMAL = ("nx", "ny", "nz")
SH0 = ("f_dc_0", "f_dc_1", "f_dc_2")
OPACITY = ("opacity",)
SCALE = ("scale_0", "scale_1", "scale_2")
ROTATION = ("rot_0", "rot_1", "rot_2", "rot_3")
SMOOTHING = ("filter_3D",)
COLOR = ("red", "green", "blue")

NUM_REST = (0, 9, 24, 45)  # ``f_rest`` properties, by SH degree

MEMORY_RATIO = 3  # memory that reading takes, in bytes of the rows: measured 2.8, also from text

MAX_HEADER_BYTES = 1 << 20  # the header of 62 properties takes 1.5 kB; the rest is for comments

STATEMENT = re.compile(r"drgs ([a-z][a-z_]{0,39}) ([!-~]{1,40})")
"""A comment of ours: a name and its value. Others but the following are ignored."""

MIP = "SplatRenderMode: mip"
ANTIALIASED = re.compile(
    r"SplatRenderMode: *mip|postshot\.anti_aliasing *= *1|antialiased 1", re.IGNORECASE
)
"""Comments of Brush and of Postshot's versions for ``antialiased``, which ours override."""


@FORMATS.register("ply")
class Ply(FileFormat):
    """The 3DGS reference's PLY."""

    suffix = ".ply"
    description = "the 3DGS reference's PLY, which every program reads"
    has_smoothing = True
    allows_nonfinite = True
    metadata = None

    @override
    def read(self, path: Path) -> tuple[Arrays, Mapping[str, Scalar]]:
        """Return Gaussians, and the values in the header's comments.

        Properties are found by name, in any order and of any numeric type; others are ignored.
        Positions of float64 that are far from the origin become relative to another one. Infinite
        logits, which formats with opacities of 8 bits leave for 1 and 0, become the ends of what
        sigmoids tell apart, with a :class:`UserNote`.
        """
        rows, statements = read_elements(path, ["vertex"])
        vertex = rows["vertex"]
        num_rest = sum(name.startswith("f_rest_") for name in vertex.dtype.names or ())
        if num_rest not in NUM_REST:
            raise UserError(
                f"{path}: the number of f_rest properties must be one of {list(NUM_REST)} "
                f"(SH degree 0 to 3), got {num_rest}"
            )
        names = (*POSITION, *SH0, *_rest(num_rest), *OPACITY, *SCALE, *ROTATION)
        _require(path, vertex, names, "Gaussians")
        means = _columns(vertex, POSITION, np.float64)
        if vertex.dtype["x"] == np.float64:
            with np.errstate(invalid="ignore", over="ignore"):  # of what is refused later
                means, origin = recenter_means(means)
            if origin != WORLD:
                statements |= zip(ORIGIN, origin, strict=True)
        sh_rest = _columns(vertex, _rest(num_rest)).reshape(len(vertex), 3, num_rest // 3)
        gaussians = {
            "means": means,
            "quats": _columns(vertex, ROTATION),
            "log_scales": _columns(vertex, SCALE),
            "logit_opacities": _finite_logits(path, _columns(vertex, OPACITY)[:, 0]),
            "sh0": _columns(vertex, SH0)[:, None, :],
            "shN": np.ascontiguousarray(sh_rest.transpose(0, 2, 1)),
        }
        if set(SMOOTHING) <= set(vertex.dtype.names or ()):
            gaussians["smoothing"] = _columns(vertex, SMOOTHING)[:, 0]
        return gaussians, statements

    @override
    def encode(self, gaussians: Arrays, rendered_with: Mapping[str, Scalar]) -> bytes:
        """Return a file as the 3DGS reference writes it, binary little-endian."""
        num, num_rest = len(gaussians["means"]), 3 * gaussians["shN"].shape[1]
        columns = {
            POSITION: gaussians["means"],
            NORMAL: np.zeros((num, 3)),
            SH0: gaussians["sh0"].reshape(num, 3),
            _rest(num_rest): gaussians["shN"].transpose(0, 2, 1).reshape(num, num_rest),
            OPACITY: gaussians["logit_opacities"].reshape(num, 1),
            SCALE: gaussians["log_scales"],
            ROTATION: gaussians["quats"],
        }
        if "smoothing" in gaussians:
            columns[SMOOTHING] = gaussians["smoothing"].reshape(num, 1)
        rows = np.concatenate(list(columns.values()), axis=1).astype("<f4")
        vertex = rows.view([(name, "<f4") for names in columns for name in names]).reshape(num)
        return encode_elements({"vertex": vertex}, rendered_with)

    @override
    def recognizes(self, path: Path) -> bool:
        return not has_packed_vertices(path)


def encode_elements(
    elements: Mapping[str, np.ndarray], rendered_with: Mapping[str, Scalar] | None = None
) -> bytes:
    """Return a binary little-endian file of structured arrays by name, in their order.

    Raises ValueError for values of ``rendered_with`` that are not of one word.
    """
    comments = []
    for name, value in (rendered_with or {}).items():
        comments.append(f"drgs {name} {str(value).lower() if isinstance(value, bool) else value}")
        if STATEMENT.fullmatch(comments[-1]) is None:
            raise ValueError(
                f"rendered_with must be names and values of one word, got {name!r}: {value!r}"
            )
    if (rendered_with or {}).get("antialiased") is True:
        comments.append(MIP)
    described = [PlyElement.describe(rows, name) for name, rows in elements.items()]
    file = io.BytesIO()
    PlyData(described, byte_order="<", comments=comments).write(file)
    return file.getvalue()


def read_points(path: str | Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Return positions (N, 3) float64, world, and colours (N, 3) float32 in 0..1, or None."""
    rows, statements = read_elements(path, ["vertex"])
    vertex = rows["vertex"]
    _require(path, vertex, POSITION, "points")
    positions = _columns(vertex, POSITION, np.float64)
    _check_rows(path, vertex, POSITION, np.abs(positions) <= np.finfo(np.float32).max, "finite")
    positions += pop_origin(path, statements)
    if not set(COLOR) <= set(vertex.dtype.names or ()):
        return positions, None
    colors = _columns(vertex, COLOR)
    kind = vertex.dtype["red"]
    if np.issubdtype(kind, np.integer):
        colors = colors / np.float32(65535 if kind == np.uint16 else 255)
    expected = "an integer in 0..255 or a float in 0..1"
    _check_rows(path, vertex, COLOR, (colors >= 0) & (colors <= 1), expected)
    return positions, colors


def has_packed_vertices(path: str | Path) -> bool:
    """Return whether a PLY file is one of :mod:`drgs.io.compressed_ply`."""
    with _open_after_header(path) as (_, header):
        names = [p.name for each in header.ply.elements for p in each.properties]
        return "chunk" in header.counts and "packed_position" in names


def read_elements(
    path: str | Path, names: Collection[str]
) -> tuple[dict[str, np.ndarray], dict[str, Scalar]]:
    """Return elements as structured arrays, and the values in the header's comments.

    Elements but ``vertex`` may be missing. What follows one with lists, as faces, is not read.

    Raises :class:`UserError` naming the file and what it lacks: it must be complete, and elements
    of ``names`` must have numbers only.
    """
    with _open_after_header(path) as (file, header):
        elements = list(takewhile(_has_numbers_only, header.ply.elements))
        size = sum(header.counts[each.name] * each.dtype().itemsize for each in elements)
        require_memory(path, MEMORY_RATIO * size, header.expected_rows)
        lines = io.TextIOWrapper(file, "ascii") if header.ply.text else None
        rows = {each.name: _read_rows(lines or file, header, each) for each in elements}
        for name in ("vertex", *(name for name in names if name in header.counts)):
            if not len(rows.get(name, ())):
                raise UserError(
                    f"{path}: element {name} must have at least 1 row, no lists, and come before "
                    f"elements that have; the file has {header.expected_rows}"
                )
        rest = "" if len(elements) < len(header.ply.elements) else (lines or file).read()
        if num_left := len(rest.strip() if header.ply.text else rest):
            raise UserError(
                f"{path}: the file must end after the rows that its header promises "
                f"({header.expected_rows}), got {num_left:,} bytes more; correct the header's "
                "counts, or get the file again"
            )
        return rows, header.statements


@dataclass(frozen=True)
class _Header:
    """Content of a header; its elements have no rows."""

    ply: PlyData
    counts: dict[str, int]  # promised rows, by element
    statements: dict[str, Scalar]
    end: int  # byte: of the file

    @property
    def expected_rows(self) -> str:
        return format_names([f"{n} of {one_line(name, 60)}" for name, n in self.counts.items()])


@contextmanager
def _open_after_header(path: str | Path) -> Iterator[tuple[IO[bytes], _Header]]:
    """Open a file after its header; whatever fails in the block becomes a :class:`UserError`."""
    with refuse_damage(f"{path}: not a valid PLY file"), open_regular(path) as file:
        yield file, _read_header(path, file)


def _read_header(path: str | Path, file: IO[bytes]) -> _Header:
    """Read the header, by plyfile, and leave the file at its end."""
    content = file.read(MAX_HEADER_BYTES)
    newline = next((n for n in (b"\r\n", b"\r") if content.startswith(b"ply" + n)), b"\n")
    header, end, _ = content.partition(newline + b"end_header" + newline)
    if not end:
        raise ValueError(
            f"the header must end with end_header within the first {MAX_HEADER_BYTES:,} bytes"
        )
    size = file.seek(0, io.SEEK_END)
    file.seek(len(header) + len(end))
    lines, counts = header.split(newline), {}
    for index, line in enumerate(lines):
        if line.split()[:1] == [b"element"]:
            _, name, count = line.decode().split()
            counts[name] = int(count)
            lines[index] = b"element %s 0" % name.encode()  # plyfile is to read no rows
            if not 0 <= counts[name] <= size:  # refused before memory is allocated
                _refuse_end(name, counts[name], size)
    ply = PlyData.read(io.BytesIO(b"\n".join([*lines, b"end_header", b""])))
    return _Header(ply, counts, _statements(path, lines), size)


def _has_numbers_only(element: PlyElement) -> bool:
    return not any(isinstance(each, PlyListProperty) for each in element.properties)


def _read_rows(
    file: IO[bytes] | io.TextIOWrapper, header: _Header, element: PlyElement
) -> np.ndarray:
    """Read the rows of an element from a binary file, or from the lines of a text."""
    count, dtype = header.counts[element.name], element.dtype(header.ply.byte_order)
    if isinstance(file, io.TextIOWrapper):
        with warnings.catch_warnings():  # of no rows, which are refused
            warnings.simplefilter("ignore")
            rows = np.loadtxt(islice(file, count), element.dtype(), comments=None, ndmin=1)
    else:
        num_left = (header.end - file.tell()) // max(1, dtype.itemsize)
        rows = np.fromfile(file, dtype, min(count, num_left))
    if len(rows) < count:
        _refuse_end(element.name, count, len(rows))
    return rows


def _refuse_end(name: str, promised: int, got: int) -> NoReturn:
    raise ValueError(
        f"element {one_line(name, 60)} must have the {promised:,} rows that the header promises, "
        f"got {got:,}: the file is cut off; get it again"
    )


def _statements(path: str | Path, lines: list[bytes]) -> dict[str, Scalar]:
    values: dict[str, str] = {}
    comments = [line.removeprefix(b"comment ") for line in lines if line.startswith(b"comment ")]
    texts = [comment.decode("ascii", "replace").strip() for comment in comments]
    for match in filter(None, map(STATEMENT.fullmatch, texts)):
        name, text = match.groups()
        if values.setdefault(name, text) != text:
            raise UserError(
                f"{path}: the header's comments must give {name} once, got {values[name]} and "
                f"{text}; remove one of the lines"
            )
    if any(map(ANTIALIASED.fullmatch, texts)):
        values.setdefault("antialiased", "true")
    return {name: _scalar(text) for name, text in values.items()}


def _scalar(text: str) -> Scalar:
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text


def _finite_logits(path: str | Path, logits: np.ndarray) -> np.ndarray:
    """Return logits with infinite ones at the limits of float32's sigmoid."""
    if count := np.count_nonzero(np.isinf(logits)):
        note_user(
            f"{path}: {count:,} of {len(logits):,} opacities are infinite logits, as formats of 8 "
            f"bits leave them for 1 and 0; read as {MAX_LOGIT:.2f} and {MIN_LOGIT:.2f}"
        )
    largest, smallest = float(np.float32(MAX_LOGIT)), float(np.float32(MIN_LOGIT))
    return np.nan_to_num(logits, nan=np.nan, posinf=largest, neginf=smallest)


def _check_rows(
    path: str | Path, vertex: np.ndarray, names: tuple[str, ...], fits: np.ndarray, expected: str
) -> None:
    bad = np.argwhere(~fits)
    if len(bad):
        row, column = bad[0]
        raise UserError(
            f"{path}: element vertex, row {row}: {names[column]} must be {expected}, got "
            f"{vertex[names[column]][row]}"
        )


def _rest(num_rest: int) -> tuple[str, ...]:
    return tuple(f"f_rest_{i}" for i in range(num_rest))


def _require(path: str | Path, vertex: np.ndarray, names: tuple[str, ...], what: str) -> None:
    if missing := [name for name in names if name not in (vertex.dtype.names or ())]:
        raise UserError(f"{path}: not a PLY of {what}: properties {', '.join(missing)} are missing")


def _columns(vertex: np.ndarray, names: tuple[str, ...], kind: type = np.float32) -> np.ndarray:
    """Return properties (N, len(names)) of a float type, a copy."""
    rows = np.empty((len(vertex), len(names)), kind)
    with np.errstate(over="ignore"):  # a float64 beyond float32 becomes inf, which is refused
        for column, name in enumerate(names):
            rows[:, column] = vertex[name]
    return rows
