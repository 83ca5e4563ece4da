"""Functions that depend on the release of Dr.Jit (1.5) or Mitsuba (3.9), in one place.

To recheck with Dr.Jit 1.6 and Mitsuba 3.10, which are not released yet:

- each function below: it calls what is undocumented, and says what it relies on;
- ``dr.freeze`` for the iterations of a fit: ``docs/tried.md`` has what 1.5 lacks;
- :mod:`drgs._registration`, next to Mitsuba's own discovery by entry points.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, cast

import drjit as dr

from drgs.core.errors import UserError
from drgs.core.types import Float, UInt32

if TYPE_CHECKING:
    from drjit.opt import _LRCache


def bucket_order(buckets: UInt32, block_size: int, num_buckets: int) -> UInt32:
    """Return a permutation (N,) that orders the lanes of each block stably by their bucket.

    buckets: (N,), evaluated, each below ``num_buckets``; block_size: lanes of a block.

    Relies on ``dr.detail.block_mkperm`` being stable.
    """
    # The stub knows the types of each backend, not those of drjit.auto.
    return cast("Callable[..., UInt32]", dr.detail.block_mkperm)(buckets, block_size, num_buckets)


def same_variables(tree: object, other: object) -> bool:
    """Return whether two PyTrees consist of the same Dr.Jit variables, in the same order."""
    return dr.detail.collect_indices(tree) == dr.detail.collect_indices(other)


def llvm_version() -> tuple[int, ...]:
    """Return the version of the loaded libLLVM, such as (19, 1, 7); (-1, ...) without one.

    Relies on ``dr.detail.llvm_version`` waiting for Dr.Jit's start-up.
    """
    return tuple(dr.detail.llvm_version())


def llvm_vector_width() -> int:
    """Return the lanes of the vectors that Dr.Jit compiles for; 0 if unknown."""
    llvm_version()  # waits until the backend knows its processor
    try:
        return _llvm_function("_Z21jit_llvm_vector_widthv", ctypes.c_uint32)()
    except (AttributeError, OSError):
        return 0


@contextmanager
def access_all_lanes(array_type: type[dr.ArrayBase]) -> Iterator[None]:
    """Access memory in all lanes of what is being traced.

    Also in those that a loop has left, and in those that only fill up the last vector of a launch.
    Accesses must be valid there, and change nothing that is read; a selection or a branch for each
    is saved. array_type: of the LLVM backend, or else nothing changes.

    Relies on Dr.Jit taking the mask of an access from the top of a stack.
    """
    functions = _mask_functions() if dr.backend_v(array_type) == dr.JitBackend.LLVM else None
    if functions is None:
        yield
        return
    push, pop = functions
    backend = int(dr.JitBackend.LLVM.value)
    everywhere = dr.mask_t(array_type)(True)
    push(backend, ctypes.c_uint32(everywhere.index))
    try:
        yield
    finally:
        pop(backend)


def same_memory(array: dr.ArrayBase) -> dr.ArrayBase:
    """Return another array of an evaluated array's memory; see :func:`shifted_views`."""
    return shifted_views(cast(Float, array), [0], dr.width(array))[0]


