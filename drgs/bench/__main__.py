"""Entry point of ``drgs bench`` and ``python -m drgs.bench``."""

from __future__ import annotations

from functools import partial

from drgs.cli.commands import CommandParser, Subcommand, run_command

# Descriptions by module.
COMMANDS = {"speed": "times of drgs and of other renderers on the same scene, in one run"}


def add_arguments(parser: CommandParser) -> None:
    """Add the measurements."""
    parser.description = "Measure drgs; write tables and plots."
    parser.show_examples("%(prog)s speed --quick")
    commands = {name: Subcommand(text, f"drgs.bench.{name}") for name, text in COMMANDS.items()}
    parser.add_commands(commands, metavar="MEASUREMENT")


main = partial(run_command, add_arguments, "python -m drgs.bench")

if __name__ == "__main__":
    main()
