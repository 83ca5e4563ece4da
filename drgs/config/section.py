"""Sections of a configuration: their base, numbers with limits, and messages about wrong values."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Any, Optional, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field
from pydantic_core import ErrorDetails

from drgs.core.constants import MAX_INT
from drgs.core.errors import one_line

Count = Annotated[int, Field(le=MAX_INT)]

T = TypeVar("T")

if TYPE_CHECKING:
    Resolved = Annotated[T, "null before"]
else:
    Resolved = Optional
"""A value that may be null in a file. Once the configuration is resolved, which it is wherever it
is used, it has the type in brackets."""

UNRESOLVED: Any = None  # default of a value that follows from others, or from the dataset

Rate = Annotated[float, Field(le=10)]
"""A step of Adam is about as long as its rate: ten units of a logarithm or a logit go from next to
nothing to everything."""

Weight = Annotated[float, Field(ge=0, le=1e6)]
"""Weight of a term of the loss, beside terms of weight 1."""


class Section(BaseModel):
    """Frozen; unknown keys, infinities and silent conversions ("3" for 3) are refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


SectionType = TypeVar("SectionType", bound=Section)


def subsection(model: type[SectionType]) -> SectionType:
    """Return a field whose default is the section with all defaults."""
    return Field(default_factory=model)


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
"""Expected values by the first word of pydantic's type of error."""


def expectation(error: ErrorDetails) -> str:
    """Return one of pydantic's errors as ``must be >= 1``; that of a validator of ours as it is."""
    kind, context = error["type"], error.get("ctx", {})
    if kind == "value_error":
        return str(context["error"])
    for relation, sign in _RELATIONS.items():
        if relation in context:
            return f"must be {sign} {context[relation]:.10g}"
    if kind == "literal_error":
        return f"must be one of {context['expected']}"
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
