"""Commands and their subcommands: argparse's own, each imported when it is called."""

from __future__ import annotations

import argparse
import math
import re
import shlex
import sys
import traceback
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, NoReturn

from typing_extensions import override

from drgs.cli.ending import (
    escape_unencodable,
    exit_on_interrupt,
    exit_on_user_error,
    interruptible_imports,
    print_notes,
)
from drgs.core.constants import MAX_INT
from drgs.core.errors import UserError, did_you_mean, one_line
from drgs.core.processes import end_job_on_error, process_count, root_output_only
from drgs.core.registry import ExtensionError, reporting_extensions


class Subcommand(NamedTuple):
    """A command among several."""

    text: str  # description, one phrase in lower case
    module: str  # has a function add_arguments(parser), which sets run(args) as a default


class CommandParser(argparse.ArgumentParser):
    """A parser that imports ``module``, which adds its arguments, when it parses."""

    def __init__(self, *, module: str | None = None, **settings: Any) -> None:
        super().__init__(formatter_class=argparse.RawDescriptionHelpFormatter, **settings)
        self._negative_number_matcher = re.compile(r"-\.?\d")  # argparse's lacks -1e-3
        self._module = module
        self._subcommands: tuple[str, ...] = ()
        self.more_help: Callable[[], str] = str  # ends the help; called when this is shown
        shown = "print the traceback of an extension's error"
        self.add_argument("--traceback", action="store_true", default=argparse.SUPPRESS, help=shown)

    @override
    def format_help(self) -> str:
        more = self.more_help()
        return super().format_help() + (f"\n{more}\n" if more else "")

    def show_examples(self, *lines: str) -> None:
        """End the help with command lines; ``%(prog)s`` in them is the command."""
        self.epilog = "\n  ".join(["example:" if len(lines) == 1 else "examples:", *lines])

    def add_overrides(self, text: str) -> None:
        """Add ``--set``, which gives values of a configuration; text: its help."""
        self.add_argument(
            "--set",
            dest="overrides",
            action="append",
            default=[],
            metavar="KEY=VALUE",
            help=f"{text}; repeatable",
        )

    def add_commands(self, commands: dict[str, Subcommand], metavar: str) -> None:
        """Add subcommands by name, exactly one of which has to be given."""
        self._subcommands = tuple(commands)
        subparsers = self.add_subparsers(metavar=metavar, required=True, title="commands")
        for name, (text, module) in commands.items():
            description = f"{text[0].upper()}{text[1:]}."
            subparsers.add_parser(name, help=text, description=description, module=module)

    @override
    def parse_known_args(  # pyright: ignore[reportIncompatibleMethodOverride]  # overloads
        self, args: Iterable[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        if self._module is not None:
            module, self._module = self._module, None
            import_module(module).add_arguments(self)
        words = sys.argv[1:] if args is None else list(args)
        name = next((word for word in words if not word.startswith("-")), None)
        if self._subcommands and name is not None and name not in self._subcommands:
            *others, last = self._subcommands
            known = f"{', '.join(others)} and {last}" if others else last
            nearest = did_you_mean(name, self._subcommands, cutoff=0.5)
            self.error(f"there is no command {name}, only {known}{nearest}")
        return super().parse_known_args(words, namespace or argparse.Namespace())

    @override
    def error(self, message: str) -> NoReturn:
        """Raise :class:`UserError`; an option of several words is shown with them."""
        match = re.fullmatch(r"argument (?:\S+/)?(--\S+): expected \d+ arguments", message)
        if match and isinstance(metavar := self._option_string_actions[match[1]].metavar, tuple):
            message = f"{message}: {match[1]} {' '.join(metavar)}"
        raise UserError(f"{one_line(message, 500)}; see {self.prog} --help")


def run_command(
    add_arguments: Callable[[CommandParser], None],
    prog: str,
    arguments: Sequence[str] | None = None,
) -> None:
    """Parse a command line, run its command, and exit as :mod:`drgs.cli.ending` defines.

    add_arguments: adds the command's arguments, and sets ``run``, a function of the parsed ones
    with the whole line as ``command``, and ``is_shared`` if several processes may run it together.
    prog: the command's name. arguments: its words; None: those of this process.
    """
    escape_unencodable()
    with (
        end_job_on_error(),
        exit_on_interrupt(),
        exit_on_user_error(),
        root_output_only(),
        print_notes(),
    ):
        parser = CommandParser(prog=prog)
        parser.set_defaults(is_shared=False, traceback=False)
        add_arguments(parser)
        with interruptible_imports():
            args = parser.parse_args(arguments)
        words = sys.argv[1:] if arguments is None else arguments
        args.command = shlex.join([*prog.split(), *words])
        if not args.is_shared and (process_count() or 1) > 1:
            raise UserError(
                "mpiexec: processes can share fit and render, no other command; leave it out"
            )
        try:
            with reporting_extensions():
                args.run(args)
        except ExtensionError as error:
            if args.traceback:
                traceback.print_exception(error.__cause__)
            raise


def bounded_int(minimum: int, maximum: int = MAX_INT) -> Callable[[str], int]:
    """Return a parser of whole numbers from ``minimum`` to ``maximum``."""

    def whole_number(text: str) -> int:
        # Python converts no more than 4,300 digits.
        number = int(text) if re.fullmatch(r"\s*[+-]?[0-9]{1,4000}\s*", text) else None
        if number is not None and minimum <= number <= maximum:
            return number
        expected = f"a whole number >= {minimum}"
        if number is not None and number > maximum:
            expected = f"at most {maximum:,}"
        got = one_line(text, 80) or "nothing"
        raise argparse.ArgumentTypeError(f"must be {expected}, got {got}")

    return whole_number


def file_or_folder(text: str) -> Path:
    """Parse a path, which need not exist."""
    if "\0" in text:
        raise argparse.ArgumentTypeError("a path has no zero byte")
    try:
        return Path(text).expanduser()
    except RuntimeError as error:  # there is no such user
        raise argparse.ArgumentTypeError(f"{one_line(error)}: {one_line(text, 40)}") from None


def finite_number(text: str) -> float:
    """Parse a finite number."""
    with suppress(ValueError):
        if math.isfinite(number := float(text)):
            return number
    got = one_line(text, 80) or "nothing"
    raise argparse.ArgumentTypeError(f"must be a finite number, got {got}")


def degrees(text: str) -> float:
    """Parse a field of view in degrees, as Mitsuba's ``fov``."""
    angle = finite_number(text)
    if not 0 < angle < 180:
        raise argparse.ArgumentTypeError(f"must be between 0 and 180 degrees, got {text}")
    return angle


VECTOR: dict[str, Any] = {"type": finite_number, "nargs": 3, "metavar": ("X", "Y", "Z")}
SIZE: dict[str, Any] = {"type": bounded_int(1), "nargs": 2, "metavar": ("W", "H")}
PORT: dict[str, Any] = {
    "type": bounded_int(1, 65535),
    "metavar": "N",
    "help": "port of the page (default: first free port from 8080)",
}
"""Settings of options for a point or direction, for an image's size in px, and for a page's port.
"""