def shifted_views(array: Float, starts: Sequence[int], size: int) -> list[Float]:
    """Return parts of an array, ``size`` long from each start.

    In the LLVM backend they are its memory, which whole vectors load at any place: ``array`` is
    evaluated, and must live until what is computed from them is evaluated. Vectors go beyond the
    end of an array, as they do for Dr.Jit's own. Elsewhere, they are gathered. Not differentiated.

    Relies on ``jit_var_mem_map``, and on the device running kernels in the order of their launch.
    """
    array = dr.detach(array)
    dr.eval(array)
    if starts and not 0 <= min(starts) <= max(starts) <= dr.width(array) - size:
        raise IndexError(f"shifted_views(): {size} of {dr.width(array)} numbers from {starts}")
    functions = _view_functions() if dr.backend_v(array) == dr.JitBackend.LLVM else None
    if functions is None or array.state != dr.VarState.Evaluated:
        index = dr.arange(dr.uint32_array_t(type(array)), size)
        firsts = type(index)(list(starts))
        places = (index + dr.gather(type(index), firsts, k) for k in range(len(starts)))
        return [dr.gather(type(array), array, place) for place in places]
    data, mem_map, release = functions
    memory = ctypes.c_void_p()
    held = [data(array.index, ctypes.byref(memory))]
    backend, number = int(dr.JitBackend.LLVM.value), int(dr.type_v(array).value)
    try:
        for start in starts:
            place = cast(int, memory.value) + dr.itemsize_v(array) * start
            held.append(mem_map(backend, number, place, size, 0))
        views = dr.detail.update_indices([type(array)(0)] * len(starts), held[1:])
    finally:
        for index in held:
            release(index)
    return cast("list[Float]", views)


@cache
def _view_functions() -> tuple[ctypes._NamedFuncPointer, ...] | None:
    try:
        data = _llvm_function("_Z12jit_var_datajPPv", ctypes.c_uint32)
        mem_map = _llvm_function("_Z15jit_var_mem_map10JitBackend7VarTypePvmi", ctypes.c_uint32)
        release = _llvm_function("_Z20jit_var_dec_ref_implj", None)
    except (AttributeError, OSError):
        return None
    data.argtypes = [ctypes.c_uint32, ctypes.c_void_p]
    number = ctypes.c_int
    mem_map.argtypes = [number, number, ctypes.c_void_p, ctypes.c_size_t, number]
    release.argtypes = [ctypes.c_uint32]
    return data, mem_map, release


@cache
def _mask_functions() -> tuple[ctypes._NamedFuncPointer, ctypes._NamedFuncPointer] | None:
    try:
        return (
            _llvm_function("_Z17jit_var_mask_push10JitBackendj", None),
            _llvm_function("_Z16jit_var_mask_pop10JitBackend", None),
        )
    except (AttributeError, OSError):
        return None


def disable_avx512() -> None:
    """Compile from now on for this processor as if it had AVX2 and no AVX-512.

    To be called before the first kernel. Raises :class:`UserError` if that is not possible.
    """
    llvm_version()  # waits until the backend knows its processor
    where = "jit_llvm_set_target(): cannot leave out AVX-512"
    try:
        processor = _llvm_function("_Z19jit_llvm_target_cpuv", ctypes.c_char_p)()
        features = _llvm_function("_Z24jit_llvm_target_featuresv", ctypes.c_char_p)()
        set_target = _llvm_function("_Z19jit_llvm_set_targetPKcS0_j", None)
    except (AttributeError, OSError) as error:
        raise UserError(f"{where}: this build of Dr.Jit has no such function; omit it") from error
    names = (features or b"").decode().split(",")
    if "+avx512vl" not in names:
        raise UserError(f"{where}: Dr.Jit does not use it on this processor; omit it")
    wider = ("avx512", "evex512", "avx10", "amx")
    rest = [f"-{name[1:]}" if name[1:].startswith(wider) else name for name in names]
    set_target(processor, ",".join(rest).encode(), ctypes.c_uint32(8))


def _llvm_function(name: str, result: type | None) -> ctypes._NamedFuncPointer:
    library = next(iter(sorted(Path(dr.__file__).parent.glob("libdrjit-core.*"))), None)
    if library is None:
        raise OSError("no library of drjit-core")
    function = getattr(ctypes.CDLL(str(library)), name)
    function.restype = result
    return function


def new_rate_cache() -> _LRCache:
    """Return the cache of scaled learning rates of ``drjit.opt.Adam._step`` for a step."""
    from drjit.opt import _LRCache

    return _LRCache()


def call_on_variant_change(callback: Callable[[str | None, str | None], None]) -> None:
    """Have Mitsuba call ``callback(old, new)`` after each change of its variant."""
    import mitsuba as mi

    mi.detail.add_variant_callback(callback)
