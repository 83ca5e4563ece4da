"""Samples of a film: sample positions, backgrounds, and the image from the values there.

:class:`CenterSamples` evaluates each pixel once, at its centre; :class:`DrawnSamples` at several
points of Mitsuba's samplers, in passes of one point per pixel or, on a small film, of several
(:class:`SamplePoints`). A box filter averages the samples in their order: the same bytes in every
run. Any other filter adds a sample to neighbours atomically: runs agree only up to rounding. No
samples are taken beyond the film, also where it has ``sample_border``.

Backgrounds that differ from pixel to pixel are environments, and textures stretched over the film.
Derivatives of their texels are added atomically as well.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np
from typing_extensions import override

from drgs.cameras.camera import Camera
from drgs.core.arrays import (
    divide,
    from_host,
    interleave,
    planes_of,
    quotient,
    repeat_array,
    types_of,
)
from drgs.core.errors import UnsupportedError
from drgs.core.types import Float
from drgs.splatting.footprint import PixelCenters, SamplePositions
from drgs.splatting.grid import MICRO, Lanes, TileGrid, load_pixels

Channels = list[Float]  # by pass, each (samples * H * W,): red, green, blue, perhaps alpha, AOVs


def num_colors(film: mi.Film) -> int:
    """Return the number of a film's colour channels, alpha included."""
    return 4 if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else 3


def with_weight(film: mi.Film, channels: Channels, weight: Float) -> Channels:
    """Return the channels of a block of this film: the weight follows the colours."""
    count = num_colors(film)
    return [*channels[:count], weight, *channels[count:]]


def pixel_corners(film: mi.Film, samples: int = 1) -> mi.Point2f:
    """Return the upper left corners of pixels, row by row, px; again for each sample."""
    width, height = film.crop_size()
    _, pixel = divide(dr.arange(mi.UInt32, samples * width * height), width * height, samples)
    row = quotient(pixel, width)
    return mi.Point2f(pixel - row * width, row)


