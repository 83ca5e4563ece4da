"""Names and docstrings follow the rules that CONTRIBUTING.md shows."""

import ast
import re
from collections import defaultdict

import pytest
from conftest import REPOSITORY

FIRST_WORDS = {"Of", "Those", "That", "What", "Where", "Whose", "As", "By"}
"""No docstring begins with one."""

NAMES = re.findall(
    r"\w+",
    """
    about above after along around as at back before behind below between beyond both by for from
    in inside into last near next of off on only onto other others out outside over own through
    together towards under unless until up where whole why with within without been begun built
    called chosen drawn found given gone held hidden kept known lost made met paid seen sent shown
    spent taken told unknown unread unseen written asks says seeing weighing importing executing
    """,
)
"""No function has such a name: it does not tell what the function returns or does."""

VERBS = {"feed", "need", "seed", "speed", "embed"}

FILES = {
    str(path.relative_to(REPOSITORY)): ast.parse(path.read_text())
    for folder in ("drgs", "plugins", "tests")
    for path in sorted((REPOSITORY / folder).rglob("*.py"))
}
PACKAGE = {name: tree for name, tree in FILES.items() if not name.startswith("tests")}

DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)


def forbidden_docstrings(tree):
    """First lines that begin with one of ``FIRST_WORDS``."""
    nodes = [n for n in ast.walk(tree) if isinstance(n, (ast.Module, *DEFINITIONS))]
    lines = [(ast.get_docstring(node) or "").partition("\n")[0] for node in nodes]
    return [line for line in lines if re.split(r"\W", line)[0] in FIRST_WORDS]


def forbidden_names(tree):
    """Functions that are called by a preposition, an adverb or a participle alone."""
    names = [n.name for n in ast.walk(tree) if isinstance(n, DEFINITIONS[:2])]
    bare = {name: name.strip("_") for name in names}
    return sorted(
        name
        for name, word in bare.items()
        if word in NAMES or (re.fullmatch("[a-z]+ed", word) and word not in VERBS)
    )


@pytest.mark.parametrize("name", FILES)
def test_docstrings_begin_with_a_verb_or_a_noun(name):
    assert forbidden_docstrings(FILES[name]) == []


@pytest.mark.parametrize("name", PACKAGE)
def test_functions_are_verbs_or_name_their_value(name):
    assert forbidden_names(PACKAGE[name]) == []


def test_a_class_name_stands_for_one_type():
    """The reference mirrors the package's names."""
    places = defaultdict(list)
    for name, tree in PACKAGE.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and not node.name.startswith("_"):
                places[node.name] += [name] * ("reference" not in name)
    assert {key: files for key, files in places.items() if len(files) > 1} == {}


def test_offences_are_found():
    tree = ast.parse('def of():\n    """That of none."""\ndef joined(): ...\ndef speed(): ...')
    assert forbidden_docstrings(tree) == ["That of none."]
    assert forbidden_names(tree) == ["joined", "of"]
