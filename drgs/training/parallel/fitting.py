"""``mpiexec -n K drgs fit``: what a process of several does for the command."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from drgs.cli.execution import executing, select_variant
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.datasets import Dataset, load_dataset
from drgs.training.parallel.agreement import check_views
from drgs.training.parallel.ranks import Ranks
from drgs.training.parallel.shards import own_views
from drgs.training.parallel.together import follow, lead
from drgs.training.trainer import Trainer


def run_together(args: argparse.Namespace, work: Callable[[Callable[..., Trainer]], None]) -> None:
    """Lead the others through the command, or follow.

    work: the command, given what makes the trainer.
    """
    ranks = Ranks.world()
    if args.threads is None:
        args.threads = ranks.own_cores
    if args.view:
        raise UserError("--view: shows the fit of one process alone; leave it out, or mpiexec")
    if ranks.is_first:
        lead(ranks, work)
        return
    with executing(args.threads, args.debug) as check_ranges:
        select_variant(args.variant)
        follow(ranks, partial(own_photographs, ranks=ranks), check_ranges)


def own_photographs(config: FitConfig, names: Sequence[str], ranks: Ranks) -> Dataset:
    """The dataset with the training views of these names; pictures of those that are rendered here.

    Of the others, and of those to measure on, there are cameras and sizes, from files' headers.
    Raises ``UserError`` where views are not those of the first process.
    """
    own = own_views(len(names), config.optimizer.views_per_step, ranks.rank, ranks.size)
    rendered = {names[index] for index in own}
    dataset = load_dataset(config.data_for_training, keeps=rendered.__contains__)
    chosen = set(names)
    dataset = replace(dataset, train=tuple(view for view in dataset.train if view.name in chosen))
    check_views(ranks, dataset, rendered, config.data.path)
    by_name = {view.name: view for view in dataset.train}
    return replace(dataset, train=tuple(by_name[name] for name in names))
