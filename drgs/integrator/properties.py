"""Properties of scene descriptions, read and checked for the plugins.

The readers of single values serve both plugins, the others ``splats``. All raise
:class:`drgs.core.errors.PluginError` with the plugin's name, that of the property, what was
expected and what was given; where the type is wrong, its subclass ``PluginTypeError``.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.config.approximations import DECLARED, Approximations, Declared, Value, said_by
from drgs.core.constants import MAX_INT, NEAR
from drgs.core.errors import PluginError, PluginTypeError, UserNote, did_you_mean
from drgs.core.origin import WORLD, shown_origin
from drgs.effects.compose import IGNORABLE
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.integrator.checks import check_shapes, degree_of
from drgs.integrator.path_segment import passes_splats
from drgs.integrator.state import AOVS, SplatObject, SplatsState, feature_widths

if TYPE_CHECKING:  # imported where the ``to_world`` of shapes is given
    from drgs.integrator.gathering import Turn

FEATURE = "feature_"
"""What the names of parameters begin with that hold numbers of the user's own."""

SHAPES_TO_WORLD = "shapes_to_world"
"""What the names of parameters begin with that tell the ``to_world`` of shapes."""


KNOWN = (
    *("filename", "to_world", SHAPES_TO_WORLD, "sh_degree", "background", "hide_emitters", "near"),
    *("srgb_primitives", "nested_spp", "light", "light_samples", "probes", "shadows", "exposure"),
    *("unseen", "aovs", "ignore", "smoothing"),
    *DECLARED,
    *PARAMETER_NAMES,
)
"""Names of the properties of ``splats``, but for those that begin with :data:`FEATURE` or
:data:`SHAPES_TO_WORLD`, and nested objects."""


OF_OBJECTS = ("filename", "to_world", "smoothing", *PARAMETER_NAMES)
"""Names of the properties of a ``splats`` that is nested in another, but for :data:`FEATURE`."""

UNNAMED = "_arg_"
"""Prefix of the names that Mitsuba gives to nested objects without one."""

LIGHT_SAMPLES = 4
"""Splats that a ray of ``light: rays`` draws."""

MAX_LIGHT_SAMPLES = 4096
"""Limit of a pixel's samples, too. With 0, all splats that a ray passes are composited."""

LIGHTS = ("none", "probe", "rays")
"""How light passes between splats and surfaces."""

UNSEEN = ("none", "rays")
"""What probes do not see."""


def read_state(
    props: mi.Properties, objects: Mapping[str, SplatObject], nested: mi.Integrator | None
) -> SplatsState:
    """Return the state of ``splats``; objects: nested ones, nested: the integrator of surfaces."""
    gaussians = load_gaussians(props)
    file, header = str(props.get("filename", "")), header_of(props, gaussians)
    own = SplatObject(gaussians, to_world_of(props), "to_world" in props, file, header)
    if own.is_moved:
        own.check_to_world()
    features = feature_widths({"": own} | {f"{name}.": one for name, one in objects.items()})
    degrees = [one.gaussians.sh_degree for one in (own, *objects.values())]
    files = {one.file: one.header for one in (own, *objects.values()) if one.file}
    header, light = agreed(props, files), light_of(props, nested)
    state = SplatsState(
        own=own,
        nested_objects=dict(objects),
        has_own=gaussians.num_gaussians > 0,
        turns=turns_of_shapes(props),
        background=background_of(props),
        nested=nested,
        default_degree=max(degrees),
        given_degree=degree_of(props["sh_degree"]) if "sh_degree" in props else None,
        approximations=approximations_of(props, header),
        header=header,
        near=positive(props, "near", NEAR),
        aovs=aovs_of(props, [*AOVS, *features]),
        ignore=ignored_effects(props),
        hide_emitters=boolean(props, "hide_emitters", False),
        srgb_primitives=boolean(props, "srgb_primitives", True),
        nested_spp=integer(props, "nested_spp", 0, least=0),
        light=light,
        light_samples=integer(props, "light_samples", LIGHT_SAMPLES, 0, MAX_LIGHT_SAMPLES),
        probes=probes_of(props, light),
        unseen=one_of(props, "unseen", UNSEEN),
        shadows=ids_of(props, "shadows"),
        exposure=positive(props, "exposure", 1.0),
    )
    refuse_unknown(props, KNOWN)
    state.check_columns()
    return state


