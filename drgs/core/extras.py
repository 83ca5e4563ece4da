"""What the base installation leaves out: imported when it is asked for."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from drgs.core.errors import UserError


def required(module: str, extra: str, asker: str) -> ModuleType:
    """The module of an extra of ``pyproject.toml``, imported.

    asker: what needs it, as the user has written it: ``--view``.

    Raises :class:`UserError` with the line that installs it, where it is not there.
    """
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        missing = (error.name or module).partition(".")[0]
        raise UserError(
            f"{asker}: needs {missing}, which is not installed; pip install 'drgs[{extra}]'"
        ) from None
