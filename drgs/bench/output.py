"""Times of computations, and output of measurements: Markdown tables and CSV files."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import drjit as dr
import numpy as np

from drgs.core.environment import processor
from drgs.core.folders import FolderRecord
from drgs.core.private import llvm_version
from drgs.results.history import write_csv

COMMAND = "bench"


def add_out(
    parser: argparse.ArgumentParser, run: Callable[[argparse.Namespace], None], *names: str
) -> None:
    """Add ``--out``; ``run`` writes the files ``names`` of that folder.

    Raises UserError before measuring if a file there was not written by a measurement.
    """
    text, folder = "output folder (default: out/bench)", Path("out/bench")
    parser.add_argument("--out", type=Path, default=folder, metavar="DIR", help=text)

    def run_and_record(args: argparse.Namespace) -> None:
        FolderRecord(args.out, COMMAND).claim(names)
        try:
            run(args)
        finally:
            FolderRecord(args.out, COMMAND).seal()
        print(f"\nwritten: {', '.join(str(args.out / name) for name in names)}")

    parser.set_defaults(run=run_and_record)


def machine() -> str:
    """Describe processor, threads and LLVM in one line."""
    version = ".".join(map(str, llvm_version()))
    return f"{processor()}, {dr.thread_count()} threads, LLVM {version}"


def write_rows(path: Path, row_type: Any, rows: Iterable[object]) -> None:
    """Write instances of the dataclass ``row_type``, a column per field."""
    names = [field.name for field in fields(row_type)]
    write_csv(path, names, [[getattr(row, name) for name in names] for row in rows])


def columns_table(columns: Sequence[tuple[str, str]], items: Iterable[object]) -> str:
    """Format a row per item; columns: header and format, such as ``{.seconds:.1f} s``."""
    headers, formats = zip(*columns, strict=True)
    return markdown_table(headers, [[each.format(item) for each in formats] for item in items])


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Format a table."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)


SLOW_S, SLOW_ROUNDS = 1.0, 3  # slower tasks are timed in SLOW_ROUNDS
VERY_SLOW_S = 15.0  # slower tasks are called once


def seconds(function: Callable[[], object]) -> float:
    """Time one call."""
    started = time.perf_counter()
    function()
    return time.perf_counter() - started


def count_operations(function: Callable[[], object]) -> int:
    """Count the operations in the kernels that a call launches."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        function()
        return sum(kernel["operation_count"] for kernel in dr.kernel_history([dr.KernelType.JIT]))


def time_in_turns(tasks: Sequence[Sequence[Callable[[], object]]], rounds: int) -> list[np.ndarray]:
    """Return the seconds (R, F) of each task's F functions in R rounds.

    In turns, so that other load affects all tasks, and in random order, as caches depend on the
    previous call. Slow tasks have fewer rounds. First calls, which compile kernels, do not count.
    """

    def call(task: Sequence[Callable[[], object]]) -> list[float]:
        return [seconds(function) for function in task]

    first = [call(task) for task in tasks]
    times = [[spent] if sum(spent) > VERY_SLOW_S else [] for spent in first]
    rng = np.random.default_rng(0)
    for turn in range(rounds):
        for k in rng.permutation(len(tasks)):
            fastest = min(map(sum, times[k]), default=0.0)
            if fastest < SLOW_S or (turn < SLOW_ROUNDS and fastest < VERY_SLOW_S):
                times[k].append(call(tasks[k]))
    return [np.array(each) for each in times]
