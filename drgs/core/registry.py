"""Registries of extensions: implementations by name, shipped ones and those of other packages.

A decorator registers a class or function, with the pydantic model of its configuration section::

    from drgs.training.density import STRATEGIES

    class Settings(Section):
        growth: float = 0.01

    @STRATEGIES.register("my_strategy", section=Settings)
    class MyStrategy(DensityStrategy): ...

Shipped implementations use it, too; their modules are imported when they are used. An installed
package has an entry point of the group ``drgs``, whose value is the module with the decorators. A
configuration names extensions, not modules, so that reading one runs no code.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import entry_points
from traceback import walk_tb
from typing import TYPE_CHECKING, Generic, TypeVar, cast

from typing_extensions import override

from drgs.core.errors import UserError, did_you_mean, one_line, root_cause

if TYPE_CHECKING:
    from pydantic import BaseModel

ENTRY_POINT_GROUP = "drgs"
HOW_TO_INSTALL = 'others come with installed packages that have an entry point of the group "drgs"'

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
        """Return an error that reports another with the name of the extension."""
        text = one_line(f"{type(cause).__name__}: {cause}")
        return ExtensionError(f'{self.kind} "{self.name}" ({self.module}): {text}')

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

    def __init__(self, kind: str, shipped: Mapping[str, str] | None = None) -> None:
        """kind: of the extensions, for messages; shipped: module of each shipped one, by name."""
        self.kind = kind
        self._shipped = dict(shipped or {})
        self._extensions: dict[str, Extension[T]] = {}
        _registries.append(self)

    def register(
        self, name: str, section: type[BaseModel] | None = None
    ) -> Callable[[Registered], Registered]:
        """Return a decorator that registers a class or function under ``name``.

        section: model of the section ``extensions.NAME`` of a configuration.

        Raises ValueError if another module has registered the name.
        """

        def decorate(value: Registered) -> Registered:
            module = getattr(value, "__module__", type(value).__module__)
            before = self._extensions.get(name)
            owner = self._shipped.get(name) if before is None else before.module
            if owner not in (None, module):
                raise ValueError(f'{self.kind} "{name}" is registered by {owner} already')
            others = (r for r in _registries if r is not self and name in r._extensions)
            if name not in self._shipped and (other := next(others, None)) is not None:
                raise ValueError(f'a {other.kind} is called "{name}" already: names are sections')
            self._extensions[name] = Extension(self.kind, name, cast(T, value), section, module)
            return value

        return decorate

    def __contains__(self, name: object) -> bool:
        return name in self._shipped or name in self._extensions or name in self.names()

    @property
    def shipped_names(self) -> list[str]:
        """The names of the extensions that drgs ships, in their order."""
        return list(self._shipped)

    def installed_extensions(self) -> list[Extension[T]]:
        """Return the extensions that drgs does not ship, by name."""
        _load_installed()
        return [e for name, e in sorted(self._extensions.items()) if name not in self._shipped]

    def names(self) -> list[str]:
        """Return the names of all extensions, shipped ones first."""
        return [*self._shipped, *(extension.name for extension in self.installed_extensions())]

    def get(self, name: str, place: str = "") -> Extension[T]:
        """Import and return the extension of this name.

        place: of the name, such as ``scenes/lego.yml: densify.strategy``, for the
        :class:`UserError` for an unknown name.
        """
        if name not in self._extensions and name in self._shipped:
            import_module(self._shipped[name])
        if name not in self:
            known = self.names()
            start = f"{place}: " if place else ""
            raise UserError(
                f'{start}no {self.kind} is called "{name}"{did_you_mean(name, known)}; there are '
                f"{', '.join(known) or 'none'} ({HOW_TO_INSTALL})"
            )
        return self._extensions[name]


Base = TypeVar("Base")


class ClassRegistry(Registry[type[Base]]):
    """A registry of classes, each of which has its name as the attribute ``kind``."""

    @override
    def register(
        self, name: str, section: type[BaseModel] | None = None
    ) -> Callable[[Registered], Registered]:
        decorate = super().register(name, section)

        def register_class(cls: Registered) -> Registered:
            cls.kind = name  # pyright: ignore[reportAttributeAccessIssue]
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
            now = registry._extensions
            shipped = {name: now[name] for name in registry._shipped.keys() & now.keys()}
            registry._extensions = {**shipped, **extensions}


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
        registered = {e.module: e for r in _registries for e in r._extensions.values()}
        cause: BaseException | None = error
        while cause is not None:
            for frame, _ in walk_tb(cause.__traceback__):
                extension = registered.get(frame.f_globals.get("__name__", ""))
                if extension is not None and not extension.is_shipped:
                    raise extension.error(root_cause(error)) from error
            cause = cause.__cause__ or cause.__context__
        raise


_loaded: set[str] = set()  # entry points whose modules have been imported


def _load_installed() -> None:
    """Import the modules of the entry points; :class:`ExtensionError` if that fails."""
    for point in entry_points(group=ENTRY_POINT_GROUP):
        if point.value in _loaded:
            continue
        try:
            point.load()
        except Exception as error:
            package = "" if point.dist is None else f" of the package {point.dist.name}"
            cause = one_line(f"{type(error).__name__}: {error}")
            raise ExtensionError(
                f'cannot load the extension "{point.name}"{package} ({point.value}): {cause}; '
                "repair or uninstall it"
            ) from error
        _loaded.add(point.value)
