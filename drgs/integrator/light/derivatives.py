"""Refusals of derivatives that would be wrong in an image with surfaces."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from drgs.core.errors import UnsupportedError, format_names
from drgs.integrator.light.rays import TransportIntegrator
from drgs.integrator.state import SplatsState

ATTACHED_INTEGRATORS = ("PathIntegrator", "DirectIntegrator")  # samples move with parameters
REPLAYED_INTEGRATORS = ("PRBIntegrator", "BasicPRBIntegrator")  # samples stay in place

DIFFERENTIATED_BY_PATH = (
    *("SmoothDiffuse", "SmoothConductor", "RoughConductor"),
    *("SmoothDielectric", "RoughDielectric", "ThinDielectric", "TwoSidedBRDF"),
)
"""Classes of BSDFs that sample no parts with probabilities that depend on parameters."""

COVERAGE = {"MaskBSDF": ("opacity",), "ThinDielectric": ("eta", "specular_transmittance")}
"""Parameters that change a surface's coverage of pixels, by the class of the BSDF."""

WRONG_IN_MITSUBA = {
    "RoughPlastic": ("alpha", "eta"),  # tables of its transmittance are not differentiated
    "RoughDielectric": ("eta",),
    "NormalMap": ("normalmap",),
}
"""Parameters by which Mitsuba's own derivative of ``eval`` is wrong."""

SPLATPATH = "splatpath"

TO_SPLATPATH = f"nest {SPLATPATH}, which does"


@dataclass(frozen=True)
class Parameter:
    """An attached parameter of a scene or sensor."""

    name: str  # in mi.traverse
    key: str  # its name within its object
    owners: list[mi.Object]  # its object, the parent of that, and so on
    value: object  # attached
    has_nested: bool  # whether its material contains other materials

    @property
    def is_geometry(self) -> bool:
        """True for parameters that move points of a shape."""
        is_attribute = self.key.startswith(("vertex_", "face_"))
        moves = not is_attribute or self.key in ("vertex_positions", "vertex_normals")
        return isinstance(self.owners[0], mi.Shape) and moves

    @property
    def bsdfs(self) -> list[mi.BSDF]:
        """Its material and those around it, from the inside out."""
        return [owner for owner in self.owners if isinstance(owner, mi.BSDF)]


def check_derivatives(
    splats: SplatsState, scene: mi.Scene, sensor: mi.Sensor, mode: dr.ADMode
) -> None:
    """Raise UnsupportedError for a parameter whose derivative would be wrong."""
    light, shadows = splats.lighting.light, splats.lighting.shadows
    parts = splats.attached_parts(scene) if light != "none" or shadows else []
    if any(dr.grad_enabled(value) for part in parts for value in part.values.values()):
        raise UnsupportedError(
            f"splats: with light '{light}' and shadows '{', '.join(shadows)}', the Gaussians are "
            "not differentiated, as surfaces show and shade them; detach their parameters, or set "
            "light to 'none' and leave out shadows"
        )
    for name, value in mi.traverse(sensor):
        if dr.grad_enabled(value):
            raise UnsupportedError(
                f"splats: {sensor.id()}.{name} is not differentiated in a scene with surfaces, as "
                "it moves these in the image; detach it, or leave out the surfaces"
            )
    reasons = {p.name: _refusal(p, splats, mode) for p in attached_parameters(scene)}
    reason = next(filter(None, reasons.values()), None)
    if reason is not None:
        names = [name for name, other in reasons.items() if other == reason]
        are, them = ("is", "it") if len(names) == 1 else ("are", "them")
        raise UnsupportedError(
            f"splats: {format_names(names)} {are} not differentiated, as {reason}; or detach {them}"
        )


def attached_parameters(scene: mi.Scene) -> Iterator[Parameter]:
    """Yield the attached parameters of a scene's surfaces and emitters."""
    params = mi.traverse(scene)
    for name, (_, _, node, _) in params.properties.items():
        value = parameter_value(params, name)
        if not dr.grad_enabled(value):
            continue
        owners = [node]
        while (parent := params.hierarchy[owners[-1]][0]) is not None:
            owners.append(parent)
        if any(isinstance(owner, (mi.Sensor, mi.Integrator)) for owner in owners):
            continue
        if any(isinstance(owner, mi.Shape) and owner.is_ellipsoids() for owner in owners):
            continue
        bsdf = next((owner for owner in owners if isinstance(owner, mi.BSDF)), None)
        nested = (n for n, (p, _) in params.hierarchy.items() if bsdf is not None and p is bsdf)
        has_nested = any(isinstance(node, mi.BSDF) for node in nested)
        yield Parameter(name, name.rpartition(".")[2], owners, value, has_nested)


