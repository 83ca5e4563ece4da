"""Lenses to look through: the sensor of a picture that somebody asks for.

All see the same in the middle of the picture: where they look, they agree on how large a thing is.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import ClassVar, Protocol

import mitsuba as mi
import numpy as np

from drgs.cameras.axes import OPENCV_TO_MITSUBA
from drgs.cameras.lens import Lens
from drgs.datasets.types import Viewpoint
from drgs.datasets.viewpoints import pinhole
from drgs.integrator.scene import NEAR_CLIP, film_of, make_sensors


@dataclass(frozen=True, eq=False)
class Eye:
    """Where somebody looks from, and at what."""

    camera_to_world: np.ndarray  # (4, 4) float64, rigid, OpenCV axes: x right, y down, z forward
    fov: float  # degrees, vertical
    distance: float  # scene units, along the axis, to what the camera turns about

    def viewpoint(self, width: int, height: int) -> Viewpoint:
        """The pinhole of this field of view, with a picture of so many px."""
        half = math.tan(math.radians(self.fov) / 2) * width / height
        return pinhole(
            "eye", self.camera_to_world, width, height, 2 * math.degrees(math.atan(half))
        )


class Optics(Protocol):
    """What stands between the eye and the film."""

    most_accurate: ClassVar[str] = "exact"
    """Of the projections that know such rays. ``exact`` does where all go through one point and
    straight lines stay straight; of parallel rays, ``ewa`` leaves nothing out."""

    def sensor(self, eye: Eye, width: int, height: int) -> mi.Sensor:
        """A sensor for one picture (px); the film has a box filter, and is RGB."""


@dataclass(frozen=True)
class Pinhole(Optics):
    """No lens."""

    def sensor(self, eye: Eye, width: int, height: int) -> mi.Sensor:
        """See :class:`Optics`."""
        (sensor,) = make_sensors([eye.viewpoint(width, height)])
        return sensor


@dataclass(frozen=True)
class OpenCVLens(Optics):
    """Radial and tangential distortion: see ``drgs.cameras.radial_tangential``."""

    most_accurate: ClassVar[str] = "unscented"

    coefficients: Mapping[str, float] = field(default_factory=dict)  # k1 to k6, p1, p2

    def sensor(self, eye: Eye, width: int, height: int) -> mi.Sensor:
        """See :class:`Optics`."""
        from drgs.cameras.radial_tangential import RadialTangential

        return _through(
            RadialTangential.from_coefficients(**self.coefficients), eye.viewpoint(width, height)
        )


@dataclass(frozen=True)
class FisheyeLens(Optics):
    """Kannala and Brandt's: see ``drgs.cameras.fisheye``."""

    most_accurate: ClassVar[str] = "unscented"

    coefficients: Mapping[str, float] = field(default_factory=dict)  # k1 to k4

    def sensor(self, eye: Eye, width: int, height: int) -> mi.Sensor:
        """The film's height shows the eye's whole field of view, where nothing is distorted."""
        from drgs.cameras.fisheye import Fisheye

        focal = height / math.radians(eye.fov)
        view = replace(eye.viewpoint(width, height), fx=focal, fy=focal)
        return _through(Fisheye.from_coefficients(**self.coefficients), view)


@dataclass(frozen=True)
class Orthographic(Optics):
    """Parallel rays."""

    most_accurate: ClassVar[str] = "ewa"

    def sensor(self, eye: Eye, width: int, height: int) -> mi.Sensor:
        """What the camera turns about is as large as through the pinhole."""
        half_height = eye.distance * math.tan(math.radians(eye.fov) / 2)
        half_width = half_height * width / height
        # Mitsuba's film is two units of the sensor's own wide.
        scale = np.diag([half_width, half_width, 1.0, 1.0])
        return _mitsubas("orthographic", eye, width, height, scale=scale)


@dataclass(frozen=True)
class ThinLens(Optics):
    """A lens with an aperture: what is not in focus is blurred."""

    aperture: float  # radius, as a share of the distance to what the camera turns about
    focus: float = 1.0  # distance that is sharp, in units of that distance

    def sensor(self, eye: Eye, width: int, height: int) -> mi.Sensor:
        """See :class:`Optics`."""
        if self.aperture == 0:  # Mitsuba's would warn of each picture
            return Pinhole().sensor(eye, width, height)
        lens = {
            "fov": eye.fov,
            "fov_axis": "y",
            "aperture_radius": self.aperture * eye.distance,
            "focus_distance": self.focus * eye.distance,
        }
        return _mitsubas("thinlens", eye, width, height, **lens)


def _through(lens: Lens, view: Viewpoint) -> mi.Sensor:
    (sensor,) = make_sensors([replace(view, lens=lens)])
    return sensor


def _mitsubas(
    kind: str,
    eye: Eye,
    width: int,
    height: int,
    scale: np.ndarray | None = None,
    **settings: object,
) -> mi.Sensor:
    """One of Mitsuba's own; scale: (4, 4), of the sensor's axes."""
    to_world = eye.camera_to_world @ OPENCV_TO_MITSUBA
    to_world = to_world if scale is None else to_world @ scale
    return mi.load_dict(
        {
            "type": kind,
            "to_world": mi.ScalarTransform4f(to_world),
            "near_clip": NEAR_CLIP,
            "sampler": {"type": "independent", "sample_count": 1},
            "film": film_of(width, height),
            **settings,
        }
    )
