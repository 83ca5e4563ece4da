"""Derivatives of several views, taken through the projection together.

Going back from splats to Gaussians reads and writes all of their numbers. For views that see the
same Gaussians, one kernel does it for some of them at a time.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from drgs.cameras.camera import Camera
from drgs.core.arrays import types_of
from drgs.gaussians.parameters import Gaussians
from drgs.splatting.rasterize import SplatGradients
from drgs.splatting.rendering import (
    NO_FAULT,
    Frame,
    GaussianGradients,
    Pipeline,
    SeenSplats,
    footprints_seen_by,
    gradients_of,
    on_film,
)
from drgs.splatting.tiles import Footprints

VIEWS_AT_ONCE = 4
"""Whose derivatives one kernel adds up; it is longer, and takes longer to compile, with each."""


@dataclass(eq=False)
class Deferred:
    """Projects Gaussians, and keeps derivatives with respect to the splats, of each time."""

    seen: list[SeenSplats] = field(default_factory=list)

    def footprints(self, gaussians: Gaussians, camera: Camera, pipeline: Pipeline) -> Footprints:
        """Project them."""
        return footprints_seen_by(gaussians, camera, pipeline)

    def gradients(
        self, gaussians: Gaussians, frame: Frame, of_splats: SplatGradients, of_camera: bool
    ) -> GaussianGradients:
        """Keep what there is; where the camera gets derivatives, these need the projection now."""
        camera, pipeline, visible = frame.camera, frame.pipeline, on_film(frame.bins)
        if of_camera:
            found = gradients_of(gaussians, camera, pipeline, of_splats, of_camera)
            return GaussianGradients(**{**vars(found), "visible": visible})
        self.seen.append(SeenSplats(camera, pipeline, of_splats))
        fault = types_of(type(of_splats.opacities)).UInt32(NO_FAULT)
        return GaussianGradients(None, of_splats.means2d, visible, fault)

    def taken(self) -> list[SeenSplats]:
        """What was kept of the last view; nothing, where it was not deferred."""
        seen, self.seen = self.seen, []
        return seen
