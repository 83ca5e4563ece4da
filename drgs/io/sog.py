"""SOG files of PlayCanvas: about 9 bytes per Gaussian, and a palette of harmonics.

Source of the layout: "The SOG Format" in PlayCanvas's manual, version 2. ``meta.json`` names images
of 8 bits, lossless WebP, in which a Gaussian has the same pixel, row by row:

- ``means_l``, ``means_u``: the low and the high bytes of x, y, z between the bounds in
  ``meta.json``, of sign(x) log(1 + |x|) in 16 bits;
- ``quats``: all components but the largest, of wxyz, from -1/sqrt(2) to 1/sqrt(2); alpha is 252 and
  the index of the largest;
- ``scales``, ``sh0``: indices of logarithms and coefficients in a codebook of 256 numbers each;
  alpha of ``sh0`` is the opacity;
- ``shN_labels``: the index in the palette ``shN_centroids``, whose rows of pixels have 64 entries
  each, coefficient by coefficient, as indices in a third codebook.

A file ``.sog`` is a ZIP archive of them; the ``meta.json`` of an unpacked one is read as well. The
axes are those of PLY files. ``model`` (formerly ``antialias``) marks compensated opacities.
"""

from __future__ import annotations

import io
import json
import math
import re
import warnings
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from PIL import Image
from pydantic import BaseModel, ConfigDict, Field
from scipy.cluster.vq import kmeans2
from typing_extensions import override

from drgs.config.section import parse_json, validate
from drgs.core.errors import UserError, one_line
from drgs.core.files import open_regular, read_bytes, refuse_damage
from drgs.core.memory import require_memory
from drgs.io.formats import FORMATS, PLAYCANVAS, Arrays, FileFormat, Rounding, Scalar
from drgs.io.quantization import (
    drop_largest_component,
    logits_from_opacities,
    morton_order,
    normalize_quaternions,
    opacities_from_logits,
    require_scene_memory,
    restore_largest_component,
    round_to_uint32,
)

MAX_BYTES = 1 << 32  # largest file: 4.3 GB
MAX_RATIO, MAX_SMALL = 16, 1 << 20  # of a file in an archive to its packed bytes, and bytes of any

META, LOD_META = "meta.json", "lod-meta.json"
LEVELS = 256
POSITION_LEVELS = 65535
MAX_LOG_POSITION = 80.0  # log(1 + |x|), below what float32 holds
FIRST_TAG = 252  # alpha of a quaternion whose largest component is w
NUM_HARMONICS = (0, 3, 8, 15)  # above degree 0, by degree
PALETTE_COLUMNS = 64
MAX_PALETTE = 65536

FITTED_SHARE = 1 / 6
"""Entries of the palette by Gaussian, where Gaussians are fitted as they are rounded."""

CELLS = 256
"""Parts of the space of harmonics, in each of which k-means chooses a share of the palette: the
time is that of 512 centroids, not 65,536."""

LLOYD_ITERATIONS = 50  # of codebooks; further ones change the error by less than 1 %