def parameter_value(params: mi.SceneParameters, name: str) -> object:
    """Return ``params[name]``, which fails where ``hair`` has no value for a parameter."""
    value, kind, node, _ = params.properties[name]
    return value if kind is None else mi.get_property(value, kind, node)


def type_of(integrator: mi.Integrator) -> str:
    """Return the name of its class; Mitsuba has one name for all that are written in Python."""
    if isinstance(integrator, TransportIntegrator):
        return SPLATPATH
    name = integrator.class_name()
    return type(integrator).__name__ if name == "SamplingIntegrator" else name


def _refusal(parameter: Parameter, splats: SplatsState, mode: dr.ADMode) -> str | None:
    nested, owner = splats.nested, parameter.owners[0]
    kind = SPLATPATH if nested is None else type_of(nested)
    is_of_emitter = any(isinstance(node, mi.Emitter) for node in parameter.owners)
    if splats.lighting.shadows and (is_of_emitter or parameter.is_geometry):
        return "how surfaces shade splats, which changes with it, is not; leave out shadows"
    if parameter.bsdfs:
        return _bsdf_refusal(parameter, kind)
    if (
        isinstance(owner, mi.Shape)
        and parameter.is_geometry
        and kind in (SPLATPATH, *ATTACHED_INTEGRATORS, *REPLAYED_INTEGRATORS)
    ):
        return _geometry_refusal(owner, kind)
    if isinstance(owner, mi.Emitter) and parameter.key in ("position", "to_world"):
        if kind in (ATTACHED_INTEGRATORS if owner.is_environment() else REPLAYED_INTEGRATORS):
            return f"{kind} does not follow a lamp that moves; {TO_SPLATPATH}"
        if splats.lighting.light != "none" and not owner.is_environment():
            return "the shadows that splats throw move with it; set light to 'none'"
    # Mitsuba renders a padded copy of an environment map's texels.
    is_padded = (owner.class_name(), parameter.key) == ("EnvironmentMapEmitter", "data")
    if mode == dr.ADMode.Forward and is_padded:
        return "forward mode does not reach its texels; use dr.backward"
    return None


def _geometry_refusal(shape: mi.Shape, kind: str) -> str | None:
    if kind in ATTACHED_INTEGRATORS:
        return f"{kind} does not differentiate where paths hit surfaces; {TO_SPLATPATH}"
    if shape.is_emitter():
        return "the edge of a lamp that moves is not; optimise the lamp's radiance"
    if shape.bsdf() is not None and _is_mirror(shape.bsdf()):
        return (
            "its BSDF is a perfect mirror or glass, and where that sends light is not; give it a "
            "rough one"
        )
    return None


def _bsdf_refusal(parameter: Parameter, kind: str) -> str | None:
    bsdf, outer = parameter.bsdfs[0], parameter.bsdfs[-1]
    name = bsdf.class_name()
    own = parameter.name.split(".")[-1 - parameter.owners.index(bsdf)]  # or its texture's
    if own in COVERAGE.get(name, ()):
        return "how much of a pixel its surface covers is not; optimise reflectances"
    if own in WRONG_IN_MITSUBA.get(name, ()):
        return f"Mitsuba's derivative of {name} is wrong there; use another BSDF"
    is_mixed = name != "BlendBSDF" or _has_flag(bsdf, mi.BSDFFlags.Smooth, mi.BSDFFlags.Null)
    if parameter.has_nested and _is_mirror(bsdf) and is_mixed:
        return f"{name} is around a perfect mirror or glass; use a rough one"
    if kind in REPLAYED_INTEGRATORS and _is_mirror(outer):
        return f"{kind} leaves out what perfect mirrors and glass reflect; {TO_SPLATPATH}"
    others = {b.class_name() for b in parameter.bsdfs} - {*DIFFERENTIATED_BY_PATH}
    if kind in ATTACHED_INTEGRATORS and others:
        return f"{kind} does not differentiate which part of a {name} it samples; {TO_SPLATPATH}"
    return None


def _is_mirror(bsdf: mi.BSDF) -> bool:
    """Return whether a part of it is a delta function, other than straight on."""
    return _has_flag(bsdf, mi.BSDFFlags.DeltaReflection, mi.BSDFFlags.DeltaTransmission)


def _has_flag(bsdf: mi.BSDF, *flags: mi.BSDFFlags) -> bool:
    return any(mi.has_flag(bsdf.flags(), flag) for flag in flags)
