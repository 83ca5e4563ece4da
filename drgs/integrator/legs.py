"""Legs of paths, and who knows what these pass of the splats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import mitsuba as mi


@dataclass(frozen=True)
class Leg:
    """Of a path: from one vertex to the next, or to an emitter."""

    ray: mi.Ray3f  # maxt: where it ends
    start: mi.ShapePtr  # that it leaves
    end: mi.EmitterPtr  # that it reaches, if it is one
    pdf: mi.Float  # of the direction, by solid angle; inf: there was no other
    is_open: mi.Bool  # whether it leaves a scene without an environment: black is the last splat


class Light(Protocol):
    """What rays of a scene pass of its splats, and who knows."""

    def passed(self, leg: Leg, sample: mi.Float, active: mi.Bool) -> tuple[mi.Color3f, mi.Float]:
        """Radiance of the splats along legs, linear, and what they let through.

        sample: in 0..1, of each leg.
        """
        ...

    def transmittance(self, leg: Leg, sample: mi.Float, active: mi.Bool) -> mi.Float:
        """What splats let through, or an estimate of that."""
        ...


@dataclass(frozen=True, eq=False)
class Unlit:
    """That of no splats."""

    def passed(self, leg: Leg, sample: mi.Float, active: mi.Bool) -> tuple[mi.Color3f, mi.Float]:
        """See :meth:`Light.passed`."""
        return mi.Color3f(0), mi.Float(1)

    def transmittance(self, leg: Leg, sample: mi.Float, active: mi.Bool) -> mi.Float:
        """See :meth:`Light.transmittance`."""
        return mi.Float(1)
