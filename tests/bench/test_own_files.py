"""A measurement replaces what a measurement has written, and nothing else."""

import argparse
import importlib

import pytest

from drgs.bench.__main__ import COMMANDS
from drgs.bench.output import add_out
from drgs.cli.commands import CommandParser
from drgs.core.errors import UserError


def measurement(text):
    """``measure(folder)``, which writes ``text`` as ``it.csv``."""
    parser = argparse.ArgumentParser()
    add_out(parser, lambda args: (args.out / "it.csv").write_text(text), "it.csv")

    def measure(folder):
        args = parser.parse_args(["--out", str(folder)])
        args.run(args)

    return measure


def test_a_measurement_is_replaced_by_the_next_and_nothing_else(tmp_path):
    (tmp_path / "it.csv").write_text("mine")
    with pytest.raises(UserError, match=r"holds it\.csv"):
        measurement("first")(tmp_path)
    path = tmp_path / "out" / "it.csv"
    measurement("first")(path.parent)
    measurement("second")(path.parent)
    assert path.read_text() == "second"
    path.write_text("edited")
    with pytest.raises(UserError, match=r"holds it\.csv"):
        measurement("third")(path.parent)
    assert path.read_text() == "edited"


@pytest.mark.parametrize("name", COMMANDS)
def test_existing_output_is_refused_before_measuring(name, tmp_path):
    module = importlib.import_module(f"drgs.bench.{name}")
    parser = CommandParser()
    module.add_arguments(parser)
    (tmp_path / f"{name}.csv").write_text("mine")
    args = parser.parse_args(["--out", str(tmp_path)])
    with pytest.raises(UserError, match=rf"holds .*{name}\.csv"):
        args.run(args)
    assert [p.name for p in tmp_path.iterdir()] == [f"{name}.csv"]
