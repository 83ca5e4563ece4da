"""Parts of a fit that are given as objects, and checks of what extensions return."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeVar

import drjit as dr
import numpy as np

from drgs.core.errors import UserError
from drgs.core.registry import ExtensionError, abstract_methods
from drgs.core.types import Float, TensorXf

if TYPE_CHECKING:
    from drgs.effects.base import TrainingEffect
    from drgs.training.density.strategy import DensityReport, DensityStrategy
    from drgs.training.losses import Loss, LossTerm

T = TypeVar("T")


@dataclass(frozen=True)
class GivenParts:
    """Objects that take part in a fit; those of the configuration do where None is given."""

    strategy: DensityStrategy | None = None  # instead of the configured one
    effects: Sequence[TrainingEffect] = ()  # besides the configured ones
    loss: Loss | None = None  # instead of the configured one
    terms: Sequence[LossTerm] = ()  # besides the configured ones

    def __post_init__(self) -> None:
        """Raise :class:`UserError` for classes in place of objects, and for missing methods."""
        for name, given in vars(self).items():
            is_list = name in ("effects", "terms")
            parts = list(given) if isinstance(given, (list, tuple)) else [given]
            if is_list != isinstance(given, (list, tuple)):
                expected = "a list of objects" if is_list else "one object"
                raise UserError(f"{name} must be {expected}, got {type(given).__name__}")
            for part in parts:
                if isinstance(part, (type, str)):
                    raise UserError(f"{name} must be an object, got {part}; call the class")
                if missing := abstract_methods(type(part)):
                    raise UserError(f"{name}: {type(part).__name__} must define {missing[0]}")

    def __bool__(self) -> bool:
        return self != GivenParts()


NO_PARTS = GivenParts()


def wrong_return(part: object, method: str, expected: str, got: object) -> ExtensionError:
    """Return the error for a method of an extension that returns something else."""
    described = type(got).__name__
    if isinstance(got, (bool, int, float, type(None))):
        described = repr(got)
    elif (shape := getattr(got, "shape", None)) is not None:
        described += f" of shape {tuple(shape)}"
    cls = type(part)
    return ExtensionError(
        f"{cls.__module__}.{cls.__qualname__}.{method}() must return {expected}, got {described}"
    )


def checked_number(part: object, method: str, value: T, is_attached: bool = False) -> T:
    """Return a term of a loss, a Float of one value; is_attached: it must have derivatives."""
    shape = value.shape if isinstance(value, dr.ArrayBase) and dr.is_float_v(value) else (0,)
    if math.prod(shape) != 1:
        raise wrong_return(part, method, "a Float of one value", value)
    if is_attached and not dr.grad_enabled(value):
        expected = "a loss that depends on the image (Float of one value, with derivatives)"
        raise wrong_return(part, method, f"{expected}, not a detached one", value)
    return value


def checked_terms(part: object, method: str, terms: Iterable[Float | None]) -> list[Float]:
    """Return terms of a loss, without those that are None."""
    return [checked_number(part, method, term) for term in terms if term is not None]


def checked_image(part: object, method: str, image: T, like: TensorXf | np.ndarray) -> T:
    """Return an image, which must have the size of another, and at most as many channels."""
    shape, got = tuple(like.shape), tuple(getattr(image, "shape", ()))
    if len(got) != 3 or got[:2] != shape[:2] or not 3 <= got[2] <= shape[2]:
        raise wrong_return(part, method, f"an image of shape {shape}", image)
    return image


def checked_report(
    part: DensityStrategy, report: DensityReport | None, num_rows: int | None = None
) -> DensityReport | None:
    """Return a strategy's report, which must be one of the number of rows, or None."""
    if report is not None:
        count = getattr(report, "num_gaussians", None)
        if count is None or count != (count if num_rows is None else num_rows):
            expected = "None or a DensityReport"
            expected += "" if num_rows is None else f" of {num_rows:,} Gaussians, not of {count}"
            raise wrong_return(part, "refine", expected, report)
    return report
