"""How Sphinx builds these pages: sphinx-build -W -b html docs docs/_build/html"""

import inspect
import re
import sys
from dataclasses import is_dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "docs" / "_ext")]

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
    """List the fields of a dataclass, which have comments, below its docstring."""
    del app, what, name, options
    if inspect.isclass(obj) and is_dataclass(obj):
        comment = r"^    (\w+): [^#\n]*  # (.*?)(?:  # noqa.*)?$"
        fields = re.findall(comment, inspect.getsource(obj), re.MULTILINE)
        lines += ["", *(f"- ``{name}``: {text}" for name, text in fields), ""]


def shorten_defaults(app, what, name, obj, options, signature, returns):
    """Make signatures of dataclasses Python, so that Sphinx sets them in lines."""
    del app, what, name, obj, options
    return signature and signature.replace("<factory>", "..."), returns


def setup(app):
    """Called by Sphinx."""
    app.connect("autodoc-process-docstring", add_fields)
    app.connect("autodoc-process-signature", shorten_defaults)
