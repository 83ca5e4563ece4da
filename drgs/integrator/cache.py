"""What an integrator keeps for its next picture: frames, surfaces, maps of films.

``mi.render`` has Dr.Jit traverse the integrator with all that it keeps, which resolves annotations.
So what is imported on demand is ``Any`` here, and named beside it.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from drgs.core.private import same_variables
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.sensors import SensorState
from drgs.splatting import rendering


@dataclass(frozen=True)
class Rendered:
    """The last frames of a view, and everything that they depend on."""

    frames: list[list[rendering.Frame]]  # by time; one for each pass
    pipeline: rendering.Pipeline
    samples: object  # key of the film's samples: see drgs.integrator.film.FilmSamples
    sensor: SensorState
    gaussians: Gaussians  # detached: holding them keeps their variable indices from being reused
    traced: TracedSurfaces | None  # what was seen besides splats

    def matches(
        self,
        pipeline: rendering.Pipeline,
        samples: object,
        sensor: SensorState,
        gaussians: Gaussians,
        traced: TracedSurfaces | None,
    ) -> bool:
        """Whether rendering these would give the same frames."""
        return (
            self.pipeline == pipeline
            and self.samples == samples
            and self.sensor.same_as(sensor)
            and same_variables(self.gaussians, gaussians)
            and self.traced is traced
        )


@dataclass(frozen=True, eq=False)
class TracedSurfaces:
    """What a sensor saw of a scene's surfaces, and everything that this depends on."""

    surfaces: Any  # drgs.integrator.surfaces.Surfaces
    settings: tuple[object, ...]  # of samples, integrator and sensor
    sensor: SensorState
    seen: list[list[Any]]  # by time and by pass: drgs.integrator.surfaces.SeenSurface

    def matches(self, surfaces: Any, settings: tuple[object, ...], sensor: SensorState) -> bool:
        """Whether tracing these would give the same."""
        same = self.surfaces is surfaces and self.settings == settings
        return same and self.sensor.same_as(sensor)


@dataclass
class Memory:
    """What an integrator keeps. Views are known by their numbers."""

    rendered: dict[int, Rendered] = field(default_factory=dict)
    traced: dict[int, TracedSurfaces] = field(default_factory=dict)
    surfaces: Any = None  # drgs.integrator.surfaces.Surfaces of the last scene that had some
    light: Any = None  # drgs.integrator.light.LightOfSplats of the last scene that asked for it
    probes: Any = None  # of the last scene that asked for some: see drgs.integrator.probes
    mirrors: Any = None  # the same of flat mirrors
    shadows: Any = None  # drgs.integrator.shadows.Shadows of the last scene that asked for them
    film_maps: dict[str, np.ndarray] = field(default_factory=dict)  # see drgs.integrator.film

    def forget_view(self, index: int) -> None:
        """A view that will not be asked for again."""
        self.rendered.pop(index, None)
        self.traced.pop(index, None)
