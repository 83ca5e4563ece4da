"""Caches of the ``splats`` integrator, its parameters, and that its bytes repeat."""

import gc
import weakref
from dataclasses import fields, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.splats_checks import (
    ALL_PARAMETERS,
    assert_images_agree,
    fresh_image,
    fresh_integrator,
    random_directions,
    with_tangents,
)
from support.views import (
    VIEWS,
    Scene,
    View,
    gradients_of,
    image_of,
    pose,
    tensors,
)

import drgs  # noqa: F401  (registers the plugin)
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.splatting import rendering


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


# ----------------------------------------------------------------------------------------------
# The same bytes in every run
# ----------------------------------------------------------------------------------------------


DIGEST = """
import hashlib
import drgs, drjit as dr, mitsuba as mi
dr.set_thread_count({threads})
mi.set_variant("llvm_ad_rgb")
import sys
sys.path.insert(0, "tests")
from support.views import Scene, View, gradients_of, image_of

scene = Scene(View("large", 150, 110), count=2000, srgb_primitives=True)
loaded = scene.load()
digest = hashlib.sha256(image_of(loaded).tobytes())
for name, value in gradients_of(loaded, scene.weights()).items():
    digest.update(value.tobytes())
print(digest.hexdigest())
"""


@pytest.mark.slow
def test_image_and_gradients_have_the_same_bytes_in_every_process(run_python):
    """Whatever the number of threads."""
    results = [run_python(DIGEST.format(threads=threads)) for threads in (1, 2, 3)]
    assert all(result.returncode == 0 for result in results), results[0].stderr
    assert len({result.stdout for result in results}) == 1


# ----------------------------------------------------------------------------------------------
# Parameters
# ----------------------------------------------------------------------------------------------


def test_traverse_lists_the_documented_parameters_as_differentiable():
    params = mi.traverse(mi.load_dict({"type": "splats", **tensors(Scene().gaussians)}))
    assert list(params.keys()) == [*PARAMETER_NAMES, "to_world", "background"]
    shapes = {name: tuple(params[name].shape) for name in PARAMETER_NAMES}
    assert shapes == {
        "means": (40, 3),
        "quats": (40, 4),
        "log_scales": (40, 3),
        "logit_opacities": (40,),
        "sh0": (40, 1, 3),
        "shN": (40, 3, 3),
    }
    assert {type(params[name]) for name in PARAMETER_NAMES} == {mi.TensorXf, mi.Float}
    for name in params.keys():  # noqa: SIM118
        assert params.flags(name) == mi.ParamFlags.Differentiable.value, name


def test_a_model_of_degree_zero_has_no_empty_parameter():
    """An empty parameter could not be optimized."""
    params = mi.traverse(Scene(degree=0).load())
    ours = [key for key in params.keys() if key.startswith("integrator.")]  # noqa: SIM118
    names = [*(name for name in PARAMETER_NAMES if name != "shN"), "to_world", "background"]
    assert ours == [f"integrator.{name}" for name in names]


def test_the_class_documents_every_parameter():
    integrator = mi.load_dict({"type": "splats", **tensors(Scene().gaussians)})
    documentation = type(integrator).__doc__
    settings = ("filename", "to_world", "shapes_to_world", "sh_degree", "near", "srgb_primitives")
    approximations = [field.name for field in fields(Approximations)]
    for name in (*settings, *approximations, *ALL_PARAMETERS):
        assert name in documentation, name


# ----------------------------------------------------------------------------------------------
# The frame that is kept from render() to render_backward()
# ----------------------------------------------------------------------------------------------


@pytest.fixture
def renderings(monkeypatch):
    """A list that grows with each frame that is rendered and not reused."""
    calls = []
    original = rendering.render

    def counting(*arguments):
        calls.append(arguments)
        return original(*arguments)

    monkeypatch.setattr(rendering, "render", counting)
    return calls


