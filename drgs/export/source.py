"""Gaussians to export, and what their fit knows about them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from drgs.cameras.orbits import near_plane_of, rings_around
from drgs.cameras.viewpoints import Viewpoint
from drgs.config.approximations import DECLARED, Approximations, from_ply_header
from drgs.config.schema import FitConfig, ModelConfig
from drgs.core.errors import UserError, note_user
from drgs.effects.smoothing import bake_smoothing
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.similarity import Similarity, shortest_rotation
from drgs.results.folder import GAUSSIANS, GAUSSIANS_FOR_VIEWERS, load_run_config, require_results
from drgs.results.refined_cameras import training_cameras

Honoured = Callable[[Approximations], frozenset[str]]
"""Function from fitted approximations to the names of those that a program honours, about."""


@dataclass(frozen=True, eq=False)
class ExportSource:
    """Gaussians to export."""

    gaussians: Gaussians[np.ndarray]  # without a smoothing filter
    path: Path  # of the file
    config: FitConfig | None = None  # of the fit; None: a file was named
    cameras: Sequence[Viewpoint] | None = None  # of the fit's training views, if it has them
    is_turned: bool = False  # whether Gaussians and cameras are not as fitted

    @property
    def settings(self) -> ModelConfig:
        """How the Gaussians are rendered."""
        near = near_plane_of(self.gaussians) if self.config is None else self.config.model.near
        settings = ModelConfig(near=near).with_3dgs_defaults()
        return settings.model_copy(update=self.gaussians.rendered_with or {})

    def views(self, up: np.ndarray, views_per_ring: int, side_px: int) -> Sequence[Viewpoint]:
        """Return the fit's training cameras, or else cameras around the Gaussians, about ``up``."""
        if self.cameras is not None:
            return self.cameras
        return rings_around(self.gaussians, up, views_per_ring, side_px)

    def turn(self, up: np.ndarray, towards: np.ndarray) -> ExportSource:
        """Return this with the direction ``up`` (3,) rotated to ``towards``."""
        turn, cameras = np.eye(4), self.cameras
        turn[:3, :3] = rotation = shortest_rotation(up, towards)
        if cameras is not None:
            cameras = [replace(v, camera_to_world=turn @ v.camera_to_world) for v in cameras]
        gaussians = Similarity(1.0, rotation, np.zeros(3)).of_gaussians(self.gaussians)
        return replace(self, gaussians=gaussians, cameras=cameras, is_turned=True)


def load_source(what: Path, honoured: Honoured | None = None) -> ExportSource:
    """Load a file, or a fit's Gaussians for other programs, and bake in a smoothing filter.

    honoured: by the target; if that is enough, the fit's own Gaussians are loaded. Other
    non-default approximations of the file give a :class:`UserNote`.
    """
    if not what.exists():
        raise UserError(f"{what}: there is no such file or folder")
    path, config = what, None
    if what.is_dir():
        for_viewers = what / GAUSSIANS_FOR_VIEWERS
        require_results(what, *(() if for_viewers.is_file() else (GAUSSIANS,)))
        config, path = load_run_config(what), what / GAUSSIANS
        fitted = config.model.approximations
        is_enough = honoured is not None and fitted.non_default.keys() <= honoured(fitted)
        if for_viewers.is_file() and not (is_enough and path.is_file()):
            path = for_viewers
    gaussians = Gaussians.load(path)
    recorded = from_ply_header(str(path), gaussians.rendered_with or {})
    others = {name: value for name, value in recorded.items() if value != DECLARED[name].default}
    shown = frozenset() if honoured is None else honoured(Approximations.from_values(recorded))
    if unknown := [f"{k} {str(v).lower()}" for k, v in others.items() if k not in shown]:
        beside = path.with_name(GAUSSIANS_FOR_VIEWERS)
        note_user(
            f"{path}: made to be rendered with {', '.join(unknown)}; programs that do not will "
            "show it otherwise" + (f"; export {beside} instead" if beside.is_file() else "")
        )
    gaussians = bake_smoothing(replace(gaussians, rendered_with=others or None))
    cameras = None if config is None else training_cameras(what, gaussians.origin)
    return ExportSource(gaussians, path, config, cameras)
