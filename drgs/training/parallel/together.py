"""One process leads, the others follow: what the first calls of its trainer, all call.

So the command that runs on the first process is written as if it were alone: it reads, decides by
the clock, writes and speaks. The others wait for what it calls next, until it says that this is the
end.
"""

from __future__ import annotations

import json
import signal
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial, wraps
from typing import Any

import mitsuba as mi
import numpy as np

from drgs.config.schema import FitConfig
from drgs.datasets.reading import without_pictures
from drgs.datasets.types import Dataset
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.scene import make_scene
from drgs.training.finite_checks import NonFiniteError
from drgs.training.parallel.agreement import check_versions, send_fingerprint, versions
from drgs.training.parallel.ranks import Ranks
from drgs.training.parallel.shards import AgreedError, own_views
from drgs.training.parallel.trainer import DistributedTrainer, check_can_be_shared
from drgs.training.trainer import StepReport, Trainer

START, RESTORE, TAKE_OVER, END = "start", "restore", "take over", "end"
"""What is said besides the names of methods."""

AGREED = (NonFiniteError, AgreedError)
"""Errors that all processes raise alike."""


def _called_by_all(method: Callable) -> Callable:
    """Of the leader: have the others call it, too, with arguments that JSON knows.

    What a method calls of itself, the others call by themselves.
    """

    @wraps(method)
    def call(self: Leader, *arguments: Any) -> Any:
        if self.is_calling:
            return method(self, *arguments)
        self.is_calling = True
        try:
            self.ranks.text_of(0, json.dumps([method.__name__, *arguments]))
            return method(self, *arguments)
        finally:
            self.is_calling = False

    return call


class Leader(DistributedTrainer):
    """The first process's trainer, which all others follow."""

    def __init__(
        self, config: FitConfig, dataset: Dataset, gaussians: Gaussians, ranks: Ranks
    ) -> None:
        """gaussians: all of them; dataset: with all pictures, of which it keeps its own."""
        self.is_calling = True
        check_can_be_shared(config, ranks.size, gaussians.num_gaussians)
        names = [view.name for view in dataset.train]
        ranks.text_of(0, json.dumps([START, config.model_dump_json(), names, versions()]))
        share_gaussians(ranks, gaussians)
        if _others_read(ranks):
            send_fingerprint(ranks, dataset)  # made while they do
        dataset = with_own_pictures(dataset, config.optimizer.views_per_step, ranks)
        super().__init__(config, dataset, gaussians, ranks)
        self.is_calling = False
        self._latest: tuple[int, mi.Scene] | None = None

    @_called_by_all
    def step(self) -> StepReport:
        """See :meth:`Trainer.step`."""
        self._latest = None
        return super().step()

    @_called_by_all
    def check_iterations(self) -> None:
        """See :meth:`Trainer.check_iterations`."""
        super().check_iterations()

    @_called_by_all
    def check(self) -> None:
        """See :meth:`Trainer.check`."""
        super().check()

    @_called_by_all
    def gaussians(self) -> Gaussians:
        """See :meth:`Trainer.gaussians`."""
        return super().gaussians()

    @_called_by_all
    def state(self) -> dict[str, np.ndarray]:
        """See :meth:`Trainer.state`."""
        return super().state()

    @_called_by_all
    def replan(self, iterations: int, densify_stop: int) -> None:
        """See :meth:`Trainer.replan`."""
        super().replan(iterations, densify_stop)

    @_called_by_all
    def retire(self) -> None:
        """See :meth:`Trainer.retire`."""
        super().retire()

    @_called_by_all
    def show(self) -> None:
        """See :meth:`Trainer.show`."""
        super().show()

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """See :meth:`Trainer.restore`; state: of this process, which tells the others."""
        self.is_calling = True
        self.ranks.text_of(0, json.dumps([RESTORE]))
        super().restore(state)
        self.is_calling = False

    def another(self, config: FitConfig, gaussians: Gaussians) -> Leader:
        """See :meth:`Trainer.another`; the others follow that one from now on."""
        return Leader(config, self.dataset, gaussians, self.ranks)

    def take_over(self, former: Trainer) -> None:
        """See :meth:`Trainer.take_over`; former: whom the others have followed before."""
        self.ranks.text_of(0, json.dumps([TAKE_OVER]))
        super().take_over(former)

    def scene_of_all(self) -> mi.Scene:
        """See :meth:`Trainer.scene_of_all`: on this process."""
        if self._latest is None or self._latest[0] != self.iteration:
            scene = make_scene(self.gaussians(), self.config.model, self.dataset.background)
            scene.integrator().sh_degree = self.integrator.sh_degree
            self._latest = self.iteration, scene
        return self._latest[1]