def kernels_of(action) -> int:
    """Kernels that Dr.Jit launches during ``action``."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        action()
        history = dr.kernel_history()
    return sum(kernel["type"] == dr.KernelType.JIT for kernel in history)


def test_unchanged_scene_reuses_the_frame():
    """All that is launched reads the pixels and lays out the image."""
    loaded = Scene().load()
    dr.eval(mi.render(loaded))
    assert kernels_of(lambda: dr.eval(mi.render(loaded))) <= 2
    loaded.integrator().state.cache.forget("frames")
    assert kernels_of(lambda: dr.eval(mi.render(loaded))) > 10


def test_a_backward_pass_reuses_the_frame(renderings):
    scene = Scene()
    gradients_of(scene.load(), scene.weights())
    assert len(renderings) == 1


def change_pose(params):
    params["sensor.to_world"] = mi.ScalarTransform4f(np.array(VIEWS[2].to_world))


def change(key, value):
    def apply(params):
        params[key] = value() if callable(value) else value

    return apply


SENSOR_CHANGES = {
    "to_world": (change_pose, {"to_world": VIEWS[2].to_world}),
    "field of view": (change("sensor.x_fov", 60.0), {"fov": 60.0}),
    "principal point": (
        change("sensor.principal_point_offset_x", 0.125),
        {"offset": (0.125, 0.0)},
    ),
    "near clip": (change("sensor.near_clip", 0.25), {"near_clip": 0.25}),
    "film size": (change("sensor.film.size", [29, 19]), {"width": 29, "height": 19}),
}


@pytest.mark.parametrize("name", SENSOR_CHANGES)
def test_a_changed_sensor_is_rendered_again(name, renderings):
    apply, changes = SENSOR_CHANGES[name]
    scene = Scene()
    loaded = scene.load()
    before = image_of(loaded)
    params = mi.traverse(loaded)
    apply(params)
    params.update()
    assert len(renderings) == 1
    after = image_of(loaded)
    assert len(renderings) == 2
    view = replace(scene.view, **changes)
    sensor = mi.load_dict(view.sensor())
    expected = image_of(loaded, sensor=sensor, integrator=fresh_integrator(scene))
    assert_images_agree(after, expected)
    assert after.shape != before.shape or np.abs(after - before).max() > 0.05


def test_a_moved_window_is_rendered_again():
    scene = Scene(replace(VIEWS[12], crop=(13, 7, 29, 18)))
    loaded = scene.load()
    mi.render(loaded)
    params = mi.traverse(loaded)
    params["sensor.film.crop_offset"] = [15, 9]
    params.update()
    expected = replace(scene.view, crop=(15, 9, 29, 18))
    sensor = mi.load_dict(expected.sensor())
    image = image_of(loaded, sensor=sensor, integrator=fresh_integrator(scene))
    assert np.array_equal(image_of(loaded), image)


@pytest.mark.parametrize("name", PARAMETER_NAMES)
def test_a_changed_parameter_is_rendered_again(name, renderings):
    scene = Scene()
    loaded = scene.load()
    before = image_of(loaded)
    params = mi.traverse(loaded)
    params[f"integrator.{name}"] = params[f"integrator.{name}"] + 0.25
    params.update()
    after = image_of(loaded)
    assert len(renderings) == 2 and np.abs(after - before).max() > 0.01
    value = type(params[f"integrator.{name}"])(params[f"integrator.{name}"])
    expected = fresh_integrator(scene, **{name: value})
    assert np.array_equal(after, image_of(loaded, integrator=expected))


def test_a_parameter_written_in_place_is_rendered_again():
    """Through a view of its memory, announced as Mitsuba asks for: no variable's index changes."""
    scene = Scene()
    loaded = scene.load()
    before = image_of(loaded)
    params = mi.traverse(loaded)
    memory = params["integrator.logit_opacities"].numpy()
    memory += 1
    params.set_dirty("integrator.logit_opacities")
    params.update()
    after = image_of(loaded)
    value = mi.TensorXf(scene.gaussians.logit_opacities.astype(np.float32) + 1)
    expected = image_of(loaded, integrator=fresh_integrator(scene, logit_opacities=value))
    assert np.abs(after - before).max() > 0.01 and np.array_equal(after, expected)


