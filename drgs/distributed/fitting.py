"""``mpiexec -n K drgs fit``: what a process of several does for the command."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from drgs.cli.execution import executing, select_variant
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.data import Dataset, load_dataset
from drgs.distributed.ranks import Ranks
from drgs.distributed.shards import own_views
from drgs.distributed.together import end_all, end_if_told, follow, lead
from drgs.training.trainer import Trainer


def run_together(args: argparse.Namespace, work: Callable[[Callable[..., Trainer]], None]) -> None:
    """Lead the others through the command, or follow; ends the process where it follows.

    work: the command, given what makes the trainer.
    """
    ranks = Ranks.world()
    if args.threads is None:
        args.threads = ranks.own_cores
    if ranks.is_first:
        lead(ranks, lambda make: work_alone(args, work, make))
        return
    try:
        with executing(args.threads, args.debug) as check_ranges:
            select_variant(args.variant)
            load = partial(own_photographs, ranks=ranks)
            sys.exit(follow(ranks, load, check_ranges))
    except UserError as error:  # of this machine, or of all
        end_if_told(ranks)
        end_all(ranks, f"error: {error}", 2)


def work_alone(
    args: argparse.Namespace,
    work: Callable[[Callable[..., Trainer]], None],
    make: Callable[..., Trainer],
) -> None:
    """The command, of which not everything has several processes."""
    if args.view:
        raise UserError("--view: shows the fit of one process alone; leave it out, or mpiexec")
    work(make)


def own_photographs(config: FitConfig, names: Sequence[str], ranks: Ranks) -> Dataset:
    """The dataset with the training views of these names; pictures of those that are rendered here.

    Of the others, and of those to measure on, there are cameras and sizes, from files' headers.
    """
    own = own_views(len(names), config.optimizer.views_per_step, ranks.rank, ranks.size)
    rendered = {names[index] for index in own}
    dataset = load_dataset(config.data_for_training, keeps=rendered.__contains__)
    by_name = {view.name: view for view in dataset.train}
    return replace(dataset, train=tuple(by_name[name] for name in names))
