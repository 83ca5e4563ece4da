"""``drgs COMMAND`` and ``python -m drgs COMMAND``: the commands under one name."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from typing_extensions import override

import drgs
from drgs.cli.commands import CommandParser, Subcommand, run_command
from drgs.core.environment import describe_installation

COMMANDS = {
    "fit": Subcommand("fit 3D Gaussians to posed photographs", "drgs.fit.__main__"),
    "examine": Subcommand("find out which effects photographs call for", "drgs.examine.__main__"),
    "poses": Subcommand("find out where photographs were taken", "drgs.poses.__main__"),
    "render": Subcommand("render Gaussians, a fit, or a Mitsuba scene", "drgs.render.__main__"),
    "export": Subcommand("write Gaussians for other programs", "drgs.export.__main__"),
    "view": Subcommand("look at Gaussians in a browser, rendered live", "drgs.view.__main__"),
    "capture": Subcommand("turn a Mitsuba scene into a training set", "drgs.capture.__main__"),
    "bench": Subcommand("measure drgs; write tables and plots", "drgs.bench.__main__"),
}


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
    parser.add_commands(COMMANDS, metavar="COMMAND")


class ShowVersion(argparse.Action):
    """Print the versions and exit."""

    @override
    def __call__(self, parser: argparse.ArgumentParser, *arguments: object) -> None:
        print(f"drgs {drgs.__version__}\n{describe_installation()}")
        parser.exit()


if __name__ == "__main__":
    main(prog="python -m drgs")
