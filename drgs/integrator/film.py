"""Samples of a film: where pixels are evaluated, and how an image comes of the values.

Between the integrator and Mitsuba's films. :class:`CenterSamples` evaluates each pixel once, at its
centre; ``drgs.integrator.sampling`` derives from it for several samples per pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.core.arrays import divide, from_host, interleave, quotient
from drgs.core.errors import UnsupportedError
from drgs.splatting.footprint import PixelCenters, Positions

Channels = list[Any]
"""Channels of one pass for a film, each Float (samples * H * W,): red, green, blue, perhaps alpha,
then what the integrator puts out besides (AOVs)."""


def num_colors(film: mi.Film) -> int:
    """Channels of colour that a film gets: with or without alpha."""
    return 4 if mi.has_flag(film.flags(), mi.FilmFlags.Alpha) else 3


def with_weight(film: mi.Film, channels: Channels, weight: Any) -> Channels:
    """The channels of a block of this film: the weight is behind the colours."""
    count = num_colors(film)
    return [*channels[:count], weight, *channels[count:]]


def pixel_corners(film: mi.Film, samples: int = 1) -> mi.Point2f:
    """The upper left corners of the crop window's pixels, row by row, px; again for each sample."""
    width, height = film.crop_size()
    _, pixel = divide(dr.arange(mi.UInt32, samples * width * height), width * height, samples)
    row = quotient(pixel, width)
    return mi.Point2f(pixel - row * width, row)


def samples_in(film: mi.Film, x: Any) -> int:
    """How many samples of each pixel a plane has; x may be a number for all pixels."""
    return max(dr.width(x) // dr.prod(film.crop_size()), 1)


def offsets_of(positions: Positions) -> tuple[Any, Any]:
    """Return x and y of sample positions from their pixels' upper left corners, px."""
    return (0.5, 0.5) if isinstance(positions, PixelCenters) else (positions.x, positions.y)


class CenterSamples:
    """One sample per pixel, at its centre. Exact for films whose filter is a box."""

    positions: Sequence[Positions] = (PixelCenters(),)  # by pass
    key: object = None  # equal for equal positions

    def __init__(
        self, film: mi.Film, maps: dict[str, np.ndarray], aovs: Sequence[str] = ()
    ) -> None:
        """maps: remembers the linear maps of films, by their description; aovs: channels' names."""
        self.film, self.maps, self.aovs = film, maps, list(aovs)

    def develop(self, passes: Sequence[Channels]) -> mi.TensorXf:
        """Return the image, from the channels of each pass."""
        (channels,) = passes
        return develop_pixels(self.film, channels, self.aovs)

    def adjoint(self, grad_in: mi.TensorXf) -> list[Channels]:
        """Return derivatives with respect to the channels, given those of the image."""
        return [pixels_adjoint(self.film, self.maps, grad_in, self.aovs)]


def develop_pixels(film: mi.Film, channels: Channels, aovs: Sequence[str]) -> mi.TensorXf:
    """Put the channels into ``film`` as one block of the whole image, and develop it.

    A film reconstructs an image from blocks without filtering them again, so the picture is
    exact whatever the film's filter.
    """
    weight = dr.ones(mi.Float, dr.width(channels[0]))
    size = film.crop_size()
    columns = with_weight(film, channels, weight)
    raw = mi.TensorXf(interleave(columns), (size[1], size[0], len(columns)))
    film.prepare(list(aovs))
    film.put_block(mi.ImageBlock(raw, mi.ScalarPoint2i(film.crop_offset())))
    return film.develop()


def pixels_adjoint(
    film: mi.Film, maps: dict[str, np.ndarray], grad_in: mi.TensorXf, aovs: Sequence[str]
) -> Channels:
    """The adjoint of :func:`develop_pixels`.

    A film develops each pixel by the same linear map, found once by developing unit images.
    (The derivative of ``develop`` itself would be scattered by atomic additions.)
    """
    matrix = film_map(film, maps, aovs)
    pixel = dr.arange(mi.UInt32, grad_in.shape[0] * grad_in.shape[1])
    developed = [
        dr.gather(mi.Float, grad_in.array, pixel * len(matrix) + k) for k in range(len(matrix))
    ]
    return [
        sum(
            (float(weight) * d for weight, d in zip(column, developed, strict=True) if weight),
            start=mi.Float(0),
        )
        for column in matrix.T
    ]


def film_map(film: mi.Film, maps: dict[str, np.ndarray], aovs: Sequence[str]) -> np.ndarray:
    """(developed channels, channels): the linear map that a film applies to each pixel.

    maps: remembers those of films, by their description.
    """
    key = f"{film} {', '.join(aovs)}"
    if key not in maps:
        maps[key] = _found_map(film, aovs)
    return maps[key]


def _found_map(film: mi.Film, aovs: Sequence[str]) -> np.ndarray:
    count = num_colors(film) + len(aovs)
    num_pixels = film.crop_size()[0] * film.crop_size()[1]

    def develop(channels: np.ndarray) -> np.ndarray:
        planes = [from_host(mi.Float, plane) for plane in channels.T]
        return np.array(develop_pixels(film, planes, aovs)).reshape(num_pixels, -1)

    unit = np.eye(count, dtype=np.float32)
    units = [develop(np.tile(channel, (num_pixels, 1)))[0] for channel in unit]
    matrix = np.stack(units, axis=1)
    mixed = np.linspace(0.1, 2, num_pixels * count, dtype=np.float32).reshape(num_pixels, count)
    linear = np.allclose(develop(mixed), mixed @ matrix.T, rtol=1e-3, atol=1e-4)
    if not linear:
        raise UnsupportedError(
            f"splats: gradients through this film are not supported: {film} does not map each "
            "pixel's channels linearly"
        )
    return matrix
