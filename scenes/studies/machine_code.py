"""The machine code of a kernel, and what its innermost loop does.

Dr.Jit's kernel history has a kernel's intermediate representation (LLVM's, as text). The libLLVM
that Dr.Jit has loaded compiles it here once more, by its C interface, with the passes that Dr.Jit
asks for (``default<O2>`` without unrolling and vectorization, aggressive code generation; processor
and features stand in the text), into assembly instead of an object. That this is what Dr.Jit runs
can be seen from the disassembly that it logs at ``dr.LogLevel.Trace``: a test compares the two.

Only for x86-64 on Linux: elsewhere :func:`assembly` raises :class:`MachineCodeError`.
"""

from __future__ import annotations

import ctypes
import platform
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components

AGGRESSIVE, POSITION_INDEPENDENT, SMALL = 3, 2, 3
"""Constants of LLVM's C interface: level of code generation, relocation and size of addresses
(Core.h and TargetMachine.h of LLVM 17 to 22)."""

PASSES = b"default<O2>"

DISABLED_PASSES = ("LoopUnrolling", "LoopVectorization", "SLPVectorization")
"""Passes that Dr.Jit switches off: its code consists of vectors already."""


class MachineCodeError(Exception):
    """The machine code of a kernel cannot be had here; its text says why, in a line."""


# ----------------------------------------------------------------------------------------------
# From the intermediate representation to assembly
# ----------------------------------------------------------------------------------------------


def assembly(ir: str) -> str:
    """Assembly in AT&T's syntax of a kernel, as its entry in the kernel history has it (``ir``).

    Raises :class:`MachineCodeError` where there is no libLLVM to ask, or another processor.
    """
    llvm = _library()
    context = llvm("ContextCreate", _Pointer)()
    try:
        module = _parse(llvm, context, ir)
        with _target_machine(llvm) as machine:
            _optimize(llvm, module, machine)
            return _emit(llvm, module, machine)
    finally:
        llvm("ContextDispose", None)(context)


class _Pointer(ctypes.c_void_p):
    """A pointer that ctypes passes on as it is; void pointers become ints."""


@cache
def _library() -> Any:
    """Functions of the libLLVM that Dr.Jit has loaded: (name without LLVM, type of the result)."""
    if platform.system() != "Linux" or platform.machine() != "x86_64":
        raise MachineCodeError("machine code is read on x86-64 and Linux only")
    loaded = re.findall(r"/\S*/libLLVM\S*", Path("/proc/self/maps").read_text())
    if not loaded:
        raise MachineCodeError("Dr.Jit has loaded no libLLVM")
    library = ctypes.CDLL(loaded[0])

    def function(name: str, result: Any) -> Any:
        found = library[f"LLVM{name}"]  # a new object each time: types can differ
        found.restype = result
        return found

    for part in ("TargetInfo", "Target", "TargetMC", "AsmPrinter"):
        function(f"InitializeX86{part}", None)()
    return function


def _parse(llvm: Any, context: _Pointer, ir: str) -> _Pointer:
    data = ir.encode()
    buffer = llvm("CreateMemoryBufferWithMemoryRangeCopy", _Pointer)(
        data, ctypes.c_size_t(len(data)), b"kernel"
    )
    module, message = _Pointer(), ctypes.c_char_p()
    failed = llvm("ParseIRInContext", ctypes.c_int)(
        context, buffer, ctypes.byref(module), ctypes.byref(message)
    )
    _check(failed, message)
    return module


def _check(failed: int, message: ctypes.c_char_p) -> None:
    if failed:
        text = (message.value or b"").decode(errors="replace").strip()
        raise MachineCodeError(f"libLLVM does not compile a kernel: {text.partition(chr(10))[0]}")


@contextmanager
def _target_machine(llvm: Any) -> Iterator[_Pointer]:
    """Compiles for this machine, unless a function's attributes name another processor."""
    triple = llvm("GetDefaultTargetTriple", ctypes.c_char_p)()
    target, message = _Pointer(), ctypes.c_char_p()
    failed = llvm("GetTargetFromTriple", ctypes.c_int)(
        triple, ctypes.byref(target), ctypes.byref(message)
    )
    _check(failed, message)
    machine = llvm("CreateTargetMachine", _Pointer)(
        target,
        triple,
        llvm("GetHostCPUName", ctypes.c_char_p)(),
        llvm("GetHostCPUFeatures", ctypes.c_char_p)(),
        AGGRESSIVE,
        POSITION_INDEPENDENT,
        SMALL,
    )
    try:
        yield machine
    finally:
        llvm("DisposeTargetMachine", None)(machine)


def _optimize(llvm: Any, module: _Pointer, machine: _Pointer) -> None:
    options = llvm("CreatePassBuilderOptions", _Pointer)()
    for name in DISABLED_PASSES:
        llvm(f"PassBuilderOptionsSet{name}", None)(options, 0)
    error = llvm("RunPasses", _Pointer)(module, PASSES, machine, options)
    llvm("DisposePassBuilderOptions", None)(options)
    if error:
        message = llvm("GetErrorMessage", ctypes.c_char_p)(error)
        _check(1, ctypes.c_char_p(message))


def _emit(llvm: Any, module: _Pointer, machine: _Pointer) -> str:
    text, message = _Pointer(), ctypes.c_char_p()
    as_assembly = 0
    failed = llvm("TargetMachineEmitToMemoryBuffer", ctypes.c_int)(
        machine, module, as_assembly, ctypes.byref(message), ctypes.byref(text)
    )
    _check(failed, message)
    size = llvm("GetBufferSize", ctypes.c_size_t)(text)
    result = ctypes.string_at(llvm("GetBufferStart", _Pointer)(text), size).decode()
    llvm("DisposeMemoryBuffer", None)(text)
    return result


