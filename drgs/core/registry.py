"""Registries of extensions: implementations by name, shipped ones and those of other packages.

A decorator registers a class or function, with the pydantic model of its configuration section::

    from drgs.config.extensions import STRATEGIES

    class Settings(Section):
        growth: float = 0.01

    @STRATEGIES.register("my_strategy", section=Settings)
    class MyStrategy(DensityStrategy): ...

An entry point of the registry's group, whose value is the module with the decorator, makes the name
known; the module is imported when the extension is used. What drgs ships has its entry points in
``pyproject.toml`` and no other way in; those of missing modules are left out. Modules of the group
``drgs`` may register extensions of all kinds. A configuration names extensions, not modules, so
that reading one runs no code but theirs.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from importlib import import_module
from importlib.metadata import EntryPoint, PackageNotFoundError, distribution, entry_points
from importlib.util import find_spec
from pathlib import Path
from traceback import walk_tb
from types import FrameType, ModuleType
from typing import TYPE_CHECKING, Generic, TypeVar, cast

from typing_extensions import override

from drgs.core.errors import UserError, did_you_mean, one_line, root_cause

if TYPE_CHECKING:
    from pydantic import BaseModel

ANY_KIND = "drgs"
"""Group of entry points whose modules register extensions of any kind."""

HOW_TO_INSTALL = 'others come with installed packages that have an entry point of the group "drgs"'

PROJECT = Path(__file__).parents[2] / "pyproject.toml"
"""Project file of a checkout, whose installed metadata may be older."""

T = TypeVar("T")
Registered = TypeVar("Registered")


class ExtensionError(UserError):
    """An error that an extension raised, reported with its name."""


@dataclass(frozen=True)
class Extension(Generic[T]):
    """A registered implementation."""

    kind: str  # of its registry, such as "density strategy"
    name: str
    value: T  # the class or function that was decorated
    section: type[BaseModel] | None  # model of its configuration section
    module: str  # that defines it

    @property
    def is_shipped(self) -> bool:
        """True if it is a part of drgs."""
        return self.module.partition(".")[0] == "drgs"

    @property
    def summary(self) -> str:
        """The first line of its documentation."""
        return (getattr(self.value, "__doc__", None) or self.name).strip().splitlines()[0]

    def error(self, cause: BaseException) -> ExtensionError:
        """Return an error that reports another with the name of the extension, file and line."""
        text = one_line(f"{type(cause).__name__}: {cause}")
        places = [
            f"{frame.f_code.co_filename}:{line}"
            for frame, line in walk_tb(cause.__traceback__)
            if frame.f_globals.get("__name__") == self.module
        ]
        place = f", at {places[-1]}" if places else ""
        return ExtensionError(f'{self.kind} "{self.name}" ({self.module}): {text}{place}')

    def owns(self, frame: FrameType) -> bool:
        """Return whether a function is the extension, or one of its class or object."""
        owner = frame.f_locals.get("self", frame.f_locals.get("cls"))
        owner = owner if isinstance(owner, type) else type(owner)
        is_function = getattr(self.value, "__code__", None) is frame.f_code
        return is_function or (isinstance(self.value, type) and issubclass(owner, self.value))

    @contextmanager
    def reporting(self) -> Iterator[None]:
        """Raise errors of installed extensions within the block as :class:`ExtensionError`.

        A ``UserError`` passes unchanged.
        """
        try:
            yield
        except UserError:
            raise
        except Exception as error:
            if self.is_shipped:
                raise
            raise self.error(error) from error


class Registry(Generic[T]):
    """The implementations of one extension point, by name."""

    def __init__(self, kind: str, group: str, unique: str = "") -> None:
        """kind: of the extensions, for messages; group: of their entry points.

        unique: name of an attribute that no two extensions have the same value of.
        """
        self.kind, self.group, self.unique = kind, group, unique
        self._extensions: dict[str, Extension[T]] = {}
        _registries.append(self)

    def register(
        self, name: str, section: type[BaseModel] | None = None
    ) -> Callable[[Registered], Registered]:
        """Return a decorator that registers a class or function under ``name``.

        section: model of the section ``NAME`` of a configuration.

        Raises ValueError if another module has registered the name.
        """

        def decorate(value: Registered) -> Registered:
            if missing := abstract_methods(value):
                raise TypeError(f'{self.kind} "{name}" must define {", ".join(missing)}')
            module = getattr(value, "__module__", type(value).__module__)
            before, shipped = self._extensions.get(name), shipped_modules(self.group)
            owner = shipped.get(name) if before is None else before.module
            if owner not in (None, module):
                raise ValueError(f'{self.kind} "{name}" is registered by {owner} already')
            others = (r for r in _registries if r is not self and name in r._extensions)
            if name not in shipped and (other := next(others, None)) is not None:
                raise ValueError(f'a {other.kind} is called "{name}" already: names are sections')
            if self.unique and name not in shipped:
                one = getattr(value, self.unique)
                others = {**shipped, **self._extensions}.keys() - {name}
                if same := [o for o in others if getattr(self.get(o).value, self.unique) == one]:
                    raise ValueError(
                        f'{self.kind} "{name}": {self.unique} {one} is that of {same[0]} already'
                    )
            self._extensions[name] = Extension(self.kind, name, cast(T, value), section, module)
            return value

        return decorate

    def __contains__(self, name: object) -> bool:
        return name in shipped_modules(self.group) or name in self.names()

    @property
    def shipped_names(self) -> list[str]:
        """The names of the extensions that drgs ships."""
        return list(shipped_modules(self.group))

    def names(self) -> list[str]:
        """Return the names of all extensions, shipped ones first."""
        for point in installed_points(ANY_KIND).values():
            if point.value not in _loaded:
                _load(point)
                _loaded.add(point.value)
        shipped = self.shipped_names
        return [*shipped, *sorted({*self._extensions, *installed_points(self.group)} - {*shipped})]

    def get(self, name: str, place: str = "") -> Extension[T]:
        """Import and return the extension of this name.

        place: of the name, such as ``scenes/lego.yml: densify.strategy``, for the
        :class:`UserError` for an unknown name.
        """
        if name not in self._extensions and (module := shipped_modules(self.group).get(name)):
            import_module(module)
        if name not in self._extensions and (point := installed_points(self.group).get(name)):
            _load(point)
        if name not in self._extensions and name not in self.names():
            known = self.names()
            start = f"{place}: " if place else ""
            raise UserError(
                f'{start}no {self.kind} is called "{name}"{did_you_mean(name, known)}; there are '
                f"{', '.join(known) or 'none'} ({HOW_TO_INSTALL})"
            )
        if name not in self._extensions:
            raise ExtensionError(
                f'the entry point "{name}" of the group {self.group} registers no {self.kind} of '
                "this name: repair or uninstall its package"
            )
        return self._extensions[name]

    def all(self) -> list[Extension[T]]:
        """Import and return all extensions, shipped ones first."""
        return [self.get(name) for name in self.names()]

    def installed_extensions(self) -> list[Extension[T]]:
        """Import and return the extensions that drgs does not ship, by name."""
        return [self.get(name) for name in self.names() if name not in self.shipped_names]


def abstract_methods(value: object) -> list[str]:
    """Return the names of a class's methods that it must define."""
    methods = ((name, getattr(value, name, None)) for name in dir(value))
    return [name for name, method in methods if getattr(method, "__isabstractmethod__", False)]


