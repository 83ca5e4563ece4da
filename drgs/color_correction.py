"""Exposure and white balance: an affine colour transform for each training photograph.

Layer 4, imported when ``colors.lr`` is given. What is rendered is transformed as its photograph
seems to have been, y = A (r, g, b, 1), before they are compared; A starts as the identity and is
drawn to it, so that what all photographs have in common stays with the splats. New views are
rendered without a transform. (As in the 3DGS reference's "exposure compensation", whose transforms
are not drawn to the identity.)
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.arrays import from_host
from drgs.config import ColorConfig
from drgs.data.types import View
from drgs.files import atomic_path
from drgs.pixels import transform_colors
from drgs.training_effects import TrainingEffect
from drgs.view_parameters import ViewParameters

if TYPE_CHECKING:
    from drgs.trainer import Trainer, TrainingView

IDENTITY = np.eye(3, 4).reshape(1, 12)
"""Row by row."""

COLORS = "colors.json"


class ColorCorrection(TrainingEffect):
    """One 3 x 4 transform a view."""

    name = "colors"

    def __init__(self, config: ColorConfig, num_views: int) -> None:
        """num_views: of the training split."""
        self.weight = config.identity_weight
        values = {"matrices": np.repeat(IDENTITY, num_views, axis=0)}
        self.parameters = ViewParameters(values, {"matrices": config.lr})
        self.leaves: dict[str, mi.Float] = {}

    def before(self, trainer: Trainer, view: TrainingView) -> None:
        """Get the view's transform."""
        del trainer
        self.leaves = self.parameters.leaves(view.index)

    def adjust(self, image: Any, view: TrainingView) -> Any:
        """What was rendered, with the colours of the photograph."""
        del view
        return transform_colors(image, mi.TensorXf(self.leaves["matrices"], (3, 4)))

    def penalties(self, view: TrainingView) -> Iterator[Any]:
        """The mean square by which the transform differs from the identity."""
        del view
        difference = self.leaves["matrices"] - from_host(mi.Float, IDENTITY)
        yield self.weight * dr.mean(dr.square(difference))

    def after(self, trainer: Trainer, view: TrainingView) -> None:
        """One step of its own."""
        decay = trainer.means_lr(trainer.iteration) / trainer.means_lr.initial
        self.parameters.step(view.index, self.leaves, decay)

    def state(self) -> dict[str, np.ndarray]:
        """Numbers and moments."""
        return self.parameters.state()

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Continue from :meth:`state`."""
        self.parameters.restore(state)

    def write(self, folder: Path, views: tuple[View, ...]) -> None:
        """``colors.json``: the transform of each training view, 3 x 4, by name."""
        matrices = self.parameters.numpy()["matrices"].reshape(-1, 3, 4)
        by_view = {v.name: m.tolist() for v, m in zip(views, matrices, strict=True)}
        with atomic_path(folder / COLORS) as temporary:
            temporary.write_text(json.dumps(by_view, indent=1) + "\n")
