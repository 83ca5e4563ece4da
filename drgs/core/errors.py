"""Errors that a user can repair, with place, name, expected and got values, and remedy.

For example, ``scenes/lego.yml: densify.every must be >= 1, got 0``.
"""

from __future__ import annotations

import difflib
import re
import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from typing_extensions import override


class UserError(ValueError):
    """A wrong input: a configuration, a dataset, a file. Its text is all that the user needs."""


class UserNote(UserWarning):
    """A note about an input that is used all the same; commands print its text."""


def note_user(text: str) -> None:
    """Emit a :class:`UserNote`, as of the caller's place."""
    warnings.warn(UserNote(text), stacklevel=3)


class PluginError(UserError):
    """A parameter or scene that a plugin cannot use; the message begins with the plugin's name."""


class PluginTypeError(PluginError, TypeError):
    """A :class:`PluginError` about a value of the wrong type."""


class UnsupportedError(PluginError, NotImplementedError):
    """A :class:`PluginError` about something that the plugin has no code for."""


def check_type(where: str, name: str, value: object, *types: Any) -> None:
    """Raise :class:`UserError` for an argument that is of none of these types."""
    if not isinstance(value, types):
        known = " or ".join(each.__name__ for each in types)
        raise UserError(f"{where}: {name} must be {known}, got {one_line(repr(value), 60)}")


class Place(NamedTuple):
    """A place in a file, as messages write it."""

    path: Path
    unit: str  # byte, or line
    number: int

    @override
    def __str__(self) -> str:
        return f"{self.path}: {self.unit} {self.number:,}"


def one_line(text: object, limit: int = 300) -> str:
    """Return ``text`` as one line of at most ``limit`` characters."""
    line = " ".join(str(text).split())
    return line if len(line) <= limit else f"{line[: limit - 3]}..."


def root_cause(error: BaseException) -> BaseException:
    """Return the exception that a chain of exceptions started with."""
    while before := error.__cause__ or error.__context__:
        error = before
    return error


def reason_of_mitsuba(error: Exception) -> str:
    """Shorten Mitsuba's message to one line: where, and the error itself, without a traceback."""
    head, *rest = re.sub(r"^\[[\w.]+:\d+\] ", "", str(error).strip() or "error").splitlines()
    head = head.removesuffix("Traceback (most recent call last):").strip()
    last = re.sub(r"^[\w.]*(Error|Exception): ", "", rest[-1].strip()) if rest else ""
    return one_line(f"{head} {last}", 1000)


def format_names(names: Sequence[object], most: int = 3, separator: str = ", ") -> str:
    """Return the first ``most`` of ``names``, and the number of others: ``a, b and 4 more``."""
    more = f" and {len(names) - most:,} more" if len(names) > most else ""
    return separator.join(str(name) for name in names[:most]) + more


def did_you_mean(name: str, candidates: Iterable[str], cutoff: float = 0.7) -> str:
    """Return ``"; did you mean X?"`` with the candidate nearest to ``name``, or ``""``.

    cutoff: least similarity, 0 to 1 (``difflib``'s ratio), also of the last part of dotted names.
    """
    candidates = list(candidates)
    nearest = difflib.get_close_matches(name, candidates, n=1, cutoff=cutoff)
    if not nearest:
        by_leaf = {candidate.rpartition(".")[2]: candidate for candidate in reversed(candidates)}
        leaf = difflib.get_close_matches(name.rpartition(".")[2], by_leaf, n=1, cutoff=cutoff)
        nearest = [by_leaf[leaf[0]]] if leaf else []
    return f"; did you mean {nearest[0]}?" if nearest else ""
