"""What a value that pydantic refuses must be, in a few words."""

from __future__ import annotations

from pydantic_core import ErrorDetails

_RELATIONS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}

_EXPECTED = {
    "int": "an integer",
    "float": "a number",
    "finite": "a finite number",
    "bool": "true or false",
    "string": "text",
    "path": "a path",
    "list": "a list",
    "model": "a section of keys",
}
"""By the first word of pydantic's type of error."""


def expectation(error: ErrorDetails) -> str:
    """One of pydantic's errors as ``must be >= 1``; of a validator of ours, what it says."""
    kind, limits = error["type"], error.get("ctx", {})
    if kind == "value_error":
        return str(limits["error"])
    for relation, sign in _RELATIONS.items():
        if relation in limits:
            return f"must be {sign} {limits[relation]:.10g}"
    if kind == "literal_error":
        return f"must be one of {limits['expected']}"
    return f"must be {_EXPECTED.get(kind.split('_')[0], error['msg'])}"
