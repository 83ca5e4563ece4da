"""Surfaces that Mitsuba renders, between splats: against the float64 reference and differences."""

import gc
import weakref
from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.splats_checks import XYZ
from support.views import VIEWS, Scene, gradient, gradients_of, image_of, tensors
from support.wall_scenes import (
    IMAGE,
    RADIANCE,
    SCENE,
    SKY,
    WALL,
    Wall,
    apart,
    blob,
    expected,
    load,
    rgba,
    to_display,
)

import drgs  # noqa: F401  (registers the plugins)
from drgs.core.errors import UnsupportedError

CROPPED = Scene(VIEWS[12])


@pytest.mark.parametrize("scene", [SCENE, CROPPED], ids=lambda scene: scene.view.name)
@pytest.mark.parametrize("srgb_primitives", [False, True])
@pytest.mark.parametrize("sky", [None, SKY], ids=["constant background", "sky"])
def test_wall_occludes_splats_behind_it_and_is_occluded_by_splats_before(
    scene, srgb_primitives, sky
):
    scene = apart(replace(scene, srgb_primitives=srgb_primitives))
    image = image_of(load(scene, sky=sky is not None))
    np.testing.assert_allclose(image, rgba(scene, sky=sky), rtol=0, atol=IMAGE * image.max())


def covered_by(wall, camera, count=32) -> np.ndarray:
    """(H, W): the part of each pixel that a wall covers, by count^2 points."""
    share = np.zeros((camera.height, camera.width))
    axes = wall.axes()
    for down in (np.arange(count) + 0.5) / count - 0.5:
        for right in (np.arange(count) + 0.5) / count - 0.5:
            moved = replace(camera, cx=camera.cx - right, cy=camera.cy - down)
            y, x = np.mgrid[: camera.height, : camera.width] + 0.5
            slopes = (x - moved.cx) / camera.fx, (y - moved.cy) / camera.fy
            point = np.stack([*slopes, np.ones_like(x)], axis=-1) * wall.depth(moved)[..., None]
            offset = (point - [0, 0, wall.z]) @ axes[:2].T
            share += np.abs(offset).max(axis=-1) < wall.half
    return share / count**2


@pytest.mark.slow
def test_edges_of_a_wall_match_ray_coverage():
    """Pixels that it covers are as before it, others as without it, those at its edge between."""
    scene, wall = apart(SCENE), Wall(half=0.5)
    image = image_of(load(scene, wall=wall, nested_spp=1024))
    share = covered_by(wall, scene.camera)[..., None]
    whole, without = rgba(scene, wall=wall), scene.image()
    tolerance = np.full_like(image, IMAGE * image.max())
    # Rows of samples are a quarter of a pixel apart, so that a straight edge is found to an eighth;
    # 1024 samples of the nested image differ by 0.016 of what they show (3 sigma).
    edge = (share > 0) & (share < 1)
    assert 50 < edge.sum() < 150
    assert 50 < (share == 1).sum() < 500
    tolerance += edge * (np.abs(whole - without) / 8 + 3 * 0.016 * RADIANCE.max())
    assert np.all(np.abs(image - share * whole - (1 - share) * without) <= tolerance)


def test_image_without_splats_is_the_nested_image():
    """With an environment that is seen past the edges of the wall, and a mirror that shows it."""
    scene = apart(SCENE)
    empty = {"logit_opacities": mi.TensorXf(np.full(scene.count, -20, np.float32))}
    ball = {"type": "sphere", "radius": 0.4, "bsdf": {"type": "conductor"}}
    position = scene.camera.rotation.T @ [0.1, 0.2, 1.8] + scene.camera.center
    ball["to_world"] = mi.ScalarTransform4f().translate(position)
    for background in ({"sky": True}, {"background": [0.0, 0.0, 0.0]}):
        loaded = load(
            scene, wall=Wall(half=0.4), shapes={"ball": ball}, nested_spp=64,
            **(empty | {"srgb_primitives": True} | background),
        )  # fmt: skip
        image = image_of(loaded, seed=3)
        nested = image_of(loaded, integrator=mi.load_dict({"type": "path"}), spp=64, seed=3)
        difference = np.abs(image - nested)
        # A surface at an edge that one of 64 rays meets may be missed by all 16: an eighth of a
        # pixel at most, seen by some more of 64 random samples.
        assert (difference[..., :3].max(axis=-1) > 1e-5).mean() < 0.02
        assert difference.max() < 0.125 + 0.1


