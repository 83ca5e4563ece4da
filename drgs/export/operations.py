"""The operations of ``drgs export``: options that act on the Gaussians, in the order given."""

from __future__ import annotations

import json
import operator
from argparse import Action, ArgumentParser, ArgumentTypeError, Namespace
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import astuple, replace
from itertools import zip_longest
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from typing_extensions import override

from drgs.cameras.orbits import extent_of, up_of
from drgs.cli.commands import VECTOR, bounded_int, finite_number
from drgs.cli.execution import execution_settings, select_variant
from drgs.core.constants import SH_C0
from drgs.core.errors import UserError, one_line
from drgs.export.merging import world_means
from drgs.export.source import Z_UP, ExportSource
from drgs.export.voxels import CLUSTER, FLOATERS, VoxelRule, find_cluster, find_non_floaters
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.sh import num_coefficients
from drgs.results.folder import VIEWS

GREY = (0.5, 0.5, 0.5)  # background where none is known: neither hides white nor black

MIN_SNAP_COSINE = np.cos(np.radians(5))  # angle below which the cameras' up is snapped to an axis

PROPERTIES = (*"xyz", "opacity", "size", "scale_0", "scale_1", "scale_2", "red", "green", "blue")

COMPARISONS = ("lt", "le", "gt", "ge", "eq", "ne")  # functions of ``operator``

STATISTICS = {"least": np.min, "median": np.median, "mean": np.mean, "greatest": np.max}

MAX_LOG_SCALE = 600.0  # of standard deviations to sum: float64 ends at exp(709)

Condition = tuple[str, str, float]  # one of PROPERTIES, one of COMPARISONS, a number
FindRule = Callable[[Gaussians[np.ndarray]], VoxelRule]


class Operation(NamedTuple):
    """An option that changes the Gaussians, or describes them."""

    text: str  # help
    apply: Callable[[ExportSource, Any, Namespace], ExportSource]
    """Function of what was loaded, the option's value, and all arguments of the command."""
    settings: Mapping[str, Any]  # others of ``add_argument``


class _AddStep(Action):
    """Append the option and its value to ``steps``."""

    @override
    def __call__(self, _: object, namespace: Namespace, *given: object) -> None:
        namespace.steps = (*namespace.steps, (self.option_strings[0], given[0]))


def add_operations(parser: ArgumentParser) -> None:
    """Add the options of :data:`OPERATIONS`; ``steps`` has those given, with their values."""
    add = parser.add_argument_group("operations, applied in the order given").add_argument
    for option, (text, _, settings) in OPERATIONS.items():
        add(option, help=text, action=_AddStep, dest="steps", default=(), **settings)


def apply_steps(source: ExportSource, args: Namespace) -> ExportSource:
    """Return what the operations of the command line make of the Gaussians."""
    for option, value in args.steps:
        source = OPERATIONS[option].apply(source, value, args)
    return source


def _positive_number(text: str) -> float:
    if (number := finite_number(text)) > 0:
        return number
    raise ArgumentTypeError(f"must be above 0, got {text}")


def _count_or_percentage(text: str) -> Callable[[int], int]:
    """Return the function from a number of Gaussians to that which is left."""
    if not text.endswith("%"):
        count = bounded_int(1)(text)
        return lambda before: min(count, before)
    if not 0 < (share := finite_number(text[:-1]) / 100) <= 1:
        raise ArgumentTypeError(f"must be above 0% and at most 100%, got {text}")
    return lambda before: max(1, round(share * before))


def _condition(text: str) -> Condition:
    words = text.split(",")
    if len(words) != 3 or words[0] not in PROPERTIES or words[1] not in COMPARISONS:
        raise ArgumentTypeError(
            f"must be NAME,COMPARISON,NUMBER with a name of {', '.join(PROPERTIES)} and a "
            f"comparison of {', '.join(COMPARISONS)}, got {one_line(text, 40)}"
        )
    return words[0], words[1], finite_number(words[2])


