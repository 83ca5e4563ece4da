"""The approximations of an image, declared once.

:data:`DECLARED` lists them for the section ``model`` of a configuration (``drgs.config.schema``)
and the properties of the plugin ``splats`` (``drgs.integrator.properties``).
``drgs.accuracy.pipeline`` implements :class:`Approximations`.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, fields
from numbers import Real
from typing import Any, TypeVar

import numpy as np

from drgs.core.constants import ALPHA_CUT, ALPHA_MAX, LOW_PASS, TRANSMITTANCE_STOP
from drgs.core.errors import UserError, did_you_mean, format_names, note_user, one_line
from drgs.core.registry import HOW_TO_INSTALL, ClassRegistry

Value = bool | int | float | str


@dataclass(frozen=True)
class Limits:
    """Limits of a number; None: no such limit."""

    words: str  # for messages
    gt: float | None = None
    ge: float | None = None
    lt: float | None = None
    le: float | None = None
    or_infinite: bool = False  # whether infinity is allowed beyond ``le``

    def allow(self, value: float) -> bool:
        """Return whether ``value``, in single precision as in kernels, is allowed; NaN never is."""
        if self.or_infinite and value == math.inf:
            return True
        if isinstance(value, float):
            with np.errstate(over="ignore"):
                value = float(np.float32(value))
        return all(getattr(operator, k)(value, limit) for k, limit in self._limits.items())

    @property
    def finite(self) -> dict[str, float]:
        """The finite limits by name."""
        return {name: limit for name, limit in self._limits.items() if math.isfinite(limit)}

    @property
    def _limits(self) -> dict[str, float]:
        limits = {name: getattr(self, name) for name in ("gt", "ge", "lt", "le")}
        return {name: limit for name, limit in limits.items() if limit is not None}


PROJECTIONS = ClassRegistry("projection", "drgs.projections")
"""Subclasses of ``drgs.splatting.projection.ProjectionModel``."""

FALLOFFS = ClassRegistry("falloff", "drgs.falloffs")
"""Subclasses of ``drgs.splatting.footprint.GaussianFalloff``."""

ORDERS = ClassRegistry("order", "drgs.orders")
"""Subclasses of ``drgs.splatting.order.CenterOrder``."""


@dataclass(frozen=True)
class Declared:
    """The declaration of a setting with one value: its type, default and allowed values."""

    default: Value | None  # None: that of an integer depends on the scene
    description: str = ""
    choices: tuple[str, ...] = ()  # of a str: those that it may be
    registry: ClassRegistry | None = None  # of a str: whose names it may be
    limits: Limits | None = None  # of a number
    decimal: float | None = None  # in configurations, of a default rounded to single precision

    @property
    def kind(self) -> type:
        """The type of values: bool, int, float or str."""
        return int if self.default is None else type(self.default)

    @property
    def words(self) -> tuple[str, ...]:
        """The texts that a value may be, including names of installed extensions."""
        return self.choices if self.registry is None else tuple(self.registry.names())

    @property
    def expected_values(self) -> str:
        """The allowed values, for messages after "must be"."""
        if self.limits is not None:
            return self.limits.words
        others = f" ({HOW_TO_INSTALL})" if self.registry else ""
        return f"one of {', '.join(self.words)}{others}" if self.words else "true or false"

    def allows(self, value: Value) -> bool:
        """Return whether a value of this kind is within the limits."""
        if self.limits is not None:
            return not isinstance(value, str) and self.limits.allow(value)
        if self.registry is not None:
            return value in self.registry
        return not self.words or value in self.words

    def convert(self, value: Any) -> Any:
        """Return a number of this kind, and all else unchanged."""
        is_number = isinstance(value, Real) and not isinstance(value, bool)
        return float(value) if self.kind is float and is_number else value

    def check(self, name: str, value: Any) -> Any:
        """Return a value of this kind.

        Raises TypeError for another type and ValueError outside of the limits, with the name.
        """
        value = self.convert(value)
        if type(value) is not self.kind:
            raise TypeError(f"{name} must be {self.expected_values}, got {value!r}")
        if not self.allows(value):
            hint = did_you_mean(str(value), self.words)
            raise ValueError(f"{name} must be {self.expected_values}, got {value!r}{hint}")
        return value


Default = TypeVar("Default", bool, int, float, str)


def _declare(default: Default, description: str, **rules: Any) -> Default:
    return field(default=default, metadata={"declared": Declared(default, description, **rules)})


@dataclass(frozen=True)
class Approximations:
    """The approximations of an image, by default those of 3DGS; :data:`DECLARED` describes each.

    Raises TypeError for a value of another type, and ValueError outside of its limits.
    """

    projection: str = _declare(
        "ewa",
        "Projection of a Gaussian. ewa: affine approximation at its mean; unscented: mean and "
        "covariance of projected sigma points; exact: its peak along each pixel's ray.",
        registry=PROJECTIONS,
    )
    falloff: str = _declare(
        "gaussian",
        "Falloff of alpha around a splat. gaussian: the projected Gaussian's.",
        registry=FALLOFFS,
    )
    order: str = _declare(
        "center",
        "Order of compositing. center: depth of the means; pixel: depth of the peaks along each "
        "pixel's ray.",
        registry=ORDERS,
    )
    order_window: int = _declare(
        4,
        "Number of splats that a pixel buffers to sort them, if order is pixel.",
        limits=Limits("from 1 to 64", ge=1, le=64),
    )
    sh_direction: str = _declare(
        "mean",
        "Direction of colours. mean: towards a Gaussian's mean; pixel: along each pixel's ray.",
        choices=("mean", "pixel"),
    )
    alpha_max: float = _declare(
        ALPHA_MAX,
        "Upper clamp of a splat's alpha.",
        limits=Limits("above 0 and below 1 in float32", gt=0, lt=1),
        decimal=0.99,
    )
    alpha_cut: float = _declare(
        ALPHA_CUT,
        "Minimum alpha, which bounds the extent of splats; 0: unbounded.",
        limits=Limits("from 0 to below 1", ge=0, lt=1),
        decimal=1 / 255,
    )
    transmittance_stop: float = _declare(
        TRANSMITTANCE_STOP,
        "Minimum transmittance of a pixel, at which compositing stops; 0: never.",
        limits=Limits("from 0 to below 1", ge=0, lt=1),
    )
    extent: float = _declare(
        math.inf,
        "Extent of splats, in standard deviations.",
        limits=Limits("above 0, and at most 1e9 or infinite", gt=0, le=1e9, or_infinite=True),
    )
    low_pass: float = _declare(
        LOW_PASS,
        "Variance added to the image-space covariance of each splat, px²; 0: none.",
        limits=Limits("finite and not negative", ge=0, lt=math.inf),
    )
    antialiased: bool = _declare(
        False,
        "Compensate opacities for the low-pass filter, so that it keeps each splat's integral "
        "(Mip-Splatting, Yu et al. 2024).",
    )

    def __post_init__(self) -> None:
        for name, declared in DECLARED.items():
            value = declared.check(name, getattr(self, name))
            value = declared.default if value == declared.decimal else value
            object.__setattr__(self, name, value)

    @staticmethod
    def from_values(values: Mapping[str, Value | None]) -> Approximations:
        """Return those among ``values``; None gives the default."""
        given: dict[str, Any] = {k: v for k, v in values.items() if k in DECLARED and v is not None}
        return Approximations(**given)

    @property
    def non_default(self) -> dict[str, Value]:
        """The values that differ from the default, by name."""
        values = {name: getattr(self, name) for name in DECLARED}
        return {name: value for name, value in values.items() if value != DECLARED[name].default}

    @property
    def is_default(self) -> bool:
        """True if all values are those of 3DGS."""
        return not self.non_default


DECLARED: dict[str, Declared] = {f.name: f.metadata["declared"] for f in fields(Approximations)}


def from_ply_header(where: str, values: Mapping[str, Value]) -> dict[str, Value]:
    """Return the approximations among ``values`` of a file, each of its declared type.

    where: the file, for messages. Unknown names, as of a later version, give a :class:`UserNote`.

    Raises :class:`UserError` for a value of another type or outside of its limits.
    """
    unknown = [name for name in values if name not in DECLARED]
    if unknown:
        hint = did_you_mean(unknown[0], DECLARED)
        note = f"{where}: specifies {format_names(unknown)}, which is not known here and ignored"
        note_user(note + hint)
    known: dict[str, Value] = {}
    for name, declared in DECLARED.items():
        if name not in values:
            continue
        try:
            known[name] = declared.check(name, values[name])
        except (TypeError, ValueError):
            raise UserError(
                f"{where}: the header's {name} must be {declared.expected_values}, got "
                f"{one_line(declared.convert(values[name]), 60)}; correct the line, or remove it"
            ) from None
    return known


MIN_ERROR = 2e-5
"""Smallest error budget: errors of single precision, which the tests bound."""

ERROR_UNITS: dict[str, Callable[[float], float]] = {
    "dB": lambda psnr: 10 ** (-psnr / 20),
    "steps": lambda steps: steps / 255,
    "step": lambda steps: steps / 255,
    "": lambda error: error,
}


def parse_error(value: object) -> float:
    """Return an error budget in 0..1 from a number, "54 dB" (PSNR) or "0.5 steps" (of 8 bits).

    Raises ValueError for anything else, and for errors beyond the limits.
    """
    text = str(value).strip()
    unit = next(unit for unit in ERROR_UNITS if text.endswith(unit))
    error = math.nan
    with suppress(ValueError, OverflowError):
        error = ERROR_UNITS[unit](float(text.removesuffix(unit)))
    if MIN_ERROR <= error < 1:
        return error
    converted = f", which is {error:.2g}" if unit and not math.isnan(error) else ""
    raise ValueError(
        f"must be a number from {MIN_ERROR:f}, which single precision allows, to below 1, or as in "
        f'"54 dB" or "0.5 steps" (of 8 bits), got {one_line(text, 60) or "nothing"}{converted}'
    )
