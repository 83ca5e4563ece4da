"""A trainer of a few Gaussians before a few small views."""

import numpy as np

from drgs.cameras.viewpoints import look_at
from drgs.config.changes import with_changes
from drgs.config.schema import FitConfig
from drgs.datasets.types import Dataset, View
from drgs.initialization.start import Start, gaussians_at


def small_view(name, angle):
    """A 20x16 image of random colours, from a circle of radius 3 in the plane z = 0."""
    pose = look_at((3 * np.cos(angle), 3 * np.sin(angle), 0), (0, 0, 0), (0, 0, 1))
    image = np.random.default_rng(int(10 * angle)).uniform(size=(16, 20, 3)).astype(np.float32)
    return View(name, pose, 24.0, 24.0, 10.0, 8.0, 20, 16, image=image)


def small_dataset():
    views = tuple(small_view(f"v{i}", angle) for i, angle in enumerate((0.0, 1.0, 2.0, 4.0)))
    return Dataset(views, views[:1], "test", (1.0, 1.0, 1.0), 1.0, "four random images")


def make_trainer(room=2 << 30, **changes):
    from drgs.training.trainer import Trainer

    config = FitConfig.model_validate({"data": {"path": "."}, "iterations": 50, **changes})
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (40, 3))
    half_opaque = with_changes(config, {"init.opacity": 0.5})
    gaussians = gaussians_at(Start(points, None, "random"), half_opaque)
    return Trainer(config, small_dataset(), gaussians, room=room)