def _voxel_filter(name: str, default: VoxelRule, find: Any, text: str) -> Operation:
    """Return the filter by ``SIZE,OPACITY,MIN``, any of which may be left out; find: a mask."""

    def apply(source: ExportSource, find_rule: FindRule, args: Namespace) -> ExportSource:
        rule = find_rule(source.gaussians)
        mask = find(source.gaussians, rule, args.seed_pos)
        return source.keep(f"{name} (voxels of {rule.size:.3g})", mask)

    def parse(text: str) -> FindRule:
        words = text.split(",")
        if len(words) > 3:
            raise ArgumentTypeError(f"must be at most SIZE,OPACITY,MIN, got {one_line(text, 40)}")
        pairs = zip_longest(words, astuple(default))
        size, opacity, least = (finite_number(word) if word else usual for word, usual in pairs)
        if not (size > 0 and 0 < opacity < 1 and least >= 0):
            raise ArgumentTypeError(
                "SIZE must be above 0, OPACITY above 0 and below 1, MIN at least 0, got "
                f"{size:g},{opacity:g},{least:g}"
            )
        rule = VoxelRule(size, opacity, least)
        return lambda g: rule if words[0] else rule.scale_to(g, extent_of(g))

    text += (
        f" of at least this opacity (default: {default.size:g} of the median distance from the "
        f"middle, or more for large scenes; {default.opacity:g}; {default.contribution:g})"
    )
    settings = {"type": parse, "nargs": "?", "const": parse(""), "metavar": "SIZE,OPACITY,MIN"}
    return Operation(text, apply, settings)


def _rotate(source: ExportSource, degrees: list[float], _: Namespace) -> ExportSource:
    moved = source.move(Rotation.from_euler("xyz", degrees, degrees=True).as_matrix())
    return moved if moved.up is not None else replace(moved, up=Z_UP)  # the user has decided


def turn_up(source: ExportSource, words: list[str], args: Namespace) -> ExportSource:
    """Print the up direction and turn it to ``args.up_in_file`` (3,); no words: the default."""
    cameras, hint = source.cameras, "" if words else " (give --up otherwise)"
    words = words or (["0", "0", "1"] if cameras is None else ["cameras"])
    if words != ["cameras"]:
        up = _direction(words)
    elif cameras is None:
        raise UserError(
            f"--up cameras: needs the output folder of one fit with {VIEWS}; give --up X Y Z"
        )
    else:
        up, hint = up_of(cameras), " (the training cameras')"
        axis = np.argmax(np.abs(up))
        if abs(up[axis]) >= MIN_SNAP_COSINE:  # what was estimated is off by a little
            up = np.sign(up[axis]) * np.eye(3)[axis] + 0.0
    print(f"up: {' '.join(f'{x:.3g}' for x in up)}{hint}", flush=True)
    return source.turn(up, args.up_in_file)


def _direction(words: list[str]) -> np.ndarray:
    with suppress(ValueError):
        up = np.array([float(word) for word in words])
        with np.errstate(over="ignore"):  # an infinite length is refused
            length = np.linalg.norm(up)
        if up.shape == (3,) and 0 < length < np.inf:
            return up / length
    got = one_line(" ".join(words), 60)
    raise UserError(f"--up: must be cameras, or three numbers not all zero, got {got}")


def _crop(source: ExportSource, corners: list[float], _: Namespace) -> ExportSource:
    low, high = np.sort(np.reshape(corners, (2, 3)), axis=0)
    means = world_means(source.gaussians)
    return source.keep("box", ((means >= low) & (means <= high)).all(axis=1))


def _filter_value(source: ExportSource, condition: Condition, _: Namespace) -> ExportSource:
    name, comparison, number = condition
    mask = getattr(operator, comparison)(properties_of(source.gaussians)[name], number)
    return source.keep(f"{name} {comparison} {number:g}", mask)


def _limit_degree(source: ExportSource, degree: int, _: Namespace) -> ExportSource:
    g = source.gaussians
    return replace(source, gaussians=replace(g, shN=g.shN[:, : num_coefficients(degree) - 1]))


def reduce_to(source: ExportSource, count: int, variant: str) -> ExportSource:
    """Return at most ``count`` Gaussians that look alike from the training cameras of a fit.

    Without a fit, from cameras around the Gaussians.
    """
    from drgs.export.decimation import SIDE_PX, VIEWS_PER_RING, decimate

    if (before := source.gaussians.num_gaussians) <= count:
        return source
    select_variant(variant)
    background = GREY if source.config is None else source.config.data.background_rgb
    views = source.views(VIEWS_PER_RING, SIDE_PX)
    where = "around the model" if source.cameras is None else "of the fit"
    print(f"decimated: {before:,} to {count:,}, by {len(views)} views {where}", flush=True)
    with execution_settings(None, debug=False):
        gaussians = decimate(source.gaussians, count, views, source.settings, background)
    return replace(source, gaussians=gaussians)


