"""The photometric loss and its hand-written adjoint.

Between the rendered image and the optimizer: image (H, W, 3) + :class:`Target` -> one number that
Dr.Jit differentiates in reverse and forward mode.

SSIM (Wang et al. 2004, "Image quality assessment: from error visibility to structural
similarity") is a function of five blurred maps, two of which belong to the target. A blur with a
symmetric window and zero padding is its own adjoint, so the gradient is three more blurs: nothing
is scattered, and the result is bit-reproducible.

Images are stored row by row with zeros between the rows, and a lane computes one number. A blur
along either axis is then a weighted sum of an array with itself, shifted: views of the same memory
(:func:`drgs.core.private.shifted_views`), which are loaded by whole vectors.
"""

from __future__ import annotations

import math
import operator
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import drjit as dr
from typing_extensions import override

from drgs.config.extensions import LOSS_TERMS, LOSSES, section_of
from drgs.config.schema import FitConfig
from drgs.core.arrays import (
    MAX_LANES,
    divide,
    existing_lanes,
    first_numbers,
    quotient,
    store_columns,
    types_of,
)
from drgs.core.private import access_all_lanes, shifted_views
from drgs.core.types import Float, TensorXf, UInt32

C1, C2 = 0.01**2, 0.03**2
"""(K L)^2 with K1 = 0.01, K2 = 0.03, dynamic range L = 1 (Wang et al. 2004, section IV)."""

_WINDOW, _CHANNELS = 11, 3
_PACKET = 8  # numbers that a lane copies


@dataclass(frozen=True)
class Target:
    """A photograph y and the two blurs of SSIM that depend on it alone; detached, padded."""

    height: int
    width: int
    weights: tuple[float, ...]  # SSIM's window along one axis, unit sum
    values: Float  # y, display space; for two blurs along each axis
    means: Float  # B y; for one
    mean_squares: Float  # B y^2; for one; -1 beyond the image

    @property
    def image(self) -> TensorXf:
        """The photograph, (H, W, 3) tensor, display space."""
        flat = _Padded(_layout_of(self), self.values, 2, 2).image
        return types_of(type(flat)).TensorXf(flat, (self.height, self.width, _CHANNELS))