def test_each_sample_of_a_pixel_has_its_own_depth():
    """The mean over the samples, of a wall whose edge crosses pixels."""
    scene, count = apart(SCENE), 256
    sensor, wall = scene.view.sensor(samples=count), Wall(half=0.5)
    smooth = image_of(load(scene, sensor, wall=wall))
    center = image_of(load(scene, wall=wall, nested_spp=count))
    blurred = image_of(load(scene, sensor, wall=None)) - image_of(load(scene, wall=None))
    # Both see the same, but for what the splats change within a pixel and for the sampling noise.
    assert np.abs(smooth - center - blurred).mean() < 0.01
    assert np.abs(smooth - center).max() < 0.5


def test_film_that_converts_colours_shows_the_same_image():
    scene = replace(apart(SCENE), srgb_primitives=True)
    image = image_of(load(scene, scene.view.sensor("xyz"), sky=True))
    expected_image = rgba(scene, sky=SKY)[..., :3] @ XYZ.T
    np.testing.assert_allclose(image, expected_image, rtol=0, atol=IMAGE * image.max())


def test_depth_alpha_and_normal_include_surfaces_and_splats():
    scene = apart(SCENE)
    image = image_of(load(scene, aovs="z:depth, a:alpha, n:normal"))
    planes = expected(scene)
    np.testing.assert_allclose(image[..., :4], rgba(scene), rtol=0, atol=IMAGE * 2)
    np.testing.assert_allclose(image[..., 4], planes["depth"], rtol=0, atol=IMAGE * 4)
    np.testing.assert_allclose(image[..., 5], planes["alpha"], rtol=0, atol=IMAGE)
    # The normals of splats are 0 where they are all transparent, and the wall's is added. It points
    # to the camera, also where the wall is seen from behind.
    bare = {"logit_opacities": mi.TensorXf(np.full(scene.count, -20, np.float32))}
    bare["feature_x"] = mi.TensorXf(np.ones((scene.count, 1), np.float32))
    image = image_of(load(scene, aovs="n:normal, f:feature_x", **bare))
    normals, feature = image[..., 4:7], image[..., 7]
    np.testing.assert_allclose(feature, 0, atol=IMAGE)
    normal = scene.camera.rotation.T @ WALL.axes()[2]
    np.testing.assert_allclose(normals, np.broadcast_to(normal, normals.shape), atol=IMAGE)
    behind = {"wall": WALL.shape(scene.view.camera, flip_normals=True)}
    image = image_of(load(scene, wall=None, shapes=behind, aovs="n:normal", **bare))
    np.testing.assert_allclose(image[..., 4:7], normals, atol=IMAGE)


@pytest.mark.parametrize("rfilter", ["gaussian", "tent"])
def test_single_jittered_sample_sees_surfaces(rfilter):
    """Mitsuba's default filter, with a sample count of 1."""
    scene = apart(SCENE)
    bare = {"logit_opacities": mi.TensorXf(np.full(scene.count, -20, np.float32))}
    sensor = scene.view.sensor(rfilter=rfilter)
    image = image_of(load(scene, sensor, wall=Wall(tilt=(0, 0)), aovs="z:depth", **bare))
    np.testing.assert_allclose(image[..., 4], WALL.z, rtol=IMAGE)
    np.testing.assert_allclose(
        image[..., :3], np.broadcast_to(to_display(RADIANCE), (23, 37, 3)), rtol=1e-4
    )


def test_hidden_emitters_are_transparent():
    scene = apart(SCENE)
    hidden = image_of(load(scene, hide_emitters=True))
    np.testing.assert_array_equal(hidden, image_of(load(scene, wall=None)))
    # One behind the other: what is seen is behind both.
    screen = Wall(z=3.1).shape(scene.camera)
    screen["bsdf"] = {"type": "diffuse"}
    del screen["emitter"]
    shapes = {"first": Wall(z=1.7).shape(scene.camera), "screen": screen}
    hidden = image_of(load(scene, shapes=shapes, hide_emitters=True, aovs="z:depth"))
    planes = expected(scene, wall=Wall(z=3.1))
    # Mitsuba moves the rays that go on from an emitter by 1e-4, along its normal.
    np.testing.assert_allclose(hidden[..., 4], planes["depth"], rtol=0, atol=4e-4)


