"""Light between splats and surfaces, for the integrator ``splatpath``.

Imported where a scene asks for it. Splats have display-encoded colours: what a ray has composited
of them, C with transmittance T, is the colour C / (1 - T) with the coverage 1 - T. Its radiance is

    exposure (1 - T) lin(C / (1 - T)),

so that what is opaque looks the same in a mirror, and a white fog before a white wall stays white.

To composite all that a ray passes takes long. By default, a few splats are drawn with their weights
instead, n of them, of which h exist. h / n estimates 1 - T, and the colours c of those that exist
the powers of C / (1 - T), without bias: from the sums s_k of c^k,

    m: s_1 / h,   m^2: (s_1^2 - s_2) / (h (h - 1)),
    m^3: (s_1^3 - 3 s_1 s_2 + 2 s_3) / (h (h - 1) (h - 2))

(Hoeffding 1948), of which lin is a sum to within :data:`DECODED_WITHIN`. Of one or two splats, the
missing powers are those of their mean.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi

from drgs.accuracy.pipeline import pipeline_of
from drgs.config.approximations import Approximations
from drgs.core.private import same_variables
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.legs import Leg, Unlit
from drgs.integrator.settings import SplatsSettings
from drgs.integrator.view import decode
from drgs.light.walk import RaySplats, Segment
from drgs.splatting.projection import load_rows

DECODING = (0.012522878, 0.682171111, 0.305306011)
"""Of the first three powers of a display-encoded colour, whose sum is nearly linear radiance
(Chapman, "sRGB approximations for HLSL", 2012)."""

DECODED_WITHIN = 2e-3
"""Of a colour in 0..1, decoded by :data:`DECODING`."""

ROULETTE = 0.25
"""Transmittance to an emitter, below which the rest of the splats is asked for with a probability:
few splats make a ray dark, and many more are behind them."""


@dataclass(frozen=True, eq=False)
class LightOfSplats:
    """What rays pass of the splats themselves."""

    splats: RaySplats
    exposure: mi.Float  # (1,): factor of the splats' radiance
    num_samples: int  # splats that are drawn; 0: all are composited
    made_of: tuple[Gaussians, Approximations, int]  # detached: holding them keeps their indices

    @staticmethod
    def of(integrator: SplatsSettings) -> LightOfSplats:
        """That of an integrator's Gaussians, or the last one if they are the same."""
        gaussians, degree = dr.detach(integrator.gaussians), integrator.sh_degree
        approximations, last = integrator.approximations, integrator.memory.light
        exposure = dr.opaque(mi.Float, integrator.exposure)
        if (
            last is not None
            and last.made_of[1:] == (approximations, degree)
            and same_variables(last.made_of[0], gaussians)
        ):
            found = replace(last, exposure=exposure, num_samples=integrator.light_samples)
        else:
            splats = ray_splats_of(gaussians, approximations, degree)
            made_of = (gaussians, approximations, degree)
            found = LightOfSplats(splats, exposure, integrator.light_samples, made_of)
        integrator.memory.light = found
        return found

    def passed(self, leg: Leg, sample: mi.Float, active: mi.Bool) -> tuple[mi.Color3f, mi.Float]:
        """See :meth:`drgs.integrator.legs.Light.passed`."""
        segment = _segment(leg.ray, active)
        look = self._sampled if self.num_samples else self._composited
        color, coverage = look(segment, leg.is_open, sample)
        return dr.select(active, self.exposure * color, 0), dr.select(active, 1 - coverage, 1)

    def _composited(
        self, segment: Segment, is_open: mi.Bool, sample: mi.Float
    ) -> tuple[mi.Color3f, mi.Float]:
        """Linear colour, times coverage, and coverage."""
        del sample
        passed = self.splats.passed(segment)
        coverage = 1 - passed.transmittance
        return decode(mi.Color3f(passed.color), dr.select(is_open, 1, coverage)), coverage

    def _sampled(
        self, segment: Segment, is_open: mi.Bool, sample: mi.Float
    ) -> tuple[mi.Color3f, mi.Float]:
        """Estimates of the same."""
        seed = dr.reinterpret_array(mi.UInt32, sample)
        drawn = self.splats.sampled(segment, seed, self.num_samples)
        hits, sums = mi.Float(0), [mi.Color3f(0)] * 3
        for one in drawn:
            hits += dr.select(one.exists, 1, mi.Float(0))
            color = dr.select(one.exists, mi.Color3f(one.color), 0)
            sums = [s + color**k for k, s in enumerate(sums, 1)]
        s1, s2, s3 = sums
        h = dr.select(is_open, self.num_samples, dr.maximum(hits, 1))
        mean = s1 / h
        square = dr.select(h > 1, (s1 * s1 - s2) / dr.maximum(h * (h - 1), 1), mean * mean)
        cube = (s1 * s1 * s1 - 3 * s1 * s2 + 2 * s3) / dr.maximum(h * (h - 1) * (h - 2), 1)
        cube = dr.select(h > 2, cube, mean * square)
        a, b, c = DECODING
        coverage = hits / self.num_samples
        decoded = a * mean + b * square + c * cube
        return dr.select(is_open, 1, coverage) * decoded, coverage

    def transmittance(self, leg: Leg, sample: mi.Float, active: mi.Bool) -> mi.Float:
        """An estimate of that of the splats along legs.

        Below :data:`ROULETTE`, Russian roulette: a ray that lets through less than ``sample`` (in
        0..1) times that is dark, and all others let through as much as that.
        """
        least = sample * ROULETTE
        T = self.splats.transmittance(_segment(leg.ray, active), least)
        T = dr.select(least > T, 0, dr.maximum(T, ROULETTE))
        return dr.select(active, T, 1)


def ray_splats_of(gaussians: Gaussians, approximations: Approximations, degree: int) -> RaySplats:
    """Gaussians as rays meet them, their smoothing filter included."""
    rows = load_rows(gaussians, degree)
    if rows.smoothing is not None:
        from drgs.effects.smoothing import smoothed

        rows = smoothed(rows)
    return RaySplats.of(rows, degree, pipeline_of(approximations, degree).model.cutoffs)


def lit(integrator: SplatsSettings, scene: mi.Scene, num_paths: int) -> mi.Integrator:
    """The nested integrator, with the splats of the one that it is nested in.

    num_paths: of a pixel.
    """
    nested = integrator.nested
    if nested is None:
        settings = {"type": "splatpath", "hide_emitters": integrator.hide_emitters}
        nested = mi.load_dict(settings)
    if integrator.light == "rays":
        nested.light = LightOfSplats.of(integrator)
    else:
        from drgs.integrator.probes import LightOfProbes

        traces = integrator.unseen == "rays"
        unseen = LightOfSplats.of(integrator) if traces else Unlit()
        nested.light = LightOfProbes.of(integrator, scene, num_paths, unseen)
    return nested


def _segment(ray: mi.Ray3f, active: mi.Bool) -> Segment:
    return Segment(mi.Vector3f(ray.o), mi.Vector3f(ray.d), mi.Float(ray.maxt), mi.Bool(active))
