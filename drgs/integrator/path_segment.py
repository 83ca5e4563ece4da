"""Segments of paths, and the splats along them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import mitsuba as mi


@dataclass(frozen=True)
class PathSegment:
    """A part of a path: from one vertex to the next, or to an emitter."""

    ray: mi.Ray3f  # maxt: where it ends
    start: mi.ShapePtr  # that it leaves
    end: mi.EmitterPtr  # that it reaches, if it is one
    pdf: mi.Float  # of the direction, by solid angle; inf: there was no other
    is_open: mi.Bool  # whether it leaves a scene without an environment: black is the last splat


class SplatTransport(Protocol):
    """Radiance and transmittance of the splats along segments of paths."""

    def composite_segment(
        self, segment: PathSegment, sample: mi.Float, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        """Return the linear radiance and the transmittance of the splats along segments.

        sample: in 0..1, of each segment.
        """
        ...

    def transmittance(self, segment: PathSegment, sample: mi.Float, active: mi.Bool) -> mi.Float:
        """Return the transmittance of the splats along segments, or an estimate of it."""
        ...


@dataclass(frozen=True, eq=False)
class NoSplats:
    """Transport without splats: zero radiance, full transmittance."""

    def composite_segment(
        self, segment: PathSegment, sample: mi.Float, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        return mi.Color3f(0), mi.Float(1)

    def transmittance(self, segment: PathSegment, sample: mi.Float, active: mi.Bool) -> mi.Float:
        return mi.Float(1)


def passes_splats(integrator: mi.Integrator) -> bool:
    """Return whether an integrator's paths can pass splats, as those of ``splatpath`` do."""
    return hasattr(integrator, "use_transport")
