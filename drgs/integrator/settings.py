"""What a picture may know of the integrator that it is rendered for.

:class:`SplatsSettings` is what ``plugins/splats.py`` has for pictures and views; the plugin itself
is loaded for each variant of Mitsuba, so that its class cannot be imported here.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any, Protocol, runtime_checkable

import mitsuba as mi

from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.cache import Memory
from drgs.splatting.rendering import Pipeline


class SplatsSettings(Protocol):
    """What an integrator renders, and how."""

    near: float  # near plane, scene units
    background: mi.Color3f | mi.Texture  # display space; a texture: linear
    hide_emitters: bool
    srgb_primitives: bool  # whether pictures are linear radiance, not display space
    sh_degree: int  # highest that is evaluated
    approximations: Approximations
    said_by_file: Collection[str]  # names of the approximations that a file has decided
    ignore: Sequence[str]  # effects that are not simulated
    aovs: dict[str, str]  # what is put out besides colour: kinds by name
    nested: mi.Integrator | None  # of surfaces
    nested_spp: int  # 0: as many as of the splats
    light: str  # how light passes between splats and surfaces: see drgs.integrator.properties
    light_samples: int  # splats that a ray draws; 0: it composites all
    probes: Sequence[str]  # ids of the shapes and emitters that have one
    unseen: str  # what rays meet that probes do not see
    shadows: Sequence[str]  # ids of the shapes that cast some on splats
    exposure: float  # factor of the splats' radiance, where surfaces see it
    memory: Memory

    @property
    def gaussians(self) -> Gaussians:
        """All that is rendered, those of the scene's shapes included."""

    @property
    def has_smoothing(self) -> bool:
        """True where Gaussians have a smoothing filter, be it ignored."""

    @property
    def pipeline(self) -> Pipeline:
        """What the settings call for."""

    def aov_names(self) -> list[str]:
        """Of the channels besides colour and alpha."""

    def channels_of(self, kind: str) -> Sequence[int | str]:
        """What comes behind the dot in the names of an AOV's channels."""


@runtime_checkable
class LitIntegrator(Protocol):
    """An integrator whose rays pass splats, as ``splatpath`` does."""

    light: Any  # drgs.integrator.legs.Light, once it is rendered; None before


@runtime_checkable
class SummarisingIntegrator(Protocol):
    """An integrator that says what it simulates, as ``splats`` does."""

    srgb_primitives: bool  # whether pictures are linear radiance, not display space

    def summary(self, scene: mi.Scene, *sensors: mi.Sensor) -> str:
        """One line for each effect: what is simulated, and what asked for it."""