@FORMATS.register("sog")
class Sog(FileFormat):
    """PlayCanvas's SOG."""

    suffix = ".sog"
    other_names = frozenset({META, LOD_META})
    description = "PlayCanvas's SOG, for SuperSplat and PlayCanvas"
    metadata = frozenset({"antialiased"})
    shown_with = PLAYCANVAS

    @override
    def read(self, path: Path) -> tuple[Arrays, Mapping[str, Scalar]]:
        """Return Gaussians, and whether ``antialiased``; of an archive or beside a meta.json.

        Of levels of detail, the finest is read.
        """
        if path.name.lower() == LOD_META:
            return self._read_finest(path)
        where = f"{path}: {META}: "
        content = parse_json(_load(path, META), where)
        if isinstance(content, dict) and "mins" in content.get("scales", ""):
            raise UserError(
                f"{path}: version 2 of SOG is read, got version 1; write it again with "
                "PlayCanvas's splat-transform, or as PLY"
            )
        meta = validate(_Meta, content, where)
        num, degree = meta.count, meta.shN.bands if meta.shN else 0
        require_scene_memory(path, num, (degree + 1) ** 2)
        low, high = (_pixels(path, n, num)[:, :3].astype(np.uint16) for n in meta.means.files)
        bounds = np.array(meta.means.mins), np.array(meta.means.maxs)
        parts = (meta.quats, meta.scales, meta.sh0)
        quats, scales, sh0 = (_pixels(path, part.files[0], num) for part in parts)
        arrays = {
            "means": _means(low | high << 8, *bounds),
            "quats": _quaternions(quats),
            "log_scales": np.array(meta.scales.codebook)[scales[:, :3]],
            "logit_opacities": logits_from_opacities(sh0[:, 3] / 255),
            "sh0": np.array(meta.sh0.codebook)[sh0[:, None, :3]],
            "shN": _read_harmonics(path, meta.shN, num) if meta.shN else np.zeros((num, 0, 3)),
        }
        is_antialiased = meta.antialias or meta.model == "antialiased"
        return arrays, {"antialiased": True} if is_antialiased else {}

    def _read_finest(self, path: Path) -> tuple[Arrays, Mapping[str, Scalar]]:
        content = parse_json(read_bytes(path, "file", MAX_BYTES), f"{path}: ")
        names = content.get("filenames") if isinstance(content, dict) else None
        names = names if isinstance(names, list) else []
        finest = [n for n in map(str, names) if re.fullmatch(rf"0_\d{{1,9}}/{META}", n)]
        if not finest:
            raise UserError(f"{path}: filenames must list files as 0_0/{META}, got {names[:3]}")
        parts = [self.read(path.parent / name) for name in finest]
        with refuse_damage(f"{path}: cannot join its files"):
            arrays = {k: np.concatenate([part[k] for part, _ in parts]) for k in parts[0][0]}
        return arrays, parts[0][1]

    @override
    def rounding(self, gaussians: Arrays) -> Rounding:
        """Return rounding with these Gaussians' bounds, codebooks, and choice in a small palette.

        Entries of the palette are the mean harmonics of those that have chosen them. Quaternions
        keep their lengths and signs, which files do not have.
        """
        num = len(gaussians["means"])
        low, high = _bounds(gaussians["means"])
        codes = {name: _codebook(gaussians[name])[0] for name in ("log_scales", "sh0")}
        rows = gaussians["shN"].reshape(num, -1)
        most = min(MAX_PALETTE, max(CELLS, round(FITTED_SHARE * num)))
        _, labels = _palette(rows, most)
        order = np.argsort(labels, kind="stable")
        starts = np.flatnonzero(np.diff(labels[order], prepend=-1))
        sizes = np.diff(starts, append=num)[:, None].astype(np.float32)

        def entries(g: Arrays) -> np.ndarray:
            return np.add.reduceat(g["shN"].reshape(num, -1)[order], starts) / sizes

        harmonics = _codebook(entries(gaussians))[0] if rows.size else np.zeros(LEVELS)

        def round_values(g: Arrays) -> Arrays:
            opacities = _opacity_levels(g["logit_opacities"]) / 255
            quats = g["quats"]
            lengths = np.linalg.norm(quats, axis=1, keepdims=True)
            largest = np.take_along_axis(quats, np.abs(quats).argmax(axis=1)[:, None], axis=1)
            palette = harmonics[_nearest(harmonics, entries(g))]
            return {
                "means": _means(_mean_levels(g["means"], low, high), low, high),
                "quats": _quaternions(_quaternion_levels(quats)) * np.copysign(lengths, largest),
                **{name: code[_nearest(code, g[name])] for name, code in codes.items()},
                "logit_opacities": logits_from_opacities(opacities),
                "shN": palette[labels].reshape(g["shN"].shape),
            }

        return round_values

    @override
    def encode(self, gaussians: Arrays, rendered_with: Mapping[str, Scalar]) -> bytes:
        """Return an archive of the Gaussians in Morton order.

        Up to 65,536 different harmonics have an entry each in the palette, and up to 256 different
        numbers one in a codebook, so that they stay as they are if they were rounded before.
        """
        order = morton_order(gaussians["means"])
        ordered = {name: values[order] for name, values in gaussians.items()}
        stream = io.BytesIO()
        with zipfile.ZipFile(stream, "w") as archive:  # of stored files, with a fixed date
            for name, content in encode_files(ordered, rendered_with).items():
                archive.writestr(zipfile.ZipInfo(name), content)
        return stream.getvalue()


