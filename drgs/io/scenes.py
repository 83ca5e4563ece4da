"""Mitsuba scenes from files and dictionaries, without inputs that crash Mitsuba or make it hang."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi

from drgs.core.errors import UserError, one_line
from drgs.core.files import open_regular


@contextmanager
def openexr_threads() -> Iterator[None]:
    """Use two threads at least while OpenEXR files are read or written within the block.

    Mitsuba 3.9 has OpenEXR work in Dr.Jit's pool and sleeps until it is done: with a single thread,
    no thread is left to do it.
    """
    threads = dr.thread_count()
    if threads >= 2:
        yield
        return
    dr.set_thread_count(2)
    try:
        yield
    finally:
        dr.set_thread_count(threads)


def load_scene_file(path: Path, **definitions: str) -> mi.Object:
    """Load the scene of an XML file; definitions: values for its parameters ($name).

    Raises RuntimeError as Mitsuba does, and :class:`UserError` for inputs that would crash it.
    """
    for text in (str(path), *definitions.values()):
        try:
            text.encode()
        except UnicodeEncodeError:
            shown = one_line(repr(text), 80)
            raise UserError(
                f"{path}: Mitsuba takes names in UTF-8 only, got {shown}; rename it"
            ) from None
    open_regular(path, "scene").close()
    try:
        if not {"config", "filename"} & set(definitions):  # names that the parser does not take
            _check(mi.parser.parse_file(_parser_config(), str(path), **definitions).nodes, path)
        with openexr_threads():
            parameters: dict[str, Any] = dict(definitions)
            return mi.load_file(str(path), **parameters)
    except (UnicodeDecodeError, RuntimeError) as error:
        # Mitsuba's own error quotes the file; on its way to Python, the quotation fails or is lost.
        if not isinstance(error, UnicodeDecodeError) and str(error):
            raise
        raise UserError(f"{path}: not a valid scene: it holds bytes that are not UTF-8") from None


def load_scene_dictionary(description: dict[str, object], path: Path) -> mi.Object:
    """Load the scene dictionary of the file ``path``; raises as the above."""
    config = _parser_config()
    with openexr_threads():
        _check(mi.parser.parse_dict(config, description).nodes, path)
        return mi.load_dict(description)


def _parser_config() -> mi.parser.ParserConfig:
    variant = mi.variant()
    assert variant is not None, "commands set a variant first"
    return mi.parser.ParserConfig(variant)


def _check(nodes: Iterable[mi.parser.SceneNode], path: Path) -> None:
    """Refuse samplers without samples: some divide by the count when they are made."""
    for node in nodes:
        if node.type != mi.ObjectType.Sampler:
            continue
        for name in ("sample_count", "sampleCount"):  # the latter: of old files
            if name in node.props and node.props[name] == 0:
                raise UserError(
                    f"{path}: the sampler '{node.props.plugin_name()}' must have a {name} of at "
                    "least 1, got 0"
                )
