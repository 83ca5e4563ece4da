"""``drgs examine FOLDER``: which effects photographs need, and the evidence.

Runs :func:`drgs.examine.examination.examine`, as ``drgs fit FOLDER`` does at its start.
"""

from __future__ import annotations

import argparse
import shlex
from functools import partial

from drgs.cli.commands import CommandParser, file_or_folder, run_command
from drgs.cli.execution import add_execution_arguments, execution_settings, select_variant
from drgs.cli.progress import StepProgress
from drgs.config.load import load_config
from drgs.config.section import format_value
from drgs.core.environment import VARIANTS
from drgs.datasets import load_dataset
from drgs.datasets.folders import config_for
from drgs.examine.examination import examine


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.description = (
        "Find out which effects photographs need, by short fits that leave some of them out. "
        "Writes nothing. `drgs fit FOLDER` begins with the same."
    )
    parser.show_examples("%(prog)s photographs")
    text = "dataset folder, or configuration file, whose own values are not examined"
    parser.add_argument("config", type=file_or_folder, metavar="FOLDER|CONFIG.yml", help=text)
    parser.add_overrides("value of the configuration, which is then not examined")
    add_execution_arguments(parser)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Examine the dataset, and print the table and the command that fits with the choice."""
    if args.config.is_dir():
        config, _ = config_for(args.config, args.overrides)
    else:
        config = load_config(args.config, args.overrides)
    with execution_settings(args.threads, args.debug):
        dataset = load_dataset(config.data_for_training, sections=config.sections)
        print(dataset.description)
        select_variant(args.variant or VARIANTS[0])
        with StepProgress("examining: ") as steps:
            examination = examine(dataset, config, steps.update)
    print(examination)
    changes, bad = examination.changes, examination.bad_photographs
    if changes or bad:
        words = ["drgs", "fit", str(args.config)]
        words += [word for name in bad for word in ("--leave-out", name)]
        kept = (each for each in changes.items() if each[0] != "data.leave_out")
        kept = ((k, list(v) if isinstance(v, tuple) else v) for k, v in kept)
        for each in (*args.overrides, *(f"{key}={format_value(value)}" for key, value in kept)):
            words += ["--set", each]
        print(f"fit with it: {shlex.join(words)}")


main = partial(run_command, add_arguments, "python -m drgs.examine")

if __name__ == "__main__":
    main()
