"""The last line of a traceback names the cause.

Dr.Jit raises errors of a picture, a loop or a frozen function again, as a RuntimeError whose text
is "see above". What is above may be pages away, and in a notebook out of sight.
"""

from __future__ import annotations

import sys
import traceback
from types import TracebackType
from typing import Any

from drgs.core.errors import UserError


def show_causes_last() -> None:
    """From now on, repeat a user's error behind the traceback of what was raised because of it.

    In scripts and, where this is called from one, in notebooks.
    """
    if getattr(sys.excepthook, "shows_cause", False):
        return
    show_before = sys.excepthook

    def show(kind: type[BaseException], error: BaseException, tb: TracebackType | None) -> None:
        show_before(kind, error, tb)
        _show_cause(error)

    show.shows_cause = True
    sys.excepthook = show
    if "IPython" in sys.modules and (shell := sys.modules["IPython"].get_ipython()) is not None:
        shell.set_custom_exc((RuntimeError,), _show_in_notebook)


def _show_in_notebook(
    shell: Any, kind: type, error: BaseException, tb: Any, tb_offset: int | None = None
) -> None:
    """The handler of a notebook's RuntimeErrors, as IPython calls it."""
    shell.showtraceback((kind, error, tb), tb_offset=tb_offset)
    _show_cause(error)


def _show_cause(error: BaseException) -> None:
    cause = error
    while cause is not None and not isinstance(cause, UserError):
        cause = cause.__cause__ or cause.__context__
    if cause is not None and cause is not error:
        print(*traceback.format_exception_only(cause), sep="", end="", file=sys.stderr)
