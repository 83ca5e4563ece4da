"""The approximations that a picture is made with, declared once.

Whoever lists them asks :data:`DECLARED`, which reads the annotations of :class:`Approximations`:
the section ``model`` of a configuration (``drgs.config.schema``), the properties of the plugin
``splats`` (``drgs.integrator.properties``) and the test of that plugin's documentation.
``drgs.accuracy.pipeline`` turns :class:`Approximations` into what renders.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Annotated, Literal, get_args, get_type_hints

import numpy as np

from drgs.core.class_registry import ClassRegistry
from drgs.core.constants import ALPHA_CUT, ALPHA_MAX, LOW_PASS, TRANSMITTANCE_STOP
from drgs.core.errors import UserError, UserNote, did_you_mean, listed, one_line
from drgs.core.registry import ENTRY_POINT_GROUP

Value = bool | int | float | str


@dataclass(frozen=True)
class Limits:
    """The numbers that a value may be; None: no such limit."""

    words: str  # what messages call them
    gt: float | None = None
    ge: float | None = None
    lt: float | None = None
    le: float | None = None
    or_infinite: bool = False  # whether infinity may be beyond ``le``

    def hold_for(self, value: float) -> bool:
        """Whether they do in single precision, in which kernels compute; they never do for NaN."""
        if self.or_infinite and value == math.inf:
            return True
        with np.errstate(over="ignore"):
            value = float(np.float32(value))
        return (
            (self.gt is None or value > self.gt)
            and (self.ge is None or value >= self.ge)
            and (self.lt is None or value < self.lt)
            and (self.le is None or value <= self.le)
            and not math.isnan(value)
        )

    @property
    def finite(self) -> dict[str, float]:
        """By name, those that are given and finite."""
        given = {name: getattr(self, name) for name in ("gt", "ge", "lt", "le")}
        return {k: v for k, v in given.items() if v is not None and math.isfinite(v)}


@dataclass(frozen=True)
class Unrounded:
    """What a configuration writes for a default that is rounded to single precision."""

    value: float


PROJECTIONS = ClassRegistry(
    "projection",
    {
        "ewa": "drgs.splatting.projection",
        "unscented": "drgs.accuracy.unscented",
        "exact": "drgs.accuracy.exact",
    },
)
"""Classes derived from ``drgs.splatting.projection.ProjectionModel``."""

FALLOFFS = ClassRegistry("falloff", {"gaussian": "drgs.splatting.footprint"})
"""Classes derived from ``drgs.splatting.footprint.GaussianFalloff``."""

ORDERS = ClassRegistry(
    "order", {"center": "drgs.splatting.rendering", "pixel": "drgs.accuracy.pixel_order"}
)
"""Classes derived from ``drgs.splatting.rendering.CenterOrder``."""


@dataclass(frozen=True)
class Approximations:
    """The approximations that a picture is made with; the defaults are those of 3DGS.

    What each one means is beside it, and in the section ``model`` of a configuration.

    Raises ValueError for a value that is outside of its limits.
    """

    projection: Annotated[
        str,
        PROJECTIONS,
        "How a Gaussian comes to the film. ewa: by the affine approximation at its mean; "
        "unscented: by the mean and covariance of projected sigma points; exact: by its peak along "
        "each pixel's ray.",
    ] = "ewa"
    falloff: Annotated[
        str,
        FALLOFFS,
        "How alpha falls off around a splat. gaussian: as the projected Gaussian does.",
    ] = "gaussian"
    order: Annotated[
        str,
        ORDERS,
        "In which splats are composited. center: by the depth of their means; pixel: by that of "
        "their peaks along each pixel's ray.",
    ] = "center"
    order_window: Annotated[
        int,
        "Splats that a pixel keeps waiting to put them in order, where order is pixel.",
        Limits("from 1 to 64", ge=1, le=64),
    ] = 4
    sh_direction: Annotated[
        Literal["mean", "pixel"],
        "In which colours are seen. mean: towards the mean of a Gaussian; pixel: along each "
        "pixel's ray.",
    ] = "mean"
    alpha_max: Annotated[
        float,
        "Upper clamp of a splat's alpha.",
        Limits("above 0 and below 1 in float32", gt=0, lt=1),
        Unrounded(0.99),
    ] = ALPHA_MAX
    alpha_cut: Annotated[
        float,
        "Splats end where their alpha is smaller; 0: they do not.",
        Limits("from 0 to below 1", ge=0, lt=1),
        Unrounded(1 / 255),
    ] = ALPHA_CUT
    transmittance_stop: Annotated[
        float,
        "A pixel ends before its transmittance is smaller; 0: never.",
        Limits("from 0 to below 1", ge=0, lt=1),
    ] = TRANSMITTANCE_STOP
    extent: Annotated[
        float,
        "Standard deviations at which splats end.",
        Limits("above 0, and at most 1e9 or infinite", gt=0, le=1e9, or_infinite=True),
    ] = math.inf
    low_pass: Annotated[
        float,
        "Variance that is added to each splat on the film, in square pixels; 0: none.",
        Limits("finite and not negative", ge=0, lt=math.inf),
    ] = LOW_PASS
    antialiased: Annotated[
        bool,
        "Compensate opacities for the low-pass filter, so that it keeps each splat's integral "
        "(Mip-Splatting, Yu et al. 2024).",
    ] = False

    def __post_init__(self) -> None:
        """Check all values."""
        for name, declared in DECLARED.items():
            value = getattr(self, name)
            if not declared.allows(value):
                raise ValueError(f"{name} must be {declared.expected}, got {value!r}")

    @staticmethod
    def of(values: Mapping[str, Value | None]) -> Approximations:
        """Those among ``values``; None, and a default that is not rounded, are the default."""
        given = {name: value for name, value in values.items() if name in DECLARED}
        return Approximations(
            **{k: v for k, v in given.items() if v not in (None, DECLARED[k].unrounded)}
        )

    @property
    def others_than_default(self) -> dict[str, Value]:
        """By name, the values that are not the default."""
        values = {name: getattr(self, name) for name in DECLARED}
        return {name: value for name, value in values.items() if value != DECLARED[name].default}

    @property
    def are_usual(self) -> bool:
        """Whether viewers of 3DGS files render with the same."""
        return not self.others_than_default


@dataclass(frozen=True)
class Declared:
    """What is said of one approximation."""

    kind: type  # bool, int, float or str
    default: Value
    description: str
    given_words: tuple[str, ...] = ()  # of a str: those that it may be
    registry: ClassRegistry | None = None  # of a str: whose names it may be
    limits: Limits | None = None  # of a number
    unrounded: float | None = None  # the default, where configurations write another number

    @property
    def words(self) -> tuple[str, ...]:
        """The texts that a value may be, those of installed packages included."""
        return self.given_words if self.registry is None else self.registry.words()

    @property
    def expected(self) -> str:
        """What messages ask for, behind "must be"."""
        if self.limits is not None:
            return self.limits.words
        others = f' or of a package with an entry point of the group "{ENTRY_POINT_GROUP}"'
        others = others if self.registry else ""
        return f"one of {', '.join(self.words)}{others}" if self.words else "true or false"

    def allows(self, value: Value) -> bool:
        """Whether a value of this kind is within the limits."""
        if self.limits is not None:
            return self.limits.hold_for(value)
        if self.registry is not None:
            return value in self.registry
        return not self.words or value in self.words


def said_by(where: str, values: Mapping[str, Value]) -> dict[str, Value]:
    """The approximations among ``values`` that a file gives by name, each of its declared type.

    where: the file, for messages. A name that is not known, of a later version perhaps, is noted
    and left out.

    Raises :class:`UserError` for a value of another type or outside of its limits.
    """
    unknown = [name for name in values if name not in DECLARED]
    if unknown:
        hint = did_you_mean(unknown[0], DECLARED)
        note = f"{where}: says {listed(unknown)}, which is not known here and makes no difference"
        warnings.warn(UserNote(note + hint), stacklevel=2)
    found: dict[str, Value] = {}
    for name in (name for name in DECLARED if name in values):
        declared, value = DECLARED[name], values[name]
        if declared.kind is float and type(value) is int:
            value = float(value)
        if type(value) is not declared.kind or not declared.allows(value):
            raise UserError(
                f"{where}: the header's {name} must be {declared.expected}, got "
                f"{one_line(value, 60)}; correct the line, or remove it"
            )
        found[name] = value
    return found


def _declared() -> dict[str, Declared]:
    """Read the annotations."""
    hints, result = get_type_hints(Approximations, include_extras=True), {}
    for field in fields(Approximations):
        kind, *extras = get_args(hints[field.name])
        words = get_args(kind)
        found = {type(extra): extra for extra in extras}
        unrounded = found.get(Unrounded)
        result[field.name] = Declared(
            kind=str if words else kind,
            default=field.default,
            description=found[str],
            given_words=words,
            registry=found.get(ClassRegistry),
            limits=found.get(Limits),
            unrounded=None if unrounded is None else unrounded.value,
        )
    return result


DECLARED = _declared()
"""All approximations by name, in the order in which they are listed."""