def test_surfaces_before_the_near_plane_are_invisible():
    scene = apart(replace(SCENE, near=0.5))
    shapes = {"close": Wall(z=0.4, tilt=(0, 0)).shape(scene.camera)}
    image = image_of(load(scene, shapes=shapes, aovs="z:depth"))
    np.testing.assert_allclose(image[..., 4], expected(scene)["depth"], rtol=0, atol=IMAGE * 4)


def test_surfaces_beyond_the_far_clip_are_invisible():
    """``path`` does the same. Splats are seen there."""
    scene = apart(SCENE)
    loaded = load(scene, sensor=scene.view.sensor() | {"far_clip": 1.5}, aovs="z:depth")
    without = image_of(load(scene, wall=None, aovs="z:depth"))
    np.testing.assert_array_equal(image_of(loaded), without)
    params = mi.traverse(loaded)
    params["sensor.far_clip"] = 100.0
    params.update()
    np.testing.assert_array_equal(image_of(loaded), image_of(load(scene, aovs="z:depth")))


def pane(z, bsdf) -> dict:
    shape = Wall(z=z).shape(SCENE.camera)
    del shape["emitter"]
    return shape | {"bsdf": bsdf}


def masked(opacity) -> dict:
    return {"type": "mask", "opacity": opacity, "bsdf": {"type": "diffuse"}}


@pytest.mark.slow
@pytest.mark.parametrize("nested", ["path", "prb"])
@pytest.mark.parametrize("srgb_primitives", [True, False])
def test_splats_between_windows_and_a_wall_are_visible(srgb_primitives, nested):
    """Each of two windows and a wall lies at its own depth; a third window is invisible."""
    scene = apart(replace(SCENE, srgb_primitives=srgb_primitives))
    windows = [(Wall(z=1.6), 0.25), (Wall(z=1.9), 0.5)]
    shapes = {f"pane_{k}": pane(wall.z, masked(c)) for k, (wall, c) in enumerate(windows)}
    shapes["nothing"] = pane(1.2, masked(0.0))
    settings = {"nested": mi.load_dict({"type": nested}), "aovs": "z:depth", "nested_spp": 1024}
    image = image_of(load(scene, shapes=shapes, **settings))
    planes = expected(scene, windows=windows)
    # Paths pass a window with its opacity: 5 standard errors of the part of the wall's light.
    noise = 5 * 0.5 / np.sqrt(1024) * (to_display if not srgb_primitives else np.asarray)(RADIANCE)
    difference = np.abs(image[..., :3] - planes["color"])
    assert (difference <= noise + IMAGE).all() and difference.mean() < noise.mean() / 5
    np.testing.assert_allclose(image[..., 3], planes["alpha"], rtol=0, atol=IMAGE)
    # Mitsuba moves the rays that go on from a surface by 1e-4, along its normal.
    np.testing.assert_allclose(image[..., 4], planes["depth"], rtol=0, atol=8e-4)


def test_surface_edges_match_at_the_border_of_a_crop_window():
    scene, (x, y, width, height) = apart(SCENE), (9, 4, 17, 9)
    wall = Wall(half=0.5)
    planes = covered_by(wall, scene.camera)[y : y + height, x : x + width]
    edge = (planes > 0) & (planes < 1)
    border = np.ones_like(edge)
    border[1:-1, 1:-1] = False
    assert (edge & border).sum() > 5
    cropped = replace(scene.view, crop=(x, y, width, height)).sensor()
    settings = {"wall": wall, "aovs": "z:depth,t:alpha"}
    whole = image_of(load(scene, **settings))[y : y + height, x : x + width]
    part = image_of(load(scene, sensor=cropped, **settings))
    np.testing.assert_allclose(part[..., 3:], whole[..., 3:], rtol=0, atol=IMAGE)