def light_of(props: mi.Properties, nested: mi.Integrator | None) -> str:
    """Return ``light``, one of :data:`LIGHTS`."""
    light = one_of(props, "light", LIGHTS)
    if light != LIGHTS[0] and nested is not None and not passes_splats(nested):
        raise PluginError(
            f"splats: with light '{light}', the nested integrator must be splatpath, got "
            f"{nested.class_name()}; it takes max_depth, rr_depth and hide_emitters as path does"
        )
    return light


def ids_of(props: mi.Properties, name: str) -> tuple[str, ...]:
    """Return a list of ids from a text with commas."""
    return tuple(part.strip() for part in props.get(name, "").split(",") if part.strip())


def probes_of(props: mi.Properties, light: str) -> tuple[str, ...]:
    """Ids of the objects that have a probe."""
    names = ids_of(props, "probes")
    if light == "probe" and not names:
        raise PluginError(
            "splats: with light 'probe', probes must be ids of shapes and emitters, got none"
        )
    return names


def refuse_unknown(props: mi.Properties, known: Sequence[str]) -> None:
    """Raise PluginError for a property that nobody has read: a mistyped name.

    Mitsuba would refuse it as well, without the name that was meant. Called when everything that
    is known has been read.
    """
    for name in props.unqueried():
        where = f"{props.plugin_name()}: there is no parameter {name}"
        hint = did_you_mean(name, known) or f"; there are {', '.join(known)}"
        raise PluginError(where + hint)


def load_gaussians(props: mi.Properties) -> Gaussians:
    """The Gaussians of a scene description: a PLY file, or six tensors; or none."""
    given = [name for name in PARAMETER_NAMES if name in props]
    given += ["smoothing"] if "smoothing" in props else []
    features = {n: _tensor(props, n) for n in props.keys() if n.startswith(FEATURE)}  # noqa: SIM118
    if "filename" in props:
        if given:
            raise PluginError(
                f"splats: give either 'filename' or tensors, got both ({', '.join(given)})"
            )
        path = mi.file_resolver().resolve(str(props["filename"]))
        gaussians = replace(_loaded(str(path)).to(mi.TensorXf), features=features)
    elif given or features or "to_world" in props:
        missing = [name for name in PARAMETER_NAMES if name not in given and name != "shN"]
        if missing:
            raise PluginError(
                "splats: give 'filename', or the Gaussians as tensors "
                f"{', '.join(PARAMETER_NAMES)}; missing: {', '.join(missing)}"
            )
        values = {name: _tensor(props, name) for name in given}
        if "shN" not in given:
            values["shN"] = dr.zeros(mi.TensorXf, (next(iter(values["means"].shape), 0), 0, 3))
        for name in ("logit_opacities", "smoothing"):
            if name in values:
                values[name] = _column(name, values[name])
        gaussians = Gaussians(**values, features=features)
    else:
        shapes = {"means": (0, 3), "quats": (0, 4), "log_scales": (0, 3)}
        shapes |= {"sh0": (0, 1, 3), "shN": (0, 0, 3)}
        tensors = {name: dr.zeros(mi.TensorXf, shape) for name, shape in shapes.items()}
        return Gaussians(**tensors, logit_opacities=mi.Float())
    check_shapes(gaussians)
    return gaussians


def _loaded(path: str) -> Gaussians:
    """The Gaussians of a file, in coordinates that Mitsuba's float32 can tell apart."""
    gaussians = Gaussians.load(path)
    if gaussians.origin != WORLD:
        note = (
            f"{path}: positions are relative to {shown_origin(gaussians.origin)}; place sensors "
            "and shapes relative to that"
        )
        warnings.warn(UserNote(note), stacklevel=2)
    return replace(gaussians, origin=WORLD)


def to_world_of(props: mi.Properties) -> mi.AffineTransform4f:
    """The transform that places Gaussians in the scene; the identity where none is given."""
    if "to_world" not in props:
        return mi.AffineTransform4f()
    return mi.AffineTransform4f(matrix(props, "to_world").astype(np.float32))


