"""Properties of scene descriptions, read and checked for the plugins.

Errors are :class:`drgs.core.errors.PluginError` with the names of plugin and property, the expected
and the given value; for a wrong type, ``PluginTypeError``.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.config.approximations import (
    DECLARED,
    Approximations,
    Declared,
    Limits,
    Value,
    from_ply_header,
)
from drgs.core.constants import MAX_INT, NEAR
from drgs.core.errors import PluginError, PluginTypeError, did_you_mean, note_user
from drgs.core.origin import WORLD, format_origin
from drgs.effects.compose import IGNORABLE
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.light.rays import TransportIntegrator
from drgs.integrator.state import (
    AOVS,
    LightSettings,
    SplatObject,
    SplatsState,
    check_shapes,
    feature_widths,
    parse_budget,
)

if TYPE_CHECKING:  # imported where the ``to_world`` of shapes is given
    from drgs.integrator.parts import ShRotation


def number(default: float) -> Declared:
    """Declare a number that is finite in single precision."""
    return Declared(float(default), limits=Limits("a finite number", gt=-math.inf, lt=math.inf))


def positive(default: float) -> Declared:
    """Declare a number that is positive and finite in single precision."""
    return Declared(float(default), limits=Limits("a positive number", gt=0, lt=math.inf))


def integer(default: int | None, least: int, most: int = MAX_INT) -> Declared:
    """Declare an integer from ``least`` to ``most``."""
    return Declared(default, limits=Limits(f"an integer from {least} to {most}", ge=least, le=most))


def one_of(*words: str) -> Declared:
    """Declare one of several words, the first of which is the default."""
    return Declared(words[0], choices=words)


@contextmanager
def _naming(props: mi.Properties) -> Iterator[None]:
    """Raise errors of values as those of the plugin."""
    try:
        yield
    except (TypeError, ValueError) as error:
        kind = PluginTypeError if isinstance(error, TypeError) else PluginError
        raise kind(f"{props.plugin_name()}: {error}") from None


def read(props: mi.Properties, declared: Mapping[str, Declared]) -> dict[str, Any]:
    """Return the values of declared properties, or their defaults."""
    with _naming(props):
        return {
            name: one.check(name, props[name]) if name in props else one.default
            for name, one in declared.items()
        }


def matrix(props: mi.Properties, name: str) -> np.ndarray:
    """Return the matrix of a transform, (4, 4) float64."""
    value: Any = props[name]
    if props.type(name) != mi.Properties.Type.Transform:
        raise PluginTypeError(
            f"{props.plugin_name()}: {name} must be a transform, got {type(value).__name__}"
        )
    return np.array(value.matrix, np.float64)


def refuse_unknown(props: mi.Properties, known: Sequence[str]) -> None:
    """Raise PluginError for a property that was not read: a mistyped name."""
    for name in props.unqueried():
        hint = did_you_mean(name, known) or f"; there are {', '.join(known)}"
        raise PluginError(f"{props.plugin_name()}: there is no parameter {name}{hint}")


SETTINGS = {
    "near": positive(NEAR),
    "hide_emitters": Declared(False),
    "srgb_primitives": Declared(True),
    "sh_degree": integer(None, 0, 3),
    "nested_spp": integer(0, least=0),
}
"""Settings of ``splats`` with single values, besides the approximations."""

LIGHT_SETTINGS = {
    "light": one_of("none", "probe", "rays"),
    "light_samples": integer(4, 0, 4096),
    "probe_fallback": one_of("none", "rays"),
    "radiance_scale": positive(1.0),
}
"""Settings of light between splats and surfaces."""

FORMER_NAMES = {"unseen": "probe_fallback", "exposure": "radiance_scale"}
"""Names that properties of ``splats`` had, which are still read."""

FEATURE = "feature_"  # prefix of the names of the user's own features
SHAPES_TO_WORLD = "shapes_to_world"  # prefix of properties with the ``to_world`` of shapes

OBJECT_PROPERTIES = ("filename", "to_world", "smoothing", *PARAMETER_NAMES)
"""Properties of a ``splats`` that is nested in another, besides :data:`FEATURE`."""

KNOWN = (
    *("filename", "to_world", SHAPES_TO_WORLD, "background", "probes", "shadows", "aovs"),
    *("ignore", "error", "smoothing", *SETTINGS, *LIGHT_SETTINGS, *DECLARED, *PARAMETER_NAMES),
)
"""Properties of ``splats``, besides nested objects and names with a prefix."""

UNNAMED = "_arg_"  # prefix of Mitsuba's names for nested objects without one


def read_state(
    props: mi.Properties, objects: Mapping[str, SplatObject], nested: list[mi.SamplingIntegrator]
) -> SplatsState:
    """Return the state of ``splats``; objects: nested ``splats``; nested: other integrators."""
    for former, name in FORMER_NAMES.items():
        if former in props and name not in props:
            props[name] = props[former]
    if len(nested) > 1:
        raise PluginError(
            f"splats: at most one integrator can be nested besides splats, got {len(nested)}"
        )
    gaussians, file = load_gaussians(props), str(props.get("filename", ""))
    values = {n: v for n, v in (gaussians.rendered_with or {}).items() if n not in props}
    own_header, to_world = from_ply_header(file, values), mi.AffineTransform4f()
    if "to_world" in props:
        to_world = mi.AffineTransform4f(matrix(props, "to_world").astype(np.float32))
    own = SplatObject(gaussians, to_world, "to_world" in props, file, own_header)
    if own.is_moved:
        own.check_to_world()
    every = {"": own} | {f"{name}.": one for name, one in objects.items()}
    header = _merge_headers(props, {one.file: one.header for one in every.values() if one.file})
    with _naming(props):
        given = {name: props[name] for name in DECLARED if name in props}
        approximations = Approximations(**{**header, **given})
    settings = read(props, SETTINGS)
    ignore, probes, shadows = (_words(props, name) for name in ("ignore", "probes", "shadows"))
    state = SplatsState(
        own=own,
        nested_objects=dict(objects),
        sh_rotations=_sh_rotations(props),
        background=_background(props),
        nested=next(iter(nested), None),
        default_degree=max(one.gaussians.sh_degree for one in every.values()),
        given_degree=settings.pop("sh_degree"),
        given_approximations=approximations,
        header=header,
        aovs=_aovs(props, [*AOVS, *feature_widths(every)]),
        given_error=parse_budget(props.get("error")),
        ignore=ignore,
        lighting=LightSettings(**read(props, LIGHT_SETTINGS), probes=probes, shadows=shadows),
        **settings,
    )
    _check_settings(state)
    refuse_unknown(props, KNOWN)
    state.check_columns()
    return state


def _check_settings(state: SplatsState) -> None:
    light, nested = state.lighting.light, state.nested
    if light != "none" and nested is not None and not isinstance(nested, TransportIntegrator):
        raise PluginError(
            f"splats: with light '{light}', the nested integrator must be splatpath, got "
            f"{nested.class_name()}; it takes max_depth, rr_depth and hide_emitters as path does"
        )
    if light == "probe" and not state.lighting.probes:
        raise PluginError(
            "splats: with light 'probe', probes must be ids of shapes and emitters, got none"
        )
    for word in state.ignore:
        if word not in IGNORABLE:
            raise PluginError(
                f"splats: ignore must be a list of {', '.join(IGNORABLE)}, got {word!r}"
            )


def _words(props: mi.Properties, name: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in str(props.get(name, "")).split(",") if part.strip())


def load_gaussians(props: mi.Properties) -> Gaussians:
    """Return the Gaussians of a file or of tensors, or none."""
    given = [name for name in (*PARAMETER_NAMES, "smoothing") if name in props]
    features = {n: _tensor(props, n) for n in props.keys() if n.startswith(FEATURE)}  # noqa: SIM118
    if "filename" in props:
        if given:
            raise PluginError(
                f"splats: give either 'filename' or tensors, got both ({', '.join(given)})"
            )
        resolver = mi.file_resolver()  # pyright: ignore[reportCallIssue]  has no type in the stub
        path = resolver.resolve(str(props["filename"]))
        gaussians = Gaussians.load(str(path))
        if gaussians.origin != WORLD:  # float32 requires positions relative to it
            note_user(
                f"{path}: positions are relative to {format_origin(gaussians.origin)}; place "
                "sensors and shapes relative to that"
            )
        gaussians = replace(gaussians.to(mi.TensorXf), origin=WORLD, features=features)
    elif given or features or "to_world" in props:
        gaussians = replace(_gaussians_of_tensors(props, given), features=features)
    else:
        shapes = [(0, 3), (0, 4), (0, 3), (0,), (0, 1, 3), (0, 0, 3)]
        means, quats, log_scales, logits, sh0, shN = (np.zeros(s, np.float32) for s in shapes)
        return Gaussians(means, quats, log_scales, logits, sh0, shN).to(mi.TensorXf)
    check_shapes(gaussians)
    return gaussians


def _gaussians_of_tensors(props: mi.Properties, given: Sequence[str]) -> Gaussians:
    missing = [name for name in PARAMETER_NAMES if name not in given and name != "shN"]
    if missing:
        raise PluginError(
            "splats: give 'filename', or the Gaussians as tensors "
            f"{', '.join(PARAMETER_NAMES)}; missing: {', '.join(missing)}"
        )
    values: dict[str, Any] = {name: _tensor(props, name) for name in given}
    if "shN" not in given:
        values["shN"] = dr.zeros(mi.TensorXf, (next(iter(values["means"].shape), 0), 0, 3))
    for name in {"logit_opacities", "smoothing"} & set(given):
        shape = values[name].shape
        if math.prod(shape[1:]) != 1:
            raise PluginError(f"splats: {name} must have the shape (N), got {tuple(shape)}")
        values[name] = mi.Float(values[name].array)
    return Gaussians(**values)


def _tensor(props: mi.Properties, name: str) -> mi.TensorXf:
    """Return a copy of a tensor: parameters are assigned in place."""
    value: Any = props[name]
    if not dr.is_array_v(value):
        raise PluginTypeError(f"splats: {name} must be a tensor, got {type(value).__name__}")
    if not dr.is_jit_v(value):  # on the host, as three numbers are
        value = np.array(value, np.float32)
    return mi.TensorXf(value)


def _sh_rotations(props: mi.Properties) -> dict[str, ShRotation]:
    """Return rotations of spherical harmonics by ids of shapes; "": all other shapes."""
    names = [name for name in props.keys() if name.startswith(SHAPES_TO_WORLD)]  # noqa: SIM118
    if not names:
        return {}
    from drgs.gaussians.similarity import Similarity
    from drgs.integrator.parts import ShRotation

    places = {n: Similarity.from_matrix(matrix(props, n), f"splats: {n}") for n in names}
    return {
        name.removeprefix(SHAPES_TO_WORLD).removeprefix("_"): ShRotation.from_rotation(one.rotation)
        for name, one in places.items()
    }


def _background(props: mi.Properties) -> mi.Color3f | mi.Texture:
    """Return a colour in display space, or a texture."""
    value = props.get("background", 0.0)
    if isinstance(value, mi.Texture):
        return value
    try:
        if isinstance(value, str):  # nanobind would print a warning besides its error
            raise TypeError
        color = mi.Color3f(value)
    except TypeError:
        raise PluginTypeError(
            "splats: background must be an RGB colour, such as [1, 1, 1] or "
            f"<rgb value='1, 1, 1'/>, or a texture, got {type(value).__name__}"
        ) from None
    if not np.isfinite(np.array(dr.detach(color))).all():
        raise PluginError(f"splats: background must be finite numbers, got {value}")
    return color


def _aovs(props: mi.Properties, kinds: Sequence[str]) -> dict[str, str]:
    aovs = {}
    for item in _words(props, "aovs"):
        name, _, kind = (part.strip() for part in item.partition(":"))
        if not name or kind not in kinds or name in aovs:
            raise PluginError(
                f"splats: aovs must be a list of name:type with names of their own and types of "
                f"{', '.join(kinds)}, got {item!r}"
            )
        aovs[name] = kind
    return aovs


def _merge_headers(
    props: mi.Properties, files: Mapping[str, Mapping[str, Value]]
) -> dict[str, Value]:
    """Return approximations that headers set, not properties; PluginError where files differ."""
    made_with = {file: Approximations.from_values(header) for file, header in files.items()}
    names = [name for name in DECLARED if name not in props]
    for name in names:
        values = {file: getattr(made, name) for file, made in made_with.items()}
        if len(set(values.values())) > 1:
            words = ", ".join(f"{value} ({file})" for file, value in values.items())
            raise PluginError(
                f"splats: files that are rendered together must be made for the same {name}, got "
                f"{words}; give the integrator {name}, which then holds for all"
            )
    return {name: one[name] for one in files.values() for name in names if name in one}


def nested_integrators(props: mi.Properties) -> dict[str, mi.SamplingIntegrator]:
    """Return nested integrators by name: their key, or in XML the id where no name is given."""
    # Read objects alone: a mistyped name that was read would not be refused.
    is_object = mi.Properties.Type.Object
    names = [name for name in props.keys() if props.type(name) == is_object]  # noqa: SIM118
    nested = {}
    for name in names:
        value = props[name]
        if name == "background":
            continue
        assert isinstance(value, mi.Object), "as the type of the property tells"
        if not isinstance(value, mi.Integrator):
            raise PluginError(
                f"splats: {name} must be an integrator, the only object besides the texture "
                f"background, got {value.class_name()}{did_you_mean(name, ['background'])}"
            )
        nested[(value.id() or name) if name.startswith(UNNAMED) else name] = value
    return nested


def check_object(name: str, given: Sequence[str]) -> None:
    """Raise PluginError for properties that a nested ``splats`` must not have."""
    others = [n for n in given if n not in OBJECT_PROPERTIES and not n.startswith(FEATURE)]
    if others or not given:
        got = f"{others[0]}, which holds for all: give it to the outer one" if others else "nothing"
        raise PluginError(
            f"splats: {name} is nested in another splats integrator, and must be given Gaussians "
            f"by {', '.join(OBJECT_PROPERTIES)} and {FEATURE}... alone, got {got}"
        )