Base = TypeVar("Base")


class ClassRegistry(Registry[type[Base]]):
    """A registry of classes, each of which has its name as an attribute."""

    def __init__(self, kind: str, group: str, attribute: str = "kind") -> None:
        super().__init__(kind, group)
        self.attribute = attribute

    @override
    def register(
        self, name: str, section: type[BaseModel] | None = None
    ) -> Callable[[Registered], Registered]:
        decorate = super().register(name, section)

        def register_class(cls: Registered) -> Registered:
            setattr(cls, self.attribute, name)
            return decorate(cls)

        return register_class


_registries: list[Registry] = []


def all_extensions() -> list[Extension]:
    """Return the extensions that drgs does not ship, of all kinds, by name."""
    found = [extension for registry in _registries for extension in registry.installed_extensions()]
    return sorted(found, key=lambda extension: extension.name)


@contextmanager
def temporary_registrations() -> Iterator[None]:
    """Undo at the end what is registered within the block: for tests of extensions."""
    before = [(registry, dict(registry._extensions)) for registry in _registries]
    loaded = set(_loaded)
    try:
        yield
    finally:
        _loaded.intersection_update(loaded)
        for registry, extensions in before:
            # Modules of drgs are not imported again.
            shipped = shipped_modules(registry.group)
            kept = {name: e for name, e in registry._extensions.items() if name in shipped}
            registry._extensions = {**kept, **extensions}


