"""Exposure and white balance: an affine colour transform for each training photograph.

A rendering is transformed, y = A (r, g, b, 1), before it is compared with its photograph. A starts
as the identity and is drawn to it; and since darker splats under brighter transforms would look the
same, the mean of all photographs' transforms is the identity. (The 3DGS reference's "exposure
compensation" has neither constraint.) The background behind a transparent photograph is unchanged.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, cast

import drjit as dr
import numpy as np
from pydantic import Field
from typing_extensions import Self, override

from drgs.config.extensions import EFFECTS
from drgs.config.section import Rate, Section, Weight
from drgs.core.arrays import image_of, planes_of, types_of
from drgs.core.files import write_json
from drgs.core.types import Float, TensorXf
from drgs.effects.base import (
    Finding,
    ShortFit,
    SimulatedEffect,
    as_channels,
    as_numbers,
    trimmed_deviation,
)
from drgs.effects.optimised import CenteredEffect

if TYPE_CHECKING:
    from drgs.config.schema import FitConfig
    from drgs.datasets.types import Dataset, View
    from drgs.training.views import FitState, TrainingView

EXAMINED_LR = 0.02  # of the transforms where an examination chooses them

MIN_BRIGHTNESS_DEVIATION, MIN_COLOR_DEVIATION = 0.025, 0.012
"""Standard deviations of photographs' gains, and of colours' gains in a photograph, from which a
short fit is worth its time: about twice those of renderings and photographs without differences."""

COLORS = "colors.json"  # transforms of the training views

IDENTITY = np.eye(3, 4).reshape(1, 12)  # the identity, row by row


class ColorConfig(Section):
    """Exposure and white balance of each training photograph, and each camera's vignetting."""

    lr: Rate | None = Field(None, gt=0)
    """Initial rate of the 3 x 4 numbers of each transform, such as 0.02; decays as the rate of the
    means. null: no transforms."""
    identity_weight: Weight = 1.0
    """Weight of the mean squared difference from the identity."""
    vignetting_lr: Rate | None = Field(None, gt=0)
    """Initial rate of the three coefficients of each camera's vignetting, such as 0.03. null: no
    vignetting."""
    response_lr: Rate | None = Field(None, gt=0)
    """Initial rate of the two numbers by which each camera's response differs from the mean of all,
    such as 0.005. null: the same response."""

    @property
    @override
    def is_off(self) -> bool:
        return (self.lr, self.vignetting_lr, self.response_lr) == (None, None, None)


