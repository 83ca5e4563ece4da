import sys

import pytest

from drgs.cli.ending import exit_on_user_error
from drgs.core.errors import UserError, did_you_mean, one_line
from drgs.core.llvm import LLVMVersionError


def test_did_you_mean_names_the_nearest_candidate():
    assert did_you_mean("evry", ["start", "every"]) == "; did you mean every?"


def test_did_you_mean_finds_a_key_in_another_section():
    names = ["model.near", "densify.every"]
    assert did_you_mean("every", names) == "; did you mean densify.every?"


def test_did_you_mean_is_silent_when_nothing_is_near():
    assert did_you_mean("xyzzy", ["start", "every"]) == ""


@pytest.mark.parametrize("error", [UserError("a.yml: wrong"), LLVMVersionError("a.yml: wrong")])
def test_commands_report_user_errors_in_one_line(error, capsys):
    @exit_on_user_error()
    def command():
        raise error

    with pytest.raises(SystemExit) as exit_info:
        command()
    assert exit_info.value.code == 2
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("", "error: a.yml: wrong\n")


def test_commands_report_file_system_errors_with_the_file_name(capsys):
    for error, line in (
        (PermissionError(13, "Permission denied", "/a/b"), "Permission denied; choose a folder"),
        (OSError(36, "File name too long", b"/a/b"), "File name too long; choose a shorter name"),
    ):
        with pytest.raises(SystemExit) as exit_info, exit_on_user_error():
            raise error
        assert exit_info.value.code == 2
        assert capsys.readouterr().err.startswith(f"error: /a/b: {line}")
    with pytest.raises(SystemExit) as exit_info, exit_on_user_error():
        raise MemoryError("Unable to allocate 64 MiB")
    assert exit_info.value.code == 2
    assert capsys.readouterr().err.startswith("error: out of memory (Unable to allocate 64 MiB): ")
    with pytest.raises(OSError, match="nameless"), exit_on_user_error():
        raise OSError("nameless")


def test_commands_name_a_package_that_cannot_be_imported(capsys):
    with pytest.raises(SystemExit) as exit_info, exit_on_user_error():
        raise ModuleNotFoundError("No module named 'numpy'", name="numpy")
    assert exit_info.value.code == 2
    line = f"error: No module named 'numpy', by {sys.executable}; install drgs there with all"
    assert capsys.readouterr().err.startswith(line)
    for name in (None, "drgs.nothing"):  # a defect of a package, or of this one
        with pytest.raises(ImportError), exit_on_user_error():
            raise ImportError("x", name=name)


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


def test_commands_keep_the_traceback_of_unexpected_errors():
    with pytest.raises(ZeroDivisionError), exit_on_user_error():
        print(1 / 0, file=sys.stderr)


def test_foreign_messages_are_put_on_one_line():
    assert one_line("a\n  b\tc") == "a b c"
    assert one_line("x" * 10, limit=9) == "xxxxxx..."