def target_bytes(height: int, width: int) -> int:
    """Return the memory of a :class:`Target` of so many pixels, float32."""
    layout = _Layout(height, width, _WINDOW // 2)
    return 4 * (layout.size(2, 2) + 2 * layout.size(1, 1))


def prepare_target(image: TensorXf, window: int = _WINDOW, sigma: float = 1.5) -> Target:
    """Return the :class:`Target` of a photograph.

    image: (H, W, 3) tensor, display space. window: width of SSIM's Gaussian window, px, odd.
    sigma: its standard deviation, px. The defaults are those of Wang et al. 2004, section III.B,
    and of the 3DGS reference. Not differentiated.
    """
    height, width = _film_size("prepare_target()", image)
    flat = dr.detach(image).array
    weights = _gaussian_window(window, sigma)
    layout = _Layout(height, width, window // 2)
    values = layout.place(flat)

    y = _Padded(layout, values, 2, 2).along_columns()
    maps = [_blur(y, weights), _blur(map(dr.square, y), weights)]
    _eval_each(maps)
    means, mean_squares = (_blur(_Padded(layout, z, 1, 2).along_rows(), weights) for z in maps)
    row, column = layout.row_and_column(type(flat), 1, 1)
    rows, columns = (dr.opaque(type(row), count) for count in (height, width * _CHANNELS))
    inside = (row < rows) & (column < columns)
    results = [means, dr.select(inside, mean_squares, -1)]  # views of the maps, which must live
    _eval_each(results)
    return Target(height, width, weights, values, *results)


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
    """Evaluates the loss and SSIM's partials by two blurs, the gradient by two more."""

    @override
    def eval(self, image: TensorXf, target: Target, weight: float) -> tuple[Float, Float]:
        self.target, self.weight, self.shape = target, weight, image.shape
        self.layout = _layout_of(target)
        self.values = self.layout.place(image.array)
        loss, self.partials = _ssim_and_partials(self.layout, self.values, target, weight)
        squared, share = dr.square(self.values - target.values), self.layout.share(type(loss))
        return dr.sum(loss) * share, dr.sum(squared) * share

    def gradient(self) -> Float:
        """Return d loss / d image, flat, row-major; pass 3 blurs the partials along columns."""
        layout, weights = self.layout, self.target.weights
        partials = (_Padded(layout, each, 1, 1) for each in self.partials)
        blurred = [_blur(each.along_columns(), weights) for each in partials]
        _eval_each(blurred)
        gradient = _assemble_gradient(layout, blurred, self.values, self.target, self.weight)
        dr.eval(gradient)
        return _Padded(layout, gradient, 0, 0).image

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


def _blurred_moments(layout: _Layout, values: Float, target: Target) -> list[Float]:
    """Passes 1 and 2: x, x^2 and xy blurred along columns, and along rows."""
    x, y = (_Padded(layout, z, 2, 2).along_columns() for z in (values, target.values))
    maps = x, map(dr.square, x), map(operator.mul, x, y)
    along_columns = [_blur(taps, target.weights) for taps in maps]
    _eval_each(along_columns)
    padded = (_Padded(layout, each, 1, 2) for each in along_columns)
    blurred = [_blur(each.along_rows(), target.weights) for each in padded]
    _eval_each(blurred)
    return blurred


def _ssim_and_partials(
    layout: _Layout, values: Float, target: Target, weight: float
) -> tuple[Float, list[Float]]:
    """Return each number's share of the loss, and dS/dmu_x, dS/dE[x^2], dS/dE[xy].

    With mu = E[.] the windowed means, var and cov from E[x^2] - mu^2 and so on,
        S = A1 A2 / (B1 B2),  A1 = 2 mu_x mu_y + C1,       A2 = 2 cov_xy + C2,
                              B1 = mu_x^2 + mu_y^2 + C1,   B2 = var_x + var_y + C2
    (Wang et al. 2004, equation 13). The partials are those of S(mu_x, E[x^2], E[xy]): each of
    the three is linear in windows of x, x^2 or xy.
    """
    mu_x, mean_xx, mean_xy = _blurred_moments(layout, values, target)
    mu_y, mean_yy = target.means, target.mean_squares
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
    beyond = mean_yy < 0
    partials = [dr.select(beyond, 0, d) for d in (d_mu_x, d_mean_xx, d_mean_xy)]
    x, y = (_Padded(layout, z, 2, 2).crop(1, 1) for z in (values, target.values))
    loss = (1 - weight) * dr.abs(x - y) + weight * dr.select(beyond, 0, 1 - ssim)
    dr.eval(loss, partials)
    return loss, partials


def _assemble_gradient(
    layout: _Layout, partials: list[Float], values: Float, target: Target, weight: float
) -> Float:
    """Pass 4: d loss / d image.

    The windowed means are linear in x, x^2 and xy, and the blur B is its own adjoint:
        d (sum of S) / dx = B dS/dmu_x + 2 x B dS/dE[x^2] + y B dS/dE[xy].
    """
    d_mu_x, d_mean_xx, d_mean_xy = (
        _blur(_Padded(layout, z, 0, 1).along_rows(), target.weights) for z in partials
    )
    x, y = (_Padded(layout, z, 2, 2).crop(0, 0) for z in (values, target.values))
    d_ssim = d_mu_x + 2 * x * d_mean_xx + y * d_mean_xy
    return ((1 - weight) * _sign(x - y) - weight * d_ssim) * layout.share(type(x))


def _variance(mean: Float, mean_square: Float) -> Float:
    """Return E[x^2] - E[x]^2, which rounding would make negative for x >> 1."""
    variance = mean_square - mean * mean
    return dr.select(variance < 0, 0, variance)


def _sign(x: Float) -> Float:
    return dr.select(x > 0, 1, dr.select(x < 0, -1, type(x)(0)))


@dataclass(frozen=True)
class _Layout:
    """Places of an (H, W, 3) image's numbers: row by row, with zeros between the rows.

    At least as many as a window reaches to one side. An array goes on before the first row and
    behind the last one, as far as the windows of all blurs reach that are still to come: so many
    along columns, and along rows.
    """

    height: int
    width: int
    radius: int  # of the window, pixels

    @property
    def num_values(self) -> int:
        """Values of the image, padding excluded."""
        return self.height * self.width * _CHANNELS

    def share(self, float_type: type[Float]) -> Float:
        """Return the share of a number in a mean, not compiled into kernels."""
        return dr.opaque(float_type, 1 / self.num_values)

    @property
    def stride(self) -> int:
        """Numbers from a row to the next one."""
        return _whole_vectors((self.width + self.radius) * _CHANNELS)

    def start(self, columns: int, rows: int) -> int:
        """Return where the first row starts in an array for so many blurs."""
        ends = _whole_vectors(self.radius * _CHANNELS)
        return columns * self.radius * self.stride + rows * ends

    def size(self, columns: int, rows: int) -> int:
        """Return the size of such an array."""
        return self.height * self.stride + 2 * self.start(columns, rows)

    def place(self, flat: Float) -> Float:
        """Return a row-major (H, W, 3) image for two blurs along each axis."""
        row, column = self.row_and_column(type(flat), 2, 2, _PACKET)
        size = dr.opaque(type(row), self.width * _CHANNELS)
        first, is_row = row * size + column, row < dr.opaque(type(row), self.height)
        values = []
        with access_all_lanes(type(flat)):
            for k in range(_PACKET):
                inside = is_row & (column + k < size)
                value = dr.gather(type(flat), flat, dr.select(inside, first + k, 0))
                values.append(dr.select(inside, value, 0))
        stored = store_columns(values)
        dr.eval(stored)
        return first_numbers(stored, self.size(2, 2))

    def row_and_column(
        self, float_type: type[Float], columns: int, rows: int, packet: int = 1
    ) -> tuple[UInt32, UInt32]:
        """Return the row of each packet's first number, and its place there.

        Rows before the first one are numbers above 2^31.
        """
        index, start = types_of(float_type).UInt32, self.start(columns, rows)
        rows_before = -(-start // self.stride)
        numbers = dr.arange(index, self.size(columns, rows) // packet) * packet
        numbers += dr.opaque(index, rows_before * self.stride - start)
        row = quotient(numbers, self.stride)
        column = numbers - row * dr.opaque(index, self.stride)
        return row - dr.opaque(index, rows_before), column


@dataclass(frozen=True)
class _Padded:
    """An image as :class:`_Layout` has it, for so many blurs along columns and along rows."""

    layout: _Layout
    values: Float
    columns: int
    rows: int

    @property
    def image(self) -> Float:
        """The row-major (H, W, 3) array, not evaluated."""
        layout = self.layout
        index = existing_lanes(types_of(type(self.values)).UInt32, layout.num_values)
        row, column = divide(index, layout.width * _CHANNELS, layout.height)
        source = row * dr.opaque(type(index), layout.stride) + column
        source += dr.opaque(type(index), self._start)
        with access_all_lanes(type(self.values)):
            return dr.gather(type(self.values), self.values, source)

    def along_columns(self) -> list[Float]:
        """Return the values at each pixel of windows along columns, for one blur fewer."""
        return self._views(self.columns - 1, self.rows, self.layout.stride)

    def along_rows(self) -> list[Float]:
        """Return the values at each pixel of windows along rows, for one blur fewer."""
        return self._views(self.columns, self.rows - 1, _CHANNELS)

    def crop(self, columns: int, rows: int) -> Float:
        """Return the part for fewer blurs."""
        start = self._start - self.layout.start(columns, rows)
        return shifted_views(self.values, [start], self.layout.size(columns, rows))[0]

    @property
    def _start(self) -> int:
        return self.layout.start(self.columns, self.rows)

    def _views(self, columns: int, rows: int, step: int) -> list[Float]:
        start, radius = self._start - self.layout.start(columns, rows), self.layout.radius
        starts = [start + k * step for k in range(-radius, radius + 1)]
        return shifted_views(self.values, starts, self.layout.size(columns, rows))


def _whole_vectors(count: int) -> int:
    return -(-count // MAX_LANES) * MAX_LANES


def _blur(taps: Iterable[Float], weights: tuple[float, ...]) -> Float:
    """Return the weighted sum of a window's pixels."""
    total: Any = 0
    for tap, weight in zip(taps, weights, strict=True):
        total = dr.fma(tap, weight, total)
    return total


def _eval_each(maps: Sequence[Float]) -> None:
    """Evaluate maps in kernels of their own: together, three took 2 to 3 times as long.

    Dr.Jit stores results past the caches, and loads of many rows disturb several such streams.
    """
    for each in maps:
        dr.eval(each)


def _layout_of(target: Target) -> _Layout:
    return _Layout(target.height, target.width, len(target.weights) // 2)


def _gaussian_window(window: int, sigma: float) -> tuple[float, ...]:
    if window < 1 or window % 2 == 0:
        raise ValueError(f"prepare_target(): window must be odd, in pixels, got {window}")
    if not sigma > 0:
        raise ValueError(f"prepare_target(): sigma must be > 0 pixels, got {sigma}")
    weights = [math.exp(-0.5 * ((k - window // 2) / sigma) ** 2) for k in range(window)]
    return tuple(weight / sum(weights) for weight in weights)


def _film_size(where: str, image: TensorXf) -> tuple[int, int]:
    shape = tuple(image.shape)
    if len(shape) != 3 or shape[2] != _CHANNELS or 0 in shape:
        raise ValueError(
            f"{where}: the image must be an (H, W, {_CHANNELS}) tensor, got shape {shape}; "
            "an alpha channel is composited over the background before"
        )
    return shape[0], shape[1]