def test_scene_of_the_user_is_not_modified():
    """Names of its objects, and what Mitsuba's own integrators see, with Gaussians of shapes."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(3)}
    shapes = {"floor": floor, "sun": {"type": "directional"}, "blob": blob([0, 0, 0])}
    loaded = load(SCENE, sky=True, shapes=shapes)
    names = [name for name, _ in mi.traverse(loaded)]
    path = mi.load_dict({"type": "path"})
    before = image_of(loaded, integrator=path, spp=16)
    image_of(loaded)
    assert [name for name, _ in mi.traverse(loaded)] == names
    np.testing.assert_array_equal(image_of(loaded, integrator=path, spp=16), before)


def repeated(shape) -> dict:
    """Return a shape, its group and an instance of the group."""
    group = {"type": "shapegroup", "shape": shape}
    return {"group": group, "copy": {"type": "instance", "of": {"type": "ref", "id": "group"}}}


@pytest.mark.slow
@pytest.mark.parametrize("with_shapes", [False, True])
def test_instances_are_surfaces(with_shapes):
    """Seen, moved with what they repeat, and differentiated, as if they were the shape itself."""
    scene = apart(SCENE)
    lamp = {"type": "point", "position": list(scene.camera.center)}
    diffuse = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.6, 0.7]}}
    others = {"lamp": lamp} | ({"blob": blob([0, 0, 0])} if with_shapes else {})

    def results(shapes, prefix):
        settings = {"nested": mi.load_dict({"type": "prb", "max_depth": 2}), "aovs": "z:depth"}
        loaded = load(scene, wall=None, shapes=shapes | others, **settings)
        images = [image_of(loaded)]
        params = mi.traverse(loaded)
        key = f"{prefix}.bsdf.reflectance.value"
        dr.enable_grad(params[key])
        dr.backward(dr.sum(mi.render(loaded, params), axis=None))
        gradients = gradient(params[key])
        key = f"{prefix}.to_world"
        params[key] = mi.Transform4f(mi.traverse(mi.load_dict(pane(2.9, diffuse)))["to_world"])
        params.update()
        return *images, gradients, image_of(loaded)

    found = results(repeated(pane(2.3, diffuse)), "group.shape")
    known = results({"floor": pane(2.3, diffuse)}, "floor")
    assert np.abs(found[1]).min() > 0 and np.abs(found[0] - found[2]).max() > 0.1
    for value, correct in zip(found, known, strict=True):
        # Rays go into the instance's space and back, which moves what they hit by some roundings;
        # gradients are sums over all pixels.
        np.testing.assert_allclose(value, correct, rtol=1e-4, atol=1e-4)


def test_one_integrator_can_render_scenes_with_and_without_mitsubas_gaussians():
    """All other objects are the same."""
    floor = mi.load_dict(pane(2.3, {"type": "diffuse"}))
    sensor = mi.load_dict(SCENE.view.sensor())
    lamp = mi.load_dict({"type": "point", "position": list(SCENE.camera.center)})
    common = {"type": "scene", "sensor": sensor, "floor": floor, "lamp": lamp}
    blobs = ({}, {"more": blob([0, 0, 0])}, {"more": blob([0.3, 0, 0])})
    scenes = [mi.load_dict(common | more) for more in blobs]
    settings = SCENE.settings | tensors(SCENE.gaussians)
    one = mi.load_dict(settings)
    for loaded in (*scenes, *scenes):
        fresh = image_of(loaded, integrator=mi.load_dict(settings))
        np.testing.assert_array_equal(image_of(loaded, integrator=one), fresh)


def test_changed_host_values_are_noticed():
    """A lamp of which the sampling weight becomes zero, in a scene with Mitsuba's Gaussians."""
    lamps = {
        f"lamp_{k}": {"type": "point", "position": list(SCENE.camera.center + k)} for k in range(2)
    }
    shapes = {"floor": pane(2.3, {"type": "diffuse"}), "blob": blob([0, 0, 0]), **lamps}
    loaded = load(SCENE, wall=None, shapes=shapes)
    before = image_of(loaded)
    params = mi.traverse(loaded)
    params["lamp_1.sampling_weight"] = 0.0
    params.update()
    after = image_of(loaded)
    loaded.integrator().state.cache.surfaces = None
    loaded.integrator().state.cache.forget("surfaces")
    np.testing.assert_array_equal(after, image_of(loaded))
    assert np.abs(after - before).max() > 0.01


# ----------------------------------------------------------------------------------------------
# Derivatives, and what runs and stays
# ----------------------------------------------------------------------------------------------


RADIANCE_KEY = "wall.emitter.radiance.value"

