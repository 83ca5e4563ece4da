"""What a scene description tells the integrator ``splats``: read and checked.

Every error names the property, what was expected and what was given.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, replace
from numbers import Integral
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.config.approximations import Approximations
from drgs.core.errors import did_you_mean
from drgs.effects.compose import IGNORABLE
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians

AOVS = {"depth": ("T",), "alpha": ("I",), "normal": ("X", "Y", "Z")}
"""What may be put out besides colour, and the names of its channels as Mitsuba has them."""

FEATURE = "feature_"
"""What the names of parameters begin with that hold numbers of the user's own."""


SHAPES_TO_WORLD = "shapes_to_world"
"""What the names of parameters begin with that tell the ``to_world`` of shapes."""


_EXPECTED = {bool: "true or false", int: "an integer", float: "a number", str: "text"}


def load_gaussians(props: mi.Properties) -> Gaussians:
    """The Gaussians of a scene description: a PLY file, or six tensors; or none."""
    given = [name for name in PARAMETER_NAMES if name in props]
    features = {n: _tensor(props, n) for n in props.keys() if n.startswith(FEATURE)}  # noqa: SIM118
    if "filename" in props:
        if given:
            raise ValueError(
                f"splats: give either 'filename' or tensors, got both ({', '.join(given)})"
            )
        path = mi.file_resolver().resolve(str(props["filename"]))
        gaussians = replace(Gaussians.load(str(path)).to(mi.TensorXf), features=features)
    elif given or features or "smoothing" in props or "to_world" in props:
        missing = [name for name in PARAMETER_NAMES if name not in given and name != "shN"]
        if missing:
            raise ValueError(
                "splats: give 'filename', or the Gaussians as tensors "
                f"{', '.join(PARAMETER_NAMES)}; missing: {', '.join(missing)}"
            )
        values = {name: _tensor(props, name) for name in given}
        if "shN" not in given:
            values["shN"] = dr.zeros(mi.TensorXf, (values["means"].shape[0], 0, 3))
        values["logit_opacities"] = mi.Float(values["logit_opacities"].array)
        if "smoothing" in props:
            values["smoothing"] = mi.Float(_tensor(props, "smoothing").array)
        gaussians = Gaussians(**values, features=features)
    else:
        shapes = {"means": (0, 3), "quats": (0, 4), "log_scales": (0, 3)}
        shapes |= {"sh0": (0, 1, 3), "shN": (0, 0, 3)}
        tensors = {name: dr.zeros(mi.TensorXf, shape) for name, shape in shapes.items()}
        return Gaussians(**tensors, logit_opacities=mi.Float())
    check_shapes(gaussians)
    if "to_world" in props:
        from drgs.gaussians.similarity import Similarity

        to_world = Similarity.of(_matrix(props, "to_world"), "splats: to_world")
        moved = to_world.of_gaussians(gaussians.numpy()).to(mi.TensorXf)
        gaussians = replace(moved, features=features)
    return gaussians


def turns_of_shapes(props: mi.Properties) -> dict[str, Any]:
    """By ids of shapes, and under "" for all others: how their spherical harmonics turn."""
    names = [name for name in props.keys() if name.startswith(SHAPES_TO_WORLD)]  # noqa: SIM118
    if not names:
        return {}
    from drgs.gaussians.similarity import Similarity
    from drgs.integrator.ellipsoids import Turn

    turns = {}
    for name in names:
        shape = name.removeprefix(SHAPES_TO_WORLD).removeprefix("_")
        turns[shape] = Turn.by(Similarity.of(_matrix(props, name), f"splats: {name}").rotation)
    return turns


def background_of(props: mi.Properties) -> mi.Color3f | mi.Texture:
    """A colour in display space, or a texture."""
    value = props.get("background", 0.0)
    if isinstance(value, mi.Texture):
        return value
    try:
        return mi.Color3f(value)
    except TypeError:
        raise TypeError(
            "splats: background must be an RGB colour, such as [1, 1, 1] or "
            f"<rgb value='1, 1, 1'/>, or a texture, got {type(value).__name__}"
        ) from None


def ignored_effects(props: mi.Properties) -> tuple[str, ...]:
    """What is called for and not to be simulated."""
    words = [word.strip() for word in str(props.get("ignore", "")).split(",") if word.strip()]
    for word in words:
        if word not in IGNORABLE:
            raise ValueError(
                f"splats: ignore must be a list of {', '.join(IGNORABLE)}, got {word!r}"
            )
    return tuple(words)


def aovs_of(props: mi.Properties, kinds: Sequence[str]) -> dict[str, str]:
    """By name: what is put out, one of ``kinds``."""
    aovs = {}
    for item in str(props.get("aovs", "")).split(","):
        if not item.strip():
            continue
        name, _, kind = (part.strip() for part in item.partition(":"))
        if not name or kind not in kinds or name in aovs:
            raise ValueError(
                f"splats: aovs must be a list of name:type with names of their own and types of "
                f"{', '.join(kinds)}, got {item.strip()!r}"
            )
        aovs[name] = kind
    return aovs


