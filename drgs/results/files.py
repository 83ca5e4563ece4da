"""Names of the files and folders that a fit writes into its output folder."""

from __future__ import annotations

CONFIG = "config.yml"
"""Every value of the configuration; it says whose folder it is."""

CHECKPOINT = "checkpoint.npz"
"""While the fit runs: see :mod:`drgs.training.checkpoint`."""

GAUSSIANS = "point_cloud.ply"

GAUSSIANS_FOR_VIEWERS = "point_cloud_viewers.ply"
"""For viewers that know nothing of the approximations that the others are rendered with."""

HISTORY = "history.csv"
DENSITY = "density.csv"
"""What changed the population, and how; there is none where nothing did."""

CURVES = "curves.png"
ORBIT = "orbit.webp"
ORBIT_GIF = "orbit.gif"
REPORT = "report.html"

VIEWER = "viewer.html"
"""The Gaussians, to walk around in; there is none where it would be too large."""

RENDERS = "renders"
"""A folder for each split that was measured, with a picture for each of its views."""

SIDE_BY_SIDE = "side_by_side"
"""The same, with the photograph and the difference beside the picture."""

CAMERAS = "cameras.json"
"""Refined cameras of the training views."""

VIEWS = "views.json"
"""Cameras of the training views as the data has them: what an orbit needs."""

COLORS = "colors.json"
"""Colour transforms of the training views."""

BUDGET_PLAN = "plan.txt"
"""What was planned for a budget of time, and why."""

TENSORBOARD = "tensorboard"
"""A folder, with ``--tensorboard``."""

EVENTS = f"{TENSORBOARD}/events.out.tfevents.fit"
"""The history as TensorBoard reads it, which knows its files by the word in the middle."""

METRICS = "metrics.json"
"""Written when everything else is there."""

RESULTS = (
    CAMERAS,
    CHECKPOINT,
    COLORS,
    CURVES,
    DENSITY,
    HISTORY,
    METRICS,
    ORBIT_GIF,
    ORBIT,
    BUDGET_PLAN,
    GAUSSIANS,
    GAUSSIANS_FOR_VIEWERS,
    RENDERS,
    REPORT,
    SIDE_BY_SIDE,
    TENSORBOARD,
    VIEWER,
    VIEWS,
)
"""All of them but ``config.yml``."""
