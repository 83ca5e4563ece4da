"""Mutants of derivative code, made from its source and switched at run time.

A *site* is a place in a function's source where a partial derivative comes into being or is handed
over. ``instrumented.Instrumented`` executes a copy of a module's source in which the value at each
site passes through a switch: multiplied by a factor, or, for a condition, forced. The switches are
read from the device's memory, so that all mutants run in the same kernels and none is compiled on
its own (Untch et al. 1993, "Mutation analysis using mutant schemata"). Multiplication by a factor
of one is exact.

Sites are found by syntax, so that a partial derivative which is written tomorrow has its mutants:

- the right-hand side of an assignment and what is returned; each component where that is a
  vector, a tuple or a dataclass, while a list is one partial, evaluated at many pixels;
- each term of a sum, a difference or an ``fma`` (the whole is no site of its own);
- each element of a list, and each argument that is given by name or to ``append``;
- what is given to Dr.Jit as a gradient;
- each operand of the condition of a ``select``, and each comparison.

No sites are, since the value came into being elsewhere:

- names, attributes, subscripts and copies of lists;
- results of functions of this package, where they are assigned or returned: they are either
  instrumented themselves or belong to the forward pass, whose own tests compare its values.

Mutated are floating point arrays. Not so are integers and selections between integers, as they
address memory; and numbers of the host, as every product that they enter is a site.
"""

from __future__ import annotations

import ast
import dataclasses
import operator
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from types import GeneratorType
from typing import Any

import drjit as dr

SCALED, NEGATED = "x 1.01", "x -1"
ALWAYS, NEVER, AT_EQUALITY = "always", "never", "at equality"

_FACTORS = {SCALED: 1.01, NEGATED: -1.0, None: 1.0}

LITERAL_ZERO = "a constant zero stays zero: padding, the start of a sum"
EVALUATED_ONLY = "a result that is evaluated and not read"
UNNAMED = "a result that is assigned to _"
SAME_AT_EQUALITY = "where two numbers are equal, either may be selected"
NO_NUMBERS = "a function that returns no floating point numbers, hence no derivatives"

_COMPARISONS: dict[type, Callable] = {
    ast.Lt: operator.lt,
    ast.LtE: operator.le,
    ast.Gt: operator.gt,
    ast.GtE: operator.ge,
    ast.Eq: operator.eq,
    ast.NotEq: operator.ne,
}
_AT_EQUALITY = {ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt}
_HAND_OVERS = {"accum_grad", "set_grad", "set_grad_in", "set_grad_out"}


class _Switch:
    """The input of the kernels at one part of a site: a factor, or flags that force a condition."""

    def __init__(self) -> None:
        self.changes: list[str] = []
        self.change: str | None = None
        self.reached = False
        self._variables: dict[Any, Any] = {}

    def set(self, change: str | None) -> None:
        """Apply one change, or none."""
        assert change is None or change in self.changes
        if change != self.change:
            self.change = change
            self._variables.clear()

    def factor(self, flat_type: type) -> Any:
        """A variable of this switch alone: Dr.Jit would merge equal ones, and kernels differ."""
        if flat_type not in self._variables:
            self._variables[flat_type] = dr.opaque(flat_type, _FACTORS[self.change])
        return self._variables[flat_type]

    def flag(self, bool_type: type, change: str) -> Any:
        """Whether ``change`` is applied."""
        if change not in self._variables:
            self._variables[change] = dr.opaque(bool_type, self.change == change)
        return self._variables[change]


@dataclass(eq=False)
class Site:
    """A place in the source, and the switches of what has been evaluated there."""

    function: str  # module.name or module.class.name
    line: int
    text: str  # the source there
    parts: tuple[str, ...] = ()  # names of operands, or that the value is unpacked to
    comparison: type | None = None  # the operator, of a comparison
    reason: str = ""  # to leave out its values; of a comparison, the change at equality
    evaluated: bool = False
    switches: dict[str, _Switch] = field(default_factory=dict)  # by part
    left_out: dict[str, str] = field(default_factory=dict)  # part -> reason

    def switch(self, part: str, changes: tuple[str, ...]) -> _Switch:
        """The switch of one part, with at least the given changes."""
        switch = self.switches.get(part)
        if switch is None:
            switch = self.switches[part] = _Switch()
        if changes[0] not in switch.changes:
            switch.changes += changes
        switch.reached = True
        return switch


@dataclass(frozen=True)
class Mutant:
    """One change of one part of one site."""

    site: Site
    part: str  # a component of a value, an operand of a condition; "" for the whole
    change: str

    def __str__(self) -> str:
        site = self.site
        return f"{site.function}:{site.line}  {site.text}{self.part and f'  [{self.part}]'}"

    @property
    def switch(self) -> _Switch:
        return self.site.switches[self.part]


