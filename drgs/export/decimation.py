"""Fewer Gaussians for other programs: ``drgs export --decimate``.

Neighbours are merged (``drgs.export.merging``), and the rest is fitted to images of all
Gaussians from many cameras. No photographs are used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np

from drgs.cameras.orbits import extent_of
from drgs.cameras.viewpoints import Viewpoint
from drgs.config.schema import ModelConfig
from drgs.core.errors import note_user
from drgs.core.types import TensorXf
from drgs.export.merging import merge_down
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, make_sensors
from drgs.training.rates import RATE_KEYS, TOUCH_UP_RATES

ITERATIONS = 300

LAST_RATE = 0.1  # relative to the first

BETA_2 = 0.99  # of Adam: moments of the few iterations there are

VIEWS_PER_RING, SIDE_PX = 16, 400  # of cameras around Gaussians that come without


def decimate(
    gaussians: Gaussians[np.ndarray],
    count: int,
    views: Sequence[Viewpoint],
    model: ModelConfig,
    background: tuple[float, float, float],
) -> Gaussians[np.ndarray]:
    """Return at most ``count`` Gaussians that look alike from the ``views``.

    Minimises the mean squared difference of the images, one view at a time, by Adam, with rates of
    ``drgs.training.rates``. model: how they are rendered. Deterministic.
    """
    start = merge_down(gaussians, count)
    if start is gaussians:
        return gaussians
    whole, scene = (make_scene(each, model, background) for each in (gaussians, start))
    parameters, sensors = mi.traverse(scene), make_sensors(views)
    rates = {
        next(key for key in parameters.keys() if key.endswith(f".{name}")): rate  # noqa: SIM118
        for name, rate in _rates(extent_of(gaussians)).items()
        if np.size(getattr(start, name))
    }
    optimizer = mi.ad.Adam(lr=1.0, beta_2=BETA_2)
    for key in rates:
        optimizer[key] = cast(TensorXf, parameters[key])
    shuffle, order = np.random.default_rng(0), np.zeros(0, np.int64)
    for iteration in range(ITERATIONS):
        factor = LAST_RATE ** (iteration / ITERATIONS)
        optimizer.set_learning_rate({key: factor * rate for key, rate in rates.items()})
        parameters.update(optimizer)
        order = order if len(order) else shuffle.permutation(len(sensors))
        sensor, order = sensors[order[0]], order[1:]
        with dr.suspend_grad():
            expected = mi.render(whole, sensor=sensor, spp=1)
        image = mi.render(scene, parameters, sensor=sensor, spp=1)
        dr.backward(dr.mean(dr.square(image - expected), axis=None))
        optimizer.step()
    if not all(np.isfinite(np.array(optimizer[key])).all() for key in rates):
        note_user("the remaining Gaussians are merged, but not fitted: a number became infinite")
        return start
    fitted = {key.rpartition(".")[2]: np.array(optimizer[key]) for key in rates}
    shaped = {name: value.reshape(getattr(start, name).shape) for name, value in fitted.items()}
    return replace(start, **shaped)


def _rates(extent: float) -> dict[str, float]:
    """Return the first learning rates by parameter; extent: world units."""
    rates = {name: TOUCH_UP_RATES[key] for name, key in RATE_KEYS.items()}
    return {**rates, "means": rates["means"] * extent}
