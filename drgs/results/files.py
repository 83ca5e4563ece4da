"""Names of the files and folders in a fit's output folder."""

from __future__ import annotations

from drgs.config.extensions import EFFECTS

CONFIG = "config.yml"  # every value of the configuration; marks whose folder it is
CHECKPOINT = "checkpoint.npz"  # while the fit runs: see :mod:`drgs.fit.checkpoint`
GAUSSIANS = "point_cloud.ply"
GAUSSIANS_FOR_VIEWERS = "point_cloud_viewers.ply"  # for viewers without our approximations
HISTORY = "history.csv"
DENSITY = "density.csv"  # changes of the population, if there are any
CURVES = "curves.png"
ORBIT = "orbit.webp"
ORBIT_GIF = "orbit.gif"  # of earlier versions
REPORT = "report.html"
VIEWER = "viewer.html"  # interactive page of the Gaussians, unless too large
RENDERS = "renders"  # a folder for each split, with an image of each view
SIDE_BY_SIDE = "side_by_side"  # the same, with the photograph and the difference beside the image
VIEWS = "views.json"  # the dataset's cameras of the training views, for orbits
EXAMINATION = "examination.json"  # which effects an examination chose, with the evidence
BUDGET_PLAN = "plan.txt"  # the plan for a budget of time, with reasons
TENSORBOARD = "tensorboard"  # a folder, with ``--tensorboard``
EVENTS = f"{TENSORBOARD}/events.out.tfevents.fit"  # TensorBoard finds the word in the middle
METRICS = "metrics.json"  # written last
ERROR_BUDGET = "error_budget.json"  # of ``drgs render --error``


def result_names() -> list[str]:
    """Return the files of a fit but for ``config.yml``, with those of effects."""
    names = [name for effect in EFFECTS.all() for name in effect.value.files]
    names += [CHECKPOINT, CURVES, DENSITY, EXAMINATION, HISTORY, METRICS, ORBIT, ORBIT_GIF]
    names += [BUDGET_PLAN, GAUSSIANS, GAUSSIANS_FOR_VIEWERS, RENDERS, REPORT, SIDE_BY_SIDE]
    return [*names, TENSORBOARD, VIEWER, VIEWS]
