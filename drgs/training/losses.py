"""The photometric loss and its hand-written adjoint.

Between the rendered image and the optimizer: image (H, W, 3) + :class:`Target` -> one number that
Dr.Jit differentiates in reverse and forward mode.

SSIM (Wang et al. 2004, "Image quality assessment: from error visibility to structural
similarity") is a function of five blurred maps, two of which belong to the target. A blur with a
symmetric window and zero padding is its own adjoint, so the gradient is three more blurs: nothing
is scattered, and the result is bit-reproducible.

Each channel is cut into 8 x 8 tiles. One lane computes the 8 outputs of one tile row (or column)
from the 18 inputs that they share, which it loads as three packets of 8. Maps are blurred one after
the other, as the inputs of one alone fit into a core's registers.
"""

from __future__ import annotations

import math
import sys
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
from typing_extensions import override

from drgs.config.extensions import LOSS_TERMS, LOSSES, section_of
from drgs.config.schema import FitConfig
from drgs.core.arrays import MAX_LANES, is_float64, types_of
from drgs.core.private import access_all_lanes
from drgs.core.types import ArrayXf, Bool, Float, TensorXf, UInt32

C1, C2 = 0.01**2, 0.03**2
"""(K L)^2 with K1 = 0.01, K2 = 0.03, dynamic range L = 1 (Wang et al. 2004, section IV)."""

TARGET_BYTES = 36
"""Memory of a pixel: three numbers for each of three channels, float32; see :class:`Target`."""

_TILE = 8  # pixels; 4 and 16 were measured to be slower
_CHANNELS = 3


@dataclass(frozen=True)
class Target:
    """A photograph y and the two blurs of SSIM that depend on it alone; detached, in tiles."""

    height: int
    width: int
    weights: tuple[float, ...]  # SSIM's window along one axis, unit sum
    values: Float  # y, display space; row order
    means: Float  # B y; column order
    mean_squares: Float  # B y^2; column order

    @property
    def image(self) -> TensorXf:
        """The photograph, (H, W, 3) tensor, display space."""
        flat = _tiling(self).from_tiles(self.values)
        return types_of(type(flat)).TensorXf(flat, (self.height, self.width, _CHANNELS))


def prepare_target(image: TensorXf, window: int = 11, sigma: float = 1.5) -> Target:
    """Return the :class:`Target` of a photograph.

    image: (H, W, 3) tensor, display space. window: width of SSIM's Gaussian window, px, odd.
    sigma: its standard deviation, px. The defaults are those of Wang et al. 2004, section III.B,
    and of the 3DGS reference. Not differentiated.
    """
    height, width = _film_size("prepare_target()", image)
    flat = dr.detach(image).array
    weights = _gaussian_window(window, sigma)
    tiling = _Tiling(height, width, weights, dr.uint32_array_t(type(flat)))
    values = tiling.to_tiles(flat)
    dr.eval(values)

    y = tiling.rows.read(values)
    maps = [tiling.rows.store_across(_blur(z, weights)) for z in (y, _product(y, y))]
    dr.eval(maps)
    columns = tiling.columns
    means, mean_squares = [columns.store(_blur(columns.read(z), weights)) for z in maps]
    dr.eval(means, mean_squares)
    return Target(height, width, weights, values, means, mean_squares)


class Loss:
    """A loss of a rendered image and a photograph; subclasses define :meth:`__call__`."""

    @classmethod
    def from_config(cls, config: FitConfig, section: Any) -> Loss:
        """Return the loss of a fit; section: see ``TrainingEffect.from_config``."""
        make = cast("Callable[..., Loss]", cls)
        return make() if section is None else make(section)

    @abstractmethod
    def __call__(self, image: TensorXf, target: Target) -> Float:
        """Return the loss, a ``Float`` of one value; image: (H, W, 3) tensor, display space.

        ``target.image`` is the photograph. Differentiated in the image.
        """
        raise NotImplementedError

    def with_squared_error(self, image: TensorXf, target: Target) -> tuple[Float, Float]:
        """Return the loss, and the mean over pixels and channels of (x - y)^2: Floats of one value.

        Not differentiated: the squared error.
        """
        error = dr.mean(dr.square(dr.detach(image).array - target.image.array))
        return self(image, target), error


