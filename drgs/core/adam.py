"""Adam, of which ``drjit.opt.Adam`` keeps ``(value, promoted, rate, (t, m, v, v_max))``.

These are, for each parameter, the step count t and the moments m, v (flat arrays as long as the
value). Assigning a value of another shape discards moments, step count and rate.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from drjit.opt import Adam, LearningRate
from typing_extensions import override

from drgs.core.arrays import types_of
from drgs.core.private import new_rate_cache, same_memory

if TYPE_CHECKING:
    from drjit.opt import _LRCache

_State = tuple[int, dr.ArrayBase, dr.ArrayBase, dr.ArrayBase | None]

LARGE_WIDTH = 1 << 23
"""Entries from which on moments are overwritten, which saves memory and takes 1.7 times as long."""


class LeanAdam(Adam):
    """``drjit.opt.Adam``, to the same bits, with fewer large arrays at a time.

    ``drjit.opt.Adam`` evaluates all new values and moments at once, while the former ones and all
    gradients are there: seven arrays of each parameter. Here large moments are overwritten, and
    their gradients cleared when they have been used: five arrays. (On CUDA, memory is free for the
    next kernel as soon as the last one that uses it is launched, and this is ``drjit.opt.Adam``.)
    """

    @override
    def step(
        self,
        *,
        eval: bool = True,
        grad_scale: LearningRate | None = None,
        active: dr.ArrayBase | None = None,
    ) -> None:
        """Take a step, and clear the gradients of large arrays.

        A step that is scaled, masked or not evaluated, or has more than two moments, is that of
        ``drjit.opt.Adam``.
        """
        is_plain = eval and grad_scale is None and active is None
        if not is_plain or self.mask_updates or self.amsgrad:
            super().step(eval=eval, grad_scale=grad_scale, active=active)
            return
        rates = new_rate_cache()
        for key in self.state:  # one kernel each: more arrays would share the sets of a cache
            dr.eval(self._update(key, rates))

    def _update(self, key: str, rates: _LRCache) -> list[dr.ArrayBase]:
        """Give a parameter its new state, not evaluated, and return the arrays to evaluate."""
        value, promoted, rate, (count, first, second, _) = self.state[key]
        is_large = dr.width(value) >= LARGE_WIDTH and dr.backend_v(value) == dr.JitBackend.LLVM
        former = first, second
        if is_large:  # Dr.Jit would copy what it scatters to, if it knew that this is read as well
            former = same_memory(first), same_memory(second)
        rate_in_use = self.lr if rate is None else rate
        flat, gradient = dr.detach(value).array, value.grad.array
        new, (count, new_first, new_second, _) = self._step(
            rates, flat, gradient, rate_in_use, (count, *former, None)
        )
        new_value = type(value)(new, value.shape) if dr.is_tensor_v(value) else type(value)(new)
        dr.enable_grad(new_value)
        if not is_large:
            self.state[key] = new_value, promoted, rate, (count, new_first, new_second, None)
            return [new_first, new_second, new]
        dr.clear_grad(value)
        element = dr.arange(types_of(type(new)).UInt32, dr.width(new))
        dr.scatter(first, new_first, element)
        dr.scatter(second, new_second, element)
        self.state[key] = new_value, promoted, rate, (count, first, second, None)
        return [new]  # and by the same kernel the moments, which it reads


class NesterovAdam(LeanAdam):
    """Adam with steps along Nesterov's momentum (Dozat 2016).

    That is the first moment as it would be after one more step with the same gradient, without
    the bias that it would have.
    """

    @override
    def _step(
        self,
        cache: _LRCache,
        value: dr.ArrayBase,
        grad: dr.ArrayBase,
        lr: LearningRate,
        extra: _State,
    ) -> tuple[dr.ArrayBase, _State]:
        count, first = extra[0] + 1, dr.lerp(grad, extra[1], self.beta_1)
        rate = lr * ((1 - self.beta_1**count) / (1 - self.beta_1 ** (count + 1)))
        new, state = super()._step(cache, value, grad, rate, (extra[0], first, *extra[2:]))
        return new, (count, first, *state[2:])


def make_optimizer(
    parameters: Mapping[str, dr.ArrayBase],
    rates: Mapping[str, float],
    beta_1: float = 0.9,
    beta_2: float = 0.999,
    epsilon: float = 1e-15,
) -> NesterovAdam:
    """Return the optimizer of a fit, with a learning rate for each parameter.

    parameters: tensors by name; empty ones are left out.
    rates: learning rate per step by name. A fixed rate of 0 is allowed.
    epsilon: 3DGS uses 1e-15, because gradients of a mean over pixels are far below 1e-8.
    """
    optimizer = NesterovAdam(lr=0.0, beta_1=beta_1, beta_2=beta_2, epsilon=epsilon)
    for name, value in parameters.items():
        if name not in rates:
            raise ValueError(
                f"make_optimizer(): no learning rate for parameter {name}; rates are given for "
                f"{', '.join(sorted(rates)) or 'none'}"
            )
        if dr.width(value) == 0:
            continue
        optimizer[name] = value
        optimizer.set_learning_rate({name: float(rates[name])})
    return optimizer


def optimizer_state(optimizer: Adam) -> dict[str, np.ndarray]:
    """Return values, moments and step counts, numpy: ``NAME.value``, ``.m``, ``.v``, ``.t``.

    Learning rates are not part of it: they follow from the configuration and the iteration.
    """
    state = {}
    for name, (value, _, _, (step, first, second, _)) in optimizer.state.items():
        state[f"{name}.value"] = np.array(dr.detach(value))
        state[f"{name}.m"], state[f"{name}.v"] = np.array(first), np.array(second)
        state[f"{name}.t"] = np.array(step)
    return state


def pending_gradients(optimizer: Adam) -> dict[str, np.ndarray]:
    """Return the gradients of a step that is not taken yet, numpy: ``NAME.gradient``."""
    return {f"{name}.gradient": np.array(dr.grad(value)) for name, value in optimizer.items()}


def restore_optimizer(optimizer: Adam, state: Mapping[str, np.ndarray]) -> None:
    """Continue from :func:`optimizer_state`, and :func:`pending_gradients` if there are any.

    Bit by bit; rates do not change.
    """
    for name, (old, promoted, rate, (step, first, second, maximum)) in optimizer.state.items():
        value = type(old)(state[f"{name}.value"])
        dr.make_opaque(value)
        dr.enable_grad(value)
        if f"{name}.gradient" in state:
            dr.set_grad(value, type(old)(state[f"{name}.gradient"]))
        moments = type(first)(state[f"{name}.m"]), type(second)(state[f"{name}.v"])
        extra = (type(step)(state[f"{name}.t"]), *moments, maximum)
        optimizer.state[name] = value, promoted, rate, extra
