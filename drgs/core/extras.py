"""Libraries that only some of what drgs offers needs: the extras of ``pyproject.toml``."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType

from drgs.core.errors import UserError, one_line


def imported(module: str, extra: str, what_for: str) -> ModuleType:
    """``module``, which the extra ``extra`` installs.

    what_for: begins the error, such as ``drgs poses``.

    Raises :class:`UserError` that says what to install.
    """
    try:
        return import_module(module)
    except ImportError as error:
        missing = isinstance(error, ModuleNotFoundError) and error.name == module
        reason = "is not installed" if missing else f"cannot be imported ({one_line(error, 200)})"
        raise UserError(
            f"{what_for} needs {module}, which {reason}: pip install {module} (it comes with the "
            f"extra {extra}: pip install 'drgs[{extra}]')"
        ) from None
