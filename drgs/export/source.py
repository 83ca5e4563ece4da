"""Gaussians to export, and what their fit knows about them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from drgs.cameras.orbits import near_plane_of, rings_around
from drgs.cameras.viewpoints import Viewpoint
from drgs.config.approximations import DECLARED, Approximations, from_ply_header
from drgs.config.schema import FitConfig, ModelConfig
from drgs.core.errors import UserError, note_user
from drgs.core.origin import WORLD, recenter_means
from drgs.effects.smoothing import bake_smoothing
from drgs.export.merging import world_means
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.similarity import Similarity, shortest_rotation
from drgs.results import folder
from drgs.results.refined_cameras import training_cameras

Z_UP = np.array([0.0, 0.0, 1.0])  # of datasets, and of Gaussians that formats with axes encode

Honoured = Callable[[Approximations], frozenset[str]]
"""Function from fitted approximations to the names of those that a program honours, about."""


@dataclass(frozen=True, eq=False)
class ExportSource:
    """Gaussians to export."""

    gaussians: Gaussians[np.ndarray]  # without a smoothing filter
    path: Path  # of the file, or the first of several
    config: FitConfig | None = None  # of the fit; None: files were named
    cameras: Sequence[Viewpoint] | None = None  # of the fit's training views, if it has them
    near: float | None = None  # of the fit, world units; None: by the Gaussians' extent
    up: np.ndarray | None = None  # (3,), once it was chosen by rotating; None: z, or the cameras'

    @property
    def settings(self) -> ModelConfig:
        """How the Gaussians are rendered."""
        near = self.near or near_plane_of(self.gaussians)
        settings = ModelConfig(near=near).with_3dgs_defaults()
        return settings.model_copy(update=self.gaussians.rendered_with or {})

    def views(self, views_per_ring: int, side_px: int) -> Sequence[Viewpoint]:
        """Return the fit's training cameras, or else cameras around the Gaussians."""
        if self.cameras is not None:
            return self.cameras
        up = Z_UP if self.up is None else self.up
        return rings_around(self.gaussians, up, views_per_ring, side_px)

    def translate(self, vector: ArrayLike) -> ExportSource:
        """Return this moved by ``vector`` (3,), with an origin nearby if that is far away."""
        means, origin = recenter_means(world_means(self.gaussians) + vector)
        gaussians = replace(self.gaussians, means=means.astype(np.float32), origin=origin)
        offset = np.add(vector, self.gaussians.origin) - origin
        cameras = self.cameras and [view.with_offset(offset) for view in self.cameras]
        return replace(self, gaussians=gaussians, cameras=cameras)

    def move(self, rotation: np.ndarray, scale: float = 1.0) -> ExportSource:
        """Return this rotated by R (3, 3) and scaled about the world's origin."""
        gaussians = Similarity(scale, rotation, np.zeros(3)).of_gaussians(self.gaussians)
        turn, scaling = np.eye(4), np.diag([scale, scale, scale, 1])
        turn[:3, :3] = rotation

        def change(pose: np.ndarray) -> np.ndarray:
            return scaling @ turn @ pose @ np.linalg.inv(scaling)

        cameras = self.cameras and [view.with_poses(change) for view in self.cameras]
        near = self.near if scale == 1 else None
        return replace(self, gaussians=gaussians, cameras=cameras, near=near)

    def turn(self, up: np.ndarray, towards: np.ndarray) -> ExportSource:
        """Return this with the direction ``up`` (3,) rotated to ``towards``."""
        return replace(self.move(shortest_rotation(up, towards)), up=towards)

    def keep(self, criterion: str, mask: np.ndarray) -> ExportSource:
        """Return the Gaussians that ``mask`` (N,) marks, and print the number of the others."""
        kept, gone = np.count_nonzero(mask), np.count_nonzero(~mask)
        print(f"kept: {kept:,}; left out by {criterion} {gone:,}", flush=True)
        if not kept:
            raise UserError(
                f"{self.path}: nothing is left of {gone:,} Gaussians by {criterion}; crop and "
                "filter less"
            )
        return replace(self, gaussians=self.gaussians[mask])


def merge_sources(sources: Sequence[ExportSource]) -> ExportSource:
    """Return the Gaussians of all; of several, without the cameras and settings of fits."""
    first, *others = sources
    if not others:
        return first
    settings = first.gaussians.rendered_with
    for each in others:
        if each.gaussians.rendered_with != settings:
            note_user(
                f"{each.path}: made to be rendered otherwise than {first.path}, whose settings are "
                "used for both"
            )
    parts = [each.gaussians for each in sources]
    gaussians = Gaussians.concatenate(parts)
    means = np.concatenate([world_means(part) for part in parts])
    return ExportSource(replace(gaussians, means=means, origin=WORLD), first.path).translate(0.0)


def load_source(what: Path, honoured: Honoured | None = None) -> ExportSource:
    """Load a file, or a fit's Gaussians for other programs, and bake in a smoothing filter.

    honoured: by the target; if that is enough, the fit's own Gaussians are loaded. Other
    non-default approximations of the file give a :class:`UserNote`.
    """
    if not what.exists():
        raise UserError(f"{what}: there is no such file or folder")
    path, config = what, None
    if what.is_dir():
        own, path = folder.own_gaussians(what), folder.viewer_gaussians(what)
        folder.require_results(what, (path if path.is_file() else own).name)
        config = folder.load_run_config(what)
        fitted = config.model.approximations
        is_enough = honoured is not None and fitted.non_default.keys() <= honoured(fitted)
        if own.is_file() and (is_enough or not path.is_file()):
            path = own
    gaussians = Gaussians.load(path)
    recorded = from_ply_header(str(path), gaussians.rendered_with or {})
    others = {name: value for name, value in recorded.items() if value != DECLARED[name].default}
    shown = frozenset() if honoured is None else honoured(Approximations.from_values(recorded))
    if unknown := [f"{k} {str(v).lower()}" for k, v in others.items() if k not in shown]:
        beside = folder.viewer_gaussians(path.parent)
        is_better = beside.is_file() and beside != path == folder.own_gaussians(path.parent)
        note_user(
            f"{path}: made to be rendered with {', '.join(unknown)}; programs that do not will "
            "show it otherwise" + (f"; export {beside} instead" if is_better else "")
        )
    gaussians = bake_smoothing(replace(gaussians, rendered_with=others or None))
    if config is None:
        return ExportSource(gaussians, path)
    cameras = training_cameras(what, gaussians.origin)
    return ExportSource(gaussians, path, config, cameras, config.model.near)
