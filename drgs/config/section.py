"""Base and number types of a configuration's sections, and messages about wrong values."""

from __future__ import annotations

import json
import math
import re
from typing import TYPE_CHECKING, Annotated, Any, Optional, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from drgs.core.constants import MAX_INT
from drgs.core.errors import UserError, one_line

Count = Annotated[int, Field(le=MAX_INT)]

T = TypeVar("T")
Model = TypeVar("Model", bound=BaseModel)

if TYPE_CHECKING:
    Resolved = Annotated[T, "null before"]
else:
    Resolved = Optional
"""A value that may be null in a file, and has the type in brackets in a resolved configuration."""

UNRESOLVED: Any = None  # default of a value that follows from others, or from the dataset

Rate = Annotated[float, Field(le=10)]  # about the length of Adam's steps, also of logits
Weight = Annotated[float, Field(ge=0, le=1e6)]  # of a term of the loss, beside terms of weight 1


class Section(BaseModel):
    """A frozen section without unknown keys, infinities or silent conversions ("3" for 3)."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


SectionType = TypeVar("SectionType", bound=Section)


def subsection(model: type[SectionType]) -> SectionType:
    """Return a field whose default is the section with all defaults."""
    return Field(default_factory=model)


_RELATIONS = {"ge": ">=", "gt": ">", "le": "<=", "lt": "<"}

_EXPECTED = {  # by the first word of pydantic's type of error
    "int": "an integer",
    "float": "a number",
    "finite": "a finite number",
    "bool": "true or false",
    "string": "text",
    "path": "a path",
    "list": "a list",
    "model": "a section of keys",
}


def expectation(error: ErrorDetails) -> str:
    """Return one of pydantic's errors as ``must be >= 1``, and our validators' as they are."""
    kind, context = error["type"], error.get("ctx", {})
    if kind == "value_error":
        return str(context["error"])
    for relation, sign in _RELATIONS.items():
        if relation in context:
            return f"must be {sign} {context[relation]:.10g}"
    if kind == "literal_error":
        return f"must be one of {context['expected']}"
    known = _EXPECTED.get(kind.split("_")[0])
    if known is None or kind in ("string_pattern_mismatch", "too_short"):
        return re.sub(r"^\w+ should", "must", error["msg"])
    return f"must be {known}"


def validate(kind: type[Model], content: object, where: str) -> Model:
    """Return a part of a file; where: start of messages, followed by keys.

    Raises :class:`UserError` naming the key, the expectation and the value.
    """
    try:
        return kind.model_validate(content)
    except ValidationError as error:
        raise UserError(f"{where}{explain_error(error.errors()[0])}") from None


def parse_json(text: str | bytes, where: str) -> Any:
    """Return the content of JSON; where: start of messages. Raises :class:`UserError`."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError) as error:
        raise UserError(f"{where}not valid JSON: {one_line(error)}") from None


def explain_error(error: ErrorDetails) -> str:
    """Return key, expectation and value of one of pydantic's errors on the content of a file."""
    parts = [f"[{part}]" if isinstance(part, int) else f".{part}" for part in error["loc"]]
    key = one_line("".join(parts).removeprefix("."), 200)
    if error["type"] == "missing":
        return f"{key} is missing"
    expected = "must be an object" if error["type"] == "model_type" else expectation(error)
    got = one_line(json.dumps(error["input"]), 60)
    return f"{key or 'the content'} {one_line(expected, 200)}, got {got}"


def format_value(value: object) -> str:
    """Return the value in YAML, on one line and shortened."""
    if isinstance(value, str):
        return one_line(repr(value), limit=60)
    try:
        text = yaml.safe_dump(value, default_flow_style=True, width=math.inf)
    except ValueError:  # Python writes no integer of more than 4300 digits
        return "a number of thousands of digits"
    return one_line(text.removesuffix("\n").removesuffix("\n..."), limit=60)
