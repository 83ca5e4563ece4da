"""How commands are called, and how they end: one line, and no traceback of Ctrl-C."""

import argparse
import io
import os
import re
import runpy
import signal
import subprocess
import sys
import warnings
from contextlib import redirect_stderr, redirect_stdout
from importlib import metadata
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest
from conftest import REPOSITORY
from PIL import Image
from support.commands import run_in_process

import drgs
from drgs import __main__ as commands
from drgs.bench import __main__ as bench
from drgs.cli.commands import CommandParser, bounded_int, file_or_folder, finite_number, run_command
from drgs.core.errors import UserError, UserNote
from drgs.core.files import atomic_path
from drgs.fit import __main__ as fit
from drgs.io.images import image_size, write_png


def command(act):
    """``main`` of a command that does nothing else."""

    def add_arguments(parser):
        parser.add_argument("--size", type=bounded_int(1, 4096))
        parser.set_defaults(run=lambda args: act())

    return lambda words: run_command(add_arguments, "some command", words)


def raising(error):
    """``main`` of a command that raises."""
    return command(Mock(side_effect=error))


@pytest.mark.parametrize("name", ["f\u00fc\u4e2d", os.fsdecode(b"\xff")], ids=["UTF-8", "other"])
def test_names_are_printed_in_any_encoding(name):
    def act():
        print(f"written: {name}")
        raise UserError(f"{name}: wrong")

    # As PYTHONIOENCODING=ascii makes them.
    out, err = (io.TextIOWrapper(io.BytesIO(), "ascii") for _ in range(2))
    with redirect_stdout(out), redirect_stderr(err):
        with pytest.raises(SystemExit, match="2"):
            command(act)([])
        out.flush()
        err.flush()
    escaped = name.encode("ascii", "backslashreplace")
    assert out.buffer.getvalue() == b"written: " + escaped + b"\n"
    assert err.buffer.getvalue() == b"error: " + escaped + b": wrong\n"


def test_user_notes_are_printed_and_pillow_warnings_are_not(tmp_path, monkeypatch):
    """Pillow warns of large images that are not too large for drgs."""
    write_png(tmp_path / "a.png", np.zeros((6, 8, 3), np.uint8))
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 40)
    with pytest.warns(Image.DecompressionBombWarning):
        image_size(tmp_path / "a.png")

    def act():
        image_size(tmp_path / "a.png")
        warnings.warn(UserNote("a.ply: clamped"), stacklevel=1)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        outcome = run_in_process(command(act))
    assert (outcome.returncode, outcome.stdout) == (0, "note: a.ply: clamped\n")
    assert (outcome.stderr, caught) == ("", [])


def test_errors_are_printed_on_one_line_and_shortened_in_the_middle():
    assert run_in_process(raising(UserError("a\nb.yml: wrong"))).stderr == "error: a b.yml: wrong\n"
    line = run_in_process(raising(UserError(f"a.yml: {'x' * 5000}; remove it"))).stderr
    assert line.startswith("error: a.yml: xxx") and line.endswith("xxx; remove it\n")
    assert " ... " in line and len(line) < 1000


def test_home_folders_are_expanded_or_refused(monkeypatch):
    monkeypatch.setenv("HOME", "/home/somebody")
    assert file_or_folder("~/out") == Path("/home/somebody/out")
    with pytest.raises(argparse.ArgumentTypeError, match=r"home directory.*: ~no-such-user/out"):
        file_or_folder("~no-such-user/out")
    with pytest.raises(argparse.ArgumentTypeError, match="no zero byte"):
        file_or_folder("a\0b")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--size", "9" * 4000], "argument --size: must be at most 4,096, got 99"),
        (["--size", "1" * 20 + "x"], "argument --size: must be a whole number >= 1, got 111"),
        (["--sise", "a\nb"], "unrecognized arguments: --sise a b"),
    ],
)
def test_invalid_command_line_is_reported_in_one_line(words, message):
    outcome = run_in_process(command(lambda: None), *words)
    assert outcome.returncode == 2 and outcome.stdout == ""
    assert outcome.stderr.startswith(f"error: {message}")
    assert outcome.stderr.endswith("; see some command --help\n")
    assert outcome.stderr.count("\n") == 1 and len(outcome.stderr) < 300


@pytest.fixture(autouse=True)
def sigint_handler_is_restored():
    before = signal.getsignal(signal.SIGINT)
    yield
    signal.signal(signal.SIGINT, before)


def interrupted():
    signal.raise_signal(signal.SIGINT)


def raise_interrupt_in_a_callback():
    """Raise as Dr.Jit does, whose own error hides the exception raised within it."""
    try:
        interrupted()
    except KeyboardInterrupt as cause:
        raise RuntimeError("drjit.backward(): failed (see above)") from cause


@pytest.mark.parametrize("act", [interrupted, raise_interrupt_in_a_callback])
def test_an_interrupt_ends_a_command_without_a_traceback(act):
    outcome = run_in_process(command(act))
    assert (outcome.returncode, outcome.stdout, outcome.stderr) == (130, "", "interrupted\n")
    assert signal.getsignal(signal.SIGINT) == signal.SIG_DFL  # what comes now ends it at once


