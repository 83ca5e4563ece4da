"""What stops a fit whose numbers are no longer finite, before it saves them.

To ask the device is to wait for it. So the trainer writes down what every iteration computed, and
looks at it when the host waits anyhow: before the state is saved, returned or changed row by row,
and when the numbers of an iteration are read for the history. What it names is where the trouble
began, not where it was noticed.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import drjit as dr
import numpy as np

from drgs.core.errors import UserError
from drgs.splatting.rendering import decode_fault


class NonFiniteError(UserError):
    """A loss, a gradient or a value is NaN or infinite: what the fit has become is of no use."""

    def __init__(self, message: str, iteration: int) -> None:
        """iteration: where it was found."""
        super().__init__(message)
        self.iteration = iteration


@dataclass(frozen=True)
class _Iteration:
    number: int
    view: str
    loss: Any  # Float (1,)
    first_fault: Any  # UInt32 (1,), of the gradients
    numbers: Mapping[str, Any]  # Float, by name: of the view, from effects


NO_NUMBERS: Mapping[str, Any] = {}
"""Of a fit without effects that optimise."""


class GradientWatch:
    """The losses and gradients of the iterations that nobody has looked at yet."""

    def __init__(self) -> None:
        self._iterations: list[_Iteration] = []

    def add(
        self,
        iteration: int,
        view: str,
        loss: Any,
        first_fault: Any,
        numbers: Mapping[str, Any] = NO_NUMBERS,
    ) -> None:
        """Write down an iteration on the view of that name; waits for nothing.

        loss: Float (1,). first_fault: see :func:`drgs.splatting.rendering.decode_fault`.
        numbers: Float by name, what effects had optimised of the view.
        """
        self._iterations.append(_Iteration(iteration, view, loss, first_fault, numbers))

    def check(self) -> None:
        """Raise :class:`NonFiniteError` for the first iteration at fault; waits for the device."""
        for iteration in self._iterations:
            if faults := list(_faults(iteration)):
                where = f"iteration {iteration.number}, view {iteration.view}"
                raise NonFiniteError(f"{where}: {' and '.join(faults)}", iteration.number)
        self._iterations.clear()


def _faults(iteration: _Iteration) -> Iterator[str]:
    # First: what is wrong with them is wrong with all that follows.
    for name, values in iteration.numbers.items():
        if (first := _first_fault(np.array(values))) is not None:
            yield f"{name} is {first[1]}"
    loss, fault = float(iteration.loss[0]), decode_fault(int(iteration.first_fault[0]))
    if not math.isfinite(loss):
        yield f"the loss is {loss}"
    if fault is not None:
        row, name = fault
        yield f"the gradient of {name} in row {row} is not finite, or too large to be squared"


def check_values(iteration: int, values: Mapping[str, Any], first_row: int = 0) -> None:
    """Raise :class:`NonFiniteError` for the first value that is not finite; waits for the device.

    values: tensors or numpy arrays by name, one row a Gaussian, or single numbers; first_row: the
    number of their first one. A Gaussian of such values is invisible, so that no loss and no
    gradient ever tells.
    """
    for name, array in values.items():
        on_device = not isinstance(array, np.ndarray)
        if on_device and dr.all(dr.isfinite(dr.detach(array).array)):
            continue
        host = np.atleast_1d(np.array(dr.detach(array) if on_device else array))
        if (first := _first_fault(host)) is not None:
            row, value = first
            where = f"in row {first_row + row}"
            raise NonFiniteError(
                f"after iteration {iteration}: {name} is {value} {where}", iteration
            )


def check_view_values(
    iteration: int, values: Mapping[str, np.ndarray], views: Sequence[str]
) -> None:
    """The same for what effects optimise, and its moments.

    values: arrays by name, a row for each of the training views, whose names are ``views``, or one
    row for all. A camera that is not finite sees nothing: no loss tells.
    """
    for name, array in values.items():
        if (first := _first_fault(array)) is not None:
            row, value = first
            view = f"view {views[row]}" if len(array) > 1 else "all views"
            raise NonFiniteError(
                f"after iteration {iteration}: {name} is {value} in row {row} ({view})", iteration
            )


def _first_fault(array: np.ndarray) -> tuple[int, float] | None:
    """The first row, and in it the first value, that is not finite; None: all are."""
    faults = np.argwhere(~np.isfinite(array))
    return (int(faults[0][0]), array[tuple(faults[0])]) if len(faults) else None
