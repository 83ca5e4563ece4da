"""The pages are true: paths, names, commands, options, and programs."""

import contextlib
import importlib.util
import io
import os
import re
import shlex
import sys
from functools import cache
from pathlib import Path

import pytest
from conftest import REPOSITORY, run_program

import drgs
from drgs.bench import __main__ as bench
from drgs.config.load import known_keys
from drgs.config.schema import FitConfig

PAGES = (
    "README.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    *sorted(
        path.relative_to(REPOSITORY).as_posix()
        for path in (REPOSITORY / "docs").rglob("*.md")
        if "_build" not in path.parts
    ),
)

STUDIES = sorted(
    f"scenes/studies/{path.name}" for path in (REPOSITORY / "scenes" / "studies").glob("*.md")
)

each_page = pytest.mark.parametrize("page", (*PAGES, *STUDIES))


def text_of(page) -> str:
    return (REPOSITORY / page).read_text()


def fenced(page, language) -> list[str]:
    """Blocks of a page, in their order."""
    return re.findall(rf"^```{language}\n(.*?)^```", text_of(page), re.MULTILINE | re.DOTALL)


def inline_code(page) -> list[str]:
    """Return the text in backticks, outside of blocks."""
    prose = re.sub(r"^```.*?^```", "", text_of(page), flags=re.MULTILINE | re.DOTALL)
    return re.findall(r"`([^`\n]+)`", prose)


# ----------------------------------------------------------------------------------------------
# The README
# ----------------------------------------------------------------------------------------------

MAX_README_WORDS = 900
MAX_WORDS = 22_000


def test_documents_are_short():
    words = {page: len(text_of(page).split()) for page in PAGES}
    assert words["README.md"] <= MAX_README_WORDS
    assert sum(words.values()) <= MAX_WORDS


def test_readme_has_two_commands_each_on_its_own_line():
    assert [block.strip() for block in fenced("README.md", "sh")] == [
        "python3 -m venv .venv && . .venv/bin/activate && "
        "pip install -e '.[llvm,viewer]' && python -m drgs.fit scenes/lego.yml",
        "pip install -e '.[llvm,test]' && python -m pytest",
    ]


def linked_pages(page) -> set[str]:
    targets = re.findall(r"\]\(([^):#]+\.md)[)#]", text_of(page))
    return {os.path.normpath(Path(page).parent / target) for target in targets}


def test_readme_links_to_every_page_outside_of_folders():
    for page in PAGES:
        if Path(page).parent in (Path(), Path("docs")):
            assert page in {"README.md", "docs/index.md", *linked_pages("README.md")}, page


def test_readme_leads_to_every_page():
    reached, found = set(), {"README.md"}
    while found:
        reached |= found
        found = {target for page in found for target in linked_pages(page)} - reached
    assert set(PAGES) - reached <= {"docs/index.md"}


# ----------------------------------------------------------------------------------------------
# Paths and names
# ----------------------------------------------------------------------------------------------


FOLDERS = ("drgs", "plugins", "scenes", "examples", "tests", "docs")


@each_page
def test_mentioned_paths_exist(page):
    for code in inline_code(page):
        if code.startswith(tuple(f"{folder}/" for folder in FOLDERS)):
            for path in code.split()[:1]:
                assert (REPOSITORY / path).exists(), path


def test_the_layout_lists_every_package():
    table = text_of("docs/developing.md").split("## Layout")[1].split("## Tests")[0]
    for init in sorted((REPOSITORY / "drgs").rglob("__init__.py")):
        folder = init.parent.relative_to(REPOSITORY / "drgs")
        assert folder == Path() or f"`{folder.as_posix()}/`" in table, folder


REMOVED_MODULES = {"drgs.rendering"}  # of the changelog


@each_page
def test_mentioned_modules_and_names_exist(page):
    for code in inline_code(page):
        if re.fullmatch(r"drgs(\.\w+)+", code) and code not in REMOVED_MODULES:
            assert _exists(code), code


