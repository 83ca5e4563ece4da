"""What every measurement writes: a table on the screen and in Markdown, CSV."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import drjit as dr

from drgs.core.environment import processor
from drgs.core.files import atomic_path
from drgs.core.folders import FolderRecord
from drgs.core.private import llvm_version

COMMAND = "bench"


def add_out(
    parser: argparse.ArgumentParser, run: Callable[[argparse.Namespace], None], *names: str
) -> None:
    """Add ``--out``, and have ``run`` measure with the files ``names`` of that folder for itself.

    A file that no measurement has written is not replaced: it is refused before anything is
    measured.
    """
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/bench"),
        metavar="DIR",
        help="output folder (default: out/bench)",
    )

    def run_with_own_files(args: argparse.Namespace) -> None:
        with own_files(args.out, names):
            run(args)

    parser.set_defaults(run=run_with_own_files)


@contextmanager
def own_files(folder: Path, names: Sequence[str]) -> Iterator[None]:
    """A block that may write the files ``names`` of a folder.

    Raises :class:`UserError` before it begins where one is there that no measurement has written.
    """
    FolderRecord(folder, COMMAND).claim(names)
    try:
        yield
    finally:
        FolderRecord(folder, COMMAND).seal()


def machine() -> str:
    """One line: processor, threads, LLVM."""
    version = ".".join(map(str, llvm_version()))
    return f"{processor()}, {dr.thread_count()} threads, LLVM {version}"


def write_csv(path: Path, header: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Write rows of numbers and words."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as temporary, temporary.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def markdown_table(header: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table as the page of results holds it."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(map(str, line))} |" for line in lines)