def test_sigterm_ends_a_command_as_ctrl_c_does(tmp_path):
    """Files that it was writing are removed. Afterwards the signal is what it was."""
    before = signal.getsignal(signal.SIGTERM)

    def act():
        with atomic_path(tmp_path / "a.png") as temporary:
            temporary.touch()
            signal.raise_signal(signal.SIGTERM)

    outcome = run_in_process(command(act))
    assert (outcome.returncode, outcome.stdout, outcome.stderr) == (143, "", "terminated\n")
    assert signal.getsignal(signal.SIGTERM) == before and not list(tmp_path.iterdir())


IMPORT = "with interruptible_imports():\n        try: signal.raise_signal(signal.{})\n"
IMPORT += "        except BaseException: pass"


@pytest.mark.parametrize(
    ("act", "expected"),
    [
        ("exec('signal.raise_signal(signal.SIGINT)')", (130, "interrupted\n")),
        (IMPORT.format("SIGINT"), (130, "interrupted\n")),
        (IMPORT.format("SIGTERM"), (143, "terminated\n")),
    ],
    ids=["exec", "import", "SIGTERM in an import"],
)
def test_signal_while_modules_are_imported_ends_a_process_with_its_status(act, expected):
    """Modules may hide what is raised; CPython would end by SIGINT within ``exec``."""
    program = (
        "import signal\n"
        "from drgs.cli.ending import exit_on_interrupt, interruptible_imports\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        f"with exit_on_interrupt():\n    {act}"
    )
    ended = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert (ended.returncode, ended.stderr) == expected


@pytest.mark.parametrize("error", [ZeroDivisionError(), SystemExit(3)])
def test_unexpected_errors_keep_their_tracebacks(error):
    with pytest.raises(type(error)):
        raising(error)([])


NAMES = [*commands.commands(), *(f"bench {name}" for name in bench.COMMANDS)]


@pytest.mark.parametrize(
    ("main", "words", "called"),
    [
        *((commands.main, name, f"drgs {name}".strip()) for name in ("", *NAMES)),
        (fit.main, "", "python -m drgs.fit"),
        (bench.main, "", "python -m drgs.bench"),
    ],
)
def test_help_shows_the_command_with_an_example(main, words, called):
    outcome = run_in_process(main, *words.split(), "--help")
    assert outcome.returncode == 0
    assert outcome.stdout.startswith(f"usage: {called} ")
    assert f"  {called} " in outcome.stdout.partition("\nexample")[2]
    assert "%(prog)s" not in outcome.stdout and str(REPOSITORY) not in outcome.stdout


@pytest.mark.parametrize(
    "module", ["drgs", *(f"drgs.{name}" for name in ("capture", "fit", "render", "export", "view"))]
)
def test_modules_run_as_commands(module, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [module, "--help"])
    # As if it had not been imported.
    monkeypatch.delitem(sys.modules, f"{module}.__main__", raising=False)
    with pytest.raises(SystemExit) as end:
        runpy.run_module(module, run_name="__main__")
    assert end.value.code == 0
    assert f"usage: python -m {module} " in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (
            "fot",
            "only bench, capture, examine, export, fit, poses, render and view; did you mean fit?",
        ),
        (
            "xyz",
            "no command xyz, only bench, capture, examine, export, fit, poses, render and view;",
        ),
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
    program = """
import sys
from drgs.__main__ import main
try:
    main(['--help'])
except SystemExit:
    heavy = {'mitsuba', 'drjit', 'matplotlib', 'drgs.fit.__main__', 'drgs.bench.__main__'}
    print(sorted(heavy & set(sys.modules)))
"""
    assert run_python(program).stdout.splitlines()[-1] == "[]"


def test_version_describes_the_installation(capsys):
    with pytest.raises(SystemExit) as end:
        commands.main(["--version"])
    printed = capsys.readouterr().out.splitlines()
    assert end.value.code == 0 and printed[0] == f"drgs {drgs.__version__}"
    packages = f"Mitsuba {metadata.version('mitsuba')}, Dr.Jit {metadata.version('drjit')}"
    assert printed[1] == packages
    name, file, width, threads = re.fullmatch(
        r"LLVM ([\d.]+) \((.+)\), vectors of (\d+) floats, (\d+) threads", printed[2]
    ).groups()
    assert "libLLVM" in file and Path(file).is_file()
    assert name.split(".")[0] in Path(file).name
    assert int(width) in (4, 8, 16) and int(threads) >= 1


def test_parser_adds_arguments_of_a_command_once():
    parser = CommandParser(prog="drgs", module="drgs.__main__")
    for _ in range(2):
        args, _ = parser.parse_known_args(["fit", "a.yml"])
        assert args.config.name == "a.yml"


@pytest.mark.parametrize(
    ("parse", "texts", "message"),
    [
        (bounded_int(1), ("", "0", "-3", "1.5", "two", "1e3"), "must be a whole number >= 1, got"),
        (finite_number, ("", "nan", "-inf", "1e999", "x"), "must be a finite number, got"),
    ],
)
def test_numbers_are_parsed_or_refused(parse, texts, message):
    for text in texts:
        with pytest.raises(argparse.ArgumentTypeError, match=message):
            parse(text)
    assert bounded_int(0)("0") == 0 and bounded_int(1)("+7") == 7
    assert finite_number("-1e3") == -1000.0
