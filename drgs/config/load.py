"""Configurations from YAML and back, with messages that name file, key, expected and got."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import get_args

import yaml
from pydantic import BaseModel, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails
from typing_extensions import override

from drgs.config.schema import FitConfig
from drgs.config.section import ExtensibleSection, expectation, format_value, set_value
from drgs.core.errors import UserError, did_you_mean, format_names, one_line
from drgs.core.file_kinds import describe_file
from drgs.core.files import read_text, write_bytes

PATH_KEYS = ("data.path", "init.point_cloud", "init.gaussians", "output.dir")  # made absolute

MAX_BYTES = 1 << 20  # of a file: a thousand times all values with comments

MAX_EXPLAINED = 3  # wrong values in an error; the rest are counted


def load_config(path: str | Path, overrides: Iterable[str] = ()) -> FitConfig:
    """Read a YAML configuration; ``overrides`` are ``section.key=VALUE`` with VALUE in YAML.

    Relative paths are relative to the file's folder, in ``overrides`` (not in YAML) to the current
    folder. Raises :class:`UserError` with the first wrong keys.
    """
    path = Path(path)
    return _validate(_read_yaml(path), str(path), path.resolve().parent, overrides)


def config_from(
    values: Mapping[str, object], where: str, overrides: Iterable[str] = ()
) -> FitConfig:
    """Return a configuration from nested mappings, with the keys of the YAML file.

    where: the beginning of errors. Paths are relative to the current folder. See
    :func:`load_config`.
    """
    values = {
        key: dict(section) if isinstance(section, Mapping) else section
        for key, section in values.items()
    }
    return _validate(values, where, Path(), overrides)


def dump_config(config: FitConfig, path: str | Path) -> None:
    """Write all values of ``config`` as YAML for :func:`load_config`."""
    text = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False)
    write_bytes(path, text.encode())


def known_keys(model: type[BaseModel] = FitConfig, prefix: str = "") -> list[str]:
    """Return dotted names of every section and value, such as ``densify.every``."""
    sections = {name: _section(field.annotation) for name, field in model.model_fields.items()}
    keys: list[str] = []
    if issubclass(model, ExtensibleSection):
        sections |= {extension.name: extension.section for extension in model.extensions()}
    for name, section in sections.items():
        keys.append(prefix + name)
        if section is not None:
            keys += known_keys(section, f"{prefix}{name}.")
    return keys


def _find(key: str) -> FieldInfo | None:
    """Return the field of a dotted name, imported where it is an extension's; None: it has none."""
    model, field = FitConfig, None
    for name in (part for part in key.split(".") if not part.isdigit()):
        if model is None:
            return None
        if (field := model.model_fields.get(name)) is not None:
            model = _section(field.annotation)
        elif issubclass(model, ExtensibleSection) and (extension := model.extension(name)):
            model, field = extension.section, FieldInfo(annotation=extension.section)
        else:
            return None
    return field


def _section(annotation: object) -> type[BaseModel] | None:
    """Return the section model in a type, also of a list's elements."""
    if arguments := get_args(annotation):
        return next(filter(None, map(_section, arguments)), None)
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return None


class _Loader(yaml.SafeLoader):
    """YAML 1.1 in which 1e-15 is a number, not text, and a key given twice is an error."""

    @override
    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict:
        seen = set()
        for key_node, _ in node.value:
            if str(key_node.value) in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key {key_node.value} is given twice", problem_mark=key_node.start_mark
                )
            seen.add(str(key_node.value))
        return super().construct_mapping(node, deep)


_Loader.add_implicit_resolver(
    "tag:yaml.org,2002:float",
    re.compile(r"[-+]?(\d+(\.\d*)?|\.\d+)[eE][-+]?\d+$"),
    list("-+.0123456789"),
)


def _read_yaml(path: Path) -> dict:
    if kind := describe_file(path):
        raise UserError(f"{path}: {kind}")
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
        raise UserError(f"{path}: must hold sections such as 'data:', got {format_value(values)}")
    if isinstance(values.get("frames"), list):
        raise UserError(f"{path}: describes a dataset, no fit; give its folder {path.parent}")
    return values


def _validate(values: dict, where: str, folder: Path, overrides: Iterable[str]) -> FitConfig:
    for key in PATH_KEYS:
        section, leaf = key.split(".")
        entries = values.get(section)
        if isinstance(entries, dict) and isinstance(entries.get(leaf), (str, Path)):
            entries[leaf] = _absolute(folder, str(entries[leaf]), f"{where}: {key}")
    overridden = set()
    for assignment in overrides:
        key, value = _parse_override(assignment)
        overridden.add(key)
        set_value(values, key, value)
    try:
        return FitConfig.model_validate(values)
    except ValidationError as error:
        errors = error.errors()
        first, *others = (_explain(where, each, overridden) for each in errors[:MAX_EXPLAINED])
        others = [text.removeprefix(f"{where}: ") for text in others]
        rest = [where] * (len(errors) - MAX_EXPLAINED)
        raise UserError(format_names([first, *others, *rest], MAX_EXPLAINED, "; ")) from None


def _parse_override(override: str) -> tuple[str, object]:
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals or not key:
        raise UserError(f"--set {override}: must be KEY=VALUE, as in densify.every=200")
    if _find(key) is None:
        raise UserError(f"--set {key}: unknown key {key}{did_you_mean(key, known_keys())}")
    if key in PATH_KEYS:
        return key, None if text == "null" else _absolute(Path(), text, f"--set {key}")
    try:
        return key, yaml.load(text, Loader=_Loader)
    except Exception:  # as in _read_yaml
        raise UserError(f"--set {key}: not a YAML value: {one_line(text)}") from None


def _absolute(folder: Path, text: str, where: str) -> str:
    try:
        path = str((folder / Path(text).expanduser()).resolve())
        path.encode()  # config.yml is UTF-8
    except ValueError:
        raise UserError(
            f"{where} must be a path in UTF-8 without zero bytes, got {format_value(text)}"
        ) from None
    except (OSError, RuntimeError) as error:  # RuntimeError: no such user
        raise UserError(
            f"{where} must be a path, got {format_value(text)} ({one_line(error, 100)})"
        ) from None
    return path


def _explain(file: str, item: ErrorDetails, overridden: set[str]) -> str:
    """Describe one of pydantic's errors in a line."""
    key = one_line(".".join(str(part) for part in item["loc"]), limit=60)
    given = [k for k in overridden if key == k or key.startswith(f"{k}.")]
    where = f"--set {given[0]}" if given else file
    kind, context = item["type"], item.get("ctx", {})
    if kind in ("extra_forbidden", "invalid_key"):
        return f"{where}: unknown key {key}{did_you_mean(key, known_keys())}"
    if kind == "missing":
        field = _find(key)
        assert field is not None, "pydantic names fields"
        about = field.description or getattr(field.annotation, "__doc__", "")
        return f"{where}: {key} is missing: {one_line(about)}"
    if kind == "value_error" and not key:
        # A relation between values that may come from the file and from the command line.
        origin = f"{file} with --set {' '.join(sorted(overridden))}" if overridden else file
        return f"{origin}: {context['error']}"
    return f"{where}: {key} {expectation(item)}, got {format_value(item['input'])}"
