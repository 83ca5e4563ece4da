"""The options of ``drgs export`` that choose, merge and remove Gaussians."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from drgs.cameras.orbits import extent_of, near_plane_of, rings_around
from drgs.cli.commands import CommandParser, bounded_int, finite_number
from drgs.cli.execution import add_variant_argument, execution_settings
from drgs.config.schema import ModelConfig
from drgs.core.errors import UserError, one_line
from drgs.export.selection import find_kept, take
from drgs.export.voxels import CLUSTER, FLOATERS, VoxelRule, find_cluster, find_non_floaters
from drgs.gaussians.parameters import Gaussians
from drgs.results.folder import load_run_config
from drgs.results.refined_cameras import training_cameras

GREY = (0.5, 0.5, 0.5)  # background where none is known: neither hides white nor black


def add_cleaning_arguments(parser: CommandParser) -> None:
    """Add the options of :func:`clean` and :func:`reduce_to`."""
    add = parser.add_argument_group("selection").add_argument
    corners = tuple(f"{axis}{end}" for end in "01" for axis in "XYZ")
    add(
        "--crop",
        type=finite_number,
        nargs=6,
        metavar=corners,
        help="keep the Gaussians inside a box",
    )
    add("--min-opacity", type=_opacity, metavar="P", help="remove less opaque Gaussians, 0 to 1")
    add(
        "--max-size",
        type=_size,
        metavar="S",
        help="remove Gaussians with a larger standard deviation, scene units",
    )
    for option, rule, text in (
        ("floaters", FLOATERS, "remove Gaussians that contribute less than MIN to every voxel"),
        ("cluster", CLUSTER, "keep the Gaussians that contribute MIN to the cluster of voxels"),
    ):
        add(
            f"--filter-{option}",
            type=_VoxelOption(rule),
            nargs="?",
            const=_VoxelOption(rule)(""),
            metavar="SIZE,OPACITY,MIN",
            help=f"{text} of at least this opacity (default: {rule.size:g} of the median distance "
            f"from the middle, or more for large scenes; {rule.opacity:g}; {rule.contribution:g})",
        )
    add(
        "--seed-pos",
        type=finite_number,
        nargs=3,
        metavar=("X", "Y", "Z"),
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


def _opacity(text: str) -> float:
    if not 0 <= (number := finite_number(text)) <= 1:
        raise argparse.ArgumentTypeError(f"must be between 0 and 1, got {text}")
    return number


def _size(text: str) -> float:
    if not (number := finite_number(text)) > 0:
        raise argparse.ArgumentTypeError(f"must be above 0, got {text}")
    return number


@dataclass(frozen=True)
class _VoxelOption:
    """A parser of ``SIZE,OPACITY,MIN``: what is left out is the default's, and SIZE is relative."""

    default: VoxelRule

    def __call__(self, text: str) -> tuple[VoxelRule, bool]:
        """Return the rule, and whether its size is given, in world units."""
        words, d = text.split(","), self.default
        defaults = (d.size, d.opacity, d.contribution)
        if len(words) > len(defaults):
            got = one_line(text, 40)
            raise argparse.ArgumentTypeError(f"must be at most SIZE,OPACITY,MIN, got {got}")
        given = [finite_number(w) if w else n for w, n in zip(words, defaults, strict=False)]
        size, opacity, least = [*given, *defaults[len(given) :]]
        if not (size > 0 and 0 < opacity < 1 and least >= 0):
            raise argparse.ArgumentTypeError(
                "SIZE must be above 0, OPACITY above 0 and below 1, MIN at least 0, got "
                f"{size:g},{opacity:g},{least:g}"
            )
        return VoxelRule(size, opacity, least), bool(words[0])


def _count_or_percentage(text: str) -> Callable[[int], int]:
    """Return the function from a number of Gaussians to that which is left."""
    if not text.endswith("%"):
        count = bounded_int(1)(text)
        return lambda before: min(count, before)
    if not 0 < (share := finite_number(text[:-1]) / 100) <= 1:
        raise argparse.ArgumentTypeError(f"must be above 0% and at most 100%, got {text}")
    return lambda before: max(1, round(share * before))


def clean(
    gaussians: Gaussians[np.ndarray], path: Path, args: argparse.Namespace
) -> Gaussians[np.ndarray]:
    """Return the Gaussians that the options keep, and print why others are left out.

    path: of their file, for messages. Raises :class:`UserError` if none are left.
    """
    if args.seed_pos is not None and args.filter_cluster is None:
        raise UserError("--seed-pos: needs --filter-cluster")
    found = find_kept(gaussians, args.crop, args.min_opacity, args.max_size)
    lost = {name: np.count_nonzero(~kept) for name, kept in found.items()}
    if found:
        gaussians = take(gaussians, np.logical_and.reduce(list(found.values())))
    for name, option in (("floaters", args.filter_floaters), ("cluster", args.filter_cluster)):
        if option is not None and gaussians.num_gaussians:
            rule, is_given = option
            if not is_given:
                rule = rule.scale_to(gaussians, extent_of(gaussians))
            if name == "floaters":
                kept = find_non_floaters(gaussians, rule)
            else:
                seed = None if args.seed_pos is None else args.seed_pos - np.array(gaussians.origin)
                kept = find_cluster(gaussians, rule, seed)
            lost[f"{name} (voxels of {rule.size:.3g})"] = np.count_nonzero(~kept)
            gaussians = take(gaussians, kept)
    if lost:
        reasons = ", ".join(f"{name} {count:,}" for name, count in lost.items())
        print(f"kept: {gaussians.num_gaussians:,}; left out by {reasons}", flush=True)
    if not gaussians.num_gaussians:
        raise UserError(f"{path}: nothing is left; crop and filter less")
    return gaussians


def reduce_to(
    gaussians: Gaussians[np.ndarray], count: int, folder: Path | None, up: np.ndarray
) -> Gaussians[np.ndarray]:
    """Return at most ``count`` Gaussians that look alike from the training cameras of a fit.

    folder: of the fit; None: from cameras around the Gaussians, whose axis is ``up`` (3,), world.
    """
    from drgs.export.decimation import SIDE_PX, VIEWS_PER_RING, decimate

    if (before := gaussians.num_gaussians) <= count:
        return gaussians
    settings = ModelConfig(near=near_plane_of(gaussians)).with_3dgs_defaults()
    background, views, where = GREY, None, "around the model"
    if folder is not None:
        config = load_run_config(folder)
        settings = settings.model_copy(update={"near": config.model.near})
        background, views = config.data.background_rgb, training_cameras(folder, gaussians.origin)
    if views is not None:
        where = "of the fit"
    else:
        views = rings_around(gaussians, up, VIEWS_PER_RING, SIDE_PX)
    settings = settings.model_copy(update=gaussians.rendered_with or {})
    print(f"decimated: {before:,} to {count:,}, by {len(views)} views {where}", flush=True)
    with execution_settings(None, debug=False):
        return decimate(gaussians, count, views, settings, background)
