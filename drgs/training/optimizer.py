"""Adam over the parameters of the Gaussians, and row surgery on them.

``drjit.opt.Adam`` keeps, for each parameter, ``(value, promoted, rate, (t, m, v, v_max))``: the
step count t and the moments m, v (flat arrays as long as the value). Assigning a value of another
shape to it discards moments, step count and rate, so every change of the number of Gaussians goes
through :func:`edit_rows`, which moves a row's value and moments together and leaves everything else
as it was.

Parameters are named as in ``gaussians.PARAMETER_NAMES``; in the optimizer (and in Mitsuba's
parameter tables) a prefix such as ``integrator.`` precedes the name. Entries without the prefix
are left alone. A parameter of zero size, ``shN`` at degree 0, cannot be registered and is not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import drjit as dr
import numpy as np
from drjit.opt import Adam, LearningRate
from typing_extensions import override

from drgs.core.arrays import Array, types_of
from drgs.core.private import new_rate_cache, same_memory
from drgs.core.types import UInt32

if TYPE_CHECKING:
    from drjit.opt import _LRCache

AdamState = tuple[
    dr.ArrayBase,
    bool,
    LearningRate | None,
    tuple[int, dr.ArrayBase, dr.ArrayBase, dr.ArrayBase | None],
]
"""The optimizer's entry of a parameter: ``(value, promoted, rate, (t, m, v, v_max))``."""

LARGE_WIDTH = 1 << 20  # entries of an array from which on memory is worth saving


@dataclass(frozen=True)
class _Moments:
    """The moments of a parameter, and aliases by which they are read while they are overwritten.

    Dr.Jit copies an array before it scatters to it, if anything else refers to it, and the new
    moments do. The former ones are therefore read under a name that Dr.Jit takes for other memory.
    """

    arrays: Sequence[dr.ArrayBase]  # as in the optimizer's state
    indices: Sequence[int]  # of the arrays: an array has another one if it was assigned to
    former: tuple[dr.ArrayBase, dr.ArrayBase]  # of the same memory

    @staticmethod
    def from_arrays(first: dr.ArrayBase, second: dr.ArrayBase) -> _Moments:
        """Wait for the device, and take other names for the memory of arrays."""
        former = same_memory(first), same_memory(second)
        return _Moments((first, second), (first.index, second.index), former)

    def match(self, *arrays: dr.ArrayBase) -> bool:
        """Return whether these are the moments still."""
        pairs = zip(self.arrays, self.indices, arrays, strict=True)
        return all(own is array and index == array.index for own, index, array in pairs)


class LeanAdam(Adam):
    """``drjit.opt.Adam``, to the same bits, with fewer large arrays at a time.

    ``drjit.opt.Adam`` evaluates all new values and moments at once, while the former ones and all
    gradients are there: seven arrays of each parameter. Here large moments are overwritten, and
    their gradients cleared when they have been used: five arrays. (On CUDA, memory is free for the
    next kernel as soon as the last one that uses it is launched, and this is ``drjit.opt.Adam``.)
    """

    def __init__(self, *arguments: Any, **settings: Any) -> None:
        """Take the arguments of ``drjit.opt.Adam``."""
        super().__init__(*arguments, **settings)
        self._moments: dict[str, _Moments] = {}

    @override
    def step(
        self,
        *,
        eval: bool = True,
        grad_scale: LearningRate | None = None,
        active: dr.ArrayBase | None = None,
    ) -> None:
        """Take a step, and clear the gradients of large arrays.

        Waits for nothing, but in the first step after large moments were assigned. A step that is
        scaled, masked or not evaluated, and one with more than two moments, is that of
        ``drjit.opt.Adam``, where the arguments are documented.
        """
        is_plain = eval and grad_scale is None and active is None
        if not is_plain or self.mask_updates or self.amsgrad:
            super().step(eval=eval, grad_scale=grad_scale, active=active)
            return
        rates = new_rate_cache()
        dr.eval([self._update(key, rates) for key in self.state])

    def forget_moments(self) -> None:
        """Free memory of moments that are the parameters' no longer."""
        self._moments.clear()

    def _update(self, key: str, rates: _LRCache) -> list[dr.ArrayBase]:
        """Give a parameter its new state, not evaluated, and return the arrays to evaluate."""
        value, promoted, rate, (count, first, second, _) = self.state[key]
        is_large = dr.width(value) >= LARGE_WIDTH and dr.backend_v(value) == dr.JitBackend.LLVM
        former = first, second
        if is_large:
            known = self._moments.get(key)
            if known is None or not known.match(first, second):
                self._moments[key] = known = _Moments.from_arrays(first, second)
            former = known.former
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


