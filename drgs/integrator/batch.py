"""Sensors of type ``batch``: the pictures of several sensors, side by side on one film.

Imported for such a sensor. Each of them is rendered as if it were alone, at its own part of the
film's sample points; the parts are put together before the film gets them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi

from drgs.core.errors import PluginError
from drgs.integrator.film import Channels
from drgs.splatting.footprint import PixelCenters, Positions


@dataclass(frozen=True)
class SideBySide:
    """The sensors of a batch, whose images of one size (px) stand side by side."""

    sensors: list[mi.Sensor]  # the same one, perhaps, at several places
    width: int
    height: int

    @staticmethod
    def of(batch: mi.Sensor) -> SideBySide:
        """Raises PluginError if the batch's film has a crop window."""
        sensors, film = _children(batch), batch.film()
        if list(film.crop_size()) != list(film.size()):
            raise PluginError("splats: the film of a batch sensor must not have a crop window")
        return SideBySide(sensors, film.size()[0] // len(sensors), film.size()[1])

    def positions(self, positions: Sequence[Positions], index: int) -> tuple[Positions, ...]:
        """Return the points at which the pixels of one image are evaluated, by pass."""
        return tuple(
            p
            if isinstance(p, PixelCenters)
            else replace(p, x=self._cut(p.x, index), y=self._cut(p.y, index))
            for p in positions
        )

    def cut(self, passes: Sequence[Channels], index: int) -> list[Channels]:
        """The part of one picture of what the film gets, by pass."""
        return [[self._cut(plane, index) for plane in channels] for channels in passes]

    def put_together(self, pictures: Sequence[Sequence[Channels]]) -> list[Channels]:
        """Return the channels for the film, by pass; pictures: by sensor, each by pass."""
        return [
            [self._joined(planes) for planes in zip(*of_pass, strict=True)]
            for of_pass in zip(*pictures, strict=True)
        ]

    def _cut(self, plane: mi.Float, index: int) -> mi.Float:
        pixel = dr.arange(mi.UInt32, dr.width(plane) // len(self.sensors))
        row = pixel // dr.opaque(mi.UInt32, self.width)
        place = pixel + row * ((len(self.sensors) - 1) * self.width) + index * self.width
        return dr.gather(mi.Float, plane, place, mode=dr.ReduceMode.Permute)

    def _joined(self, planes: Sequence[mi.Float]) -> mi.Float:
        whole = len(self.sensors) * self.width
        pixel = dr.arange(mi.UInt32, len(planes) * dr.width(planes[0]))
        row = pixel // dr.opaque(mi.UInt32, whole)
        column = pixel - row * whole
        sensor = column // dr.opaque(mi.UInt32, self.width)
        place = row * self.width + column - sensor * self.width
        # Each pixel is taken once, so that derivatives are written, not added.
        parts = [
            dr.gather(mi.Float, plane, place, sensor == k, mode=dr.ReduceMode.Permute)
            for k, plane in enumerate(planes)
        ]
        return sum(parts[1:], parts[0])


def _children(batch: mi.Sensor) -> list[mi.Sensor]:
    """The sensors of a batch in their order; ``mi.traverse`` names each once."""

    class Children(mi.TraversalCallback):  # of the variant that is set
        def put(self, name: str, value: Any, flags: int, cpptype: Any = None) -> None:
            del name, flags, cpptype
            if isinstance(value, mi.Sensor):
                sensors.append(value)

    sensors: list[mi.Sensor] = []
    batch.traverse(Children())
    return sensors