def nested_integrator(props: mi.Properties) -> mi.Integrator | None:
    """The nested integrator, under whatever name it was given."""
    # Objects alone: whatever is read counts as known, and a mistyped name would not be refused.
    is_object = mi.Properties.Type.Object
    names = [name for name in props.keys() if props.type(name) == is_object]  # noqa: SIM118
    objects = {name: props[name] for name in names if name != "background"}
    for name, value in objects.items():
        if not isinstance(value, mi.Integrator):
            raise ValueError(
                f"splats: {name} must be an integrator, the only object besides the texture "
                f"background, got {value.class_name()}{did_you_mean(name, ['background'])}"
            )
    nested = list(objects.values())
    if len(nested) > 1:
        raise ValueError(f"splats: at most one integrator can be nested, got {len(nested)}")
    return nested[0] if nested else None


def approximations_of(props: mi.Properties) -> Approximations:
    """The choices of accuracy among the parameters; of the types that the defaults have."""
    values = {}
    for field in fields(Approximations):
        if field.name in props:
            value, expected = props[field.name], type(field.default)
            if expected is float and type(value) is int:
                value = float(value)
            if type(value) is not expected:
                raise TypeError(
                    f"splats: {field.name} must be {_EXPECTED[expected]}, got {value!r}"
                )
            values[field.name] = value
    try:
        return Approximations(**values)
    except ValueError as error:
        raise ValueError(f"splats: {error}") from None


def _tensor(props: mi.Properties, name: str) -> mi.TensorXf:
    """A tensor of the integrator's own: parameters are assigned in place, the caller's are not."""
    value = props[name]
    if not dr.is_array_v(value):
        raise TypeError(f"splats: {name} must be a tensor, got {type(value).__name__}")
    if not dr.is_jit_v(value):
        # Three numbers, which a property set turns into a vector on the host.
        value = mi.Float(list(value))
    return mi.TensorXf(value)


def _matrix(props: mi.Properties, name: str) -> np.ndarray:
    """(4, 4) of a transform."""
    value = props[name]
    if not hasattr(value, "matrix"):
        raise TypeError(f"splats: {name} must be a transform, got {type(value).__name__}")
    return np.array(value.matrix, np.float64)


def boolean(props: mi.Properties, name: str, default: bool) -> bool:
    """True or false."""
    value = props.get(name, default)
    if not isinstance(value, bool):
        raise TypeError(f"splats: {name} must be true or false, got {value!r}")
    return value


def whole_number(props: mi.Properties, name: str, default: int) -> int:
    """A whole number, 0 or more."""
    value = props.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError(f"splats: {name} must be a whole number, 0 or more, got {value!r}")
    return value


def positive(props: mi.Properties, name: str, default: float) -> float:
    """A finite number above 0."""
    value = props.get(name, default)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    if not (is_number and 0 < value < math.inf):
        raise ValueError(f"splats: {name} must be a positive number, got {value!r}")
    return float(value)


def check_shapes(gaussians: Gaussians) -> None:
    """Raise ValueError unless all parameters have rows for the same Gaussians."""
    num = next(iter(gaussians.means.shape), 0)
    if num == 0:
        raise ValueError("splats: at least one Gaussian is needed, got none")
    rows = {
        "means": [(3,)],
        "quats": [(4,)],
        "log_scales": [(3,)],
        "logit_opacities": [()],
        "sh0": [(1, 3)],
        "shN": [((degree + 1) ** 2 - 1, 3) for degree in range(4)],
    }
    for name, allowed in rows.items():
        got = tuple(getattr(gaussians, name).shape)
        if got not in [(num, *row) for row in allowed]:
            expected = " or ".join(f"({', '.join(map(str, ('N', *row)))})" for row in allowed)
            raise ValueError(
                f"splats: {name} must have the shape {expected}, with N = {num} the rows of "
                f"means, got {got}"
            )
    for name, tensor in (gaussians.features or {}).items():
        if len(tensor.shape) != 2 or tensor.shape[0] != num or tensor.shape[1] == 0:
            raise ValueError(
                f"splats: {name} must have the shape (N, C), with N = {num} the rows of means and "
                f"C at least 1, got {tuple(tensor.shape)}"
            )
    if gaussians.smoothing is not None and dr.width(gaussians.smoothing) != num:
        raise ValueError(
            f"splats: smoothing must have the shape (N), with N = {num} the rows of means, got "
            f"({dr.width(gaussians.smoothing)},)"
        )


def degree_of(value: Any) -> int:
    """A degree of spherical harmonics that Gaussians may have."""
    is_integer = isinstance(value, Integral) and not isinstance(value, bool)
    if not is_integer or value not in range(4):
        raise ValueError(f"splats: sh_degree must be an integer from 0 to 3, got {value!r}")
    return int(value)


def check_degree(degree: int, gaussians: Gaussians) -> None:
    """Raise ValueError for a degree of spherical harmonics that the Gaussians do not have."""
    if degree > gaussians.sh_degree:
        raise ValueError(
            f"splats: sh_degree must be an integer from 0 to {gaussians.sh_degree}, the degree of "
            f"the Gaussians, got {degree}"
        )