def encode_files(g: Arrays, rendered_with: Mapping[str, Scalar]) -> dict[str, bytes]:
    """Return the files of an archive by name, the last one :data:`META`; g: keep their order."""
    num = len(g["means"])
    low, high = _bounds(g["means"])
    levels = _mean_levels(g["means"], low, high)
    log_scales, scales = _codebook(g["log_scales"])
    colors, sh0 = _codebook(g["sh0"][:, 0])
    images = {
        "means_l": _per_gaussian(levels & 255),
        "means_u": _per_gaussian(levels >> 8),
        "scales": _per_gaussian(scales),
        "quats": _per_gaussian(_quaternion_levels(g["quats"])),
        "sh0": _per_gaussian(np.column_stack([sh0, _opacity_levels(g["logit_opacities"])])),
    }
    meta: dict[str, object] = {
        "version": 2,
        "asset": {"generator": "drgs"},
        "count": num,
        "means": {"mins": low.tolist(), "maxs": high.tolist()},
        "scales": {"codebook": log_scales.tolist()},
        "quats": {},
        "sh0": {"codebook": colors.tolist()},
    }
    if rendered_with.get("antialiased"):
        meta |= {"model": "antialiased", "antialias": True}
    if g["shN"].shape[1]:
        bands = NUM_HARMONICS.index(g["shN"].shape[1])
        palette, labels = _palette(g["shN"].reshape(num, -1), MAX_PALETTE)
        codebook, entries = _codebook(palette)
        num_rows = -(-len(palette) // PALETTE_COLUMNS)
        rows = np.zeros((num_rows * PALETTE_COLUMNS, palette.shape[1]))
        rows[: len(palette)] = entries
        images["shN_centroids"] = rows.reshape(-1, PALETTE_COLUMNS * NUM_HARMONICS[bands], 3)
        high_bytes, low_bytes = np.divmod(labels, LEVELS)
        columns = [low_bytes, high_bytes, np.zeros_like(labels)]
        images["shN_labels"] = _per_gaussian(np.column_stack(columns))
        meta["shN"] = {"count": len(palette), "bands": bands, "codebook": codebook.tolist()}
    for name in images:
        part = meta[name.partition("_")[0]]
        part.setdefault("files", []).append(f"{name}.webp")  # type: ignore[attr-defined]
    files = {f"{name}.webp": _encode(rows) for name, rows in images.items()}
    return {**files, META: json.dumps(meta, separators=(",", ":")).encode()}


def unpack(archive: bytes) -> dict[str, bytes]:
    """Return the files of what :meth:`Sog.encode` returns, by name, the last one :data:`META`."""
    with zipfile.ZipFile(io.BytesIO(archive)) as opened:
        return {name: opened.read(name) for name in opened.namelist()}


Coordinate = Annotated[float, Field(ge=-MAX_LOG_POSITION, le=MAX_LOG_POSITION)]
Point = Annotated[list[Coordinate], Field(min_length=3, max_length=3)]
Number = Annotated[float, Field(allow_inf_nan=False)]
Name = Annotated[str, Field(pattern=r"^[^/\\.][^/\\]{0,199}$")]  # beside meta.json


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, frozen=True)


class _Quats(_Part):
    files: Annotated[list[Name], Field(min_length=1, max_length=1)]


class _Indexed(_Quats):
    codebook: Annotated[list[Number], Field(min_length=LEVELS)]


class _Means(_Part):
    mins: Point
    maxs: Point
    files: Annotated[list[Name], Field(min_length=2, max_length=2)]


class _Harmonics(_Part):
    count: Annotated[int, Field(ge=1, le=MAX_PALETTE)]
    bands: Annotated[int, Field(ge=1, le=3)]
    codebook: Annotated[list[Number], Field(min_length=LEVELS)]
    files: Annotated[list[Name], Field(min_length=2, max_length=2)]