class Switchboard:
    """The functions that instrumented code calls; it knows the mutants of all evaluated code."""

    def __init__(self) -> None:
        self.sites: list[Site] = []
        self.applied: Mutant | None = None
        self._conditions: dict[int, tuple] = {}  # variable -> itself, comparisons it is made of
        self._returns_numbers: dict[str, bool] = {}  # by function

    @property
    def mutants(self) -> list[Mutant]:
        """In the order of the source."""
        return [
            Mutant(site, part, change)
            for site in self.sites
            if self._returns_numbers.get(site.function, True)
            for part, switch in site.switches.items()
            for change in switch.changes
        ]

    @property
    def left_out(self) -> list[tuple[Site, str, str]]:
        """(site, part, reason) of what was evaluated and has no mutant."""
        result = []
        for site in self.sites:
            reasons = {p: r for p, r in site.left_out.items() if p not in site.switches}
            if not self._returns_numbers.get(site.function, True):
                reasons |= dict.fromkeys(site.switches, NO_NUMBERS)
            result += [(site, part, reason) for part, reason in reasons.items()]
        return result

    def apply(self, mutant: Mutant | None) -> None:
        """Apply one mutant and no other, or none."""
        self._conditions.clear()
        if self.applied is not None:
            self.applied.switch.set(None)
        self.applied = mutant
        if mutant is not None:
            mutant.switch.set(mutant.change)

    def record(self, function: Callable[[], Any]) -> tuple[Any, set[_Switch]]:
        """Return the result of ``function``, and the switches that it reads."""
        before = self._take_reached()
        result = function()
        reached = self._take_reached()
        for switch in before | reached:
            switch.reached = True
        return result, reached

    def _take_reached(self) -> set[_Switch]:
        reached = {s for site in self.sites for s in site.switches.values() if s.reached}
        for switch in reached:
            switch.reached = False
        return reached

    # ------------------------------------------------------------------------------------------
    # Called by the instrumented code
    # ------------------------------------------------------------------------------------------

    def scale(self, index: int, value: Any) -> Any:
        """A value that is scaled, component by component."""
        site = self._evaluated(index)
        if isinstance(value, GeneratorType):
            value = tuple(value)
        return _scale(site, "", value, site.parts)

    def returned(self, function: str, value: Any) -> Any:
        """Return a function's result unchanged."""
        found = _has_float(value)
        self._returns_numbers[function] = self._returns_numbers.get(function, False) or found
        return value

    def add(self, left: int | None, right: int | None, a: Any, b: Any) -> Any:
        """A sum whose terms are scaled; None for a term that is a sum itself."""
        a, b = self._terms(left, right, a, b)
        return a + b

    def subtract(self, left: int | None, right: int | None, a: Any, b: Any) -> Any:
        """A difference whose terms are scaled."""
        a, b = self._terms(left, right, a, b)
        return a - b

    def _terms(self, left: int | None, right: int | None, a: Any, b: Any) -> tuple[Any, Any]:
        # A number beside an array is a term, too.
        if isinstance(a, (int, float)) and _is_float(b):
            a = _flat_type(type(b))(a)
        if isinstance(b, (int, float)) and _is_float(a):
            b = _flat_type(type(a))(b)
        a = a if left is None else _scale(self._evaluated(left), "", a)
        b = b if right is None else _scale(self._evaluated(right), "", b)
        return a, b

    def select(self, index: int, conditions: list[Any], a: Any, b: Any) -> Any:
        """A selection by the conjunction of ``conditions``: each is dropped, the whole forced."""
        site = self._evaluated(index)
        if _is_float(a) or _is_float(b):
            conditions = [self._at_equality(condition) for condition in conditions]
            if len(conditions) > 1:
                parts = zip(site.parts, conditions, strict=True)
                conditions = [_force(site, part, value, (ALWAYS,)) for part, value in parts]
        condition = _conjunction(conditions)
        if _is_float(a) or _is_float(b):
            condition = _force(site, "", condition, (ALWAYS, NEVER)[len(conditions) > 1 :])
        return dr.select(condition, a, b)

    def compare(self, index: int, a: Any, b: Any) -> Any:
        """A comparison: of numbers, forced, or decided the other way at equality.

        One of integers is only remembered: it is mutated where it selects between numbers.
        """
        site = self._evaluated(index)
        result = _COMPARISONS[site.comparison](a, b)
        if not dr.is_array_v(result):
            return result
        self._conditions[result.index] = result, [(result, site, a, b)]
        if not (_is_float(a) or _is_float(b)):
            return result
        return _force(site, "", self._at_equality(result), (ALWAYS, NEVER))

    def both(self, a: Any, b: Any) -> Any:
        """A conjunction, of comparisons that are remembered."""
        result = a & b
        if not (dr.is_array_v(a) and dr.is_array_v(b)):
            return result
        operands = [self._conditions.get(c.index, (c, [(c, None, None, None)])) for c in (a, b)]
        self._conditions[result.index] = result, [c for _, parts in operands for c in parts]
        return result

    def _at_equality(self, condition: Any) -> Any:
        """A condition; the comparisons that it is made of are mutated at equality."""
        _, parts = self._conditions.pop(condition.index, (None, []))
        mutated = [_mutated_at_equality(*part) for part in parts]
        return _conjunction(mutated) if mutated else condition

    def _evaluated(self, index: int) -> Site:
        site = self.sites[index]
        site.evaluated = True
        return site


