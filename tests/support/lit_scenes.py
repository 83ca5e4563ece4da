"""Scenes with light between splats and surfaces."""

import drjit as dr
import mitsuba as mi
import numpy as np

from support.helpers import rows
from support.reference_lenses import gaussians_at
from support.views import to_linear

SETTINGS = (
    *("light_samples", "radiance_scale", "probes", "probe_fallback", "shadows"),
    *("aovs", "smoothing", "alpha_max", "alpha_cut"),
)
"""Integrator settings accepted by :func:`scene_of`."""


def scene_of(splats, light="rays", max_depth=8, nested="splatpath", spp=64, **others):
    """The objects of ``others`` among the splats, and their camera at ``sensor``.

    nested: type of the nested integrator; None: the default.
    """
    settings = {key: others.pop(key) for key in SETTINGS if key in others}
    tensors = {k: mi.TensorXf(v.astype(np.float32)) for k, v in vars(splats).items()}
    integrator = {
        "type": "splats",
        "nested_spp": spp,
        **({} if nested is None else {"nested": {"type": nested, "max_depth": max_depth}}),
        **tensors,
        **settings,
        **({} if light is None else {"light": light}),
    }
    return mi.load_dict({"type": "scene", "integrator": integrator, **others})


def camera(origin, target, size=24, fov=40, up=(0, 1, 0)):
    return {
        "type": "perspective",
        "fov": fov,
        "to_world": mi.ScalarTransform4f().look_at(origin, target, up),
        "film": {
            "type": "hdrfilm",
            "width": size,
            "height": size,
            "rfilter": {"type": "box"},
            "pixel_format": "rgb",
        },
        "sampler": {"type": "independent", "sample_count": 1},
    }


FAR_AWAY = gaussians_at([[0, 0, 1e4]], 0.3, 0.9, 1.0)


def mean_and_error(render, rounds):
    images = np.stack([np.array(render(seed)) for seed in range(rounds)])
    return images.mean(0), images.std(0, ddof=1) / np.sqrt(rounds)


def pixel_rays(sensor):
    """Origins and directions through the middles of pixels, row by row."""
    width, height = sensor.film().crop_size()
    y, x = np.mgrid[0:height, 0:width]
    place = mi.Point2f((x.ravel() + 0.5) / width, (y.ravel() + 0.5) / height)
    ray, _ = sensor.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
    directions = rows(ray.d)
    return np.broadcast_to(rows(ray.o), directions.shape), directions


def along_rays(scene, origins, directions):
    """Return the nested integrator's result with one path a ray."""
    mi.render(scene)  # it gets to know the splats
    nested, sampler = scene.integrator().state.nested, mi.load_dict({"type": "independent"})
    sampler.seed(0, len(origins))
    origins, directions = (np.ascontiguousarray(v.T, np.float32) for v in (origins, directions))
    ray = mi.Ray3f(mi.Point3f(origins), mi.Vector3f(directions))
    radiance, *_ = nested.sample(dr.ADMode.Primal, scene, sampler, ray, mi.Bool(True), δL=None)
    return rows(radiance)


def radiance_of(seen, is_open=True):
    """Radiance of what the reference's rays pass; is_open: black is behind it, and no radiance."""
    coverage = 1 - seen.transmittances[:, None]
    whole = np.ones_like(coverage) if is_open else np.where(coverage > 0, coverage, 1)
    return whole * to_linear(seen.colors / whole)
