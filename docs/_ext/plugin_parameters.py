"""A directive that shows the parameters of a plugin, from the docstring of its class.

The docstring lists them as those of Mitsuba's plugins do, below ``.. pluginparameters::``. In the
pages, ``{plugin-parameters} splats`` is the table of ``plugins/splats.py``.
"""

import ast
import re
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from drgs.config.approximations import DECLARED, Declared

PLUGINS = Path(__file__).resolve().parents[2] / "plugins"

TYPES = {bool: "bool", int: "int", float: "float", str: "string"}

SYMBOLS = {"exposed": "**P**", "differentiable": "**∂**"}

LEGEND = "**P**: exposed by `mi.traverse`; **∂**: differentiable."


class Parameter(NamedTuple):
    """A row of the table; parameters of one kind share it."""

    names: tuple[str, ...]
    type: str
    description: str
    default: str  # "" if a plugin needs it, or another one in its place
    flags: tuple[str, ...] = ()  # "exposed" and "differentiable"


def parameters_of(plugin: str) -> list[Parameter]:
    """Return the parameters in the docstring of ``plugins/PLUGIN.py``, and approximations."""
    source = (PLUGINS / f"{plugin}.py").read_text()
    documented = (
        ast.get_docstring(n) for n in ast.parse(source).body if isinstance(n, ast.ClassDef)
    )
    (text,) = (d for d in documented if d and ".. pluginparameters::" in d)
    table = re.split(r"\n(?=\S)", text.partition(".. pluginparameters::\n")[2])[0]
    return [row for item in table.split("\n * - ")[1:] for row in _rows(item)]


def _rows(item: str) -> Iterator[Parameter]:
    """Yield a row; one for each name, if it is an approximation."""
    first, kind, description, *flags = (" ".join(c.split()) for c in item.split("\n   - "))
    names = tuple(first.split(", "))
    if set(names) <= set(DECLARED):
        for name in names:
            yield _approximation(name, DECLARED[name])
        return
    text, _, default = description.removesuffix(")").partition(" (Default: ")
    found = re.findall(r"\w+", flags[0]) if flags else []
    yield Parameter(
        names, kind.replace("|", ""), text if default else description, default, tuple(found)
    )


def _approximation(name: str, declared: Declared) -> Parameter:
    text = declared.description
    for word in declared.words:
        text = text.replace(f"{word}:", f"``{word}``:")
    default = declared.default if declared.decimal is None else declared.decimal
    written = {"alpha_cut": "1/255", "extent": "that of ``alpha_cut``"}.get(name, str(default))
    return Parameter((name,), TYPES[declared.kind], text, written.lower())


def markdown(plugin: str) -> str:
    """Return the table in Markdown."""
    lines = ["| Parameter | Type | | Default | Description |", "| --- " * 5 + "|"]
    for row in parameters_of(plugin):
        names = ", ".join(n if n.startswith("(") else f"`{n}`" for n in row.names)
        flags = "\u00a0".join(SYMBOLS[flag] for flag in row.flags)
        lines.append(f"| {names} | {row.type} | {flags} | {row.default} | {row.description} |")
    if any(row.flags for row in parameters_of(plugin)):
        lines += ["", LEGEND]
    return "\n".join(lines)


def setup(app):
    """Add the directive to Sphinx."""
    from sphinx.util.docutils import SphinxDirective

    class PluginParameters(SphinxDirective):
        """The table of a plugin, which is the argument."""

        required_arguments = 1

        def run(self):
            """Return the nodes of the table."""
            self.env.note_dependency(str(PLUGINS / f"{self.arguments[0]}.py"))
            return self.parse_text_to_nodes(markdown(self.arguments[0]))

    app.add_directive("plugin-parameters", PluginParameters)
    return {"parallel_read_safe": True}
