"""Entry point of ``drgs bench`` and ``python -m drgs.bench``."""

from __future__ import annotations

from collections.abc import Sequence

from drgs.cli.commands import CommandParser, Subcommand, run_command

COMMANDS = {
    "speed": "times of drgs and of other renderers on the same scene, in one run",
    "scaling": "time and memory of a training iteration against the size of the problem",
    "accuracy": "the error of each approximation against the time that it saves",
    "effects": "what each effect costs: time and operations with and without it",
    "hybrid": "what a path-traced object among splats costs",
    "light": "price and error of light between splats and surfaces",
    "benefits": "what effects are good for: fits of spoiled data with and without them",
    "exports": "size of each file format, and the quality that is lost by a round trip",
    "training": "quality over time for several settings of a fit; half an hour",
    "volprim": "what sets Mitsuba's volprim_rf_basic apart, by how much it changes the picture",
    "stability": "error of float32 against float64 as scenes become harder",
    "population": "how many Gaussians the reference recipe keeps, by picture size and rule; hours",
    "photographs": "fits with cameras as they are, undistorted, found again; an hour",
    "processes": "steps of one process and of several, and what exchanging takes",
    "cluster": "what machines on a network would make of a fit: a model, measured and predicted",
    "batches": "what larger steps cost in quality for as many views: 1 to 16 views a step; an hour",
    "recipes": "what each part of the recipe is worth: alone, and taken out of the whole; hours",
}
"""By name, what each measures; a command is the module of its name."""


def main(arguments: Sequence[str] | None = None) -> None:
    """Entry point of ``python -m drgs.bench``."""
    run_command(add_arguments, "python -m drgs.bench", arguments)


def add_arguments(parser: CommandParser) -> None:
    """Add the measurements."""
    parser.description = "Measure drgs; write tables and plots."
    parser.show_examples("%(prog)s speed --quick", "%(prog)s accuracy out/lego --out out/bench")
    commands = {name: Subcommand(text, f"drgs.bench.{name}") for name, text in COMMANDS.items()}
    parser.add_commands(commands, metavar="MEASUREMENT")


if __name__ == "__main__":
    main()
