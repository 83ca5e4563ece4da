"""Gradients of a step, and what the backward passes of its views leave for density control.

A step of one view has its gradients in the parameters after ``dr.backward``; steps of several views
use ``drgs.training.parallel.exchange``.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from drgs.training.steps import StepView


@dataclass(frozen=True)
class ViewGradients:
    """The backward pass of one view; N are the rows that this process has."""

    means2d_grad: Any  # Array2f or tensor (N, 2): derivative of the step's loss, per px
    visible: Any  # Bool (N,): the splat's extent touches the film
    weighted_sums: Mapping[str, Any]  # Float (N,), by name: see DensityStrategy.pixel_weights
    first_fault: Any  # UInt32 (1,): see drgs.splatting.rendering.decode_fault


@dataclass(frozen=True)
class ViewLoss:
    """Loss and error of the view of an iteration."""

    loss: Any  # one entry
    squared_error: Any  # one entry: mean over pixels and channels
    counted: float  # share of the pixels that count


class WholeGradients:
    """Steps of one view: after its backward pass, the gradients are in the parameters."""

    def __init__(self, integrator: Any) -> None:
        """integrator: ``splats``."""
        self.integrator = integrator
        self._views: Sequence[StepView] = ()
        self._sums: Mapping[str, Any] = {}

    def begin(self, views: Sequence[StepView], place: Callable[[StepView], None]) -> None:
        """Begin a step. place: puts the sensor of a view that another process renders."""
        del place
        self._views = views

    def own_views(self) -> Sequence[StepView]:
        """Return the views that this process renders: all."""
        return self._views

    def end_view(self, weights: Mapping[str, Any]) -> None:
        """End the backward pass of a view; weights: planes for weighted sums, by name."""
        last = self.integrator.last
        self._sums = {name: last.weighted_sums(plane) for name, plane in weights.items()}

    def finish(self, names: Sequence[Sequence[str]]) -> list[ViewGradients]:
        """Return what is known of the view."""
        del names
        last = self.integrator.last
        return [ViewGradients(last.means2d_grad, last.visible, self._sums, last.first_nonfinite)]

    def share_losses(self, losses: Mapping[int, ViewLoss]) -> list[ViewLoss]:
        """Return the losses of all views, by place in the step."""
        return list(losses.values())

    def share(self, view: StepView, value: Any) -> Any:
        """Return an array of the process that renders a view."""
        del view
        return value