class LossTerm:
    """A term that is added to the loss; subclasses define one of its methods, or both."""

    @classmethod
    def from_config(cls, config: FitConfig, section: Any) -> LossTerm:
        """Return the term of a fit; section: see ``TrainingEffect.from_config``."""
        make = cast("Callable[..., LossTerm]", cls)
        return make() if section is None else make(section)

    def of_image(self, image: TensorXf, target: Target) -> Float | None:
        """Return a ``Float`` of one value, or None; see :class:`Loss` for the arguments."""

    def of_gaussians(self, parameters: Mapping[str, dr.ArrayBase], num_rows: int) -> Float | None:
        """Return a ``Float`` of one value, or None.

        parameters: raw values by name, attached, of ``num_rows`` Gaussians in all, of which each
        process has some: terms are sums over these, divided by ``num_rows``.
        """


@LOSSES.register("photometric")
@dataclass(frozen=True)
class PhotometricLoss(Loss):
    """L = (1 - w) L1 + w (1 - SSIM), means over all pixels and channels (3DGS, equation 7).

    SSIM's window is the one that the target was prepared with. Windows reach beyond the image
    into zeros, as in the 3DGS reference implementation. The derivative of |x - y| at x = y is
    taken as 0. Differentiable in the image; not differentiated: the target.
    """

    dssim_weight: float = 0.2  # w, in [0, 1]

    @classmethod
    @override
    def from_config(cls, config: FitConfig, section: None) -> PhotometricLoss:
        return cls(config.loss.dssim_weight)

    def __post_init__(self) -> None:
        """Refuse weights that do not interpolate."""
        if not 0 <= self.dssim_weight <= 1:
            raise ValueError(
                f"PhotometricLoss(): dssim_weight must be in [0, 1], got {self.dssim_weight}"
            )

    @override
    def __call__(self, image: TensorXf, target: Target) -> Float:
        return self.with_squared_error(image, target)[0]

    @override
    def with_squared_error(self, image: TensorXf, target: Target) -> tuple[Float, Float]:
        height, width = _film_size("PhotometricLoss()", image)
        if (height, width) != (target.height, target.width):
            raise ValueError(
                f"PhotometricLoss(): the image is {width} x {height} pixels, its target "
                f"{target.width} x {target.height}: render at the photograph's size"
            )
        if self.dssim_weight == 0:
            error = dr.mean(dr.square(dr.detach(image).array - target.image.array))
            return l1_loss(image, target.image), error
        operands = {"image": image, "target": target, "weight": self.dssim_weight}
        loss, error = dr.custom(_PhotometricOp, **operands)
        return loss, dr.detach(error)


def make_loss(config: FitConfig) -> Loss:
    """Return the loss of a configuration."""
    loss = LOSSES.get(config.loss.type, "loss.type")
    return loss.value.from_config(config, section_of(loss, config.sections))


def make_loss_terms(config: FitConfig) -> list[LossTerm]:
    """Return the terms of the loss that a configuration has sections for."""
    used = [each for each in LOSS_TERMS.all() if each.name in config.sections]
    return [each.value.from_config(config, section_of(each, config.sections)) for each in used]


def l1_loss(image: TensorXf, target: TensorXf) -> Float:
    """Return mean |x - y| of two tensors of equal shape as a ``Float`` of one value.

    The derivative at x = y is taken as 0. Not differentiated: the target.
    """
    difference = image.array - dr.detach(target).array
    return dr.mean(difference * _sign(dr.detach(difference)))


class _PhotometricOp(dr.CustomOp):
    """Evaluates the loss and SSIM's partials by two blur passes, the gradient by two more."""

    @override
    def eval(self, image: TensorXf, target: Target, weight: float) -> tuple[Float, Float]:
        self.target, self.weight, self.shape = target, weight, image.shape
        self.tiling = _tiling(target)
        self.values = self.tiling.to_tiles(image.array)
        dr.eval(self.values)
        blurred, absolute, squared = _blur_along_rows(self.tiling, self.values, target)
        loss, self.partials = _ssim_and_partials(self.tiling, blurred, absolute, target, weight)
        count = self.tiling.num_values
        return dr.sum(loss) / count, dr.sum(squared) / count

    def gradient(self) -> Float:
        """Return d loss / d image, flat, row-major; pass 3 blurs the partials along columns."""
        columns, weights = self.tiling.columns, self.tiling.weights
        blurred = [columns.store_across(_blur(columns.read(z), weights)) for z in self.partials]
        dr.eval(blurred)
        tiles = _assemble_gradient(self.tiling, blurred, self.values, self.target, self.weight)
        return self.tiling.from_tiles(tiles)

    @override
    def backward(self) -> None:
        d_loss, _ = cast("tuple[Float, Float]", self.grad_out())
        flat = self.gradient() * d_loss
        self.set_grad_in("image", types_of(type(flat)).TensorXf(flat, self.shape))

    @override
    def forward(self) -> None:
        tangent = dr.sum(self.gradient() * cast(TensorXf, self.grad_in("image")).array)
        self.set_grad_out((tangent, dr.zeros(type(tangent))))

    @override
    def name(self) -> str:
        return "PhotometricLoss"