def make_optimizer(
    parameters: Mapping[str, dr.ArrayBase],
    rates: Mapping[str, float],
    prefix: str = "",
    beta_1: float = 0.9,
    beta_2: float = 0.999,
    epsilon: float = 1e-15,
) -> LeanAdam:
    """Return an Adam optimizer (Kingma and Ba 2015) with a learning rate for each parameter.

    parameters: tensors by name, without the prefix; those of zero size are left out.
    rates: learning rate per step by name. A fixed rate of 0 is allowed.
    epsilon: 3DGS uses 1e-15, because gradients of a mean over pixels are far below 1e-8.
    """
    optimizer = LeanAdam(lr=0.0, beta_1=beta_1, beta_2=beta_2, epsilon=epsilon)
    for name, value in parameters.items():
        if name not in rates:
            raise ValueError(
                f"make_optimizer(): no learning rate for parameter {name}; rates are given for "
                f"{', '.join(sorted(rates)) or 'none'}"
            )
        if dr.width(value) == 0:
            continue
        optimizer[prefix + name] = value
        optimizer.set_learning_rate({prefix + name: float(rates[name])})
    return optimizer


def num_rows(optimizer: Adam, prefix: str = "") -> int:
    """Return the number of Gaussians N, the first dimension that all parameters share."""
    counts = {optimizer.state[prefix + name][0].shape[0] for name in _names(optimizer, prefix)}
    if len(counts) != 1:
        raise ValueError(
            f'num_rows(): the optimizer\'s parameters with prefix "{prefix}" must share one '
            f"number of rows, got {sorted(counts) or 'no parameters'}"
        )
    return counts.pop()