class _Meta(_Part):
    version: Literal[2]
    count: Annotated[int, Field(ge=1, lt=2**32)]
    means: _Means
    scales: _Indexed
    quats: _Quats
    sh0: _Indexed
    shN: _Harmonics | None = None  # noqa: N815  (the name in files)
    model: str = "default"
    antialias: bool = False


def _load(path: Path, name: str) -> bytes:
    """Return a file of the archive, or beside its meta.json."""
    if path.name.lower() == META:
        return read_bytes(path if name == META else path.with_name(name), "file", MAX_BYTES)
    with (
        open_regular(path, "file", MAX_BYTES) as file,
        refuse_damage(f"{path}: cannot read {one_line(name, 60)}"),
        zipfile.ZipFile(file) as archive,
    ):
        entry = archive.getinfo(name)
        if entry.file_size > MAX_RATIO * entry.compress_size + MAX_SMALL:
            raise ValueError(
                f"at most {MAX_RATIO} times its {entry.compress_size:,} packed bytes were "
                f"expected, got {entry.file_size:,}; images do not shrink more"
            )
        require_memory(path, entry.file_size, name)
        return archive.read(entry)


def _pixels(path: Path, name: str, least: int, width: int | None = None) -> np.ndarray:
    """Return the first pixels (N, 4) uint8 of an image, row by row; width: None: any."""
    content, most = _load(path, name), 2 * least + MAX_PALETTE
    with (
        refuse_damage(f"{path}: cannot read {one_line(name, 60)}"),
        Image.open(io.BytesIO(content), formats=["WEBP", "PNG"]) as image,
    ):
        if not least <= image.width * image.height <= most or image.width != (width or image.width):
            columns = f" in rows of {width}" if width else ""
            raise ValueError(
                f"{least:,} to {most:,} pixels{columns} were expected, got {image.width} x "
                f"{image.height}"
            )
        require_memory(path, 8 * most, name)
        return np.asarray(image.convert("RGBA")).reshape(-1, 4)[:least]


def _read_harmonics(path: Path, part: _Harmonics, num: int) -> np.ndarray:
    """Return coefficients (N, K - 1, 3)."""
    (name, labels_name), count = part.files, NUM_HARMONICS[part.bands]
    labels = _pixels(path, labels_name, num).astype(np.intp)
    index = labels[:, 0] + LEVELS * labels[:, 1]
    if (most := index.max()) >= part.count:
        raise UserError(
            f"{path}: {one_line(labels_name, 60)}: indices must be below the palette's "
            f"{part.count:,} entries, got {most:,}; the file is damaged"
        )
    entries = _pixels(path, name, part.count * count, PALETTE_COLUMNS * count)[:, :3]
    return np.array(part.codebook, np.float32)[entries].reshape(-1, count, 3)[index]


def _logarithms(means: np.ndarray) -> np.ndarray:
    """Return sign(x) log(1 + |x|), float64."""
    means = means.astype(np.float64)
    return np.sign(means) * np.log1p(np.abs(means))


