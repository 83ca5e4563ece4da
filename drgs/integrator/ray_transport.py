"""Light between splats and surfaces, for the integrator ``splatpath``.

Imported where a scene asks for it. Splats have display-encoded colours: what a ray has composited
of them, C with transmittance T, is the colour C / (1 - T) with the coverage 1 - T. Its radiance is

    exposure (1 - T) lin(C / (1 - T)),

so that what is opaque looks the same in a mirror, and a white fog before a white wall stays white.
Where a ray leaves a scene that has no environment, black is the last splat: exposure lin(C).

To composite all that a ray passes takes long. By default, a few splats are drawn with their weights
instead, n of them. Their colours c estimate the powers of C / (1 - T), without bias: from the sums
s_k of c^k,

    m: s_1 / n,   m^2: (s_1^2 - s_2) / (n (n - 1)),
    m^3: (s_1^3 - 3 s_1 s_2 + 2 s_3) / (n (n - 1) (n - 2))

(Hoeffding 1948), of which lin is a sum to within :data:`DECODED_WITHIN`. How far the draws had to
look for splats estimates T, and does not depend on which splats they have: the product of both is
without bias as well. For rays that meet black at last, a draw is black with the probability T.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.path_segment import NoSplats, PathSegment
from drgs.integrator.sensor_render import decode
from drgs.integrator.state import Cached, SplatsState
from drgs.light.walk import RaySplats, Segment
from drgs.splatting.projection import load_rows

DECODING = (0.012522878, 0.682171111, 0.305306011)
"""Of the first three powers of a display-encoded colour, whose sum is nearly linear radiance
(Chapman, "sRGB approximations for HLSL", 2012)."""

DECODED_WITHIN = 2e-3
"""Of a colour in 0..1, decoded by :data:`DECODING`."""

LEAST_SAMPLES = 3
"""Splats that a ray draws, at least: for the third power."""

ROULETTE = 0.25
"""Transmittance to an emitter, below which the rest of the splats is asked for with a probability:
few splats make a ray dark, and many more are behind them."""


@dataclass(frozen=True, eq=False)
class RayTransport:
    """Transport along rays that pass the splats themselves."""

    splats: RaySplats
    exposure: mi.Float  # (1,): factor of the splats' radiance
    num_samples: int  # splats that are drawn; 0: all are composited

    @staticmethod
    def of(splats: SplatsState) -> RayTransport:
        """Return the transport of an integrator's Gaussians."""
        gaussians = dr.detach(splats.gaussians)
        settings, last = (splats.approximations, splats.sh_degree), splats.cache.ray_splats
        if last is None or not last.matches(settings, gaussians):
            last = Cached(ray_splats_of(gaussians, *settings), settings, gaussians)
            splats.cache.ray_splats = last
        exposure = dr.opaque(mi.Float, splats.exposure)
        return RayTransport(last.value, exposure, splats.light_samples)

    def composite_segment(
        self, segment: PathSegment, sample: mi.Float, active: mi.Bool
    ) -> tuple[mi.Color3f, mi.Float]:
        look = self._sampled if self.num_samples else self._composited
        color, coverage = look(_segment(segment.ray, active), segment.is_open, sample)
        return dr.select(active, self.exposure * color, 0), dr.select(active, 1 - coverage, 1)

    def _composited(
        self, segment: Segment, is_open: mi.Bool, sample: mi.Float
    ) -> tuple[mi.Color3f, mi.Float]:
        del sample
        found = self.splats.composite_segment(segment)
        coverage = 1 - found.transmittance
        return decode(mi.Color3f(found.color), dr.select(is_open, 1, coverage)), coverage

    def _sampled(
        self, segment: Segment, is_open: mi.Bool, sample: mi.Float
    ) -> tuple[mi.Color3f, mi.Float]:
        seed, n = dr.reinterpret_array(mi.UInt32, sample), max(self.num_samples, LEAST_SAMPLES)
        drawn = self.splats.sampled(segment, seed, n)
        colors = [
            dr.select(is_open & ~exists, 0, mi.Color3f(color))
            for color, exists in zip(drawn.colors, drawn.exist, strict=True)
        ]
        s1, s2, s3 = (sum(color**k for color in colors) for k in (1, 2, 3))
        mean = s1 / n
        square = (s1 * s1 - s2) / (n * (n - 1))
        cube = (s1 * s1 * s1 - 3 * s1 * s2 + 2 * s3) / (n * (n - 1) * (n - 2))
        a, b, c = DECODING
        coverage = 1 - drawn.transmittance
        whole = dr.select(is_open, 1, coverage)
        return whole * (a * mean + b * square + c * cube), coverage

    def transmittance(self, segment: PathSegment, sample: mi.Float, active: mi.Bool) -> mi.Float:
        """An estimate of that of the splats along segments.

        Below :data:`ROULETTE`, Russian roulette: a ray that lets through less than ``sample`` (in
        0..1) times that is dark, and all others let through as much as that.
        """
        least = sample * ROULETTE
        T = self.splats.transmittance(_segment(segment.ray, active), least)
        T = dr.select(least > T, 0, dr.maximum(T, ROULETTE))
        return dr.select(active, T, 1)


def ray_splats_of(gaussians: Gaussians, approximations: Approximations, degree: int) -> RaySplats:
    """Gaussians as rays meet them, their smoothing filter included."""
    rows = load_rows(gaussians, degree)
    if rows.smoothing is not None:
        from drgs.effects.smoothing import smoothed

        rows = smoothed(rows)
    return RaySplats.of(rows, degree, pipeline_of(approximations, degree).model.cutoffs)


def nested_with_transport(
    splats: SplatsState, scene: mi.Scene, num_paths: int, sensors: Sequence[mi.Sensor]
) -> mi.Integrator:
    """The nested integrator, with the splats of the one that it is nested in.

    num_paths: of a pixel; sensors: whose picture is rendered.
    """
    nested = splats.nested
    if nested is None:
        settings = {"type": "splatpath", "hide_emitters": splats.hide_emitters}
        nested = mi.load_dict(settings)
    if splats.light == "rays":
        nested.use_transport(RayTransport.of(splats))
    else:
        from drgs.integrator.probe_transport import ProbeTransport

        traces = splats.unseen == "rays"
        unseen = RayTransport.of(splats) if traces else NoSplats()
        nested.use_transport(ProbeTransport.of(splats, scene, num_paths, sensors, unseen))
    return nested


def _segment(ray: mi.Ray3f, active: mi.Bool) -> Segment:
    return Segment(mi.Vector3f(ray.o), mi.Vector3f(ray.d), mi.Float(ray.maxt), mi.Bool(active))