def edit_rows(
    optimizer: LeanAdam,
    keep: UInt32,
    append: Mapping[str, dr.ArrayBase] | None = None,
    prefix: str = "",
) -> None:
    """Keep some rows of every parameter, in the order given, and append new ones.

    keep: (K,) ``UInt32``, the rows that stay. append: M new rows of every parameter by name,
    without the prefix; ``None``: none are appended. Afterwards row i is former row keep[i] for
    i < K, and appended row i - K from there on.

    Kept rows take their moments along bit by bit, appended rows start with moments of zero, and
    step counts and learning rates stay: the next steps move a kept row as if nothing had
    happened. Detached; waits for the device once, to check ``keep``.
    """
    total = num_rows(optimizer, prefix)
    if dr.width(keep) > 0 and dr.max(keep)[0] >= total:
        raise ValueError(f"edit_rows(): keep must hold row numbers below {total}")
    added = _num_appended(optimizer, append, prefix)
    if dr.width(keep) + added == 0:
        raise ValueError("edit_rows(): at least one row must remain, but none is kept or appended")
    optimizer.forget_moments()
    for name in _names(optimizer, prefix):
        value, promoted, rate, (step, first, second, _) = optimizer.state[prefix + name]
        row_shape = tuple(value.shape[1:])
        width = math.prod(row_shape)
        elements = _elements(keep, width)
        new_rows = no_moments = None
        if append is not None and added > 0:
            new_rows = dr.detach(append[name]).array
            no_moments = dr.zeros(type(new_rows), added * width)

        flat = _gather_and_append(dr.detach(value).array, elements, new_rows)
        first, second = (_gather_and_append(m, elements, no_moments) for m in (first, second))
        if dr.is_tensor_v(value):
            flat = type(value)(flat, (dr.width(flat) // width, *row_shape))
        dr.enable_grad(flat)
        dr.schedule(flat, first, second)
        optimizer.state[prefix + name] = flat, promoted, rate, (step, first, second, None)
    dr.eval()


def take_rows(optimizer: Adam, rows: UInt32, prefix: str = "") -> dict[str, dr.ArrayBase]:
    """Return copies of some rows of every parameter by name, detached; rows: (M,) ``UInt32``."""
    result = {}
    for name in _names(optimizer, prefix):
        value = dr.detach(optimizer.state[prefix + name][0])
        row_shape = tuple(value.shape[1:])
        flat = value.array
        flat = dr.gather(type(flat), flat, _elements(rows, math.prod(row_shape)))
        is_tensor = dr.is_tensor_v(value)
        result[name] = type(value)(flat, (dr.width(rows), *row_shape)) if is_tensor else flat
    return result


def replace_values(optimizer: Adam, name: str, value: dr.ArrayBase, prefix: str = "") -> None:
    """Give a parameter new values of the same shape, and moments of zero.

    The step count and the learning rate stay: as in the reference's opacity reset, Adam's bias
    correction does not start again.
    """
    new, promoted, rate, (step, first, second, _) = _with_value(
        "replace_values", optimizer, prefix + name, value
    )
    first, second = (dr.opaque(type(m), 0, m.shape) for m in (first, second))
    optimizer.state[prefix + name] = new, promoted, rate, (step, first, second, None)


def set_values(optimizer: Adam, name: str, value: dr.ArrayBase, prefix: str = "") -> None:
    """Give a parameter new values of the same shape; moments, step count and rate stay.

    Detached; waits for nothing.
    """
    key = prefix + name
    optimizer.state[key] = _with_value("set_values", optimizer, key, value)


def optimizer_state(optimizer: Adam, prefix: str = "") -> dict[str, np.ndarray]:
    """Return values, moments and step counts, numpy: ``NAME.value``, ``.m``, ``.v``, ``.t``.

    Learning rates are not part of it: they follow from the configuration and the iteration.
    """
    state = {}
    for name in _names(optimizer, prefix):
        value, _, _, (step, first, second, _) = optimizer.state[prefix + name]
        state[f"{name}.value"] = np.array(dr.detach(value))
        state[f"{name}.m"], state[f"{name}.v"] = np.array(first), np.array(second)
        state[f"{name}.t"] = np.array(step)
    return state


def pending_gradients(optimizer: Adam, prefix: str = "") -> dict[str, np.ndarray]:
    """Return the gradients of a step that is not taken yet, numpy: ``NAME.gradient``."""
    return {
        f"{name}.gradient": np.array(dr.grad(optimizer.state[prefix + name][0]))
        for name in _names(optimizer, prefix)
    }


def restore_optimizer(optimizer: Adam, state: Mapping[str, np.ndarray], prefix: str = "") -> None:
    """Continue from :func:`optimizer_state`, and :func:`pending_gradients` if there are any.

    Bit by bit; rates stay as they are.
    """
    for name in _names(optimizer, prefix):
        old, promoted, rate, (step, first, second, maximum) = optimizer.state[prefix + name]
        value = type(old)(state[f"{name}.value"])
        dr.make_opaque(value)
        dr.enable_grad(value)
        if f"{name}.gradient" in state:
            dr.set_grad(value, type(old)(state[f"{name}.gradient"]))
        moments = type(first)(state[f"{name}.m"]), type(second)(state[f"{name}.v"])
        extra = (type(step)(state[f"{name}.t"]), *moments, maximum)
        optimizer.state[prefix + name] = value, promoted, rate, extra


def _with_value(caller: str, optimizer: Adam, key: str, value: dr.ArrayBase) -> AdamState:
    """Return the optimizer's entry of a parameter with other values, which are evaluated."""
    old, promoted, rate, extra = optimizer.state[key]
    if tuple(value.shape) != tuple(old.shape):
        raise ValueError(
            f"{caller}(): {key} has shape {tuple(old.shape)}, the new values "
            f"{tuple(value.shape)}: edit_rows() adds and removes rows"
        )
    value = type(old)(dr.detach(value))
    dr.make_opaque(value)
    dr.enable_grad(value)
    return value, promoted, rate, extra


def _names(optimizer: Adam, prefix: str) -> list[str]:
    """Names without the prefix, in the order of registration."""
    return [key[len(prefix) :] for key in optimizer.state if key.startswith(prefix)]


def _num_appended(optimizer: Adam, rows: Mapping[str, dr.ArrayBase] | None, prefix: str) -> int:
    """Return the number of ``rows``, which must be given for every parameter in its shape."""
    if rows is None:
        return 0
    count = max((value.shape[0] for value in rows.values()), default=0)
    for name in _names(optimizer, prefix):
        expected = (count, *optimizer.state[prefix + name][0].shape[1:])
        got = tuple(rows[name].shape) if name in rows else "none"
        if got != expected:
            raise ValueError(
                f"edit_rows(): appended rows of {name} must have the shape {expected}, got {got}"
            )
    return count


def _elements(rows: UInt32, width: int) -> UInt32:
    """Return the places of ``rows`` in a flat row-major array of ``width`` columns."""
    if dr.width(rows) == 0:
        return rows  # Dr.Jit does not compute with empty arrays
    element = dr.arange(type(rows), dr.width(rows) * width)
    return dr.gather(type(rows), rows, element // width) * width + element % width


def _gather_and_append(flat: Array, elements: UInt32, added: Array | None) -> Array:
    kept = dr.gather(type(flat), flat, elements)
    if added is None:
        return kept
    index_type, num_kept, num_added = type(elements), dr.width(kept), dr.width(added)
    result = dr.empty(type(flat), num_kept + num_added)
    if num_kept > 0:
        dr.scatter(result, kept, dr.arange(index_type, num_kept))
    # Opaque: as a literal (and in dr.concat) the offset would make each call a new kernel.
    offset = dr.opaque(index_type, num_kept)
    dr.scatter(result, added, dr.arange(index_type, num_added) + offset)
    return result
