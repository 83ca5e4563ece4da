"""Several samples per pixel, at points that Mitsuba's samplers choose.

Imported when a scene asks for more than one sample, or for a reconstruction filter other than a
box. Each pass evaluates every pixel once (``drgs.accuracy.sample_points``). With a box filter the
passes are averaged, in their order: the same bytes in every run. Any other filter spreads a sample
over its neighbours, which Mitsuba does by atomic additions: such a picture is the same up to
rounding. No samples are taken beyond the film, also where it has ``sample_border``: its outermost
pixels are means of the samples that there are.
"""

from __future__ import annotations

from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.accuracy.sample_points import SamplePoints
from drgs.core.private import same_variables
from drgs.integrator.film import Channels, develop_pixels, num_colors, pixels_adjoint, with_weight

PASSES_PER_KERNEL = 16
"""Of more samples per pixel, the sums of a box filter are evaluated in between: compilers take
longer than proportionally to a kernel's length. Of other filters, which reach over many
pixels, each pass is evaluated by itself."""


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


class DrawnSamples:
    """``spp`` samples per pixel, drawn by a copy of the sensor's sampler."""

    def __init__(
        self,
        sensor: mi.Sensor,
        seed: int | mi.UInt32,
        spp: int,
        maps: dict[str, np.ndarray],
        aovs: Sequence[str] = (),
    ) -> None:
        """maps: remembers the linear maps of films, by their description; aovs: channels' names."""
        self.film, self.maps, self.aovs = sensor.film(), maps, list(aovs)
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(spp)
        spp = sampler.sample_count()  # some round it up
        size = self.film.crop_size()
        num_pixels = size[0] * size[1]
        sampler.set_samples_per_wavefront(spp)
        sampler.seed(seed, num_pixels * spp)
        points = sampler.next_2d()
        pixel = dr.arange(mi.UInt32, num_pixels)
        self.positions = tuple(
            SamplePoints(*dr.gather(mi.Point2f, points, pixel * spp + s)) for s in range(spp)
        )
        self.within = tuple((p.x, p.y) for p in self.positions)
        dr.eval(self.within)
        self.key = (HeldSeed(seed) if dr.is_jit_v(seed) else seed, spp, str(sensor.sampler()))

    def develop(self, passes: Sequence[Channels]) -> mi.TensorXf:
        """The image of all passes."""
        if self.film.rfilter().is_box_filter():
            count = len(passes)
            sums = [mi.Float(0)] * len(passes[0])
            for first in range(0, count, PASSES_PER_KERNEL):
                for channels in passes[first : first + PASSES_PER_KERNEL]:
                    sums = [total + plane for total, plane in zip(sums, channels, strict=True)]
                if count > PASSES_PER_KERNEL:
                    dr.eval(sums)
            return develop_pixels(self.film, [total / count for total in sums], self.aovs)
        film = self.film
        film.prepare(self.aovs)
        block = film.create_block()
        size, offset = film.crop_size(), film.crop_offset()
        pixel = dr.arange(mi.UInt32, size[0] * size[1])
        y = pixel // size[0]
        corner = mi.Point2f(pixel - y * size[0] + offset[0], y + offset[1])
        for point, channels in zip(self.positions, passes, strict=True):
            values = with_weight(film, channels, mi.Float(1))
            block.put(corner + mi.Point2f(point.x, point.y), values)
            dr.eval(block.tensor())  # a kernel for each pass: all are the same one
        film.put_block(block)
        return film.develop()

    def adjoint(self, grad_in: mi.TensorXf) -> list[Channels]:
        """Derivatives of the loss with respect to the channels, given those of the image."""
        count = len(self.positions)
        if self.film.rfilter().is_box_filter():
            averaged = pixels_adjoint(self.film, self.maps, grad_in, self.aovs)
            return [[d / count for d in averaged]] * count
        # The image is linear in the channels: their values do not matter.
        num_channels = num_colors(self.film) + len(self.aovs)
        size = dr.width(self.positions[0].x)
        passes = [[dr.opaque(mi.Float, 0, size) for _ in range(num_channels)] for _ in range(count)]
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
