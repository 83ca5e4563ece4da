"""``drgs COMMAND`` and ``python -m drgs COMMAND``: the commands under one name."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from types import ModuleType

from typing_extensions import override

import drgs
from drgs.cli.commands import CommandParser, Subcommand, run_command
from drgs.core.environment import describe_installation
from drgs.core.registry import modules_of

GROUP = "drgs.commands"
"""Group of entry points whose values are packages with ``add_arguments`` in ``__main__``."""


def commands() -> dict[str, Subcommand]:
    """Return the commands by name, shipped ones first."""
    packages = modules_of(GROUP)
    return {
        name: Subcommand(_describe(package), f"{package.__name__}.__main__")
        for name, package in packages.items()
    }


def _describe(package: ModuleType) -> str:
    """Return the first line of a package's documentation as a phrase."""
    first = (package.__doc__ or package.__name__).strip().splitlines()[0].removesuffix(".")
    return f"{first[0].lower()}{first[1:]}"


def main(arguments: Sequence[str] | None = None, prog: str = "drgs") -> None:
    """Entry point of the console script; see :func:`drgs.cli.commands.run_command`."""
    run_command(add_arguments, prog, arguments)


def add_arguments(parser: CommandParser) -> None:
    """Add the commands."""
    parser.description = "3D Gaussian splatting inside Mitsuba 3."
    parser.show_examples(
        "%(prog)s fit scenes/lego.yml --data DIR --out out/lego",
        "%(prog)s render out/lego --orbit 60 --out out/lego_orbit",
        "%(prog)s COMMAND --help",
    )
    parser.add_argument(
        "--version",
        action=ShowVersion,
        nargs=0,
        help="show the versions of drgs and of what it runs on, for a report, and exit",
    )
    parser.add_commands(commands(), metavar="COMMAND")


class ShowVersion(argparse.Action):
    """Print the versions and exit."""

    @override
    def __call__(self, parser: argparse.ArgumentParser, *arguments: object) -> None:
        print(f"drgs {drgs.__version__}\n{describe_installation()}")
        parser.exit()


if __name__ == "__main__":
    main(prog="python -m drgs")
