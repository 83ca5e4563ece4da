"""One process leads, the others follow: what the first calls of its trainer, all call.

So the command that runs on the first process is written as if it were alone: it reads, decides by
the clock, writes and speaks. The others wait for what it calls next, until it says that this is the
end.
"""

from __future__ import annotations

import json
import signal
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial, wraps
from typing import Any

import mitsuba as mi
import numpy as np

from drgs.config.schema import FitConfig
from drgs.core.errors import UserError
from drgs.data.reading import without_pictures
from drgs.data.types import Dataset
from drgs.distributed.ranks import Ranks
from drgs.distributed.shards import AgreedError, own_views
from drgs.distributed.trainer import DistributedTrainer, check_can_be_shared
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.scene import make_scene
from drgs.training.finite_checks import NonFiniteError
from drgs.training.trainer import StepReport, Trainer

START, RESTORE, TAKE_OVER, END = "start", "restore", "take over", "end"
"""What is said besides the names of methods."""

AGREED = (NonFiniteError, AgreedError)
"""Errors that all processes raise alike."""


INTERRUPTED = 130
"""Status of a process that Ctrl-C has ended."""


@contextmanager
def _others_waiting(ranks: Ranks) -> Iterator[None]:
    """Around what all do together, and before that hear of: who fails leaves the others waiting."""
    try:
        yield
    except AGREED:
        raise
    except BaseException:
        ranks.is_broken = True
        raise


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
            with _others_waiting(self.ranks):
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
        dataset = with_own_pictures(dataset, config.optimizer.views_per_step, ranks)
        names = [view.name for view in dataset.train]
        with _others_waiting(ranks):
            ranks.text_of(0, json.dumps([START, config.model_dump_json(), names]))
            share_gaussians(ranks, gaussians)
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
        with _others_waiting(self.ranks):
            self.ranks.text_of(0, json.dumps([RESTORE]))
            super().restore(state)
        self.is_calling = False

    def another(self, config: FitConfig, gaussians: Gaussians) -> Leader:
        """See :meth:`Trainer.another`; the others follow that one from now on."""
        return Leader(config, self.dataset, gaussians, self.ranks)

    def take_over(self, former: Trainer) -> None:
        """See :meth:`Trainer.take_over`; former: whom the others have followed before."""
        with _others_waiting(self.ranks):
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

    work: is given what makes the trainer.
    """
    with leading(ranks):
        work(partial(Leader, ranks=ranks))


@contextmanager
def leading(ranks: Ranks) -> Iterator[None]:
    """Around the first process's work: then the others end, with the same status."""
    status = 0
    try:
        yield
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 1
        raise
    except KeyboardInterrupt:
        status = INTERRUPTED
        raise
    except BaseException as error:
        status = 2 if isinstance(error, (UserError, OSError)) else 1
        raise
    finally:
        if ranks.is_broken:
            said = "stopped" if status == INTERRUPTED else f"error: {sys.exc_info()[1]}"
            print(said, file=sys.stderr, flush=True)
            ranks.comm.Abort(status)
        ranks.text_of(0, json.dumps([END, status]))


def follow(
    ranks: Ranks,
    load: Callable[[FitConfig, list[str]], Dataset],
    check_ranges: Callable[[], None],
) -> int:
    """Do what the first process does; return the status that it ends with.

    load: the dataset of a configuration, with the training views of these names; check_ranges:
    raises ``UserError``.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the first process decides when to stop
    follower = Follower(ranks, load)
    try:
        while True:
            name, *arguments = json.loads(ranks.text_of(0, ""))
            if name == END:
                return arguments[0]
            with suppress(*AGREED):  # the first process says so
                follower.do(name, *arguments)
            check_ranges()
    except BaseException as error:
        told = isinstance(error, UserError)
        text = f"error: {error}" if told else "".join(traceback.format_exception(error))
        end_all(ranks, text, 2 if told else 1)
        raise


def end_all(ranks: Ranks, text: str, status: int) -> None:
    """Say why, and end all processes."""
    print(f"process {ranks.rank}: {text}", file=sys.__stderr__, flush=True)
    ranks.comm.Abort(status)


def end_if_told(ranks: Ranks) -> None:
    """Hear what the first process says next; end where that is the end."""
    said, *status = json.loads(ranks.text_of(0, ""))
    if said == END:
        sys.exit(status[0])


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

    def start(self, text: str, names: list[str]) -> None:
        """Make a trainer; text: its configuration; names: of its views."""
        config, gaussians = FitConfig.model_validate_json(text), share_gaussians(self.ranks, None)
        former = self.trainer
        if former is not None and names != [view.name for view in former.dataset.train]:
            former = self.trainer = None  # of a rehearsal
        dataset = self.load(config, names) if former is None else former.dataset
        self.trainer = DistributedTrainer(config, dataset, gaussians, self.ranks)
        self.former = former


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
