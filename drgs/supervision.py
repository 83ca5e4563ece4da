"""What the data says besides colours: masks, depth; and backgrounds that vary.

Layer 4, imported when the data or the configuration calls for one of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.arrays import from_host
from drgs.data.types import View
from drgs.losses import prepare_target
from drgs.pixels import depth_error, split
from drgs.training_effects import TrainingEffect

if TYPE_CHECKING:
    from drgs.trainer import Trainer, TrainingView


class Masks(TrainingEffect):
    """Pixels that a mask leaves out are black in what is rendered and in what it is compared with.

    They have no derivative. SSIM's windows that reach into them see the same black in both.
    """

    name = "masks"

    def upload(self, view: View) -> Any:
        """The mask, (H, W, 3); None where a view has none."""
        if view.mask is None:
            return None
        return _tensor(np.repeat(view.mask[:, :, None], 3, axis=2))

    def target_image(self, view: View, image: np.ndarray) -> np.ndarray:
        """The photograph without what the mask leaves out."""
        return image if view.mask is None else image * view.mask[:, :, None]

    def adjust(self, image: Any, view: TrainingView) -> Any:
        """The rendering without it."""
        mask = view.uploads[self.name]
        return image if mask is None else image * mask


class DepthSupervision(TrainingEffect):
    """Penalises the difference between the composited depth and that of the data.

    The term is weight / extent times the mean of |D - A d| over the pixels whose depth d is known
    and that no mask leaves out, D being the alpha-weighted sum of the splats' depths and A the
    alpha: ``pixels.depth_error``.
    """

    name = "depth"
    aovs = "depth:depth, alpha:alpha"

    def __init__(self, weight: float, extent: float) -> None:
        """weight: of the term, per scene extent."""
        self.weight, self.depths = weight / extent, None

    def upload(self, view: View) -> Any:
        """Depths, and weights of the pixels; None where a view has none that counts."""
        if view.depth is None:
            return None
        known = view.depth > 0
        if view.mask is not None:
            known &= view.mask > 0
        if not known.any():
            return None
        weights = self.weight * known / known.sum()
        return from_host(mi.Float, view.depth), from_host(mi.Float, weights)

    def adjust(self, image: Any, view: TrainingView) -> Any:
        """The colours; depth and alpha are kept for the penalty."""
        del view
        image, self.depths = split(image, 3)
        return image

    def penalties(self, view: TrainingView) -> Iterator[Any]:
        """The difference in depth."""
        if (known := view.uploads[self.name]) is not None:
            yield depth_error(self.depths, *known)


class RandomBackground(TrainingEffect):
    """Another colour behind each picture: nothing but an opaque splat can look like what is there.

    The colours are functions of seed and iteration. Behind what is measured and shown is the
    dataset's background.
    """

    name = "background"

    def __init__(self, seed: int, background: tuple[float, float, float]) -> None:
        """background: what the pictures were composited over, display space."""
        self.seed, self.background = seed, np.array(background)

    def upload(self, view: View) -> Any:
        """1 - alpha, (H, W, 3); 0 where a mask leaves the background out as well."""
        transparent = 1 - view.alpha if view.mask is None else (1 - view.alpha) * view.mask
        return _tensor(np.repeat(transparent[:, :, None], 3, axis=2))

    def before(self, trainer: Trainer, view: TrainingView) -> None:
        """Put a colour behind the splats and behind the photograph."""
        rng = np.random.default_rng([self.seed, _BACKGROUND_STREAM, trainer.iteration])
        color = rng.uniform(size=3)
        trainer.integrator.background = mi.Color3f(*map(float, color))
        # No literal, or every colour would be a new kernel.
        shift = mi.Color3f(*map(float, color - self.background))
        dr.make_opaque(shift)
        transparent = view.uploads[self.name]
        channel = dr.arange(mi.UInt32, dr.width(transparent.array)) % 3
        shift = dr.select(channel == 0, shift.x, dr.select(channel == 1, shift.y, shift.z))
        image = view.photograph.image.array + transparent.array * shift
        loss = trainer.config.loss
        view.target = prepare_target(mi.TensorXf(image, transparent.shape), loss.window, loss.sigma)

    def after(self, trainer: Trainer, view: TrainingView) -> None:
        """Put the dataset's background back."""
        trainer.integrator.background = mi.Color3f(*map(float, self.background))
        view.target = view.photograph


_BACKGROUND_STREAM = 71
"""Tells the random numbers of backgrounds from others of the same seed."""


def _tensor(values: np.ndarray) -> mi.TensorXf:
    return mi.TensorXf(from_host(mi.Float, values), values.shape)
