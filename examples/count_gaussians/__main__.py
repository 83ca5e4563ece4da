"""A command of ``drgs``: the number of Gaussians in a file."""

import argparse

from drgs.cli.commands import CommandParser, file_or_folder, run_command
from drgs.gaussians.parameters import Gaussians


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.show_examples("%(prog)s out/lego/point_cloud.ply")
    parser.add_argument("file", type=file_or_folder, help="file of Gaussians")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> None:
    """Print the number."""
    print(f"{Gaussians.load(args.file).num_gaussians:,}")


if __name__ == "__main__":
    run_command(add_arguments, "python -m count_gaussians")
