"""``drgs COMMAND``: what is called by which words, and what a wrong word is told."""

import argparse

import pytest
from support.commands import run_in_process

from drgs import __main__ as commands
from drgs import fit
from drgs.bench import __main__ as bench
from drgs.cli.commands import CommandParser, bounded_int, finite_number

NAMES = [*commands.COMMANDS, *(f"bench {name}" for name in bench.COMMANDS)]


@pytest.mark.parametrize("name", ["", *NAMES])
def test_help_shows_the_command_with_an_example(name):
    outcome, called = run_in_process(commands.main, *name.split(), "--help"), f"drgs {name}".strip()
    assert outcome.returncode == 0
    assert outcome.stdout.startswith(f"usage: {called} ")
    assert f"  {called} " in outcome.stdout.partition("\nexample")[2]
    assert "%(prog)s" not in outcome.stdout


@pytest.mark.parametrize("command", [fit, bench])
def test_help_of_modules_shows_python_m(command):
    outcome = run_in_process(command.main, "--help")
    called = f"python -m {command.__name__.removesuffix('.__main__')} "
    assert outcome.returncode == 0 and outcome.stdout.startswith(f"usage: {called}")
    assert f"\n  {called}" in outcome.stdout.partition("\nexample")[2]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("fot", "only fit, poses, render, export, view, capture and bench; did you mean fit?"),
        ("xyz", "no command xyz, only fit, poses, render, export, view, capture and bench; see"),
        ("bench sped", "; did you mean speed?"),
        ("", "the following arguments are required: COMMAND"),
        ("bench", "the following arguments are required: MEASUREMENT"),
        ("fit", "one of the arguments CONFIG.yml|FOLDER --resume is required"),
        ("fit a.yml --resume out", "not allowed with argument"),
        ("fit --resume out --out x", "configuration from out/config.yml: leave out"),
        ("fit a.yml --budget soon", "argument --budget: "),
        ("render a.ply", "the following arguments are required: --out"),
    ],
)
def test_invalid_command_lines_exit_with_2_and_the_reason(words, message):
    outcome = run_in_process(commands.main, *words.split())
    assert (outcome.returncode, outcome.stdout) == (2, "")
    assert message in outcome.stderr and "Traceback" not in outcome.stderr


def test_listing_commands_imports_none_of_them(run_python):
    program = (
        "import sys\n"
        "from drgs.__main__ import main\n"
        "try:\n"
        "    main(['--help'])\n"
        "except SystemExit:\n"
        "    pass\n"
        "heavy = {'mitsuba', 'drjit', 'matplotlib', 'drgs.fit', 'drgs.bench'}\n"
        "print(sorted(heavy & set(sys.modules)))\n"
    )
    assert run_python(program).stdout.splitlines()[-1] == "[]"


def test_parser_adds_arguments_of_a_command_once():
    parser = CommandParser(prog="drgs", module="drgs.__main__")
    for _ in range(2):
        args, _ = parser.parse_known_args(["fit", "a.yml"])
        assert args.config.name == "a.yml"


@pytest.mark.parametrize("text", ["", "0", "-3", "1.5", "two", "1e3"])
def test_non_integers_and_small_numbers_are_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match="must be a whole number >= 1, got"):
        bounded_int(1)(text)
    assert bounded_int(0)("0") == 0 and bounded_int(1)("+7") == 7


@pytest.mark.parametrize("text", ["", "nan", "-inf", "1e999", "x"])
def test_nonfinite_numbers_are_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match="must be a finite number, got"):
        finite_number(text)
    assert finite_number("-1e3") == -1000.0