def _mutated_at_equality(condition: Any, site: Site | None, a: Any, b: Any) -> Any:
    if site is None or site.comparison not in _AT_EQUALITY:
        return condition
    if site.reason:
        site.left_out[AT_EQUALITY] = site.reason
        return condition
    flag = site.switch("", (AT_EQUALITY,)).flag(type(condition), AT_EQUALITY)
    return dr.select(flag, _COMPARISONS[_AT_EQUALITY[site.comparison]](a, b), condition)


def _conjunction(conditions: list[Any]) -> Any:
    result = conditions[0]
    for condition in conditions[1:]:
        result = result & condition
    return result


def _scale(site: Site, part: str, value: Any, names: tuple[str, ...] = ()) -> Any:
    """``names``: of the components of ``value``, where it is unpacked."""
    if _is_float(value) and not _has_components(value):
        return _scale_array(site, part, value)
    if type(value) is list:
        return [_scale(site, part, element) for element in value]
    if type(value) is dict:
        return {key: _scale(site, part, element) for key, element in value.items()}
    if type(value) is tuple or _is_float(value):
        named = zip(_names(names, len(value)), value, strict=True)
        return type(value)([_scale(site, _join(part, name), v) for name, v in named])
    return _scale_fields(site, part, value) if dataclasses.is_dataclass(value) else value


def _scale_fields(site: Site, part: str, value: Any) -> Any:
    """Each field of a dataclass, and each element of a field that is a list."""
    fields = {}
    for name in (f.name for f in dataclasses.fields(value)):
        content, name_here = getattr(value, name), _join(part, name)
        if isinstance(content, list):
            content = [_scale(site, f"{name_here}[{k}]", v) for k, v in enumerate(content)]
        else:
            content = _scale(site, name_here, content)
        fields[name] = content
    return type(value)(**fields)


def _scale_array(site: Site, part: str, value: Any) -> Any:
    if dr.width(value) == 0:
        return value
    reason = site.reason or (UNNAMED if part == "_" else "")
    if not dr.is_tensor_v(value) and dr.depth_v(value) == 1 and value.state == dr.VarState.Literal:
        reason = LITERAL_ZERO if value[0] == 0 else reason
    if reason:
        site.left_out[part] = reason
        return value
    return value * site.switch(part, (SCALED, NEGATED)).factor(_flat_type(type(value)))


def _force(site: Site, part: str, condition: Any, changes: tuple[str, ...]) -> Any:
    switch = site.switch(part, changes)
    if ALWAYS in changes:
        condition = condition | switch.flag(type(condition), ALWAYS)
    if NEVER in changes:
        condition = condition & ~switch.flag(type(condition), NEVER)
    return condition


def _is_float(value: Any) -> bool:
    """Whether a value is an array of floating point numbers, of any shape."""
    return dr.is_array_v(value) and dr.is_float_v(value)


def _has_components(value: Any) -> bool:
    """Whether the parts of an array are values of their own: a vector, but no tensor."""
    is_tensor = dr.is_tensor_v(value)
    return not is_tensor and dr.depth_v(value) > 1 and dr.size_v(value) != dr.Dynamic


def _has_float(value: Any) -> bool:
    if isinstance(value, (list, tuple)):
        return any(map(_has_float, value))
    if dataclasses.is_dataclass(value):
        return any(_has_float(getattr(value, f.name)) for f in dataclasses.fields(value))
    return _is_float(value)


@cache
def _flat_type(cls: type) -> type:
    return dr.array_t(cls) if dr.is_tensor_v(cls) else dr.leaf_t(cls)


def _join(part: str, name: str) -> str:
    return f"{part}.{name}" if part else name


def _names(names: tuple[str, ...], count: int) -> list[str]:
    """Names for ``count`` components: those of the targets, of which one may be starred."""
    if not names:
        return [str(k) for k in range(count)]
    starred = [k for k, name in enumerate(names) if name.startswith("*")]
    if not starred:
        return list(names)
    k, rest = starred[0], count - len(names) + 1
    return [*names[:k], *(f"{names[k][1:]}[{i}]" for i in range(rest)), *names[k + 1 :]]