# ----------------------------------------------------------------------------------------------
# Loops
# ----------------------------------------------------------------------------------------------


def instructions(text: str) -> list[str]:
    """The instructions of assembly, without labels, directives and comments."""
    lines = (line.partition("#")[0].strip() for line in text.splitlines())
    return [line for line in lines if re.match(r"[a-z]", line) and not line.endswith(":")]


def innermost_loop(text: str) -> list[str]:
    """Instructions of the largest loop, by their number, that contains no other loop.

    Those of every path through the loop, also of one that is hardly ever taken. A loop is a
    strongly connected part of the graph of basic blocks; without the blocks that lead into it, what
    it contains are its inner loops. Raises :class:`MachineCodeError` if there is none.
    """
    blocks, edges = _basic_blocks(text)
    loops = _innermost(edges, np.arange(len(blocks)))
    if not loops:
        raise MachineCodeError("the kernel has no loop")
    bodies = [[line for block in loop for line in blocks[block]] for loop in loops]
    return max(bodies, key=len)


def _basic_blocks(text: str) -> tuple[list[list[str]], np.ndarray]:
    """Instructions of each basic block, and pairs of blocks, one of which can follow the other."""
    blocks: list[list[str]] = [[]]
    labels, jumps, falls = {}, [], []
    goes_on = False  # whether the next block can follow the last one
    for line in text.splitlines():
        label = re.match(r"([\w.$]+):", line)
        found = instructions(line)
        if label or (found and blocks[-1] and _ends_block(blocks[-1][-1])):
            if goes_on:
                falls.append((len(blocks) - 1, len(blocks)))
            blocks.append([])
        if label:
            labels[label[1]] = len(blocks) - 1
        if found:
            blocks[-1] += found
            goes_on = not re.match(r"(jmp|ret|ud2)", found[0])
            target = re.match(r"j\w+\s+(\.L\w+)", found[0])
            if target:
                jumps.append((len(blocks) - 1, target[1]))
    edges = falls + [(block, labels[name]) for block, name in jumps]
    return blocks, np.array(edges, int).reshape(-1, 2)


def _ends_block(instruction: str) -> bool:
    return re.match(r"j|ret|ud2", instruction) is not None


def _innermost(edges: np.ndarray, members: np.ndarray) -> list[list[int]]:
    """Loops without inner loops among the blocks ``members``."""
    inside = np.isin(edges, members).all(axis=1)
    size = int(members.max(initial=-1)) + 1
    start, end = edges[inside].T
    graph = csr_array((np.ones(len(start)), (start, end)), shape=(size, size))
    _, part = connected_components(graph, connection="strong")
    found = []
    for number in np.unique(part[members]):
        loop = members[part[members] == number]
        within = np.isin(edges, loop)
        if not within.all(axis=1).any():
            continue
        entries = edges[within[:, 1] & ~within[:, 0], 1]
        body = np.setdiff1d(loop, entries if len(entries) else loop[:1])
        found += _innermost(edges, body) or [[int(block) for block in loop]]
    return found


# ----------------------------------------------------------------------------------------------
# Operations
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Operations:
    """Numbers of instructions by kind.

    An instruction whose operand lies in memory is a load, or a store, besides what it computes with
    it; one that adds to memory is both. A gather of a vector is one load.
    """

    instructions: int
    vectors: int  # that have a vector register, moves included
    loads: int  # of data: neither the stack nor constants
    stores: int
    stack_loads: int  # of what registers have no room for
    stack_stores: int
    constants: int  # loads of numbers that stand beside the code


def count_operations(code: list[str], text: str = "") -> Operations:
    """Count the instructions ``code``, such as those of a loop.

    text: the assembly that they are from, which tells the registers that point to the stack.
    """
    stack = {"%rsp", *re.findall(r"movq\s+%rsp, (%r\w+)", text)}
    counts = dict.fromkeys(Operations.__dataclass_fields__, 0)
    counts["instructions"] = len(code)
    for line in code:
        counts["vectors"] += re.search(r"%[xyz]mm", line) is not None
        base = re.search(r"\((%\w+)?[^)]*\)", line)
        if base is None or re.match(r"lea|nop|prefetch", line):
            continue
        if base[1] == "%rip":
            counts["constants"] += 1
            continue
        place = "stack_" if base[1] in stack else ""
        counts[f"{place}loads"] += _reads_memory(line)
        counts[f"{place}stores"] += _writes_memory(line)
    return Operations(**counts)


COMPARE_INSTRUCTIONS = r"cmp|test|bt[bwlq]?\s|vptest|vucomis|vcomis|ucomis|comis"
"""Instructions whose last operand is read, not written."""

MOVE_INSTRUCTIONS = (
    r"v?mov|v?pmov|vextract|v?pextr|vscatter|vpscatter|vcompress|vpcompress|set|vcvtps2ph"
)
"""Instructions whose last operand is written, not read."""


def _writes_memory(line: str) -> bool:
    """Return whether the last operand, the destination in AT&T's syntax, lies in memory."""
    return _last_is_memory(line) and re.match(COMPARE_INSTRUCTIONS, line) is None


def _reads_memory(line: str) -> bool:
    return not _last_is_memory(line) or re.match(MOVE_INSTRUCTIONS, line) is None


def _last_is_memory(line: str) -> bool:
    return re.search(r"\)\s*(\{%k\d\})?$", line) is not None