def _blur_along_rows(
    tiling: _Tiling, values: Float, target: Target
) -> tuple[list[Float], Float, Float]:
    """Pass 1: x, x^2 and xy blurred along rows, column order; each row's |x - y| and (x - y)^2."""
    rows = tiling.rows
    x, y = rows.read(values), rows.read(target.values)
    maps = (x, _product(x, x), _product(x, y))
    blurred = [rows.store_across(_blur(z, tiling.weights)) for z in maps]
    differences = [x[k] - y[k] for k in range(_TILE)]  # beyond the image both are 0
    zero = type(values)(0)
    absolute = sum(map(dr.abs, differences), zero)
    squared = sum(map(dr.square, differences), zero)
    dr.eval(blurred, absolute, squared)
    return blurred, absolute, squared


def _ssim_and_partials(
    tiling: _Tiling, maps: list[Float], absolute: Float, target: Target, weight: float
) -> tuple[Float, list[Float]]:
    """Pass 2: each line's share of the loss, and dS/dmu_x, dS/dE[x^2], dS/dE[xy], column order.

    With mu = E[.] the windowed means, var and cov from E[x^2] - mu^2 and so on,
        S = A1 A2 / (B1 B2),  A1 = 2 mu_x mu_y + C1,       A2 = 2 cov_xy + C2,
                              B1 = mu_x^2 + mu_y^2 + C1,   B2 = var_x + var_y + C2
    (Wang et al. 2004, equation 13). The partials are those of S(mu_x, E[x^2], E[xy]): each of
    the three is linear in windows of x, x^2 or xy. absolute: shares of the sum of |x - y|.
    """
    columns = tiling.columns
    blurred = [_blur(columns.read(z), tiling.weights) for z in maps]
    means, mean_squares = columns.read_own(target.means), columns.read_own(target.mean_squares)
    dissimilar, partials = 0, []
    for k, (mu_x, mean_xx, mean_xy) in enumerate(zip(*blurred, strict=True)):
        mu_y, mean_yy = means[k], mean_squares[k]
        a1 = 2 * mu_x * mu_y + C1
        a2 = 2 * (mean_xy - mu_x * mu_y) + C2
        b1 = mu_x * mu_x + mu_y * mu_y + C1
        b2 = _variance(mu_x, mean_xx) + _variance(mu_y, mean_yy) + C2
        inv_b2 = 1 / b2
        inv_b1b2 = inv_b2 / b1
        ssim = a1 * a2 * inv_b1b2
        d_mu_x = 2 * (mu_y * (a2 - a1) - mu_x * ssim * (b2 - b1)) * inv_b1b2
        d_mean_xx = -ssim * inv_b2
        d_mean_xy = 2 * a1 * inv_b1b2

        # Windows centred beyond the image are no part of the mean, nor of its adjoint.
        inside = columns.is_inside(k)
        dissimilar += dr.select(inside, 1 - ssim, 0)
        partials.append([dr.select(inside, d, 0) for d in (d_mu_x, d_mean_xx, d_mean_xy)])
    loss = (1 - weight) * absolute + weight * dissimilar
    stored = [columns.store(list(values)) for values in zip(*partials, strict=True)]
    dr.eval(loss, stored)
    return loss, stored


def _assemble_gradient(
    tiling: _Tiling, partials: list[Float], values: Float, target: Target, weight: float
) -> Float:
    """Pass 4: d loss / d image, row order.

    The windowed means are linear in x, x^2 and xy, and the blur B is its own adjoint:
        d (sum of S) / dx = B dS/dmu_x + 2 x B dS/dE[x^2] + y B dS/dE[xy].
    """
    rows = tiling.rows
    own = rows.read_own(values), rows.read_own(target.values)
    blurred = [_blur(rows.read(z), tiling.weights) for z in partials]
    gradient = []
    for x, y, d_mu_x, d_mean_xx, d_mean_xy in zip(*own, *blurred, strict=True):
        d_ssim = d_mu_x + 2 * x * d_mean_xx + y * d_mean_xy
        d_loss = (1 - weight) * _sign(x - y) - weight * d_ssim
        gradient.append(d_loss / tiling.num_values)
    return rows.store(gradient)


