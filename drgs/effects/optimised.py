"""Effects with parameters of single training views, and steps of Adam that move no other view's."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, cast

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam
from typing_extensions import override

from drgs.core.adam import make_optimizer, optimizer_state, restore_optimizer
from drgs.core.errors import UserError
from drgs.core.files import write_json
from drgs.core.types import Float
from drgs.effects.base import TrainingEffect, as_numbers

if TYPE_CHECKING:
    from drgs.datasets.types import Dataset
    from drgs.training.views import FitState, TrainingView


class OptimisedEffect(TrainingEffect):
    """An effect with rows of numbers by name, one for each view or one for all views.

    Each row has its own optimizer state: when a view is rendered for the first time, its first
    steps are as long as the rate. The numbers are checked, and part of checkpoints.
    """

    has_numbers = True

    def __init__(self, values: Mapping[str, np.ndarray], rates: Mapping[str, float]) -> None:
        """values: (V, K) each, or (1, K) for all views; rates: per step."""
        self.rates = dict(rates)
        self.optimizers: dict[str, Sequence[Adam]] = {
            name: [make_optimizer({name: mi.Float(row)}, rates) for row in value.astype(np.float32)]
            for name, value in values.items()
        }

    @override
    def check(self, dataset: Dataset) -> None:
        """Raise :class:`UserError` for other numbers of rows than one, and one for each view."""
        if type(self)._optimizers_of is not OptimisedEffect._optimizers_of:
            return  # rows are not those of views
        for name, rows in self.optimizers.items():
            if len(rows) not in (1, len(dataset.train)):
                raise UserError(
                    f"effect {self.name}: {name} must have 1 row, or {len(dataset.train)} for the "
                    f"training views, got {len(rows)}"
                )

    def parameters(self, view: TrainingView) -> dict[str, Float]:
        """Return the numbers (K,) of a view, with derivatives enabled."""
        return {name: cast(Float, adam[name]) for name, adam in self._optimizers_of(view).items()}

    def step(self, view: TrainingView, decay: float) -> None:
        """Move the view's numbers along their derivatives; decay: factor of the rates."""
        for name, optimizer in self._optimizers_of(view).items():
            optimizer.set_learning_rate({name: decay * self.rates[name]})
            optimizer.step()

    @override
    def after_backward(
        self, fit: FitState, view: TrainingView, derivatives: Mapping[str, dr.ArrayBase]
    ) -> None:
        """Take a step of Adam; the rates decay as those of the means."""
        dr.set_grad(self.parameters(view), derivatives)
        self.step(view, fit.rate_decay)

    def numpy(self) -> dict[str, np.ndarray]:
        """Return the numbers, (V, K) each."""
        rows = self._optimizer_rows()
        return {name: rows[f"{name}.value"] for name in self.optimizers}

    @override
    def write(self, folder: Path, dataset: Dataset) -> None:
        """Write ``NAME.json``: the numbers of each training view by its name, or those of all."""
        numbers = {name: rows.tolist() for name, rows in self.numpy().items()}
        views = [view.name for view in dataset.train]
        by_view = {
            name: dict(zip(views, rows, strict=True)) if len(rows) > 1 else rows[0]
            for name, rows in numbers.items()
        }
        write_json(folder / f"{self.name}.json", by_view)

    @override
    def leaves(self, view: TrainingView) -> Mapping[str, dr.ArrayBase]:
        return self.parameters(view)

    @override
    def numbers_of(self, view: TrainingView) -> dict[str, Float]:
        return dr.detach(self.parameters(view))

    @override
    def values(self) -> dict[str, np.ndarray]:
        return {key.removesuffix(".value"): v for key, v in self._optimizer_rows().items()}

    @override
    def state(self) -> dict[str, np.ndarray]:
        return self._optimizer_rows()

    @override
    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        for name, optimizers in self.optimizers.items():
            own = {key: value for key, value in state.items() if key.startswith(f"{name}.")}
            for row, optimizer in enumerate(optimizers):
                restore_optimizer(optimizer, {key: value[row] for key, value in own.items()})

    def _optimizer_rows(self) -> dict[str, np.ndarray]:
        """Return values, moments and step counts, a row for each view."""
        result = {}
        for optimizers in self.optimizers.values():
            rows = [optimizer_state(optimizer) for optimizer in optimizers]
            result |= {key: np.stack([row[key] for row in rows]) for key in rows[0]}
        return result

    def _optimizers_of(self, view: TrainingView) -> dict[str, Adam]:
        return {k: rows[min(view.index, len(rows) - 1)] for k, rows in self.optimizers.items()}


class CenteredEffect(OptimisedEffect):
    """Parameters of which one, ``centered``, has the mean change of all rows subtracted.

    Splats would absorb a change that all rows have in common. The mean is not differentiated.
    """

    centered: str  # name of the parameter

    @override
    def __init__(self, values: Mapping[str, np.ndarray], rates: Mapping[str, float]) -> None:
        super().__init__(values, rates)
        num_rows, size = np.shape(values.get(self.centered, np.zeros((1, 1))))
        self.common = cast(Float, dr.opaque(mi.Float, 0, size))  # mean change of all rows
        self.share = 1 / num_rows

    @override
    def step(self, view: TrainingView, decay: float) -> None:
        """Move the view's numbers, and the mean of all rows with them."""
        before = self.numbers_of(view).get(self.centered)
        super().step(view, decay)
        if before is not None:
            after = self.numbers_of(view)[self.centered]
            self.common = self.common + (after - before) * self.share
            dr.eval(self.common)

    @override
    def state(self) -> dict[str, np.ndarray]:
        return {**super().state(), "common": np.array(self.common)}

    @override
    def restore(self, state: Mapping[str, np.ndarray]) -> None:
        super().restore(state)
        self.common = as_numbers(state["common"])
