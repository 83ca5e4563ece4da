"""The phase ``floaters``: removes what few cameras see, close before them."""

from __future__ import annotations

from typing import Any

import drjit as dr
import numpy as np
from typing_extensions import override

from drgs.accuracy.pipeline import pipeline_of
from drgs.cameras.camera import Camera
from drgs.cameras.lens import PINHOLE
from drgs.cameras.viewpoints import Viewpoint
from drgs.config.schema import FitConfig
from drgs.core.arrays import types_of
from drgs.core.types import Float, TensorXf
from drgs.datasets.types import Dataset, evenly_spaced
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians
from drgs.splatting import rendering
from drgs.splatting.rendering import depth_feature
from drgs.training.density.strategy import DensityReport, DensityStrategy, Population

SHARES = (0.5, 0.7, 0.9)  # of the iterations, after which floaters are removed

MAX_CAMERAS = 3.0
"""Cameras that see a floater, at most: (sum w)^2 / sum w^2, with w its weights in their images."""

MAX_DEPTH = 0.9
"""Largest mean depth of a floater, relative to the mean depth of all that its pixels show."""

MIN_VIEWS, MAX_VIEWS = 12, 100
"""Fewest training views of which three are few; and how many are rendered, evenly spaced."""

MAX_SIDE_PX = 128  # of these images, which floaters cover in large part

MIN_ALPHA = 0.01  # of a pixel with a depth


class Floaters(DensityStrategy):
    """Removes floaters three times during a fit; the Gaussians change in no other way.

    A floater explains something in a few photographs from a place close before their cameras, which
    no other camera contradicts, and hides the scene from places between them.
    """

    def __init__(self, config: FitConfig, dataset: Dataset | None) -> None:
        train, model = () if dataset is None else dataset.train, config.model
        # What is transparent in a photograph is empty: nothing floats before it.
        is_used = len(train) >= MIN_VIEWS and any(view.alpha is None for view in train)
        self.views = evenly_spaced(train, MAX_VIEWS) if is_used else ()
        self.due = {round(share * config.iterations) for share in SHARES} if is_used else set()
        # Two planes, for two sums at once.
        self.pipeline = pipeline_of(model.approximations, 0, (depth_feature, depth_feature))
        self.near = model.near_plane  # scene units

    @override
    def is_due(self, iteration: int) -> bool:
        return iteration in self.due

    @override
    def refine(self, population: Population, iteration: int) -> DensityReport | None:
        rows: dict[str, Any] = {name: population.host(name) for name in PARAMETER_NAMES}
        floats = self.find(Gaussians(**rows).to(type(population.value("means"))))
        if not floats.any() or floats.all():
            return None
        kept = np.flatnonzero(~floats)
        population.edit(population.to_device_indices(kept))
        return DensityReport(num_gaussians=len(kept), pruned=len(floats) - len(kept))

    def find(self, gaussians: Gaussians[TensorXf]) -> np.ndarray:
        """Return which Gaussians are floaters, (N,) bool. Not differentiated."""
        total = squares = relative = dr.zeros(type(gaussians.means.array), gaussians.num_gaussians)
        for view in self.views:
            weight, depth = self._weights(gaussians, view)
            total, squares = total + weight, dr.fma(weight, weight, squares)
            relative = relative + depth
            dr.eval(total, squares, relative)
        few = dr.square(total) < MAX_CAMERAS * squares
        return np.array(few & (relative < MAX_DEPTH * total))

    def _weights(self, gaussians: Gaussians[TensorXf], view: Viewpoint) -> tuple[Float, Float]:
        """Return each Gaussian's weight in a view, and that times its depth relative to others'.

        The weight is the sum of T a (3DGS, equation 3) over the pixels.
        """
        camera = _small_camera(type(gaussians.means.array), view, self.near)
        frame = rendering.render(gaussians, camera, self.pipeline)
        transmittance, depth, _ = frame.planes()
        alpha = 1 - transmittance
        shown = alpha > MIN_ALPHA
        inverse = dr.select(shown, alpha / dr.select(shown, depth, 1), 0)
        covered = dr.select(shown, type(alpha)(1), 0)
        dr.eval(covered, inverse)
        weight, per_depth = rendering.weighted_sums(frame, covered, inverse)
        means = dr.unravel(types_of(type(alpha)).Array3f, gaussians.means.array)
        _, _, own = camera.lens.visibility(camera, camera.rotation @ (means - camera.center))
        return weight, own * per_depth


def _small_camera(float_type: type[Float], view: Viewpoint, near: float) -> Camera:
    scale = min(1.0, MAX_SIDE_PX / max(view.width, view.height))
    K = np.diag([scale, scale, 1]) @ view.K
    width, height = (max(1, round(scale * side)) for side in (view.width, view.height))
    rotation, lens = view.camera_to_world[:3, :3].T, view.lens or PINHOLE
    return Camera.create(float_type, rotation, view.center, K, width, height, near, lens)
