"""Derivatives of what is behind splats, and of the splats before it."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.backgrounds import (
    EMITTERS,
    VIEW,
    Camera,
    attached,
    integrator_of,
    load,
    rendered,
    texels,
)
from support.helpers import single
from support.views import VIEWS, Scene, image_of

import drgs  # noqa: F401  (registers the plugins)
from drgs.core.arrays import from_host


def tensor(values):
    values = np.asarray(values)
    return mi.TensorXf(from_host(mi.Float, values), values.shape)


def weights_of(loaded, seed=1) -> np.ndarray:
    return single(np.random.default_rng(seed).normal(size=image_of(loaded).shape))


KEYS = {
    "constant": "sky.radiance.value",
    "envmap": "sky.data",
    "image": "integrator.background.data",
}
"""The parameter of each kind of background."""


def scene_with(kind, srgb_primitives=True, sensor=None, objects=None, **settings):
    """A scene with a background of a kind, and the name of its parameter."""
    settings = {"srgb_primitives": srgb_primitives, **settings}
    objects = dict(objects or {})
    if kind == "image":
        settings["background"] = rendered(texels(6, 8), filter_type="bilinear")
    else:
        objects["sky"] = EMITTERS[kind]()
    integrator = integrator_of(Scene().gaussians, **settings)
    return load(sensor or Camera().dictionary(), integrator, **objects), KEYS[kind]


def gradient_of(loaded, key, weights) -> np.ndarray:
    params, leaves = attached(loaded, key)
    dr.backward(dr.sum(mi.render(loaded, params) * tensor(weights), axis=None))
    return np.array(dr.grad(leaves[key])).astype(np.float64)


def value_like(parameter, values):
    """Numbers as a value of a parameter: of a colour, of a flat array, of a tensor."""
    values = np.asarray(values, np.float32)
    if isinstance(parameter, mi.Color3f):
        return mi.Color3f(values.ravel().tolist())
    flat = from_host(mi.Float, values)
    return flat if isinstance(parameter, mi.Float) else mi.TensorXf(flat, values.shape)


def floor() -> dict:
    """Behind the splats, in a part of the film."""
    camera = VIEW.camera
    matrix = np.eye(4)
    matrix[:3, :3] = camera.rotation.T @ np.diag([1.0, -1.0, -1.0])
    matrix[:3, 3] = camera.rotation.T @ [0.5, 0.5, 4] + camera.center
    reflectance = {"type": "rgb", "value": [0.5, 0.3, 0.2]}
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(matrix),
        "bsdf": {"type": "diffuse", "reflectance": reflectance},
    }


TWO_PATHS = "two images", "two losses", "two losses of one graph"
"""Cases in which a factor reaches the backdrop more than once."""


def factored(way, kind):
    """A scene, and the parameters that are multiplied by the factor."""
    sensor, objects, settings = Camera().dictionary(), {}, {}
    if way == "batch":
        views = {name: Camera(view).dictionary() for name, view in (("a", VIEW), ("b", VIEWS[2]))}
        film = sensor["film"] | {"width": 2 * VIEW.width}
        sensor = {"type": "batch", "film": film, "sampler": sensor["sampler"], **views}
    if way.startswith("surface"):
        objects["floor"] = floor()
        settings |= {"nested": {"type": "prb", "max_depth": 2}, "nested_spp": 4}
    others = {
        "surface of the same": ["floor.bsdf.reflectance.value"],
        "splats of the same": ["integrator.sh0"],
    }
    loaded, key = scene_with(kind, sensor=sensor, objects=objects, **settings)
    return loaded, [key, *others.get(way, [])]


@pytest.mark.slow
@all_kinds
@pytest.mark.parametrize(
    "way", [*TWO_PATHS, "batch", "surface", "surface of the same", "splats of the same"]
)
def test_gradients_reach_the_inputs_of_the_radiance(way, kind):
    """A factor of all of it, by central differences, from the same points of the emitters."""
    loaded, keys = factored(way, kind)
    start = {key: np.array(mi.traverse(loaded)[key]) for key in keys}
    count = 2 if way in TWO_PATHS else 1
    weights = single(np.random.default_rng(1).uniform(0.5, 1.5, image_of(loaded).shape))

    def loss(factor, **seeds):
        params = mi.traverse(loaded)
        for key, values in start.items():
            params[key] = value_like(params[key], values) * factor
        params.update()
        renders = [mi.render(loaded, params, **seeds) for _ in range(count)]
        return [dr.sum(image * tensor(weights), axis=None) for image in renders]

    factor = mi.Float(1)
    dr.enable_grad(factor)
    losses = loss(factor, seed=1, seed_grad=7)
    if way == "two losses":
        dr.backward(losses[0])
        losses = loss(factor, seed=1, seed_grad=7)[1:]
    elif way == "two losses of one graph":
        dr.backward(losses.pop(0), flags=dr.ADFlag.ClearVertices)
    dr.backward(sum(losses[1:], losses[0]))
    step = 0.01
    both = [sum(np.array(one)[()] for one in loss(mi.Float(1 + s), seed=7)) for s in (step, -step)]
    # Sums of 3404 terms of one sign, in single precision; of pixels in a curved display space and
    # of what reflects the sky, a step leaves its square.
    assert dr.grad(factor)[0] == pytest.approx((both[0] - both[1]) / (2 * step), rel=3e-3)


def test_images_and_constant_radiance_are_the_same_bytes_in_two_runs():
    """Derivatives of texels are added in any order: they, alone, may differ by rounding."""
    for kind in KEYS:
        loaded, key = scene_with(kind)
        weights = weights_of(loaded)
        images = [image_of(scene_with(kind)[0]).tobytes() for _ in range(2)]
        assert images[0] == images[1]
        names = ["integrator.means", *([key] if kind == "constant" else [])]
        for name in names:
            runs = [gradient_of(scene_with(kind)[0], name, weights).tobytes() for _ in range(2)]
            assert runs[0] == runs[1], (kind, name)


def test_a_changed_environment_needs_no_new_frame_and_no_new_kernel():
    loaded, key = scene_with("constant")

    def set_to(value):
        params = mi.traverse(loaded)
        params[key] = mi.Color3f(value)
        params.update()
        dr.eval(mi.render(loaded))

    set_to([0.1, 0.2, 0.3])
    set_to([0.2, 0.3, 0.4])
    frames = loaded.integrator().state.cache.kept["frames 0"]
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        set_to([0.3, 0.4, 0.5])
        history = dr.kernel_history([dr.KernelType.JIT])
    assert history and all(kernel["cache_hit"] for kernel in history)
    assert loaded.integrator().state.cache.kept["frames 0"] is frames
