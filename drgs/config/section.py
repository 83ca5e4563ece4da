"""Base and number types of a configuration's sections, and messages about wrong values."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Optional, TypeVar, cast, get_args

import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    create_model,
    model_validator,
)
from pydantic_core import ErrorDetails, InitErrorDetails, PydanticCustomError
from pydantic_core.core_schema import ErrorType
from typing_extensions import LiteralString, Self

from drgs.core.constants import MAX_INT
from drgs.core.errors import UserError, did_you_mean, one_line
from drgs.core.registry import HOW_TO_INSTALL, Extension, Registry, shipped_modules

if TYPE_CHECKING:
    from drgs.config.schema import FitConfig

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
    """A frozen section without unknown keys, infinities or silent conversions ("3" for 3).

    A string after a field describes it.
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        strict=True,
        allow_inf_nan=False,
        use_attribute_docstrings=True,
    )

    scaled: ClassVar[tuple[str, ...]] = ()
    """Names of iterations that keep their share where the number of iterations changes."""

    removed: ClassVar[Mapping[str, object]] = {}
    """Values of earlier versions that are constants now."""

    @model_validator(mode="before")
    @classmethod
    def _drop_removed(cls, values: object) -> object:
        if not isinstance(values, Mapping) or not cls.removed.keys() & values.keys():
            return values
        for name, constant in cls.removed.items():
            if values.get(name, constant) != constant:
                text = (
                    f"must be {format_value(constant)}, its only value since 0.1.0 (CHANGELOG.md)"
                )
                error = ErrorDetails(type=text, loc=(name,), msg=text, input=values[name])
                raise ValidationError.from_exception_data(name, [_error_details(error)])
        return {name: value for name, value in values.items() if name not in cls.removed}

    @property
    def is_off(self) -> bool:
        """True if a fit with this section is a fit without it."""
        return False

    def check(self, config: FitConfig) -> None:
        """Raise ValueError for values that do not suit others of the configuration."""


SectionType = TypeVar("SectionType", bound=Section)


class _SectionsOfExtensions(Section):
    model_config = ConfigDict(use_attribute_docstrings=False)  # there is no source to read


class ExtensibleSection(Section):
    """A section that contains sections of extensions, too, under their names."""

    model_config = ConfigDict(extra="allow")

    registries: ClassVar[tuple[Registry, ...]] = ()  # of these extensions

    @property
    def sections(self) -> Mapping[str, Section]:
        """The sections of extensions by name."""
        return self.model_extra or {}

    def section(self, name: str, model: type[SectionType]) -> SectionType:
        """Return the section of an extension, by default with all defaults."""
        found = self.sections.get(name)
        return found if isinstance(found, model) else model.model_validate({})

    @classmethod
    def extension(cls, name: str) -> Extension | None:
        """Import and return the extension of a section; None: there is none."""
        shipped = (each for each in cls.registries if name in shipped_modules(each.group))
        others = (each for each in cls.registries if name in each)
        registry = next(shipped, None) or next(others, None)
        return None if registry is None else registry.get(name)

    @classmethod
    def extensions(cls) -> Iterator[Extension]:
        """Import and yield the extensions that have settings, or are active by their section."""
        for registry in cls.registries:
            yield from (e for e in registry.all() if e.section or not e.is_shipped)

    @model_validator(mode="wrap")
    @classmethod
    def _validate_sections(cls, values: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if not isinstance(values, Mapping):
            return handler(values)
        known = {*cls.model_fields, *cls.removed}
        own = {key: value for key, value in values.items() if key in known}
        others = {  # as a file has them; null is an empty section
            str(key): section.model_dump() if isinstance(section, BaseModel) else section or {}
            for key, section in values.items()
            if key not in own
        }
        extensions = [extension for name in others if (extension := cls.extension(name))]
        models: dict[str, Any] = {each.name: (each.section or Section, ...) for each in extensions}
        sections = create_model("Sections", __base__=_SectionsOfExtensions, **models)
        valid, errors = [], []
        for validate, given in ((handler, own), (sections.model_validate, others)):
            try:
                valid.append(validate(given))
            except ValidationError as error:
                errors += map(_error_details, error.errors())
        if errors:
            raise ValidationError.from_exception_data(cls.__name__, errors)
        result = cast(Self, valid[0])
        assert result.__pydantic_extra__ is not None, "extra is allowed"
        result.__pydantic_extra__.update({name: getattr(valid[1], name) for name in others})
        result.__pydantic_fields_set__.update(others)
        return result


def _error_details(error: ErrorDetails) -> InitErrorDetails:
    kind = error["type"]
    if kind not in get_args(ErrorType):  # our own, or one that pydantic has in Python
        kind = PydanticCustomError(cast(LiteralString, kind), "{text}", {"text": error["msg"]})
    context = error.get("ctx", {})
    return InitErrorDetails(type=kind, loc=error["loc"], input=error["input"], ctx=context)


def name_of(registry: Registry, *others: str) -> AfterValidator:
    """Return a validator of an extension's name; others: words that are no extension's."""

    def check(name: str) -> str:
        if name not in others and name not in registry:
            known = [*others, *registry.names()]
            quoted = ", ".join(f"'{each}'" for each in known)
            raise ValueError(
                f"must be one of {quoted}{did_you_mean(name, known)} ({HOW_TO_INSTALL})"
            )
        return name

    return AfterValidator(check)


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


def set_value(values: dict[str, Any], key: str, value: object) -> None:
    """Set a value of nested mappings by its dotted name, such as ``densify.every``."""
    *sections, name = key.split(".")
    for section in sections:
        if not isinstance(values.get(section), dict):
            values[section] = {}
        values = values[section]
    values[name] = value


def explain_error(error: ErrorDetails) -> str:
    """Return key, expectation and value of one of pydantic's errors on the content of a file."""
    parts = [f"[{part}]" if isinstance(part, int) else f".{part}" for part in error["loc"]]
    key = one_line("".join(parts).removeprefix("."), 200)
    if error["type"] == "missing":
        return f"{key} is missing"
    expected = "must be an object" if error["type"] == "model_type" else expectation(error)
    got = one_line(json.dumps(error["input"]), 60)
    return f"{key or 'the content'} {one_line(expected, 500)}, got {got}"


def format_value(value: object) -> str:
    """Return the value in YAML, on one line and shortened."""
    if isinstance(value, str):
        return one_line(repr(value), limit=60)
    try:
        text = yaml.safe_dump(value, default_flow_style=True, width=math.inf)
    except ValueError:  # Python writes no integer of more than 4300 digits
        return "a number of thousands of digits"
    return one_line(text.removesuffix("\n").removesuffix("\n..."), limit=60)
