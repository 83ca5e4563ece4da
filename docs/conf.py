"""How Sphinx builds these pages: sphinx-build -W -b html docs docs/_build/html"""

import inspect
import re
import sys
from contextlib import suppress
from dataclasses import is_dataclass
from itertools import groupby
from pathlib import Path
from typing import get_args

from pydantic import BaseModel

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs" / "_ext")]

import mitsuba as mi  # noqa: E402

import drgs  # noqa: E402  (selects LLVM and registers the plugins before Mitsuba is imported)

# Modules that use Mitsuba's types can only be imported once a variant is set.
mi.set_variant("llvm_ad_rgb")

project = "drgs"
author = "The drgs authors"
copyright = author
release = version = drgs.__version__

extensions = [
    "configuration",
    "myst_nb",
    "sphinx.ext.autodoc",
    "sphinx.ext.mathjax",
    "sphinx_design",
]
exclude_patterns = ["_build", "**.ipynb_checkpoints"]
nitpicky = False

nb_execution_mode = "off"  # notebooks are shown with their stored outputs
myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 3  # links such as results/speed.md#speed work here as on a code host

autodoc_default_options = {"exclude-members": "model_config"}
autodoc_member_order = "bysource"
python_use_unqualified_type_names = True
# Types in signatures are short names, and the kernels and the reference share some, such as Lens.
suppress_warnings = ["ref.python"]
python_maximum_signature_line_length = 100
add_module_names = False

html_theme = "furo"
html_title = "drgs"


# Docstrings are written to be read in the code: equations are indented, |x| is a norm.

LITERAL = re.compile(r"(``.+?``|:\w+(?::\w+)?:`.+?`)")


def as_restructured_text(app, what, name, obj, options, lines):
    """Escape what reStructuredText would read as markup, and set indented blocks as they are."""
    del app, what, name, options
    lines, original = list(_with_argument_lists(obj, lines)), lines
    result, literal = [], False
    for k, line in enumerate(lines):
        indented = line.startswith("    ")
        after_blank = k == 0 or not lines[k - 1].strip()
        if indented and after_blank and not literal:
            before = next((text for text in reversed(result) if text.strip()), "")
            if not before.endswith("::"):
                result += ["::", ""]
            literal = True
        elif line.strip() and not indented:
            literal = False
        result.append(line if literal else _escaped(line))
    original[:] = result + (
        ["", *_fields(obj), ""] if inspect.isclass(obj) and not get_args(obj) else []
    )


def _with_argument_lists(obj, lines):
    """Paragraphs such as "means: (N, 3) world; quats: ..." of a function as lists."""
    try:
        names = "|".join(inspect.signature(obj).parameters)
    except (TypeError, ValueError):
        names = ""
    for is_text, group in groupby(lines, lambda line: bool(line.strip())):
        paragraph = list(group)
        start = rf"(?:{names})(?:,? (?:and )?(?:{names}))*: "
        if names and is_text and re.match(start, paragraph[0]):
            for item in re.split(rf"(?:; |\. |\.$)(?={start}|$)", " ".join(paragraph)):
                if item:
                    arguments, _, text = item.partition(": ")
                    yield f"- ``{arguments}``: {text}"
        else:
            yield from paragraph


def _fields(cls):
    """The fields of a section of the configuration, or of a dataclass, as a list."""
    if issubclass(cls, BaseModel):
        for name, field in cls.model_fields.items():
            default = "required" if field.is_required() else f"default ``{field.get_default()!r}``"
            if field.default_factory is not None:
                default = ""
            described = " ".join(filter(None, [field.description, default and f"({default})"]))
            yield f"- ``{name}``: {_plain(described)}" if described else f"- ``{name}``"
    elif is_dataclass(cls):
        with suppress(OSError):
            for line in inspect.getsource(cls).splitlines():
                found = re.fullmatch(r"    (\w+): [^#]*?  # (.*?)(  # noqa.*)?", line)
                if found:
                    yield f"- ``{found[1]}``: {_plain(found[2])}"


def _plain(text):
    """Of text that is no markup."""
    parts = LITERAL.split(text)
    parts[::2] = [re.sub(r"[|*_`]", r"\\\g<0>", part) for part in parts[::2]]
    return "".join(parts)


def _escaped(line):
    """Outside of literals: no substitutions, no references, no emphasis within equations."""
    parts = LITERAL.split(line)
    for k in range(0, len(parts), 2):
        parts[k] = re.sub(
            r"\||(?<=\w)_(?!\w)|\*(?=[\w(])(?<! \*)|(?<=\w)\*\*", r"\\\g<0>", parts[k]
        )
        if k > 0 and re.match(r"[\w^]", parts[k]):
            parts[k] = r"\ " + parts[k]  # a literal ends before a space
    return "".join(parts)


def setup(app):
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", as_restructured_text)