@contextmanager
def reporting_extensions() -> Iterator[None]:
    """Within the block, report errors that come from an installed extension with its name.

    An error comes from an extension if a function of the extension's module is on its traceback.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        known = [e for r in _registries for e in r._extensions.values() if not e.is_shipped]
        cause: BaseException | None = error
        while cause is not None:
            frames = [frame for frame, _ in walk_tb(cause.__traceback__)]
            modules = [frame.f_globals.get("__name__", "") for frame in frames]
            of_module = [e for e in known if e.module in modules]
            owners = [e for frame in frames for e in of_module if e.owns(frame)]
            for extension in owners or of_module:
                raise extension.error(root_cause(error)) from error
            cause = cause.__cause__ or cause.__context__
        raise


def modules_of(group: str) -> dict[str, ModuleType]:
    """Import and return the modules of a group's entry points by name, shipped ones first."""
    shipped = {name: import_module(module) for name, module in shipped_modules(group).items()}
    return shipped | {name: _load(point) for name, point in installed_points(group).items()}


@lru_cache
def shipped_modules(group: str) -> Mapping[str, str]:
    """Return the modules of a group's entry points of drgs, by name; missing ones are left out.

    Raises :class:`UserError` where drgs is on Python's path without being installed.
    """
    points = _project_points() or _metadata_points()
    if not points:
        raise UserError(
            f"drgs is not installed: {PROJECT.parent} is on Python's path, but has neither "
            f'metadata nor the file {PROJECT.name}; run "pip install" for it'
        )
    modules = points.get(group, {})
    return {name: modules[name] for name in sorted(modules) if _exists(modules[name])}


@lru_cache
def _project_points() -> Mapping[str, Mapping[str, str]]:
    """Return the entry points of the checkout, by group and name; without one, none."""
    with suppress(ImportError, OSError):  # Python 3.10 has no tomllib
        import tomllib

        project = tomllib.loads(PROJECT.read_text(encoding="utf-8")).get("project", {})
        if project.get("name") == "drgs":
            return project["entry-points"]
    return {}


@lru_cache
def _metadata_points() -> Mapping[str, Mapping[str, str]]:
    """Return the entry points of the installed package, by group and name; without one, none."""
    points: dict[str, dict[str, str]] = {}
    with suppress(PackageNotFoundError):
        for point in distribution("drgs").entry_points:
            points.setdefault(point.group, {})[point.name] = point.value
    return points


def _exists(module: str) -> bool:
    try:
        return find_spec(module) is not None
    except ModuleNotFoundError:  # of a package that contains it
        return False


def installed_points(group: str) -> Mapping[str, EntryPoint]:
    """Return a group's entry points of other packages than drgs, by name."""
    return _find_points(entry_points, group, tuple(sys.path))


@lru_cache
def _find_points(
    find: Callable[..., Iterable[EntryPoint]], group: str, path: tuple[str, ...]
) -> Mapping[str, EntryPoint]:
    del path  # on which they are found
    points = sorted(find(group=group), key=lambda point: point.name)
    return {each.name: each for each in points if each.value.partition(".")[0] != "drgs"}


_loaded: set[str] = set()  # entry points of any kind whose modules have been imported


def _load(point: EntryPoint) -> ModuleType:
    """Import and return the module of an entry point; :class:`ExtensionError` if that fails."""
    try:
        return point.load()
    except Exception as error:
        package = "" if point.dist is None else f" of the package {point.dist.name}"
        cause = one_line(f"{type(error).__name__}: {error}")
        raise ExtensionError(
            f'cannot load the extension "{point.name}"{package} ({point.value}): {cause}; '
            "repair or uninstall it"
        ) from error