def lead(ranks: Ranks, work: Callable[[Callable[..., Trainer]], None]) -> None:
    """Run what a single process would, with a trainer of all; then let the others go.

    work: is given what makes the trainer. An error is the end of all processes: see
    :mod:`drgs.core.processes`.
    """
    work(partial(Leader, ranks=ranks))
    ranks.text_of(0, json.dumps([END]))


def follow(
    ranks: Ranks,
    load: Callable[[FitConfig, list[str]], Dataset],
    check_ranges: Callable[[], None],
) -> None:
    """Do what the first process does, until it has ended.

    load: the dataset of a configuration, with the training views of these names, after
    :func:`drgs.training.parallel.agreement.check_views`; check_ranges: raises ``UserError``.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process decides when to stop
    follower = Follower(ranks, load)
    while True:
        name, *arguments = json.loads(ranks.text_of(0, ""))
        if name == END:
            return
        with suppress(*AGREED):  # the first process says so
            follower.do(name, *arguments)
        check_ranges()


@dataclass
class Follower:
    """What a process that follows has, and does when it is told."""

    ranks: Ranks
    load: Callable[[FitConfig, list[str]], Dataset]
    trainer: DistributedTrainer | None = None
    former: DistributedTrainer | None = None  # whose dataset the trainer has

    def do(self, name: str, *arguments: Any) -> None:
        """name: of a method of the trainer, or what else is said."""
        if name == START:
            self.start(*arguments)
        elif name == RESTORE:
            self.trainer.restore({})
        elif name == TAKE_OVER:
            self.trainer.take_over(self.former)
            self.former = None
        else:
            getattr(self.trainer, name)(*arguments)

    def start(self, text: str, names: list[str], versions_of_first: dict[str, str]) -> None:
        """Make a trainer; text: its configuration; names: of its views."""
        check_versions(versions_of_first)
        config, gaussians = FitConfig.model_validate_json(text), share_gaussians(self.ranks, None)
        former = self.trainer
        if former is not None and names != [view.name for view in former.dataset.train]:
            former = self.trainer = None  # of a rehearsal
        reads = former is None
        _others_read(self.ranks, reads)
        dataset = self.load(config, names) if reads else former.dataset
        self.trainer = DistributedTrainer(config, dataset, gaussians, self.ranks)
        self.former = former


def _others_read(ranks: Ranks, reads: bool = False) -> bool:
    """Return whether all followers read their photographs now."""
    return bool(ranks.told(np.array(reads)).any())


def with_own_pictures(dataset: Dataset, views_per_step: int, ranks: Ranks) -> Dataset:
    """Without the pictures of training views that other processes render."""
    own = own_views(len(dataset.train), views_per_step, ranks.rank, ranks.size)
    train = (v if i in own else without_pictures(v) for i, v in enumerate(dataset.train))
    return replace(dataset, train=tuple(train))


def share_gaussians(ranks: Ranks, gaussians: Gaussians | None) -> Gaussians:
    """Those of the first process (numpy), on all."""
    own = [] if gaussians is None else [getattr(gaussians, name) for name in PARAMETER_NAMES]
    described = json.loads(ranks.text_of(0, json.dumps([[a.dtype.str, a.shape] for a in own])))
    arrays = own or [np.empty(shape, dtype) for dtype, shape in described]
    arrays = [ranks.from_rank(0, a).reshape(a.shape) for a in arrays]
    return Gaussians(**dict(zip(PARAMETER_NAMES, arrays, strict=True)))
