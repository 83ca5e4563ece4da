import sys

import pytest

from drgs.cli.ending import exit_on_user_error
from drgs.core.errors import UserError
from drgs.core.llvm import LLVMVersionError

REPORTED = [
    (UserError("a.yml: wrong"), "error: a.yml: wrong\n"),
    (LLVMVersionError("a.yml: wrong"), "error: a.yml: wrong\n"),
    (PermissionError(13, "No", "/a/b"), "error: /a/b: No; choose a folder"),
    (OSError(36, "File name too long", b"/a/b"), "error: /a/b: File name too long; choose a short"),
    (MemoryError("64 MiB"), "error: out of memory (64 MiB): "),
    (
        ModuleNotFoundError("No module named 'numpy'", name="numpy"),
        f"error: No module named 'numpy', by {sys.executable}; install drgs there with all",
    ),
]


@pytest.mark.parametrize(("error", "line"), REPORTED)
def test_commands_report_user_errors_in_one_line(error, line, capsys):
    @exit_on_user_error()
    def command():
        raise error

    with pytest.raises(SystemExit) as exit_info:
        command()
    assert exit_info.value.code == 2
    out, err = capsys.readouterr()
    assert out == "" and err.startswith(line) and err.count("\n") == 1


@pytest.mark.parametrize(
    "error",
    [
        OSError("nameless"),
        ZeroDivisionError(),
        ImportError("x"),  # a defect of a package, or of this one
        ImportError("x", name="drgs.nothing"),
    ],
)
def test_commands_keep_the_traceback_of_unexpected_errors(error):
    with pytest.raises(type(error)), exit_on_user_error():
        raise error


def test_closed_output_pipe_ends_a_command_quietly(run_python):
    """Two processes are needed: the output has to go through a pipe."""
    program = (
        "import os, sys\n"
        "from drgs.cli.ending import exit_on_user_error\n"
        "read, write = os.pipe()\n"
        "os.dup2(write, 1)\n"
        "os.close(write); os.close(read)\n"
        "with exit_on_user_error():\n"
        "    print('x', flush=True)\n"
    )
    result = run_python(program)
    assert (result.returncode, result.stderr) == (141, "")
