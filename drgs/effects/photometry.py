"""Vignetting and response of each camera, which renderings are given before they are compared.

A colour x at the distance r from the principal point becomes y = f(V(r) x), with

    V(r) = 1 + s (a + b (2 s - 1) + c (6 s^2 - 6 s + 1)), s = r^2, r = 1 at half the diagonal,
    f(x) = x^exp(p + q x), which is monotone in 0..1 for q < e, with f(0) = 0 and f(1) = 1.

The first is the usual polynomial in r^2 (Goldman and Chen 2005), by Legendre's, of which Adam finds
each one alone. Photographs with the same size, intrinsics and lens share a camera. Splats would
absorb a response that all cameras have, so that the mean of p and q over cameras is zero: one
camera has none. The background behind a transparent photograph is unchanged.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from drjit.opt import Adam
from typing_extensions import override

from drgs.config.extensions import EFFECTS
from drgs.core.errors import UserError
from drgs.core.files import write_json
from drgs.core.types import Float, TensorXf
from drgs.effects.base import Finding, ShortFit, SimulatedEffect, as_channels, entries
from drgs.effects.colors import ColorConfig
from drgs.effects.optimised import CenteredEffect
from drgs.effects.tones import find_tones

if TYPE_CHECKING:
    from drgs.config.schema import FitConfig
    from drgs.datasets.types import Dataset, View
    from drgs.training.views import FitState, TrainingView

DARKEST = 1e-3  # of colours that f maps; below, and above 1, it is linear

PHOTOMETRY = "photometry.json"  # vignetting and response of the training views' cameras

COEFFICIENTS = {"vignetting": 3, "response": 2}

EXAMINED_LRS = {"vignetting": 0.03, "response": 0.005}  # where an examination chooses them
MIN_FALLOFF, MIN_RESPONSE, MIN_ERRORS = 0.12, 0.04, 4.0
"""Brightness of corners, differences between exponents of cameras; and both in standard errors."""

MIN_CAMERA_VIEWS = 5  # by which a camera's are found


@EFFECTS.register("photometry")
class Photometry(CenteredEffect):
    """Coefficients of vignetting and response, a row for each camera."""

    order, centered = 20, "response"
    upload_bytes = 24
    files = (PHOTOMETRY,)

    @classmethod
    @override
    def summarize(cls, config: FitConfig, dataset: Dataset) -> list[SimulatedEffect]:
        names = given_rates(config.section("colors", ColorConfig))
        return [SimulatedEffect(n, "of each camera", f"colors.{n}_lr") for n in names]

    @classmethod
    @override
    def look_for(cls, fit: ShortFit) -> list[Finding]:
        """Compare the brightness of points between photographs, and cameras: splats absorb both."""
        views = (*fit.dataset.test, *fit.dataset.train)
        counts = Counter(camera_key(view) for view in views)
        rows = {key: k for k, (key, n) in enumerate(counts.most_common()) if n >= MIN_CAMERA_VIEWS}
        views = [view for view in views if camera_key(view) in rows]
        tones = find_tones(views, [rows[camera_key(view)] for view in views], fit.gaussians)
        found = [_finding("vignetting", "cannot be told from reflections", False)]
        if tones.falloff is not None:
            value, error = (each[np.argmin(tones.falloff[0])] for each in tones.falloff)
            text = f"corners are darker by {-np.expm1(value):.0%} ± {error:.0%}"
            found = [_finding("vignetting", text, -value > max(MIN_FALLOFF, MIN_ERRORS * error))]
        if tones.response is not None:
            value, error = np.ptp(tones.response[0]), tones.response[1].max()
            text = f"exponents of cameras differ by {value:.1%} ± {error:.1%}"
            found.append(_finding("response", text, value > max(MIN_RESPONSE, MIN_ERRORS * error)))
        return found

    @classmethod
    @override
    def from_config(cls, config: FitConfig, dataset: Dataset, section: None) -> Photometry:
        return cls(config.section("colors", ColorConfig), dataset.train)

    def __init__(self, config: ColorConfig, views: Sequence[View]) -> None:
        """views: the training split."""
        keys = [camera_key(view) for view in views]
        rows = {key: row for row, key in enumerate(dict.fromkeys(keys))}
        self.camera_rows = [rows[key] for key in keys]  # by view
        if config.response_lr is not None and len(rows) == 1:
            raise UserError(
                "colors.response_lr: needs photographs by several cameras, whose size, intrinsics "
                "or lens differ, got those of one; leave it out"
            )
        rates = given_rates(config)
        super().__init__({n: np.zeros((len(rows), COEFFICIENTS[n])) for n in rates}, rates)
        self.attached: dict[int, dict[str, Float]] = {}  # by view, which may share a camera

    @override
    def upload(self, view: View) -> tuple[TensorXf, TensorXf | None]:
        """Return r^2 and the photograph's opacity, (H, W, 3); None where it is opaque."""
        y, x = np.mgrid[: view.height, : view.width] + 0.5
        squares = np.square(x - view.cx) + np.square(y - view.cy)
        squares *= 4 / (view.width**2 + view.height**2)
        return as_channels(squares), None if view.alpha is None else as_channels(view.alpha)

    @override
    def before_render(self, fit: FitState, view: TrainingView) -> None:
        self.attached[view.index] = numbers = self.numbers_of(view)
        dr.enable_grad(numbers)

    @override
    def leaves(self, view: TrainingView) -> Mapping[str, dr.ArrayBase]:
        return self.attached.get(view.index) or self.numbers_of(view)

    @override
    def adjust(self, image: TensorXf, view: TrainingView) -> TensorXf:
        """Return the rendering with the vignetting and the response of the view's camera."""
        numbers, (r2, opaque) = self.attached[view.index], view.uploads[self.name]
        values = image.array
        if "vignetting" in numbers:
            a, b, c = entries(numbers["vignetting"])
            s = r2.array
            values = values * (1 + s * (a + b * (2 * s - 1) + c * (6 * s * (s - 1) + 1)))
        if "response" in numbers:
            p, q = entries(numbers["response"] - self.common)
            base = dr.clip(values, DARKEST, 1)
            values = values * dr.exp(dr.log(base) * (dr.exp(p + q * base) - 1))
        seen = type(image)(values, image.shape)
        return seen if opaque is None else image + opaque * (seen - image)

    @override
    def after_backward(
        self, fit: FitState, view: TrainingView, derivatives: Mapping[str, dr.ArrayBase]
    ) -> None:
        self.attached.pop(view.index, None)
        super().after_backward(fit, view, derivatives)

    def coefficients(self) -> dict[str, np.ndarray]:
        """Return a, b, c and p, q of all cameras, (cameras, 3) and (cameras, 2)."""
        numbers = self.numpy()
        if "response" in numbers:
            numbers["response"] = numbers["response"] - np.array(self.common)
        return numbers

    @override
    def write(self, folder: Path, dataset: Dataset) -> None:
        """Write ``photometry.json``: the coefficients of each training view's camera, by name."""
        found = self.coefficients()
        by_view = {
            view.name: {name: values[row].tolist() for name, values in found.items()}
            for view, row in zip(dataset.train, self.camera_rows, strict=True)
        }
        write_json(folder / PHOTOMETRY, by_view)

    @override
    def _optimizers_of(self, view: TrainingView) -> dict[str, Adam]:
        row = self.camera_rows[view.index]
        return {name: optimizers[row] for name, optimizers in self.optimizers.items()}


def given_rates(config: ColorConfig) -> dict[str, float]:
    """Return the rates of the coefficients that a fit has."""
    rates = {"vignetting": config.vignetting_lr, "response": config.response_lr}
    return {name: rate for name, rate in rates.items() if rate is not None}


def camera_key(view: View) -> tuple[object, ...]:
    """Return a key that is the same for photographs by the same camera."""
    size = view.width, view.height
    return *size, view.fx, view.fy, view.cx, view.cy, repr(view.lens)


def _finding(name: str, evidence: str, is_likely: bool) -> Finding:
    changes = {f"colors.{name}_lr": EXAMINED_LRS[name]}
    return Finding(name, evidence, bool(is_likely), changes, is_measured=True)
