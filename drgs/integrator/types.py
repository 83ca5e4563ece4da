"""The plugin ``splats`` in annotations: its class exists once for each variant that is set."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, TypeGuard

import mitsuba as mi

from drgs.core.types import Float
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.state import BackwardResult, ProjectedView, SplatsState
from drgs.splatting.rendering import Pipeline

if TYPE_CHECKING:

    class SplatsPlugin(mi.Integrator):
        """Members of the integrator ``splats`` that other modules use."""

        state: SplatsState
        gaussians: Gaussians
        sh_degree: int
        smoothing: Float | None
        near: float
        ignore: Sequence[str]
        pipeline: Pipeline
        last: BackwardResult  # after a backward pass
        projected_view: ProjectedView | None

        def forget_frames(self) -> None:
            """Clear the cached frames."""
            ...

        def summary(self, scene: mi.Scene, *sensors: mi.Sensor) -> str:
            """Return a summary of the simulated effects."""
            ...

else:
    SplatsPlugin = Any


def is_splats(node: object) -> TypeGuard[SplatsPlugin]:
    """Return whether a Mitsuba object is the integrator ``splats``."""
    return isinstance(getattr(node, "state", None), SplatsState)
