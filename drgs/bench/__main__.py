"""Entry point of ``python -m drgs.bench``."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from drgs.bench import (
    accuracy,
    benefits,
    effects,
    hybrid,
    population,
    scaling,
    speed,
    stability,
    training,
    volprim,
)
from drgs.cli.errors import exit_on_user_error

COMMANDS = {
    "speed": speed,
    "scaling": scaling,
    "accuracy": accuracy,
    "effects": effects,
    "hybrid": hybrid,
    "benefits": benefits,
    "training": training,
    "volprim": volprim,
    "stability": stability,
    "population": population,
}


def main(arguments: Sequence[str] | None = None) -> None:
    """Parse the command line and run one measurement."""
    parser = argparse.ArgumentParser(
        prog="python -m drgs.bench", description="Measure drgs; write tables and plots."
    )
    commands = parser.add_subparsers(dest="command", required=True)
    for name, module in COMMANDS.items():
        command = commands.add_parser(name, help=module.DESCRIPTION)
        command.add_argument(
            "--out",
            type=Path,
            default=Path("out/bench"),
            metavar="DIR",
            help="(default: out/bench)",
        )
        module.add_options(command)
    args = parser.parse_args(arguments)
    with exit_on_user_error():
        COMMANDS[args.command].run(args)


if __name__ == "__main__":
    main()