def test_a_changed_degree_is_rendered_again(renderings):
    scene = Scene()
    loaded = scene.load()
    before = image_of(loaded)
    loaded.integrator().sh_degree = 0
    after = image_of(loaded)
    assert len(renderings) == 2 and np.abs(after - before).max() > 0.01
    assert np.array_equal(after, fresh_image(replace(scene, sh_degree=0)))


@pytest.mark.parametrize(
    "approximations",
    [
        {"projection": "exact", "order": "pixel", "sh_direction": "pixel"},
        {"projection": "unscented", "extent": 2.5, "low_pass": 0},
        {"alpha_max": 0.5, "alpha_cut": 0.05, "transmittance_stop": 0.1, "order_window": 2},
    ],
    ids=["rays", "unscented", "cuts"],
)
def test_approximations_are_parameters(approximations):
    """The image and its gradients are those of the pipeline that these approximations name."""
    scene = Scene()
    integrator = mi.load_dict({"type": "splats", **tensors(scene.gaussians), **approximations})
    values = {k: float(v) if k == "low_pass" else v for k, v in approximations.items()}
    assert integrator.state.approximations == Approximations(**values)
    for name, value in values.items():
        if value != getattr(Approximations(), name):
            assert f"  {name} = {value}" in str(integrator)
    loaded = scene.load()
    image = image_of(loaded, integrator=integrator)
    expected = mi.load_dict({"type": "splats", **tensors(scene.gaussians)})
    assert np.abs(image - image_of(loaded, integrator=expected)).max() > 1e-3
    expected.state.approximations = Approximations(**values)
    assert np.array_equal(image, image_of(loaded, integrator=expected))


def test_a_changed_background_needs_no_new_frame_and_no_new_kernel(renderings):
    scene = Scene(srgb_primitives=True)
    loaded = scene.load()
    params = mi.traverse(loaded)
    for color in ([0.25, 0.5, 0.75], [0.125, 0.375, 0.625]):
        params["integrator.background"] = color
        params.update()
        dr.eval(mi.render(loaded))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        params["integrator.background"] = [0.375, 0.875, 0.0625]
        params.update()
        after = image_of(loaded)
        history = dr.kernel_history()
    assert all(kernel["cache_hit"] for kernel in history if kernel["type"] == dr.KernelType.JIT)
    assert len(renderings) == 1
    changed = replace(scene, background=(0.375, 0.875, 0.0625))
    assert np.array_equal(after, fresh_image(changed))


def test_a_new_view_needs_no_new_kernel():
    loaded = Scene(VIEWS[1]).load()
    sensors = [mi.load_dict(View("", to_world=pose([1, 2, i], 20 + i)).sensor()) for i in range(3)]
    for sensor in sensors[:2]:
        dr.eval(mi.render(loaded, sensor=sensor))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(mi.render(loaded, sensor=sensors[2]))
        history = dr.kernel_history()
    kernels = [kernel for kernel in history if kernel["type"] == dr.KernelType.JIT]
    assert len(kernels) > 10 and all(kernel["cache_hit"] for kernel in kernels)


@pytest.mark.slow
def test_a_stale_frame_is_not_kept():
    loaded = Scene().load()
    mi.render(loaded)
    frame = weakref.ref(loaded.integrator().state.cache.kept["frames 0"].value[0][0])
    params = mi.traverse(loaded)
    params["integrator.means"] = params["integrator.means"] + 1
    params.update()
    gc.collect()
    assert frame() is None


def test_backward_pass_leaves_no_autodiff_graph():
    """The film would hold it until the next rendering."""
    scene = Scene()
    loaded = scene.load()
    gradients_of(loaded, scene.weights())
    assert not dr.grad_enabled(loaded.sensors()[0].film().develop())
    params = with_tangents(loaded, random_directions(scene, ["means"]))
    dr.forward_to(mi.render(loaded, params))
    assert not dr.grad_enabled(loaded.sensors()[0].film().develop())
