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


def test_a_measurement_is_replaced_by_the_next(tmp_path):
    measurement("first")(tmp_path / "out")
    measurement("second")(tmp_path / "out")
    assert (tmp_path / "out" / "it.csv").read_text() == "second"


@pytest.mark.parametrize("written_before", [False, True], ids=["foreign", "edited"])
def test_foreign_file_is_not_overwritten(tmp_path, written_before):
    if written_before:
        measurement("first")(tmp_path)
    (tmp_path / "it.csv").write_text("mine")
    with pytest.raises(UserError, match=r"holds it\.csv"):
        measurement("second")(tmp_path)
    assert (tmp_path / "it.csv").read_text() == "mine"


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
