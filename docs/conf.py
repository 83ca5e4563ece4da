"""How Sphinx builds these pages: sphinx-build -W -b html docs docs/_build/html"""

import inspect
import re
import sys
from dataclasses import is_dataclass
from pathlib import Path

from pydantic import BaseModel

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs"), str(ROOT / "docs" / "_ext")]

import drgs  # noqa: E402, I001  (selects LLVM before Mitsuba is imported)
import mitsuba as mi  # noqa: E402

# Modules that use Mitsuba's types can only be imported once a variant is set.
mi.set_variant("llvm_ad_rgb")

project = "drgs"
author = "The drgs authors"
copyright = author
release = version = drgs.__version__

extensions = [
    "configuration",
    "myst_nb",
    "plugin_parameters",
    "sphinx.ext.autosummary",
    "sphinx.ext.mathjax",
    "sphinx_design",
]
exclude_patterns = ["_build", "_templates", "**.ipynb_checkpoints"]
templates_path = ["_templates"]
nitpicky = False

nb_execution_mode = "off"  # notebooks are shown with their stored outputs
myst_enable_extensions = ["colon_fence", "dollarmath"]
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


def add_fields(app, what, name, obj, options, lines):
    """List the fields of a configuration's section, or of a dataclass, below its docstring."""
    del app, what, name, options
    if inspect.isclass(obj) and issubclass(obj, BaseModel):
        fields = {name: _described(field) for name, field in obj.model_fields.items()}
    elif inspect.isclass(obj) and is_dataclass(obj):
        comment = r"^    (\w+): [^#\n]*  # (.*?)(?:  # noqa.*)?$"
        fields = dict(re.findall(comment, inspect.getsource(obj), re.MULTILINE))
    else:
        return
    items = (f"- ``{name}``: {text}".rstrip(": ") for name, text in fields.items())
    lines += ["", *(item.replace("*", r"\*") for item in items), ""]


def _described(field):
    """Return the description and the default of a field."""
    default = "" if field.default_factory else f"default ``{field.get_default()!r}``"
    if field.is_required():
        default = "required"
    return " ".join(filter(None, [field.description, default and f"({default})"]))


def setup(app):
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", add_fields)