PERSPECTIVE = {"type": "perspective"}
OF_CAMERAS = {
    "perspective": (PERSPECTIVE, ("to_world", "x_fov", "principal_point_offset_x")),
    "thinlens": (
        {"type": "thinlens", "aperture_radius": 0.1, "focus_distance": 2.0},
        ("to_world", "aperture_radius", "focus_distance"),
    ),
    "orthographic": ({"type": "orthographic"}, ("to_world",)),
    "calibrated": (
        {"type": "calibrated", "fx": 8.0, "lens": "opencv", "k1": 0.01},
        ("to_world", "fx", "cx", "k1"),
    ),
    "batch": (
        {"type": "batch", "left": PERSPECTIVE, "right": {"type": "perspective", "fov": 50}},
        ("left.to_world", "right.x_fov"),
    ),
}
"""Sensors, and parameters that have derivatives without surfaces."""


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [dr.backward, dr.forward_to])
@pytest.mark.parametrize("name", OF_CAMERAS)
def test_camera_derivatives_with_surfaces_are_refused_by_name(name, derivative):
    """Whatever renders the surfaces: see the table of docs/mitsuba.md."""
    sensor, keys = OF_CAMERAS[name]
    film = {"type": "hdrfilm", "width": 8, "height": 4, "rfilter": {"type": "box"}}
    loaded = load(SCENE)
    for key in keys:
        eye = mi.load_dict({**sensor, "film": film, "id": "eye"})
        params = mi.traverse(eye)
        dr.enable_grad(params[key])
        image = mi.render(loaded, params, sensor=eye)
        with pytest.raises(UnsupportedError, match=rf"^splats: eye\.{key} is not differentiated"):
            derivative(image)


def test_a_scene_without_surfaces_never_runs_the_nested_integrator():
    counts, path = [], mi.load_dict({"type": "path"})

    class Counting(mi.SamplingIntegrator):
        def render(self, *arguments, **named):
            counts.append(1)
            return path.render(*arguments, **named)

    nested = Counting(mi.Properties())
    image_of(load(SCENE, wall=None, sky=True, nested=nested))
    assert not counts
    image_of(load(SCENE, nested=nested))
    assert counts == [1]


@pytest.mark.slow
@pytest.mark.parametrize("use", ["an image", "a gradient", "an image with gradients"])
@pytest.mark.parametrize("with_shapes", [False, True])
def test_unreferenced_scene_is_freed(use, with_shapes):
    """Though its integrator keeps what it saw of it."""
    loaded = load(SCENE, sky=True, shapes={"blob": blob([0, 0, 0])} if with_shapes else {})
    params = mi.traverse(loaded)
    if use != "an image":
        dr.enable_grad(params["integrator.means"], params[RADIANCE_KEY])
    image = mi.render(loaded, params)
    if use == "a gradient":
        dr.backward(dr.mean(image, axis=None))
    integrator = weakref.ref(loaded.integrator())
    del loaded, params, image
    gc.collect()
    assert integrator() is None


@pytest.mark.parametrize("spp", [0, 4], ids=["its sampler's", "given"])
def test_nested_samples_are_independent_of_the_splats(spp):
    """Whatever the nested integrator and its derivatives write into the sensor's sampler."""
    loaded = load(apart(SCENE), wall=Wall(half=0.5), nested_spp=16)
    first = image_of(loaded, spp=spp, seed=3)
    loaded.integrator().state.cache.forget("frames")
    np.testing.assert_array_equal(image_of(loaded, spp=spp, seed=3), first)
    params = mi.traverse(loaded)
    for derivative in (dr.backward, dr.forward_to):
        dr.enable_grad(params[RADIANCE_KEY])
        dr.set_grad(params[RADIANCE_KEY], 1)
        derivative(mi.render(loaded, params))
        assert loaded.sensors()[0].sampler().sample_count() == 1


def test_rendering_another_image_keeps_gradients():
    scene, weights = apart(SCENE), SCENE.weights()
    loaded = load(scene)
    expected = gradients_of(loaded, weights, ["means"])["means"]
    loaded, other = load(scene), load(scene, wall=Wall(z=2.9))
    params = mi.traverse(loaded)
    dr.enable_grad(params["integrator.means"])
    image = mi.render(loaded, params)
    mi.render(other, integrator=loaded.integrator())
    dr.backward(dr.sum(image * mi.TensorXf(weights.astype(np.float32)), axis=None))
    np.testing.assert_array_equal(gradient(params["integrator.means"]), expected)
