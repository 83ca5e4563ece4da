"""Errors for non-finite numbers of a fit, before they are saved.

A check waits for the device. So the trainer keeps the results of every iteration, and checks them
when the host waits in any case. Errors name the first iteration with such a number.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import drjit as dr
import numpy as np

from drgs.core.errors import UserError
from drgs.core.types import Float, UInt32
from drgs.splatting.rendering import decode_nonfinite


class NonFiniteError(UserError):
    """A loss, a gradient or a value is NaN or infinite: the state of the fit is of no use."""

    def __init__(self, message: str, iteration: int) -> None:
        """iteration: where it was found."""
        super().__init__(message)
        self.iteration = iteration


@dataclass(frozen=True)
class WatchedIteration:
    """Numbers of an iteration that are still on the device."""

    number: int
    view: str
    loss: Float  # (1,)
    first_nonfinite: UInt32  # (1,), of the gradients: see drgs.splatting.rendering.decode_nonfinite
    numbers: Mapping[str, dr.ArrayBase]  # by name: of the view, optimised by effects

    def faults(self) -> Iterator[str]:
        """Yield the values that are not finite; waits for the device."""
        # First, because all later numbers depend on them.
        for name, values in self.numbers.items():
            if (first := _first_nonfinite(np.array(values))) is not None:
                yield f"{name} is {first[1]}"
        loss, fault = float(self.loss[0]), decode_nonfinite(int(self.first_nonfinite[0]))
        if not math.isfinite(loss):
            yield f"the loss is {loss}"
        if fault is not None:
            row, name = fault
            yield f"the gradient of {name} in row {row} is not finite, or too large to be squared"


class GradientWatch(list[WatchedIteration]):
    """The losses and gradients of the iterations that are not checked yet."""

    def check(self) -> None:
        """Raise :class:`NonFiniteError` for the first iteration at fault; waits for the device."""
        for iteration in self:
            if faults := list(iteration.faults()):
                where = f"iteration {iteration.number}, view {iteration.view}"
                raise NonFiniteError(f"{where}: {' and '.join(faults)}", iteration.number)
        self.clear()


def check_values(
    iteration: int,
    values: Mapping[str, dr.ArrayBase | np.ndarray],
    first_row: int = 0,
    views: Sequence[str] = (),
) -> None:
    """Raise :class:`NonFiniteError` for the first value that is not finite; waits for the device.

    values: arrays by name, a row for each Gaussian (first_row: the number of the first), or, if
    views are named, a row for each of these or one for all. Such a Gaussian may be invisible, and
    have finite gradients.
    """
    for name, array in values.items():
        on_device = not isinstance(array, np.ndarray)
        if on_device and dr.all(dr.isfinite(dr.detach(array).array)):
            continue
        host = np.atleast_1d(np.array(dr.detach(array) if on_device else array))
        if (first := _first_nonfinite(host)) is not None:
            row, value = first
            message = f"after iteration {iteration}: {name} is {value} in row {first_row + row}"
            if views:
                message += f" (view {views[row]})" if len(host) > 1 else " (all views)"
            raise NonFiniteError(message, iteration)


def _first_nonfinite(array: np.ndarray) -> tuple[int, float] | None:
    """Return the first row, and in it the first value, that is not finite; None: all are."""
    faults = np.argwhere(~np.isfinite(array))
    return (int(faults[0][0]), float(array[tuple(faults[0])])) if len(faults) else None