def turns_of_shapes(props: mi.Properties) -> dict[str, Turn]:
    """Return rotations of spherical harmonics by ids of shapes, and under "" for all others."""
    names = [name for name in props.keys() if name.startswith(SHAPES_TO_WORLD)]  # noqa: SIM118
    if not names:
        return {}
    from drgs.gaussians.similarity import Similarity
    from drgs.integrator.gathering import Turn

    turns = {}
    for name in names:
        shape = name.removeprefix(SHAPES_TO_WORLD).removeprefix("_")
        turns[shape] = Turn.by(Similarity.of(matrix(props, name), f"splats: {name}").rotation)
    return turns


def background_of(props: mi.Properties) -> mi.Color3f | mi.Texture:
    """A colour in display space, or a texture."""
    value = props.get("background", 0.0)
    if isinstance(value, mi.Texture):
        return value
    try:
        if isinstance(value, str):  # of which nanobind complains itself, beside its error
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


def ignored_effects(props: mi.Properties) -> tuple[str, ...]:
    """Return the effects that are not simulated."""
    words = [word.strip() for word in str(props.get("ignore", "")).split(",") if word.strip()]
    for word in words:
        if word not in IGNORABLE:
            raise PluginError(
                f"splats: ignore must be a list of {', '.join(IGNORABLE)}, got {word!r}"
            )
    return tuple(words)


def aovs_of(props: mi.Properties, kinds: Sequence[str]) -> dict[str, str]:
    """Return types of AOVs by name, each of ``kinds``."""
    aovs = {}
    for item in str(props.get("aovs", "")).split(","):
        if not item.strip():
            continue
        name, _, kind = (part.strip() for part in item.partition(":"))
        if not name or kind not in kinds or name in aovs:
            raise PluginError(
                f"splats: aovs must be a list of name:type with names of their own and types of "
                f"{', '.join(kinds)}, got {item.strip()!r}"
            )
        aovs[name] = kind
    return aovs


def nested_integrators(props: mi.Properties) -> dict[str, mi.Integrator]:
    """Nested integrators by name: their key, or in XML the id where no name is given."""
    # Objects alone: whatever is read counts as known, and a mistyped name would not be refused.
    is_object = mi.Properties.Type.Object
    names = [name for name in props.keys() if props.type(name) == is_object]  # noqa: SIM118
    objects = {name: props[name] for name in names if name != "background"}
    for name, value in objects.items():
        if not isinstance(value, mi.Integrator):
            raise PluginError(
                f"splats: {name} must be an integrator, the only object besides the texture "
                f"background, got {value.class_name()}{did_you_mean(name, ['background'])}"
            )
    return {
        (value.id() or name) if name.startswith(UNNAMED) else name: value
        for name, value in objects.items()
    }


def only_one(nested: Sequence[mi.Integrator]) -> mi.Integrator | None:
    """The integrator of surfaces, if there is one."""
    if len(nested) > 1:
        raise PluginError(
            f"splats: at most one integrator can be nested besides splats, got {len(nested)}"
        )
    return nested[0] if nested else None


def check_object(name: str, given: Sequence[str]) -> None:
    """Raise PluginError for properties of a nested ``splats`` that are not those of an object."""
    others = [n for n in given if n not in OF_OBJECTS and not n.startswith(FEATURE)]
    if others:
        raise PluginError(
            f"splats: {name} is nested in another splats integrator, whose settings hold for all "
            f"that it renders: give {others[0]} to that one, or leave it out; a nested one takes "
            f"{', '.join(OF_OBJECTS)} and {FEATURE}..."
        )
    if not given:
        raise PluginError(
            f"splats: {name} has no Gaussians: give it 'filename', or tensors "
            f"{', '.join(PARAMETER_NAMES)}"
        )


def agreed(props: mi.Properties, files: Mapping[str, Mapping[str, Value]]) -> dict[str, Value]:
    """The approximations that files say and that no property gives.

    files: by name, what a file says; for the others it is made with the defaults.

    Raises PluginError where files differ.
    """
    made_with = {file: Approximations.of(said) for file, said in files.items()}
    names = [name for name in DECLARED if name not in props]
    for name in names:
        values = {file: getattr(made, name) for file, made in made_with.items()}
        if len(set(values.values())) > 1:
            words = ", ".join(f"{value} ({file})" for file, value in values.items())
            raise PluginError(
                f"splats: files that are rendered together must be made for the same {name}, got "
                f"{words}; give the integrator {name}, which then holds for all"
            )
    return {name: said[name] for said in files.values() for name in names if name in said}


