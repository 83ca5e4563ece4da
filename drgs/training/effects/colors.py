"""Exposure and white balance: an affine colour transform for each training photograph.

Imported when ``colors.lr`` is given. What is rendered is transformed as its photograph seems to
have been, y = A (r, g, b, 1), before they are compared. A starts as the identity and is drawn to
it; and since darker splats under brighter transforms would look the same, the mean of all
photographs' transforms is the identity, always. New views are rendered without a transform: their
exposure is the mean one. (The 3DGS reference's "exposure compensation" has neither bond.)

Where the photograph is transparent, there is a background which no camera saw: it stays as it is.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.config.extensions import EFFECTS
from drgs.config.schema import ColorConfig, FitConfig
from drgs.core.arrays import from_host
from drgs.core.files import atomic_path
from drgs.datasets.types import Dataset, View
from drgs.results.files import COLORS
from drgs.training.effects.base import FitState, TrainingEffect, as_tensor
from drgs.training.effects.view_parameters import ViewParameters
from drgs.training.image_ops import transform_colors
from drgs.training.views import TrainingView

IDENTITY = np.eye(3, 4).reshape(1, 12)
"""Row by row."""


@EFFECTS.register("colors")
class ColorCorrection(TrainingEffect):
    """One 3 x 4 transform a view."""

    name = "colors"
    upload_bytes = 12

    @classmethod
    def from_config(cls, config: FitConfig, dataset: Dataset, section: None) -> ColorCorrection:
        """Return the effect of a fit."""
        del section
        return cls(config.colors, len(dataset.train))

    def __init__(self, config: ColorConfig, num_views: int) -> None:
        """num_views: of the training split."""
        self.weight = config.identity_weight
        values = {"matrices": np.repeat(IDENTITY, num_views, axis=0)}
        self.parameters = ViewParameters(values, {"matrices": config.lr})
        # What all have in common, and do without: not differentiated.
        self.common = dr.opaque(mi.Float, 0, IDENTITY.size)
        self.share = 1 / num_views
        self.matrix: Any = None  # of the view that is rendered

    def upload(self, view: View) -> Any:
        """How opaque the photograph is, (H, W, 3); None where it is opaque everywhere."""
        if view.alpha is None:
            return None
        return as_tensor(np.repeat(np.asarray(view.alpha)[:, :, None], 3, axis=2))

    def before(self, fit: FitState, view: TrainingView) -> None:
        """Get the view's transform."""
        del fit
        self.matrix = self.parameters.leaves(view.index)["matrices"] - self.common

    def adjust(self, image: Any, view: TrainingView) -> Any:
        """What was rendered, with the colours of the photograph."""
        seen = transform_colors(image, mi.TensorXf(self.matrix, (3, 4)))
        opaque = view.uploads[self.name]
        return seen if opaque is None else image + opaque * (seen - image)

    def penalties(self, view: TrainingView) -> Iterator[Any]:
        """The mean square by which the transform differs from the identity."""
        del view
        difference = self.matrix - from_host(mi.Float, IDENTITY)
        yield self.weight * dr.mean(dr.square(difference))

    def leaves(self, view: TrainingView) -> dict[str, Any]:
        """The view's transform."""
        return self.parameters.leaves(view.index)

    def after(self, fit: FitState, view: TrainingView, derivatives: dict[str, Any]) -> None:
        """One step of its own, and a little one back for all: their mean stays."""
        decay = fit.rate_decay
        dr.set_grad(self.leaves(view), derivatives)
        before = dr.detach(self.parameters.leaves(view.index)["matrices"])
        self.parameters.step(view.index, decay)
        after = dr.detach(self.parameters.leaves(view.index)["matrices"])
        self.common = self.common + (after - before) * self.share
        dr.eval(self.common)

    def transforms(self) -> np.ndarray:
        """(V, 3, 4): of all training views."""
        matrices = self.parameters.numpy()["matrices"] - np.array(self.common)
        return matrices.reshape(-1, 3, 4)

    def numbers_of(self, view: TrainingView) -> dict[str, Any]:
        """See :class:`TrainingEffect`."""
        return self.parameters.numbers(view.index)

    def values(self) -> dict[str, np.ndarray]:
        """See :class:`TrainingEffect`."""
        return self.parameters.values()

    def state(self) -> dict[str, np.ndarray]:
        """Numbers and moments."""
        return {**self.parameters.state(), "common": np.array(self.common)}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from :meth:`state`."""
        self.parameters.restore(state)
        self.common = from_host(mi.Float, state["common"])

    def write(self, folder: Path, dataset: Dataset) -> None:
        """``colors.json``: the transform of each training view, 3 x 4, by name."""
        found = zip(dataset.train, self.transforms(), strict=True)
        by_view = {view.name: matrix.tolist() for view, matrix in found}
        with atomic_path(folder / COLORS) as temporary:
            temporary.write_text(json.dumps(by_view, indent=1) + "\n")