def _bounds(means: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    logs = _logarithms(means)
    return logs.min(axis=0), logs.max(axis=0)


def _mean_levels(means: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    parts = (_logarithms(means) - low) / np.where(high > low, high - low, 1)
    return round_to_uint32(parts * POSITION_LEVELS, POSITION_LEVELS)


def _means(levels: np.ndarray, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    logs = low + levels / POSITION_LEVELS * (high - low)
    return np.sign(logs) * np.expm1(np.abs(logs))


def _quaternion_levels(quats: np.ndarray) -> np.ndarray:
    """Return pixels (N, 4)."""
    index, others = drop_largest_component(normalize_quaternions(quats))
    components = round_to_uint32((others * np.sqrt(2) + 1) * 127.5, 255)
    return np.column_stack([components, FIRST_TAG + index])


def _quaternions(levels: np.ndarray) -> np.ndarray:
    largest = levels[:, 3].astype(np.intp) - FIRST_TAG
    found = restore_largest_component(
        np.maximum(largest, 0), (levels[:, :3] / 127.5 - 1) / np.sqrt(2)
    )  # PlayCanvas's reader, too, has the identity for other tags
    return np.where(largest[:, None] < 0, [1.0, 0, 0, 0], found)


def _opacity_levels(logit_opacities: np.ndarray) -> np.ndarray:
    return round_to_uint32(opacities_from_logits(logit_opacities) * 255, 255)


def _per_gaussian(rows: np.ndarray) -> np.ndarray:
    """Return an image (H, W, C) of rows (N, C), with sides that are multiples of 4."""
    width = 4 * math.ceil(math.sqrt(len(rows)) / 4)
    height = 4 * math.ceil(len(rows) / width / 4)
    image = np.zeros((height * width, rows.shape[1]), "u1")
    image[: len(rows)] = rows
    return image.reshape(height, width, -1)


def _encode(image: np.ndarray) -> bytes:
    """Return a lossless WebP of an image (H, W, 3 or 4), also where alpha is 0."""
    stream = io.BytesIO()
    Image.fromarray(image.astype("u1")).save(stream, "WEBP", lossless=True, exact=True)
    return stream.getvalue()


def _codebook(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return 256 numbers, float32, in order, and the index of the nearest for each value.

    Up to 256 different values are kept. Others: Lloyd 1982, "Least squares quantization in PCM",
    from quantiles and steps of equal width.
    """
    if len(distinct := np.unique(values)) <= LEVELS:
        codes = np.pad(distinct, (0, LEVELS - len(distinct)), "edge")
        return codes, _nearest(codes, values)
    ordered = np.sort(values, axis=None).astype(np.float64)
    sums = np.concatenate([[0], np.cumsum(ordered)])
    steps = np.linspace(0, 1, LEVELS // 2)
    quantiles = np.quantile(ordered, steps)
    codes = np.sort(np.append(quantiles, ordered[0] + steps * (ordered[-1] - ordered[0])))
    for _ in range(LLOYD_ITERATIONS):
        ends = np.searchsorted(ordered, (codes[1:] + codes[:-1]) / 2)
        ends = np.concatenate([[0], ends, [len(ordered)]])
        counts = np.diff(ends)
        codes = np.where(counts > 0, np.diff(sums[ends]) / np.maximum(counts, 1), codes)
    codes = np.sort(codes).astype(np.float32)
    return codes, _nearest(codes, values)


def _nearest(codes: np.ndarray, values: np.ndarray) -> np.ndarray:
    return np.searchsorted((codes[1:] + codes[:-1]) / 2, values)


def _palette(rows: np.ndarray, most: int) -> tuple[np.ndarray, np.ndarray]:
    """Return at most ``most`` rows (P, D) that stand for rows (N, D), and their indices (N,).

    k-means in parts of the space, which are k-means clusters themselves, from rows at equal
    distances in their order: deterministic. A part has entries in proportion to its variance.
    """
    distinct, inverse = np.unique(rows, axis=0, return_inverse=True)
    labels = inverse.reshape(-1)
    if len(distinct) <= most:
        return distinct, labels
    centers, cells = _kmeans(rows, CELLS)
    members = [np.flatnonzero(cells == cell) for cell in range(CELLS)]
    sizes = np.array([len(member) for member in members])
    spread = np.array([np.square(rows[m] - c).sum() for m, c in zip(members, centers, strict=True)])
    shares = spread / max(spread.sum(), np.finfo(np.float32).tiny)
    counts = np.minimum(sizes, 1)
    for _ in range(4):  # parts that need no more leave theirs to others
        shares *= most - CELLS
        counts = np.minimum(sizes, 1 + shares).astype(np.intp)
        shares /= counts.sum()
    entries, num = [], 0
    for each, count in zip(members, counts, strict=True):
        if count:
            centroids, labels[each] = _kmeans(rows[each], count)
            labels[each] += num
            entries.append(centroids)
            num += count
    used, labels = np.unique(labels, return_inverse=True)
    return np.concatenate(entries)[used], labels


def _kmeans(rows: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    start = rows[np.linspace(0, len(rows) - 1, count).astype(np.intp)]
    with warnings.catch_warnings():  # of empty clusters, which stay where they are
        warnings.simplefilter("ignore", UserWarning)
        return kmeans2(rows, start, minit="matrix")
