"""Registries of classes that kernels call while Dr.Jit traces them: lenses and approximations."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from types import FunctionType
from typing import Any, TypeVar

from pydantic import BaseModel

from drgs.core.registry import Extension, Registry, load_installed

Class = TypeVar("Class", bound=type)


class ClassRegistry(Registry[Any]):
    """A registry of classes; what their methods raise is reported with the name of the class.

    A class learns the name under which it is registered: it is its attribute ``kind``.
    """

    def register(
        self, name: str, section: type[BaseModel] | None = None
    ) -> Callable[[Class], Class]:
        """Return a decorator that registers a class under ``name``; see :class:`Registry`."""
        decorate = super().register(name, section)

        def register_class(cls: Class) -> Class:
            decorate(cls)
            cls.kind = name
            if name not in self._shipped:
                _report_errors(cls, self._extensions[name])
            return cls

        return register_class

    def words(self) -> tuple[str, ...]:
        """Return all names, shipped ones first."""
        return (*self._shipped, *(extension.name for extension in self.installed()))

    def __contains__(self, name: object) -> bool:
        """Return whether there is a class of this name; installed packages are asked last."""
        if name not in self._shipped and name not in self._extensions:
            load_installed()
        return name in self._shipped or name in self._extensions


def _report_errors(cls: type, extension: Extension[Any]) -> None:
    """Wrap the methods that ``cls`` itself defines in :meth:`Extension.reporting`."""
    for name, method in list(vars(cls).items()):
        is_called = not name.startswith("__") or name in ("__call__", "__post_init__")
        if is_called and isinstance(method, FunctionType):
            setattr(cls, name, _reporting(method, extension))
        elif isinstance(method, staticmethod):
            setattr(cls, name, staticmethod(_reporting(method.__func__, extension)))


def _reporting(method: FunctionType, extension: Extension[Any]) -> Callable[..., Any]:
    @wraps(method)
    def call(*args: Any, **named: Any) -> Any:
        with extension.reporting():
            return method(*args, **named)

    return call