def num_samples(film: mi.Film, x: Float | float) -> int:
    """Return the samples per pixel of a plane; x may be one number for all pixels."""
    return max(dr.width(x) // dr.prod(film.crop_size()), 1)


def decode(color: mi.Color3f, coverage: mi.Float) -> mi.Color3f:
    """Return linear radiance A D(C / A); color: C, display space; coverage: A, sum of weights."""
    return coverage * mi.math.srgb_to_linear(color / dr.select(coverage > 0, coverage, 1))


class CenterSamples:
    """A single sample per pixel, at its centre. Exact for a box filter."""

    positions: Sequence[SamplePositions] = (PixelCenters(),)  # by pass
    key: object = None  # equal for equal positions

    def __init__(
        self, film: mi.Film, maps: dict[str, np.ndarray], aovs: Sequence[str] = ()
    ) -> None:
        """Sample a film; maps: linear maps of films by description; aovs: names of channels."""
        self.film, self.maps, self.aovs = film, maps, list(aovs)

    def develop(self, passes: Sequence[Channels]) -> mi.TensorXf:
        """Return the image, from the channels of each pass."""
        (channels,) = passes
        return develop_pixels(self.film, channels, self.aovs)

    def adjoint(self, grad_in: mi.TensorXf) -> list[Channels]:
        """Return derivatives with respect to the channels, given those of the image."""
        return [pixels_adjoint(self.film, self.maps, grad_in, self.aovs)]


def develop_pixels(film: mi.Film, channels: Channels, aovs: Sequence[str]) -> mi.TensorXf:
    """Put the channels into ``film`` as one block, without filtering, and develop it."""
    size = film.crop_size()
    columns = with_weight(film, channels, dr.ones(mi.Float, dr.width(channels[0])))
    raw = mi.TensorXf(interleave(columns), (size[1], size[0], len(columns)))
    film.prepare(list(aovs))
    film.put_block(mi.ImageBlock(raw, mi.ScalarPoint2i(film.crop_offset())))
    return film.develop()


def pixels_adjoint(
    film: mi.Film, maps: dict[str, np.ndarray], grad_in: mi.TensorXf, aovs: Sequence[str]
) -> Channels:
    """Compute the adjoint of :func:`develop_pixels`.

    A film develops each pixel by the same linear map, found once by developing unit images: the
    derivative of ``develop`` itself would be scattered atomically.
    """
    developed = planes_of(grad_in)
    columns = (zip(column, developed, strict=True) for column in film_map(film, maps, aovs).T)
    return [sum((float(w) * d for w, d in column if w), mi.Float(0)) for column in columns]


def film_map(film: mi.Film, maps: dict[str, np.ndarray], aovs: Sequence[str]) -> np.ndarray:
    """Return the linear map that a film applies to each pixel: (developed channels, channels)."""
    key = f"{film} {', '.join(aovs)}"
    if key in maps:
        return maps[key]
    count = num_colors(film) + len(aovs)
    num_pixels = film.crop_size()[0] * film.crop_size()[1]

    def develop(channels: np.ndarray) -> np.ndarray:
        planes = [from_host(mi.Float, plane) for plane in channels.T]
        return np.array(develop_pixels(film, planes, aovs)).reshape(num_pixels, -1)

    units = [develop(np.tile(unit, (num_pixels, 1)))[0] for unit in np.eye(count, dtype=np.float32)]
    matrix = np.stack(units, axis=1)
    mixed = np.linspace(0.1, 2, num_pixels * count, dtype=np.float32).reshape(num_pixels, count)
    if not np.allclose(develop(mixed), mixed @ matrix.T, rtol=1e-3, atol=1e-4):
        raise UnsupportedError(
            f"splats: gradients through this film are not supported: {film} does not map each "
            "pixel's channels linearly"
        )
    maps[key] = matrix
    return matrix


PIXELS_PER_PASS = 1 << 17  # most pixels in a pass of several samples: larger launches gain nothing
SAMPLES_PER_KERNEL = 16  # of a box filter, between evaluations: compile time is superlinear


def split_passes(points: mi.Point2f, count: int, num_pixels: int) -> tuple[SamplePoints, ...]:
    """Divide samples into passes; points: the samples of a pixel are neighbours."""
    at_once = min(max(PIXELS_PER_PASS // num_pixels, 1), count)
    passes = []
    for first in range(0, count, at_once):
        samples = min(at_once, count - first)
        sample, pixel = divide(dr.arange(mi.UInt32, samples * num_pixels), num_pixels, samples)
        place = pixel * dr.opaque(mi.UInt32, count) + sample + dr.opaque(mi.UInt32, first)
        point = dr.gather(mi.Point2f, points, place)
        passes.append(SamplePoints(point.x, point.y, samples))
    return tuple(passes)


def split_samples(points: Sequence[SamplePoints], passes: Sequence[Channels]) -> Iterator[Channels]:
    """Divide the channels of passes into those of each sample, Float (H * W,)."""
    for point, channels in zip(points, passes, strict=True):
        if point.samples == 1:
            yield channels
            continue
        dr.eval(channels)
        num_pixels = dr.width(point.x) // point.samples
        for sample in range(point.samples):
            pixel = dr.arange(mi.UInt32, num_pixels) + dr.opaque(mi.UInt32, sample * num_pixels)
            yield [dr.gather(mi.Float, p, pixel, mode=dr.ReduceMode.Permute) for p in channels]


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
        # A copy: the owner of an array may change it in place.
        seed = seed if isinstance(seed, (int, np.integer)) else int(seed[0])
        sampler = sensor.sampler().clone()
        sampler.set_sample_count(spp)
        self.spp = spp = sampler.sample_count()  # some round it up
        num_pixels = int(dr.prod(self.film.crop_size()))
        sampler.set_samples_per_wavefront(spp)
        sampler.seed(seed, num_pixels * spp)
        self.positions = self.points = split_passes(sampler.next_2d(), spp, num_pixels)
        dr.eval([(p.x, p.y) for p in self.points])
        self.key = (seed, spp, str(sensor.sampler()))

    @override
    def develop(self, passes: Sequence[Channels]) -> mi.TensorXf:
        film = self.film
        if film.rfilter().is_box_filter():
            sums = [mi.Float(0)] * len(passes[0])
            for number, channels in enumerate(split_samples(self.points, passes), 1):
                sums = [total + plane for total, plane in zip(sums, channels, strict=True)]
                if number % SAMPLES_PER_KERNEL == 0 and number < self.spp:
                    dr.eval(sums)
            return develop_pixels(film, [total / self.spp for total in sums], self.aovs)
        film.prepare(self.aovs)
        block = film.create_block()
        for point, channels in zip(self.points, passes, strict=True):
            values = with_weight(film, channels, mi.Float(1))
            corner = pixel_corners(film, point.samples) + mi.Vector2f(film.crop_offset())
            block.put(corner + mi.Point2f(point.x, point.y), values)
            dr.eval(block.tensor())  # a kernel for each pass: all are the same one
        film.put_block(block)
        return film.develop()

    @override
    def adjoint(self, grad_in: mi.TensorXf) -> list[Channels]:
        if self.film.rfilter().is_box_filter():
            averaged = pixels_adjoint(self.film, self.maps, grad_in, self.aovs)
            of_sample = [d / self.spp for d in averaged]
            dr.eval(of_sample)
            return [[repeat_array(d, point.samples) for d in of_sample] for point in self.points]
        # The image is linear in the channels: their values do not matter.
        num_channels = num_colors(self.film) + len(self.aovs)
        widths = [dr.width(point.x) for point in self.points]
        passes = [[dr.opaque(mi.Float, 0, n) for _ in range(num_channels)] for n in widths]
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


@dataclass(frozen=True)
class SamplePoints(SamplePositions):
    """Points in each pixel, one per sample; equal if the arrays are the same."""

    margin: ClassVar[float] = 0.5

    x: Float  # (samples * H * W,) in [0, 1): from the pixel's left border, px
    y: Float  # the same, from its upper border
    samples: int = 1

    @override
    def bind(self, lanes: Lanes, grid: TileGrid) -> LanePoints:
        return LanePoints(load_pixels(self.x, lanes, grid), load_pixels(self.y, lanes, grid))


@dataclass(frozen=True)
class LanePoints(SamplePositions):
    """Points in the 16 pixels of each lane."""

    x: list[Float]  # in [0, 1): from the pixel's left border, px
    y: list[Float]  # the same, from its upper border

    @override
    def points(self, lanes: Lanes, Float: type) -> list[tuple[Float, Float]]:
        x, y = Float(lanes.x), Float(lanes.y)
        return [
            (x + (pixel % MICRO) + px, y + (pixel // MICRO) + py)
            for pixel, (px, py) in enumerate(zip(self.x, self.y, strict=True))
        ]

    @override
    def offsets(self, lanes: Lanes, x: Float, y: Float) -> tuple[list[Float], list[Float]]:
        Float = types_of(type(x)).Float
        first_x, first_y = Float(lanes.x) - x, Float(lanes.y) - y
        dx = [first_x + (pixel % MICRO) + in_x for pixel, in_x in enumerate(self.x)]
        dy = [first_y + (pixel // MICRO) + in_y for pixel, in_y in enumerate(self.y)]
        return dx, dy


LENS_POINTS = 16  # fixed points of an aperture; a small, bright light is seen as this many


def environment_radiance(emitter: mi.Emitter, camera: Camera, place: mi.Point2f) -> mi.Color3f:
    """Return an environment at places of the crop window, px; black where the lens ends."""
    ray, seen, count = camera.view_directions(place.x, place.y, LENS_POINTS)
    interaction = dr.zeros(mi.SurfaceInteraction3f, count * dr.width(place))
    interaction.wi = -mi.Vector3f(dr.normalize(ray))  # the environment is infinitely far
    radiance = mi.Color3f(emitter.eval(interaction))
    if seen is not True:
        radiance = dr.select(seen, radiance, 0)
    if count == 1 or dr.width(radiance) == 1:  # the latter: a constant environment
        return radiance
    return mi.Color3f([dr.block_sum(color, count) for color in radiance]) / count


def background_radiance(
    film: mi.Film,
    background: mi.Emitter | mi.Texture,
    cameras: Sequence[Camera],
    offsets: Sequence[tuple[mi.Float | float, mi.Float | float]],
) -> list[list[mi.Color3f]]:
    """Return backgrounds by time (cameras) and pass; offsets: from pixels' upper left, in px."""
    places = [pixel_corners(film, num_samples(film, x)) + mi.Vector2f(x, y) for x, y in offsets]
    if isinstance(background, mi.Texture):
        stretched = []  # the texture, over the film
        for place in places:
            interaction = dr.zeros(mi.SurfaceInteraction3f, dr.width(place))
            interaction.uv = (place + mi.Vector2f(film.crop_offset())) / mi.Vector2f(film.size())
            stretched.append(mi.Color3f(background.eval(interaction)))
        return [stretched] * len(cameras)
    return [[environment_radiance(background, camera, p) for p in places] for camera in cameras]