def _exists(name) -> bool:
    module, names = name, []
    while True:
        with contextlib.suppress(ModuleNotFoundError):
            found = importlib.import_module(module)
            break
        module, _, last = module.rpartition(".")
        names.insert(0, last)
    for each in names:
        found = getattr(found, each, None)
    return found is not None


@each_page
def test_mentioned_configuration_keys_exist(page):
    for code in inline_code(page):
        match = re.fullmatch(r"((\w+)(\.\w+)+)(=.*)?", code)
        if match and match[3] != ".json" and match[2] in FitConfig.model_fields:
            assert match[1] in known_keys(), code


def test_the_api_lists_every_name_of_the_package():
    for name in drgs.__all__:
        assert f"\n   drgs.{name}\n" in text_of("docs/api.md"), name


# ----------------------------------------------------------------------------------------------
# Commands
# ----------------------------------------------------------------------------------------------

MODULES = {
    "fit": "drgs.fit.__main__",
    "render": "drgs.render.__main__",
    "poses": "drgs.poses.__main__",
    "examine": "drgs.examine.__main__",
    "export": "drgs.export.__main__",
    "view": "drgs.view.__main__",
    "capture": "drgs.capture.__main__",
    "bench": "drgs.bench.__main__",
}


def commands(page) -> list[list[str]]:
    """The commands of drgs on a page, without what starts them: ``fit scenes/lego.yml``."""
    lines = [line for block in fenced(page, "sh") for line in block.splitlines()]
    found = []
    for line in [*lines, *inline_code(page)]:
        match = re.search(r"python -m drgs[. ](\w.*)|^drgs (\w.*)", line)
        if match:
            found.append(shlex.split(match[1] or match[2], comments=True))
    return found


@cache
def help_of(*command) -> str:
    """Return the output of ``--help``."""
    printed = io.StringIO()
    main = importlib.import_module(MODULES[command[0]]).main
    with contextlib.redirect_stdout(printed), pytest.raises(SystemExit) as end:
        main([*command[1:], "--help"])
    assert end.value.code == 0
    return printed.getvalue()


@each_page
def test_mentioned_commands_and_options_exist(page):
    for name, *arguments in commands(page):
        assert name in MODULES, name
        command = (name, *arguments[:1]) if name == "bench" and arguments else (name,)
        options = {argument for argument in arguments if re.match(r"--?[a-zA-Z]", argument)}
        assert options <= set(re.findall(r"--?[a-zA-Z][\w-]*", help_of(*command))), arguments


def test_documents_show_every_command():
    shown = {command[0] for page in PAGES for command in commands(page)}
    benches = {tuple(c[1:2]) for page in PAGES for c in commands(page) if c[0] == "bench"}
    assert shown == set(MODULES)
    assert {name for each in benches for name in each} == set(bench.COMMANDS)


# ----------------------------------------------------------------------------------------------
# Programs
# ----------------------------------------------------------------------------------------------


PAGES_OF_PROGRAMS = {"robot_camera.py": "docs/mitsuba.md"}  # the others are extensions


@pytest.mark.parametrize("example", sorted((REPOSITORY / "examples").glob("*.py")))
def test_documents_contain_the_examples(example):
    program = example.read_text()
    page = text_of(PAGES_OF_PROGRAMS.get(example.name, "docs/developing.md"))
    assert f"```{{literalinclude}} ../examples/{example.name}\n```" in page
    assert f"](../examples/{example.name})" in page
    assert 20 <= len(program.splitlines()) <= 60


@pytest.mark.slow
def test_programs_in_the_documents_run():
    """Run by sybil: see ``support.pages``."""
    options = ["-q", "-n0", "-m", "", "-psupport.pages", "-pno:cacheprovider"]
    shown = run_program(sys.executable, "-m", "pytest", *options, "README.md", "docs")
    assert int(re.search(r"(\d+) passed", shown)[1]) >= 26
