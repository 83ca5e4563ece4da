"""Several samples per pixel, at points that Mitsuba's samplers choose.

Imported when a scene asks for more than one sample, or for a reconstruction filter other than a
box. Each pass evaluates every pixel at one point or, of a small film, at several
(``drgs.accuracy.sample_points``). With a box filter the samples are averaged, in their order: the
same bytes in every run. Any other filter spreads a sample over its neighbours, which Mitsuba does
by atomic additions: such a picture is the same up to rounding. No samples are taken beyond the
film, also where it has ``sample_border``: its outermost pixels are means of the samples that there
are.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.accuracy.sample_points import SamplePoints
from drgs.core.arrays import divide, repeat_array
from drgs.core.private import same_variables
from drgs.integrator.film import (
    CenterSamples,
    Channels,
    develop_pixels,
    num_colors,
    pixel_corners,
    pixels_adjoint,
    with_weight,
)

PIXELS_PER_PASS = 1 << 17
"""Most pixels of a pass of several samples: a launch of fewer costs more than what it computes."""

SAMPLES_PER_KERNEL = 16
"""Of more samples per pixel, the sums of a box filter are evaluated in between: compilers take
longer than proportionally to a kernel's length. Of other filters, which reach over many
pixels, each pass is evaluated by itself."""


def in_passes(points: mi.Point2f, count: int, num_pixels: int) -> tuple[SamplePoints, ...]:
    """Divide samples into passes; points: of all, those of a pixel are neighbours."""
    at_once = min(max(PIXELS_PER_PASS // num_pixels, 1), count)
    passes = []
    for first in range(0, count, at_once):
        samples = min(at_once, count - first)
        sample, pixel = divide(dr.arange(mi.UInt32, samples * num_pixels), num_pixels, samples)
        place = pixel * dr.opaque(mi.UInt32, count) + sample + dr.opaque(mi.UInt32, first)
        passes.append(SamplePoints(*dr.gather(mi.Point2f, points, place), samples))
    return tuple(passes)


def by_sample(positions: Sequence[SamplePoints], passes: Sequence[Channels]) -> Iterator[Channels]:
    """Divide the channels of passes into those of each sample, Float (H * W,)."""
    for points, channels in zip(positions, passes, strict=True):
        if points.samples == 1:
            yield channels
            continue
        dr.eval(channels)
        num_pixels = dr.width(points.x) // points.samples
        for sample in range(points.samples):
            pixel = dr.arange(mi.UInt32, num_pixels) + dr.opaque(mi.UInt32, sample * num_pixels)
            yield [dr.gather(mi.Float, p, pixel, mode=dr.ReduceMode.Permute) for p in channels]


class HeldSeed:
    """A seed that is an array, as it is now: its owner may change it in place.

    Equal to another of the same variable: no value is read back. That it is held keeps the
    variable's index from being reused.
    """

    def __init__(self, seed: mi.UInt32) -> None:
        self.seed = type(seed)(seed)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, HeldSeed) and same_variables(self.seed, other.seed)

    __hash__ = None


class DrawnSamples(CenterSamples):
    """``spp`` samples per pixel, drawn by a copy of the sensor's sampler."""

    def __init__(
        self,
        sensor: mi.Sensor,
        seed: int | mi.UInt32,
        spp: int,
        maps: dict[str, np.ndarray],
        aovs: Sequence[str] = (),
    ) -> None:
        super().__init__(sensor.film(), maps, aovs)
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(spp)
        spp = sampler.sample_count()  # some round it up
        size = self.film.crop_size()
        num_pixels = size[0] * size[1]
        sampler.set_samples_per_wavefront(spp)
        sampler.seed(seed, num_pixels * spp)
        points = sampler.next_2d()
        self.positions = in_passes(points, spp, num_pixels)
        dr.eval([(p.x, p.y) for p in self.positions])
        self.key = (HeldSeed(seed) if dr.is_jit_v(seed) else seed, spp, str(sensor.sampler()))

    def develop(self, passes: Sequence[Channels]) -> mi.TensorXf:
        film = self.film
        if film.rfilter().is_box_filter():
            count = sum(point.samples for point in self.positions)
            sums = [mi.Float(0)] * len(passes[0])
            for number, channels in enumerate(by_sample(self.positions, passes), 1):
                sums = [total + plane for total, plane in zip(sums, channels, strict=True)]
                if number % SAMPLES_PER_KERNEL == 0 and number < count:
                    dr.eval(sums)
            return develop_pixels(film, [total / count for total in sums], self.aovs)
        film.prepare(self.aovs)
        block = film.create_block()
        for point, channels in zip(self.positions, passes, strict=True):
            values = with_weight(film, channels, mi.Float(1))
            corner = pixel_corners(film, point.samples) + mi.Vector2f(film.crop_offset())
            block.put(corner + mi.Point2f(point.x, point.y), values)
            dr.eval(block.tensor())  # a kernel for each pass: all are the same one
        film.put_block(block)
        return film.develop()

    def adjoint(self, grad_in: mi.TensorXf) -> list[Channels]:
        if self.film.rfilter().is_box_filter():
            count = sum(point.samples for point in self.positions)
            averaged = pixels_adjoint(self.film, self.maps, grad_in, self.aovs)
            of_sample = [d / count for d in averaged]
            dr.eval(of_sample)
            return [[repeat_array(d, point.samples) for d in of_sample] for point in self.positions]
        # The image is linear in the channels: their values do not matter.
        num_channels = num_colors(self.film) + len(self.aovs)
        passes = [
            [dr.opaque(mi.Float, 0, dr.width(point.x)) for _ in range(num_channels)]
            for point in self.positions
        ]
        with dr.resume_grad():
            dr.enable_grad(passes)
            image = self.develop(passes)
            dr.set_grad(image, grad_in)
            dr.enqueue(dr.ADMode.Backward, image)
            dr.traverse(dr.ADMode.Backward)
            derivatives = dr.grad(passes)
        for of_pass in derivatives:
            dr.eval(of_pass)  # as in develop
        return derivatives
