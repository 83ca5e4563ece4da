"""``drgs COMMAND``: what is called by which words, and what a wrong word is told."""

import argparse
from pathlib import Path

import pytest

from drgs import __main__ as commands
from drgs import fit, render
from drgs.bench import __main__ as bench
from drgs.capture import __main__ as capture
from drgs.cli.commands import CommandParser, bounded_int, finite_number, run_command

NAMES = [*commands.COMMANDS, *(f"bench {name}" for name in bench.COMMANDS)]


def ended(capsys, call, *words):
    """(exit status, standard output, standard error) of a command that ends early."""
    with pytest.raises(SystemExit) as exit_info:
        call(list(words))
    return exit_info.value.code, *capsys.readouterr()


@pytest.mark.parametrize("name", ["", *NAMES])
def test_help_shows_the_command_with_an_example(capsys, name):
    status, out, _ = ended(capsys, commands.main, *name.split(), "--help")
    called = f"drgs {name}".strip()
    assert status == 0
    assert out.startswith(f"usage: {called} ")
    _, separator, examples = out.partition("\nexample")
    assert separator and f"  {called} " in examples
    assert "%(prog)s" not in out


@pytest.mark.parametrize("command", [fit, render, capture, bench])
def test_help_of_modules_shows_python_m(capsys, command):
    status, out, _ = ended(capsys, command.main, "--help")
    module = command.__name__.removesuffix(".__main__")
    assert status == 0 and out.startswith(f"usage: python -m {module} ")
    assert f"\n  python -m {module} " in out.partition("\nexample")[2]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            ["fot"],
            "only fit, poses, render, export, view, capture and bench; did you mean fit?",
        ),
        (["rendre"], "did you mean render?"),
        (
            ["xyz"],
            "no command xyz, only fit, poses, render, export, view, capture and bench; see drgs",
        ),
        (["bench", "sped"], "; did you mean speed?"),
        ([], "the following arguments are required: COMMAND"),
        (["bench"], "the following arguments are required: MEASUREMENT"),
        (["fit"], "one of the arguments CONFIG.yml|FOLDER --resume is required"),
        (["fit", "a.yml", "--resume", "out"], "not allowed with argument"),
        (["fit", "--resume", "out", "--out", "x"], "configuration from out/config.yml: leave out"),
        (["fit", "a.yml", "--budget", "soon"], "argument --budget: "),
        (["capture", "a.xml", "--out", "x", "--spp", "0"], "argument --spp: must be a whole"),
        (["capture", "a.xml", "--out", "x", "--fov", "inf"], "argument --fov: must be a finite"),
        (["render", "a.ply"], "the following arguments are required: --out"),
    ],
)
def test_invalid_command_lines_exit_with_2_and_the_reason(capsys, words, message):
    status, out, error = ended(capsys, commands.main, *words)
    assert (status, out) == (2, "")
    assert message in error and "Traceback" not in error


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


def test_command_receives_its_arguments_and_program_name():
    seen = []

    def add_arguments(parser):
        parser.add_argument("--count", type=int)
        parser.set_defaults(run=seen.append, prog=parser.prog)

    run_command(add_arguments, "some command", ["--count", "3"])
    assert (seen[0].count, seen[0].prog) == (3, "some command")


def test_parser_adds_arguments_of_a_command_once():
    parser = CommandParser(prog="drgs", module="drgs.__main__")
    for _ in range(2):
        args, _ = parser.parse_known_args(["fit", "a.yml"])
        assert args.config == Path("a.yml")


@pytest.mark.parametrize("text", ["", "0", "-3", "1.5", "two", "1e3"])
def test_non_integers_and_small_numbers_are_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match="must be a whole number >= 1, got"):
        bounded_int(1)(text)
    assert bounded_int(0)("0") == 0 and bounded_int(1)("+7") == 7


@pytest.mark.parametrize("text", ["", "nan", "inf", "-inf", "1e999", "x"])
def test_nonfinite_numbers_are_refused(text):
    with pytest.raises(argparse.ArgumentTypeError, match="must be a finite number, got"):
        finite_number(text)
    assert finite_number("-1e3") == -1000.0
