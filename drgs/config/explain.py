"""What a value that pydantic refuses must be, in a few words."""

from __future__ import annotations

import math

import yaml
from pydantic_core import ErrorDetails

from drgs.core.errors import one_line

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


def shown_value(value: object) -> str:
    """Return the value as YAML writes it, on one line and shortened."""
    if isinstance(value, str):
        return one_line(repr(value), limit=60)
    try:
        text = yaml.safe_dump(value, default_flow_style=True, width=math.inf)
    except ValueError:  # Python writes no integer of more than 4300 digits
        return "a number of thousands of digits"
    return one_line(text.removesuffix("\n").removesuffix("\n..."), limit=60)
