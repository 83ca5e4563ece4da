"""Photographs on disk are read by a thread of their own, ahead of the training loop."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import islice

from drgs.datasets.storage import is_on_disk
from drgs.datasets.types import View
from drgs.training.parallel.communicator import Communicator
from drgs.training.parallel.population import own_views
from drgs.training.views import TrainingView

NUM_AHEAD = 2  # views besides that of the iteration


class ReadAhead:
    """Reads the next views that a process renders, in the order of the fit."""

    def __init__(self, views: Sequence[View], views_per_step: int, comm: Communicator) -> None:
        """views: the training views."""
        own = own_views(len(views), views_per_step, comm.rank, comm.size)
        self._own = {index for index in own if is_on_disk(views[index])}
        self._thread = ThreadPoolExecutor(1, "read-ahead")  # starts with its first task

    def __call__(self, coming: Iterable[TrainingView]) -> None:
        """Start to read the first of the coming views; an error is raised where one is used."""
        if self._own:
            own = (view for view in coming if view.index in self._own)
            for view in islice(own, 1 + NUM_AHEAD):
                view.read_ahead(self._thread)
