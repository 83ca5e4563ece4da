"""The directive ``configuration``: a table of keys for each section of a fit's configuration.

The tables are made from the schema, ``drgs.config.schema.FitConfig``, when the site is built.
"""

import json
import re
from collections.abc import Iterator, Sequence
from typing import Any

from docutils import nodes
from pydantic import BaseModel
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from drgs.config.schema import FitConfig
from drgs.config.section import ExtensibleSection
from drgs.core.constants import MAX_INT

COLUMNS = {"key": 20, "type": 22, "default": 10, "description": 48}  # widths, per cent

LIMITS = {"minimum": "≥", "exclusiveMinimum": ">", "maximum": "≤", "exclusiveMaximum": "<"}

CODE = re.compile(r"``(.+?)``|:\w+:`(.+?)`|\b([A-Za-z]\w*(?:[._]\w+)+)\b")


class ConfigurationTables(SphinxDirective):
    """Sections with tables, for ``FitConfig`` and each section in it."""

    def run(self) -> list[nodes.Node]:
        """Return the sections."""
        return make_sections()


def make_sections() -> list[nodes.Node]:
    """Return the sections of the whole configuration, in the order of the schema."""
    return list(_sections("", FitConfig))


def _sections(path: str, model: type[BaseModel]) -> Iterator[nodes.section]:
    """Yield a section for the keys of a model, and then for each model among them."""
    schema = model.model_json_schema()
    models, rows = schema.get("$defs", {}), []
    inner = {name: field.annotation for name, field in model.model_fields.items()}
    inner = {name: kind for name, kind in inner.items() if _is_model(kind)}
    if issubclass(model, ExtensibleSection):
        inner |= {each.name: each.section for each in model.extensions() if each.is_shipped}
    for name, field in schema["properties"].items():
        if name not in inner:
            default = "required" if name in schema.get("required", ()) else _default(field)
            rows.append([name, _type(field, models), default, field["description"]])
    title = nodes.title("", "", nodes.literal("", path) if path else nodes.Text("Top level"))
    section = nodes.section(ids=[nodes.make_id(f"keys {path}")])
    section += [title, nodes.paragraph("", "", *_inline(schema["description"].split("\n\n")[0]))]
    section += _table(rows)
    yield section
    for name, section in inner.items():
        yield from _sections(f"{path}.{name}".lstrip("."), section)


def _is_model(kind: object) -> bool:
    return isinstance(kind, type) and issubclass(kind, BaseModel)


def _table(rows: list[list[str]]) -> nodes.table:
    group = nodes.tgroup(cols=len(COLUMNS))
    group += [nodes.colspec(colwidth=width) for width in COLUMNS.values()]
    head, body = nodes.thead(), nodes.tbody()
    head += _row(*([nodes.Text(name)] for name in COLUMNS))
    for key, kind, default, description in rows:
        body += _row(
            [nodes.literal("", key)],
            [nodes.Text(kind)],
            [nodes.literal("", default)],
            _inline(description),
        )
    group += [head, body]
    return nodes.table("", group)


def _row(*cells: Sequence[nodes.Node]) -> nodes.row:
    return nodes.row("", *(nodes.entry("", nodes.paragraph("", "", *cell)) for cell in cells))


def _inline(text: str) -> list[nodes.Node]:
    """Return text in which code and names such as ``densify.stop`` are literals."""
    pieces = [piece for piece in CODE.split(" ".join(text.split())) if piece is not None]
    is_code = [False] + [True, False] * (len(pieces) // 2)
    return [
        nodes.literal("", piece) if code else nodes.Text(piece)
        for piece, code in zip(pieces, is_code, strict=True)
    ]


def _model(field: dict[str, Any], models: dict[str, Any]) -> dict[str, Any]:
    return models[field["$ref"].rpartition("/")[2]]


def _type(field: dict[str, Any], models: dict[str, Any]) -> str:
    """Return the type in words, with limits: ``integer ≥ 1, or null``."""
    if "anyOf" in field:
        *kinds, last = (_type(kind, models) for kind in field["anyOf"])
        return ", or ".join([*kinds, last])
    if "enum" in field:
        return ", ".join(map(str, field["enum"]))
    if "items" in field and "$ref" not in field["items"]:
        return f"list of {field['items']['type']}"
    if "items" in field:
        return f"list of {{{', '.join(_model(field['items'], models)['properties'])}}}"
    name = field.get("format", field.get("type", ""))
    limits = {sign: field[limit] for limit, sign in LIMITS.items() if field.get(limit) is not None}
    shown = [f"{sign} {_number(value)}" for sign, value in limits.items() if value != MAX_INT]
    return " ".join([name, ", ".join(shown)]).strip()


def _default(field: dict[str, Any]) -> str:
    """Return the default as in YAML."""
    value = field.get("default", {"array": [], "object": {}}.get(field.get("type", "")))
    if isinstance(value, float):
        return _number(value)
    return value if value and isinstance(value, str) else json.dumps(value)


def _number(value: int | float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.4g}"


def setup(app: Sphinx) -> dict[str, bool]:
    """Register the directive with Sphinx."""
    app.add_directive("configuration", ConfigurationTables)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