def _variance(mean: Float, mean_square: Float) -> Float:
    """Return E[x^2] - E[x]^2, which rounding would make negative for x >> 1."""
    variance = mean_square - mean * mean
    return dr.select(variance < 0, 0, variance)


def _sign(x: Float) -> Float:
    return dr.select(x > 0, 1, dr.select(x < 0, -1, type(x)(0)))


@dataclass(frozen=True)
class _Tiling:
    """The layout of an (H, W, 3) image in memory: 8 x 8 tiles of one channel.

    Tiles are ordered (channel, tile row, tile column). Within a tile, pixels are in *row order*
    (the 8 pixels of a row contiguous) or in *column order*. The last tiles are filled with zeros.
    """

    height: int
    width: int
    weights: tuple[float, ...]
    index_type: type  # UInt32 of the image's backend

    @property
    def num_values(self) -> int:
        """Values of the image, padding excluded."""
        return self.height * self.width * _CHANNELS

    @property
    def grid(self) -> tuple[int, int]:
        """Tiles from top to bottom and from left to right."""
        return -(-self.height // _TILE), -(-self.width // _TILE)

    @property
    def num_lines(self) -> int:
        """Rows (or columns) of all tiles of all channels."""
        return _CHANNELS * math.prod(self.grid) * _TILE

    def empty(self, float_type: type[Float]) -> Float:
        """Allocate an image in tiles, and lines behind it for lanes that only fill up a vector."""
        return dr.empty(float_type, (self.num_lines + MAX_LANES) * _TILE)

    def to_tiles(self, flat: Float) -> Float:
        """Bring a row-major (H, W, 3) image into tiles, row order; one lane a row, all channels."""
        lines = self.num_lines // _CHANNELS
        lane = dr.arange(self.index_type, lines)
        _, tile_row, tile_column = self.split(lane // _TILE)
        row, column = tile_row * _TILE + lane % _TILE, tile_column * _TILE
        first = (row * self.width + column) * _CHANNELS
        tiles = self.empty(type(flat))
        for channel in range(_CHANNELS):
            values = []
            for k in range(_TILE):
                inside = (row < self.height) & (column + k < self.width)
                source = first + (_CHANNELS * k + channel)
                values.append(dr.gather(type(flat), flat, source, inside))
            _store_packets(tiles, values, lane + channel * lines)
        return tiles

    def from_tiles(self, tiles: Float) -> Float:
        """Bring tiles in row order back to a row-major (H, W, 3) image, not evaluated."""
        index = dr.arange(self.index_type, self.num_values)
        pixel, channel = index // _CHANNELS, index % _CHANNELS
        row, column = pixel // self.width, pixel % self.width
        rows, columns = self.grid
        tile = (channel * rows + row // _TILE) * columns + column // _TILE
        return dr.gather(type(tiles), tiles, (tile * _TILE + row % _TILE) * _TILE + column % _TILE)

    def split(self, tile: UInt32) -> tuple[UInt32, UInt32, UInt32]:
        """Channel, tile row and tile column of a tile's index."""
        rows, columns = self.grid
        strip = tile // columns
        return strip // rows, strip % rows, tile % columns

    @property
    def rows(self) -> _Lines:
        """Lanes of tile rows."""
        return _Lines(self, stride=1, axis=1)

    @property
    def columns(self) -> _Lines:
        """Lanes of tile columns."""
        return _Lines(self, stride=self.grid[1], axis=0)


@dataclass(frozen=True)
class _Lines:
    """The lanes of one pass: lane (tile, line) owns a row (column) of 8 pixels in a tile."""

    tiling: _Tiling
    axis: int  # 0: lines are columns, 1: rows
    stride: int  # from a tile to the next one along a line

    @property
    def lane(self) -> UInt32:
        return dr.arange(self.tiling.index_type, self.tiling.num_lines)

    def is_inside(self, k: int) -> Bool:
        """Return whether the line's k-th pixel belongs to the image."""
        line, (_, *tile) = self.lane % _TILE, self.tiling.split(self.lane // _TILE)
        along = tile[self.axis] * _TILE + k
        across = tile[1 - self.axis] * _TILE + line
        size = self.tiling.height, self.tiling.width
        return (along < size[self.axis]) & (across < size[1 - self.axis])

    def read_own(self, values: Float) -> ArrayXf:
        """Return the line's own 8 values; ``values`` contiguous along lines."""
        return self._read_packet(values, self.lane, True)

    def read(self, values: Float) -> dict[int, Float]:
        """Return the inputs of the line's 8 outputs by pixel, from its tile's edge; 0 beyond tiles.

        values: contiguous along lines.
        """
        packets = [self._read_packet(values, *self._neighbour(step)) for step in (-1, 0, 1)]
        radius = len(self.tiling.weights) // 2
        return {k: packets[1 + k // _TILE][k % _TILE] for k in range(-radius, _TILE + radius)}

    def store(self, values: list[Float]) -> Float:
        """Store each line's 8 values, contiguous along lines."""
        flat = self.tiling.empty(type(values[0]))
        with access_all_lanes(type(flat)):
            _store_packets(flat, values, self.lane)
        return flat

    def store_across(self, values: list[Float]) -> Float:
        """Store them contiguous across lines: rows in column order, columns in row order."""
        flat = self.tiling.empty(type(values[0]))
        line = self.lane % _TILE
        first = (self.lane - line) * _TILE + line
        with access_all_lanes(type(flat)):
            for k, value in enumerate(values):
                dr.scatter(flat, value, first + k * _TILE, mode=dr.ReduceMode.NoConflicts)
        return flat

    def _read_packet(self, values: Float, line: UInt32, valid: Bool | bool) -> ArrayXf:
        shape = (_TILE, self.tiling.num_lines)
        return dr.gather(_packet_type(type(values)), values, line, valid, shape=shape)

    def _neighbour(self, step: int) -> tuple[UInt32, Bool | bool]:
        """Return the same line in the tile ``step`` further along it, and whether there is one."""
        coordinate = self.tiling.split(self.lane // _TILE)[1 + self.axis]
        if step < 0:
            return self.lane - self.stride * _TILE, coordinate > 0
        if step > 0:
            return self.lane + self.stride * _TILE, coordinate + 1 < self.tiling.grid[self.axis]
        return self.lane, True


def _store_packets(flat: Float, values: list[Float], index: UInt32) -> None:
    """Store 8 values a lane as packet ``index`` of an array, which no other lane fills.

    ``NoConflicts`` lets several stores into one array share a kernel.
    """
    dr.scatter(flat, _packet_type(type(flat))(values), index, mode=dr.ReduceMode.NoConflicts)


def _product(x: dict[int, Float], y: dict[int, Float]) -> dict[int, Float]:
    return {k: x[k] * y[k] for k in x}


def _blur(values: dict[int, Float], weights: tuple[float, ...]) -> list[Float]:
    """Return a blurred map at the line's 8 pixels; values: see :meth:`_Lines.read`."""
    radius = len(weights) // 2
    blurred = []
    for k in range(_TILE):
        total = 0
        for offset, weight in enumerate(weights, start=k - radius):
            total = dr.fma(values[offset], weight, total)
        blurred.append(total)
    return blurred


def _tiling(target: Target) -> _Tiling:
    index_type = dr.uint32_array_t(type(target.values))
    return _Tiling(target.height, target.width, target.weights, index_type)


def _gaussian_window(window: int, sigma: float) -> tuple[float, ...]:
    widest = 2 * _TILE + 1  # only adjacent tiles are read
    if window not in range(1, widest + 1, 2):
        raise ValueError(
            f"prepare_target(): window must be odd and at most {widest} pixels, got {window}"
        )
    if not sigma > 0:
        raise ValueError(f"prepare_target(): sigma must be > 0 pixels, got {sigma}")
    weights = [math.exp(-0.5 * ((k - window // 2) / sigma) ** 2) for k in range(window)]
    return tuple(weight / sum(weights) for weight in weights)


def _packet_type(float_type: type) -> type:
    """Return the array type of any number of ``float_type`` components."""
    name = "ArrayXf64" if is_float64(float_type) else "ArrayXf"
    return getattr(sys.modules[float_type.__module__], name)


def _film_size(where: str, image: TensorXf) -> tuple[int, int]:
    shape = tuple(image.shape)
    if len(shape) != 3 or shape[2] != _CHANNELS or 0 in shape:
        raise ValueError(
            f"{where}: the image must be an (H, W, {_CHANNELS}) tensor, got shape {shape}; "
            "an alpha channel is composited over the background before"
        )
    return shape[0], shape[1]
