"""Levels of detail as PlayCanvas streams them: ``lod-meta.json`` beside folders of SOG.

Source of the layout: "Streamed SOG" in PlayCanvas's manual, version 1, and what splat-transform 2
writes. A binary tree divides space. Each leaf names, for each level that has Gaussians in it, their
place in one of the files; a viewer shows one level of each leaf, finer ones nearby.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from drgs.export.merging import shapes_of
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.io import formats
from drgs.io.quantization import morton_order
from drgs.io.sog import LOD_META, META, encode_files

LEAF_SIZE = 1 << 13  # most Gaussians of a leaf, over all levels
FILE_SIZE = 1 << 19  # Gaussians from which on a level continues in another file


@dataclass
class _Level:
    means: np.ndarray  # (N, 3) float64
    boxes: np.ndarray  # (2, N, 3) float64: least and greatest corners, at one standard deviation
    files: list[list[np.ndarray]] = field(default_factory=list)  # indices of each leaf


def encode_levels(levels: Sequence[Gaussians[np.ndarray]]) -> dict[str, bytes]:
    """Return files by path, the last one :data:`LOD_META`; levels: the finest one first."""
    _, rendered_with = levels[0].arrays_for("sog")
    for gaussians in levels:
        formats.check("sog", {name: getattr(gaussians, name) for name in PARAMETER_NAMES})
    parts = [_level(gaussians) for gaussians in levels]
    names: list[str] = []
    tree = _node(parts, [np.arange(len(part.means)) for part in parts], names)
    files: dict[str, bytes] = {}
    for number, (gaussians, part) in enumerate(zip(levels, parts, strict=True)):
        for index, leaves in enumerate(part.files):
            rows = np.concatenate(leaves)
            chosen = {name: getattr(gaussians, name)[rows] for name in PARAMETER_NAMES}
            for name, content in encode_files(chosen, rendered_with).items():
                files[f"{number}_{index}/{name}"] = content
    counts = [len(part.means) for part in parts]
    meta = {
        "version": 1,
        "asset": {"generator": "drgs"},
        "count": sum(counts),
        "counts": counts,
        "lodLevels": len(levels),
        "filenames": names,
        "tree": tree,
    }
    return {**files, LOD_META: json.dumps(meta, separators=(",", ":")).encode()}


def _level(gaussians: Gaussians[np.ndarray]) -> _Level:
    _, scales, rotations = shapes_of(gaussians)
    means = gaussians.means.astype(np.float64)
    half = np.einsum("nij,nj->ni", np.abs(rotations), scales)
    return _Level(means, np.stack([means - half, means + half]))


def _node(
    levels: Sequence[_Level], members: Sequence[np.ndarray], names: list[str]
) -> Mapping[str, object]:
    """Return a node of the tree; members: indices (M,) of each level; names: of files, extended."""
    means = np.concatenate([part.means[rows] for part, rows in zip(levels, members, strict=True)])
    low, high = means.min(axis=0), means.max(axis=0)
    axis = int(np.argmax(high - low))
    above = means[means[:, axis] > low[axis], axis]
    by_level = [part.boxes[:, rows] for part, rows in zip(levels, members, strict=True)]
    boxes = np.concatenate(by_level, axis=1)
    bound = {"min": boxes[0].min(axis=0).tolist(), "max": boxes[1].max(axis=0).tolist()}
    if len(means) > LEAF_SIZE and len(above):
        middle = max(np.median(means[:, axis]), above.min())
        left = [part.means[rows, axis] < middle for part, rows in zip(levels, members, strict=True)]
        halves = (
            [rows[is_in] for rows, is_in in zip(members, side, strict=True)]
            for side in (left, [~is_left for is_left in left])
        )
        return {"bound": bound, "children": [_node(levels, half, names) for half in halves]}
    lods = {}
    for number, (part, rows) in enumerate(zip(levels, members, strict=True)):
        if len(rows):
            if not part.files or sum(map(len, part.files[-1])) >= FILE_SIZE:
                part.files.append([])
                names.append(f"{number}_{len(part.files) - 1}/{META}")
            file = names.index(f"{number}_{len(part.files) - 1}/{META}")
            offset = sum(map(len, part.files[-1]))
            lods[str(number)] = {"file": file, "offset": offset, "count": len(rows)}
            part.files[-1].append(rows[morton_order(part.means[rows])])
    return {"bound": bound, "lods": lods}
