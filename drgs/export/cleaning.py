"""The options of ``drgs export`` that choose, merge and remove Gaussians."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import astuple, replace
from itertools import zip_longest

import numpy as np

from drgs.cameras.orbits import extent_of
from drgs.cli.commands import VECTOR, CommandParser, bounded_int, finite_number
from drgs.cli.execution import add_variant_argument, execution_settings
from drgs.core.errors import UserError, one_line
from drgs.export.merging import take
from drgs.export.source import ExportSource
from drgs.export.voxels import CLUSTER, FLOATERS, VoxelRule, find_cluster, find_non_floaters
from drgs.gaussians.parameters import Gaussians

GREY = (0.5, 0.5, 0.5)  # background where none is known: neither hides white nor black


def add_cleaning_arguments(parser: CommandParser) -> None:
    """Add the options of :func:`clean` and :func:`reduce_to`."""
    add = parser.add_argument_group("selection").add_argument
    add(
        "--crop",
        type=finite_number,
        nargs=6,
        metavar=tuple(f"{axis}{end}" for end in "01" for axis in "XYZ"),
        help="keep the Gaussians inside a box",
    )
    add(
        "--min-opacity",
        type=finite_number,
        metavar="P",
        help="remove less opaque Gaussians, 0 to 1",
    )
    add(
        "--max-size",
        type=finite_number,
        metavar="S",
        help="remove Gaussians with a larger standard deviation, scene units",
    )
    for option, rule, text in (
        ("floaters", FLOATERS, "remove Gaussians that contribute less than MIN to every voxel"),
        ("cluster", CLUSTER, "keep the Gaussians that contribute MIN to the cluster of voxels"),
    ):
        add(
            f"--filter-{option}",
            type=_voxel_rule(rule),
            nargs="?",
            const=_voxel_rule(rule)(""),
            metavar="SIZE,OPACITY,MIN",
            help=f"{text} of at least this opacity (default: {rule.size:g} of the median distance "
            f"from the middle, or more for large scenes; {rule.opacity:g}; {rule.contribution:g})",
        )
    add(
        "--seed-pos",
        **VECTOR,
        help="the cluster nearest to this point (default: the one with the most Gaussians)",
    )
    add(
        "--decimate",
        type=_count_or_percentage,
        metavar="N|N%%",
        help="merge neighbours until this many Gaussians are left, and fit them to images of all: "
        "from the training cameras of a fit, else from around the model",
    )
    add_variant_argument(parser)


def _voxel_rule(default: VoxelRule) -> Callable[[str], tuple[VoxelRule, bool]]:
    """Return a parser of ``SIZE,OPACITY,MIN``, of which any may be left out.

    It returns the rule, and whether its size is given, in world units: the default's is relative.
    """

    def parse(text: str) -> tuple[VoxelRule, bool]:
        words = text.split(",")
        if len(words) > 3:
            got = one_line(text, 40)
            raise argparse.ArgumentTypeError(f"must be at most SIZE,OPACITY,MIN, got {got}")
        pairs = zip_longest(words, astuple(default))
        size, opacity, least = (finite_number(word) if word else usual for word, usual in pairs)
        if not (size > 0 and 0 < opacity < 1 and least >= 0):
            raise argparse.ArgumentTypeError(
                "SIZE must be above 0, OPACITY above 0 and below 1, MIN at least 0, got "
                f"{size:g},{opacity:g},{least:g}"
            )
        return VoxelRule(size, opacity, least), bool(words[0])

    return parse


def _count_or_percentage(text: str) -> Callable[[int], int]:
    """Return the function from a number of Gaussians to that which is left."""
    if not text.endswith("%"):
        count = bounded_int(1)(text)
        return lambda before: min(count, before)
    if not 0 < (share := finite_number(text[:-1]) / 100) <= 1:
        raise argparse.ArgumentTypeError(f"must be above 0% and at most 100%, got {text}")
    return lambda before: max(1, round(share * before))


def clean(source: ExportSource, args: argparse.Namespace) -> ExportSource:
    """Return the Gaussians that the options keep, and print reasons; UserError if none are left."""
    if args.seed_pos is not None and args.filter_cluster is None:
        raise UserError("--seed-pos: needs --filter-cluster")
    gaussians = source.gaussians
    kept = _find_kept(gaussians, args)
    lost = {name: np.count_nonzero(~mask) for name, mask in kept.items()}
    if kept:
        gaussians = take(gaussians, np.logical_and.reduce(list(kept.values())))
    for name, option in (("floaters", args.filter_floaters), ("cluster", args.filter_cluster)):
        if option is not None and gaussians.num_gaussians:
            rule, is_given = option
            if not is_given:
                rule = rule.scale_to(gaussians, extent_of(gaussians))
            if name == "floaters":
                mask = find_non_floaters(gaussians, rule)
            else:
                seed = None if args.seed_pos is None else args.seed_pos - np.array(gaussians.origin)
                mask = find_cluster(gaussians, rule, seed)
            lost[f"{name} (voxels of {rule.size:.3g})"] = np.count_nonzero(~mask)
            gaussians = take(gaussians, mask)
    if lost:
        reasons = ", ".join(f"{name} {count:,}" for name, count in lost.items())
        print(f"kept: {gaussians.num_gaussians:,}; left out by {reasons}", flush=True)
    if not gaussians.num_gaussians:
        raise UserError(f"{source.path}: nothing is left; crop and filter less")
    return replace(source, gaussians=gaussians)


def _find_kept(gaussians: Gaussians[np.ndarray], args: argparse.Namespace) -> dict[str, np.ndarray]:
    """Return the mask (N,) of the Gaussians that each given criterion keeps."""
    kept = {}
    if args.crop is not None:
        corners = np.reshape(args.crop, (2, 3))
        means = gaussians.means.astype(np.float64) + gaussians.origin
        inside = (means >= corners.min(axis=0)) & (means <= corners.max(axis=0))
        kept["box"] = inside.all(axis=1)
    if args.min_opacity is not None:
        kept["opacity"] = gaussians.opacities >= args.min_opacity
    if args.max_size is not None:
        kept["size"] = gaussians.scales.max(axis=1) <= args.max_size
    return kept


def reduce_to(source: ExportSource, count: int, up: np.ndarray) -> ExportSource:
    """Return at most ``count`` Gaussians that look alike from the training cameras of a fit.

    Without a fit, from cameras around the Gaussians, whose axis is ``up`` (3,), world.
    """
    from drgs.export.decimation import SIDE_PX, VIEWS_PER_RING, decimate

    if (before := source.gaussians.num_gaussians) <= count:
        return source
    background = GREY if source.config is None else source.config.data.background_rgb
    views = source.views(up, VIEWS_PER_RING, SIDE_PX)
    where = "around the model" if source.cameras is None else "of the fit"
    print(f"decimated: {before:,} to {count:,}, by {len(views)} views {where}", flush=True)
    with execution_settings(None, debug=False):
        gaussians = decimate(source.gaussians, count, views, source.settings, background)
    return replace(source, gaussians=gaussians)
