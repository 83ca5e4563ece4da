"""Configurations from YAML and back, with messages that name file, key, expected and got."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from drgs.config.density import EARLIER_KEYS
from drgs.config.explain import expectation, shown_value
from drgs.config.extensions import extension_keys
from drgs.config.schema import FitConfig
from drgs.core.errors import UserError, did_you_mean, listed, one_line
from drgs.core.files import atomic_path, check_path, read_text

PATH_KEYS = ("data.path", "init.point_cloud", "output.dir")
"""Values that are made absolute when a configuration is loaded."""


MAX_BYTES = 1 << 20
"""Of a configuration file: a thousand times what every value with a comment takes."""


MAX_DEPTH = 20
"""Of nested lists and sections in YAML; a configuration has 3. Python's stack ends at about 100."""


MAX_EXPLAINED = 3
"""Wrong values that an error names; the rest are counted."""


def load_config(path: str | Path, overrides: Iterable[str] = ()) -> FitConfig:
    """Read a YAML configuration; ``overrides`` are ``section.key=VALUE`` with VALUE in YAML.

    Relative paths in the file are relative to the file's folder; in ``overrides``, which are
    typed in a shell and need not be YAML, to the current folder. The result holds absolute paths.

    Raises :class:`UserError` that names the wrong keys, the first of many, in one line.
    """
    path = Path(path)
    values = _read_yaml(path)
    _resolve_paths(values, path)
    return _validated(values, str(path), _overridden(values, overrides))


def config_from(
    values: Mapping[str, object], where: str, overrides: Iterable[str] = ()
) -> FitConfig:
    """A configuration from nested mappings, with the keys of the YAML file.

    where: the beginning of errors. Paths, text or ``Path``, are relative to the current folder.
    overrides: see :func:`load_config`.

    Raises :class:`UserError` that names the wrong keys, the first of many, in one line.
    """
    values = {
        key: dict(section) if isinstance(section, Mapping) else section
        for key, section in values.items()
    }
    for key in PATH_KEYS:
        section, leaf = key.split(".")
        entries = values.get(section)
        if isinstance(entries, dict) and isinstance(entries.get(leaf), (str, Path)):
            entries[leaf] = _absolute(Path(), str(entries[leaf]), f"{where}: {key}")
    return _validated(values, where, _overridden(values, overrides))


def _overridden(values: dict, overrides: Iterable[str]) -> set[str]:
    """Put overrides into ``values``; the keys."""
    keys = set()
    for override in overrides:
        key, value = _parse_override(override)
        _insert(values, key, value)
        keys.add(key)
    return keys


def _validated(values: dict, where: str, overridden: set[str]) -> FitConfig:
    try:
        return FitConfig.model_validate(values)
    except ValidationError as error:
        errors = error.errors()
        explained = [
            _explain(where, item, _spelled(_key(item), values), overridden)
            for item in errors[:MAX_EXPLAINED]
        ]
        first, *others = explained + [where] * (len(errors) - MAX_EXPLAINED)
        others = [text.removeprefix(f"{where}: ") for text in others]
        raise UserError(listed([first, *others], MAX_EXPLAINED, "; ")) from None


def dump_config(config: FitConfig, path: str | Path) -> None:
    """Write every value of ``config`` as YAML; :func:`load_config` reads an equal one back."""
    text = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def known_keys() -> list[str]:
    """Return dotted names of every section and value, such as ``densify.every``."""
    return [key for key, _ in _fields(FitConfig)]


def _fields(model: type[BaseModel], prefix: str = "") -> Iterator[tuple[str, object]]:
    for name, field in model.model_fields.items():
        yield prefix + name, field.annotation
        section = _section(field.annotation)
        if section is not None:
            yield from _fields(section, f"{prefix}{name}.")


def _section(annotation: object) -> type[BaseModel] | None:
    """The section that a value is, or that the elements of a list are."""
    if arguments := get_args(annotation):
        return next(filter(None, map(_section, arguments)), None)
    is_section = isinstance(annotation, type) and issubclass(annotation, BaseModel)
    return annotation if is_section else None


class _Loader(yaml.SafeLoader):
    """YAML with the changes that a configuration needs.

    1e-15 is a number (YAML 1.1 wants 1.0e-15 and would read text). A key that is given twice in
    one section is an error (the first would be dropped silently), and so are aliases and deep
    nesting: a few lines of either could take all memory or Python's whole stack.
    """

    depth = 0

    def compose_node(self, parent: yaml.Node | None, index: object) -> yaml.Node:
        event = self.peek_event()
        if isinstance(event, yaml.AliasEvent):
            raise yaml.MarkedYAMLError(
                problem=f"aliases such as *{event.anchor} are not supported; write the value out",
                problem_mark=event.start_mark,
            )
        if self.depth >= MAX_DEPTH:
            raise yaml.MarkedYAMLError(
                problem=f"more than {MAX_DEPTH} levels of nesting", problem_mark=event.start_mark
            )
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        for key_node, _ in node.value:
            key = key_node.value
            if isinstance(key, str) and key in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key {key} is given twice", problem_mark=key_node.start_mark
                )
            seen.add(str(key))
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def _read_yaml(path: Path) -> dict:
    text = read_text(path, "configuration", MAX_BYTES)
    try:
        values = yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        line = f"line {error.problem_mark.line + 1}: " if error.problem_mark else ""
        raise UserError(f"{path}: {line}not valid YAML: {one_line(error.problem)}") from None
    except Exception as error:  # a date or number that YAML's syntax allows: PyYAML raises anything
        reason = one_line(error) or type(error).__name__
        raise UserError(f"{path}: not valid YAML: {reason}") from None
    if not isinstance(values, dict):
        raise UserError(f"{path}: must hold sections such as 'data:', got {shown_value(values)}")
    return values