def properties_of(gaussians: Gaussians[np.ndarray]) -> dict[str, np.ndarray]:
    """Return the :data:`PROPERTIES` (N,), float64: world units; colours without harmonics."""
    scales = np.exp(np.minimum(gaussians.log_scales.astype(np.float64), MAX_LOG_SCALE))
    colors = 0.5 + SH_C0 * gaussians.sh0[:, 0].astype(np.float64)
    columns = (world_means(gaussians), gaussians.opacities, scales.max(axis=1), scales, colors)
    return dict(zip(PROPERTIES, np.column_stack(columns).T, strict=True))


def _describe(source: ExportSource, _: object, args: Namespace) -> ExportSource:
    """Print statistics, as JSON to the stream ``args.json`` if there is one."""
    g = source.gaussians
    content = {"gaussians": g.num_gaussians, "sh_degree": g.sh_degree, "origin": g.origin}
    content["rendered_with"] = dict(g.rendered_with or {})
    rows = {
        name: {key: float(compute(values)) for key, compute in STATISTICS.items()}
        for name, values in properties_of(g).items()
    }
    if args.json is not None:
        print(json.dumps({**content, "properties": rows}), file=args.json)
        return source
    print(*(f"{name}: {value}" for name, value in content.items()), sep="\n")
    print(" " * 8, *(f"{key:>11}" for key in STATISTICS))
    for name, row in rows.items():
        print(f"{name:8}", *(f"{value:11.5g}" for value in row.values()), flush=True)
    return source


CORNERS = {**VECTOR, "nargs": 6, "metavar": tuple(f"{x}{end}" for end in "01" for x in "XYZ")}

OPERATIONS = {
    "--translate": Operation("add this to positions", lambda s, v, _: s.translate(v), VECTOR),
    "--rotate": Operation("rotate about x, then y, then z, in degrees", _rotate, VECTOR),
    "--scale": Operation(
        "multiply positions and sizes by this factor",
        lambda source, factor, _: source.move(np.eye(3), factor),
        {"type": _positive_number, "metavar": "F"},
    ),
    "--up": Operation(
        "rotate the model so that this direction, X Y Z, is up; cameras: the mean up direction of "
        "the training cameras (default: for formats with an up direction, without --rotate: "
        "cameras, or 0 0 1 without any; other formats are not rotated)",
        turn_up,
        {"nargs": "+", "metavar": "UP"},
    ),
    "--crop": Operation("keep the Gaussians inside a box", _crop, CORNERS),
    "--min-opacity": Operation(
        "remove less opaque Gaussians, 0 to 1",
        lambda source, least, args: _filter_value(source, ("opacity", "ge", least), args),
        {"type": finite_number, "metavar": "P"},
    ),
    "--max-size": Operation(
        "remove Gaussians with a larger standard deviation, scene units",
        lambda source, most, args: _filter_value(source, ("size", "le", most), args),
        {"type": finite_number, "metavar": "S"},
    ),
    "--filter-value": Operation(
        f"keep the Gaussians of which this is true, as opacity,gt,0.1; names: "
        f"{', '.join(PROPERTIES)}; comparisons: {', '.join(COMPARISONS)}",
        _filter_value,
        {"type": _condition, "metavar": "NAME,COMPARISON,NUMBER"},
    ),
    "--filter-floaters": _voxel_filter(
        "floaters",
        FLOATERS,
        lambda gaussians, rule, _: find_non_floaters(gaussians, rule),
        "remove Gaussians that contribute less than MIN to every voxel",
    ),
    "--filter-cluster": _voxel_filter(
        "cluster",
        CLUSTER,
        lambda g, rule, seed: find_cluster(g, rule, seed and np.subtract(seed, g.origin)),
        "keep the Gaussians that contribute MIN to the cluster of voxels",
    ),
    "--sh-degree": Operation(
        "leave out harmonics of higher degrees, 0 to 3",
        _limit_degree,
        {"type": bounded_int(0, 3), "metavar": "D"},
    ),
    "--decimate": Operation(
        "merge neighbours until this many Gaussians are left, and fit them to images of all: from "
        "the training cameras of a fit, else from around the model",
        lambda s, count, args: reduce_to(s, count(s.gaussians.num_gaussians), args.variant),
        {"type": _count_or_percentage, "metavar": "N|N%"},
    ),
    "--info": Operation("print statistics; no --out: write nothing", _describe, {"nargs": 0}),
}
