"""Parameters of single training views, and steps of Adam that move no other view's. Layer 4."""

from __future__ import annotations

from collections.abc import Mapping

import drjit as dr
import mitsuba as mi
import numpy as np
from drjit.opt import Adam

from drgs.optimizer import optimizer_state, restore_optimizer


class ViewParameters:
    """A row of numbers for each view (or one row for all), by name; optimised when it is seen."""

    def __init__(self, values: Mapping[str, np.ndarray], rates: Mapping[str, float]) -> None:
        """values: (V, K) each, or (1, K) for all views; rates: per step."""
        # A view that is not seen has derivatives of zero; its numbers and moments stay.
        self.optimizer = Adam(lr=0.0, epsilon=1e-15, mask_updates=True)
        self.rates = {name: float(rates[name]) for name in values}
        for name, value in values.items():
            self.optimizer[name] = mi.TensorXf(value.astype(np.float32))

    def leaves(self, index: int) -> dict[str, mi.Float]:
        """The numbers (K,) of a view, as variables of their own with derivatives enabled."""
        result = {}
        for name, value in self.optimizer.items():
            count = value.shape[1]
            row = index if value.shape[0] > 1 else 0
            where = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, row * count)
            result[name] = dr.gather(mi.Float, dr.detach(value).array, where)
        dr.eval(result)
        dr.enable_grad(result)
        return result

    def step(self, index: int, leaves: Mapping[str, mi.Float], decay: float = 1.0) -> None:
        """Move the view's numbers along the leaves' derivatives; decay: factor of the rates."""
        self.optimizer.set_learning_rate({k: decay * rate for k, rate in self.rates.items()})
        for name, value in self.optimizer.items():
            count = value.shape[1]
            row = index if value.shape[0] > 1 else 0
            gradient = dr.zeros(mi.Float, dr.width(value.array))
            where = dr.arange(mi.UInt32, count) + dr.opaque(mi.UInt32, row * count)
            dr.scatter(gradient, dr.grad(leaves[name]), where)
            dr.set_grad(value, mi.TensorXf(gradient, value.shape))
        self.optimizer.step()

    def numpy(self) -> dict[str, np.ndarray]:
        """The numbers, (V, K) each."""
        return {name: np.array(dr.detach(value)) for name, value in self.optimizer.items()}

    def state(self) -> dict[str, np.ndarray]:
        """Numbers and moments."""
        return optimizer_state(self.optimizer)

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from :meth:`state`."""
        restore_optimizer(self.optimizer, state)
