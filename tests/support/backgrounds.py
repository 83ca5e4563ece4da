"""Environments and images behind splats."""

from functools import cache

import mitsuba as mi
import numpy as np

import drgs  # noqa: F401  (registers the plugins)
from support.views import VIEWS, View, pose, tensors

# Single precision, of values up to 2: as in test_splats; the conversion to display space multiplies
# errors of dark pixels by up to 13.
IMAGE = 2e-5
VIEW = VIEWS[1]


@cache
def texels(rows=16, columns=32, seed=0) -> np.ndarray:
    """Linear radiance (rows, columns, 3), of strong contrasts."""
    values = np.random.default_rng(seed).uniform(0.05, 1.5, (rows, columns, 3))
    return values.astype(np.float32)


def sky_turned():
    return mi.ScalarTransform4f().rotate([1, 2, 0.5], 50)


EMITTERS = {
    "constant": lambda: {"type": "constant", "radiance": {"type": "rgb", "value": [0.3, 0.9, 1.5]}},
    "envmap": lambda: {
        "type": "envmap", "bitmap": mi.Bitmap(texels()), "to_world": sky_turned(), "scale": 1.25
    },
}  # fmt: skip

CLOSE = np.array(pose([0.2, -1.0, 0.4], 46, (0.5, -0.65, 1.0)))
INTRINSICS = {"fx": 30.0, "fy": 27.0, "cx": 17.0, "cy": 12.5}


def calibrated(**changes) -> View:
    return VIEW.with_sensor("calibrated", **{**INTRINSICS, **changes})


def integrator_of(gaussians, **settings) -> dict:
    return {"type": "splats", **tensors(gaussians), **settings}


def load(sensor, integrator, **objects):
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **objects})


def rendered(values, **changes) -> dict:
    return {
        "type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, "filter_type": "nearest",
        **changes,
    }  # fmt: skip