@EFFECTS.register("colors", section=ColorConfig)
class ColorCorrection(CenteredEffect):
    """A 3 x 4 transform for each view."""

    order, centered = 10, "matrices"
    upload_bytes = 12
    files = (COLORS,)

    @classmethod
    @override
    def summarize(cls, config: FitConfig, dataset: Dataset) -> list[SimulatedEffect]:
        is_used = config.section("colors", ColorConfig).lr is not None
        what = "a colour transform for each training photograph" if is_used else None
        return [SimulatedEffect("exposure and white balance", what, "colors.lr")]

    @classmethod
    @override
    def from_config(cls, config: FitConfig, dataset: Dataset, section: ColorConfig) -> Self:
        return cls(section, len(dataset.train))

    @classmethod
    @override
    def look_for(cls, fit: ShortFit) -> Finding:
        """Compare the gains of held-out photographs over their renderings."""
        gains = np.stack([alignment.gains for alignment in fit.alignments])
        exposures = gains.mean(axis=1)
        by_view = trimmed_deviation(exposures - np.median(exposures))
        by_color = float((gains - exposures[:, None]).std())
        evidence = f"brightness differs by {by_view:.1%}, colours by {by_color:.1%}"
        is_likely = by_view > MIN_BRIGHTNESS_DEVIATION or by_color > MIN_COLOR_DEVIATION
        changes = {"colors.lr": EXAMINED_LR}
        return Finding("exposure and white balance", evidence, is_likely, changes)

    def __init__(self, config: ColorConfig, num_views: int) -> None:
        """num_views: of the training split."""
        self.weight = config.identity_weight
        assert config.lr is not None, "the effect is used where it is given"
        values = {"matrices": np.repeat(IDENTITY, num_views, axis=0)}
        super().__init__(values, {"matrices": config.lr})
        self.matrix: Float  # (12,), of the view that is rendered

    @override
    def upload(self, view: View) -> TensorXf | None:
        """Return the photograph's opacity, (H, W, 3); None where it is opaque everywhere."""
        return None if view.alpha is None else as_channels(view.alpha)

    @override
    def before_render(self, fit: FitState, view: TrainingView) -> None:
        self.matrix = self.parameters(view)["matrices"] - self.common

    @override
    def adjust(self, image: TensorXf, view: TrainingView) -> TensorXf:
        """Return the rendering with the colours of the photograph."""
        seen = transform_colors(image, type(image)(self.matrix, (3, 4)))
        opaque = view.uploads[self.name]
        return seen if opaque is None else image + opaque * (seen - image)

    @override
    def penalties(self, view: TrainingView) -> Iterator[Float]:
        """Yield the mean square by which the transform differs from the identity."""
        yield self.weight * dr.mean(dr.square(self.matrix - as_numbers(IDENTITY)))

    def transforms(self) -> np.ndarray:
        """Return the transforms of all training views, (V, 3, 4)."""
        matrices = self.numpy()["matrices"] - np.array(self.common)
        return matrices.reshape(-1, 3, 4)

    @override
    def write(self, folder: Path, dataset: Dataset) -> None:
        """Write ``colors.json``: the transform of each training view, 3 x 4, by name."""
        pairs = zip(dataset.train, self.transforms(), strict=True)
        write_json(folder / COLORS, {view.name: matrix.tolist() for view, matrix in pairs})


def transform_colors(image: TensorXf, matrix: TensorXf) -> TensorXf:
    """Return A (r, g, b, 1); image: (H, W, 3), matrix: A, (3, 4), both differentiated."""
    return dr.custom(_TransformColors, image=image, matrix=matrix)


class _TransformColors(dr.CustomOp):
    @override
    def eval(self, image: TensorXf, matrix: TensorXf) -> TensorXf:
        self.image, self.matrix = dr.detach(image), dr.detach(matrix)
        return self._transform(planes_of(image), self._rows(self.matrix))

    @override
    def forward(self) -> None:
        d_image, d_matrix = (cast(TensorXf, self.grad_in(name)) for name in ("image", "matrix"))
        rows = [[*row[:3], 0] for row in self._rows(self.matrix)]
        moved = self._transform(planes_of(d_image), rows)
        turned = self._transform(planes_of(self.image), self._rows(d_matrix))
        self.set_grad_out(moved + turned)

    @override
    def backward(self) -> None:
        g = planes_of(cast(TensorXf, self.grad_out()))
        rows, inputs = self._rows(self.matrix), planes_of(self.image)
        zero = type(g[0])(0)
        d_planes = [sum((rows[i][j] * g[i] for i in range(3)), zero) for j in range(3)]
        self.set_grad_in("image", image_of(d_planes, self.image))
        products = [d * x for d in g for x in (*inputs, 1)]
        dr.eval(products)
        d_matrix = dr.concat([dr.sum(product) for product in products])
        self.set_grad_in("matrix", type(self.matrix)(d_matrix, (3, 4)))

    def _transform(self, planes: list[Float], rows: list[list[Float]]) -> TensorXf:
        zero = type(planes[0])(0)
        columns = (*planes, 1)
        moved = [sum((a * x for a, x in zip(row, columns, strict=True)), zero) for row in rows]
        return image_of(moved, self.image)

    @staticmethod
    def _rows(matrix: TensorXf) -> list[list[Float]]:
        """Return the numbers as arrays of one entry, that are not compiled into the kernel."""
        flat = matrix.array
        t = types_of(type(flat))
        return [[dr.gather(t.Float, flat, t.UInt32(4 * i + j)) for j in range(4)] for i in range(3)]