def _parse_override(override: str) -> tuple[str, object]:
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals or not key:
        raise UserError(f"--set {override}: must be KEY=VALUE, as in densify.every=200")
    known = extension_keys() if key.startswith("extensions.") else known_keys()
    if key not in known and key not in EARLIER_KEYS:
        raise UserError(f"--set {key}: unknown key {key}{did_you_mean(key, known)}")
    if key in PATH_KEYS:
        return key, None if text == "null" else _absolute(Path(), text, f"--set {key}")
    try:
        return key, yaml.load(text, Loader=_Loader)
    except Exception:  # as in _read_yaml
        raise UserError(f"--set {key}: not a YAML value: {one_line(text)}") from None


def _insert(values: dict, key: str, value: object) -> None:
    """Put the value where the key says, in place of what it, or its other name, was before."""
    for names in EARLIER_KEYS.items():
        if key in names:
            for name in names:
                _remove(values, name)
    *sections, leaf = key.split(".")
    for section in sections:
        if not isinstance(values.get(section), dict):
            values[section] = {}
        values = values[section]
    values[leaf] = value


def _remove(values: dict, key: str) -> None:
    section, leaf = _section_of(values, key)
    section.pop(leaf, None)


def _section_of(values: object, key: str) -> tuple[dict, str]:
    """The section that the key is in, as far as it is there, and its name in it."""
    *sections, leaf = key.split(".")
    for section in sections:
        values = values.get(section) if isinstance(values, dict) else None
    return (values if isinstance(values, dict) else {}), leaf


def _spelled(key: str, values: dict) -> str:
    """A key as the file has it: earlier versions had other names for some."""
    for earlier, now in EARLIER_KEYS.items():
        section, leaf = _section_of(values, earlier)
        if key == now and leaf in section:
            return earlier
    return key


def _resolve_paths(values: dict, file: Path) -> None:
    folder = file.resolve().parent
    for key in PATH_KEYS:
        section, leaf = key.split(".")
        entries = values.get(section)
        if isinstance(entries, dict) and isinstance(entries.get(leaf), str):
            entries[leaf] = _absolute(folder, entries[leaf], f"{file}: {key}")


def _absolute(folder: Path, text: str, where: str) -> str:
    try:
        path = str((folder / Path(text).expanduser()).resolve())
        check_path(path)
        path.encode()  # what UTF-8 cannot express could not be written to config.yml
    except UnicodeEncodeError:
        raise UserError(f"{where} must be a path in UTF-8, got {shown_value(text)}") from None
    except (OSError, ValueError, RuntimeError) as error:  # of these, RuntimeError: no such user
        raise UserError(
            f"{where} must be a path, got {shown_value(text)} ({one_line(error, 100)})"
        ) from None
    return path


def _key(item: ErrorDetails) -> str:
    return one_line(".".join(str(part) for part in item["loc"]), limit=60)


def _explain(file: str, item: ErrorDetails, key: str, overridden: set[str]) -> str:
    """One line for one of pydantic's errors: where, name, expected, got, remedy."""
    given = [k for k in overridden if key == k or key.startswith(f"{k}.")]
    where = f"--set {given[0]}" if given else file
    kind, limits = item["type"], item.get("ctx", {})
    if kind == "extension":
        return f"{where}: {limits['text']}"
    if kind in ("extra_forbidden", "invalid_key"):
        return f"{where}: unknown key {key}{did_you_mean(key, known_keys())}"
    if kind == "missing":
        return f"{where}: {key} is missing: {_description(key)}"
    if kind == "value_error" and not key:
        # A relation between values that may come from the file and from the command line.
        origin = f"{file} with --set {' '.join(sorted(overridden))}" if overridden else file
        return f"{origin}: {limits['error']}"
    return f"{where}: {key} {expectation(item)}, got {shown_value(item['input'])}"


def _description(key: str) -> str:
    model = FitConfig
    *sections, leaf = (part for part in key.split(".") if not part.isdigit())
    for section in sections:
        model = _section(model.model_fields[section].annotation)
    field = model.model_fields[leaf]
    return field.description or field.annotation.__doc__