def header_of(props: mi.Properties, gaussians: Gaussians) -> dict[str, Value]:
    """Return the approximations that the file's header sets and no property gives."""
    values = gaussians.rendered_with or {}
    return said_by(
        str(props.get("filename", "")), {n: v for n, v in values.items() if n not in props}
    )


def approximations_of(props: mi.Properties, said: Mapping[str, Value]) -> Approximations:
    """The approximations among the properties, else as ``said``; all others are the default."""
    values = {n: _approximation(props, n, d) for n, d in DECLARED.items() if n in props}
    return Approximations(**{**said, **values})


def _approximation(props: mi.Properties, name: str, declared: Declared) -> Value:
    """Return one approximation, of the type that it is declared with."""
    value = props[name]
    if declared.kind is float and type(value) is int:
        value = float(value)
    if type(value) is not declared.kind:
        raise PluginTypeError(_message(props, name, _KINDS[declared.kind], value))
    if not declared.allows(value):
        raise PluginError(_message(props, name, declared.expected, value))
    return value


_KINDS = {bool: "true or false", int: "an integer", float: "a number", str: "text"}


def _tensor(props: mi.Properties, name: str) -> mi.TensorXf:
    """A tensor of the integrator's own: parameters are assigned in place, the caller's are not."""
    value = props[name]
    if not dr.is_array_v(value):
        raise PluginTypeError(f"splats: {name} must be a tensor, got {type(value).__name__}")
    if not dr.is_jit_v(value):  # of the host, as is what a property set makes of three numbers
        value = np.array(value, np.float32)
    return mi.TensorXf(value)


def _column(name: str, tensor: mi.TensorXf) -> mi.Float:
    """A tensor of shape (N,) or (N, 1) as the flat array that is kept of it."""
    if math.prod(tensor.shape[1:]) != 1:
        raise PluginError(f"splats: {name} must have the shape (N), got {tuple(tensor.shape)}")
    return mi.Float(tensor.array)


# ----------------------------------------------------------------------------------------------
# Single values
# ----------------------------------------------------------------------------------------------


def boolean(props: mi.Properties, name: str, default: bool) -> bool:
    """True or false."""
    value = props.get(name, default)
    if not isinstance(value, bool):
        raise PluginTypeError(_message(props, name, "true or false", value))
    return value


def integer(props: mi.Properties, name: str, default: int, least: int, most: int = MAX_INT) -> int:
    """An integer of at least ``least`` and at most ``most``."""
    value, expected = props.get(name, default), f"an integer of at least {least}"
    if isinstance(value, bool) or not isinstance(value, int):
        raise PluginTypeError(_message(props, name, expected, value))
    if value > most:
        expected = f"an integer from {least} to {most}"
    if not least <= value <= most:
        raise PluginError(_message(props, name, expected, value))
    return value


def number(props: mi.Properties, name: str, default: float) -> float:
    """A number that is finite in single precision, in which it is kept."""
    return _number(props, name, default, "a finite number")


def positive(props: mi.Properties, name: str, default: float) -> float:
    """A number above 0 and finite, in single precision as well."""
    value = _number(props, name, default, "a positive number")
    if np.float32(value) <= 0:
        raise PluginError(_message(props, name, "a positive number", value))
    return value


def _number(props: mi.Properties, name: str, default: float, expected: str) -> float:
    value = props.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise PluginTypeError(_message(props, name, expected, value))
    with np.errstate(over="ignore"):
        if not np.isfinite(np.float32(value)):
            raise PluginError(_message(props, name, expected, value))
    return float(value)


def one_of(props: mi.Properties, name: str, known: Sequence[str]) -> str:
    """Return one of several words, the first of which is the default."""
    value = props.get(name, known[0])
    if value not in known:
        message = _message(props, name, f"one of {', '.join(known)}", value)
        raise PluginError(message + did_you_mean(str(value), known))
    return value


def matrix(props: mi.Properties, name: str) -> np.ndarray:
    """(4, 4) float64, of a transform that is given."""
    if props.type(name) != mi.Properties.Type.Transform:
        got = type(props[name]).__name__
        where = f"{props.plugin_name()}: {name}"
        raise PluginTypeError(f"{where} must be a transform, got {got}")
    return np.array(props[name].matrix, np.float64)


def _message(props: mi.Properties, name: str, expected: str, got: object) -> str:
    return f"{props.plugin_name()}: {name} must be {expected}, got {got!r}"
