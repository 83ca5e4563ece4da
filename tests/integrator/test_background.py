"""Environments and images behind splats: against Mitsuba's ``path``, numpy, and differences."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support import reference_effects
from support.backgrounds import (
    CLOSE,
    EMITTERS,
    IMAGE,
    VIEW,
    calibrated,
    integrator_of,
    load,
    rendered,
    texels,
)
from support.kernels import launched
from support.views import (
    VIEWS,
    Scene,
    View,
    decode,
    gradients_of,
    image_of,
    side_by_side,
    to_linear,
)
from support.wall_scenes import to_display

import drgs  # noqa: F401  (registers the plugins)
from drgs.reference import splatting as reference

CAMERAS = {
    "perspective": VIEW,
    "rolled": VIEWS[2],
    "mirrored": VIEWS[3],
    "principal point": VIEWS[10],
    "crop window": VIEWS[13],
    "orthographic": VIEW.with_sensor("orthographic"),
    "calibrated": calibrated(),
    "opencv": calibrated(lens="opencv", k1=-0.25, k2=0.0625, p1=0.0078125),
    "barrel": calibrated(lens="opencv", k1=-0.3125, fx=18.0, fy=18.0),
    "fisheye": calibrated(lens="fisheye", k1=-0.03125, fx=12.0, fy=12.0),
    "rolling shutter": calibrated(
        to_world_close=lambda: mi.ScalarTransform4f(CLOSE), shutter="rolling"
    ),
}

both_emitters = pytest.mark.parametrize("emitter", EMITTERS)

ON_BLACK = {"background": 0.0, "srgb_primitives": False}


def image_before(sky, camera=None, spp=1, seed=0, is_hidden=False, **settings) -> np.ndarray:
    """Splats before an emitter; ``is_hidden``: the splats are transparent."""
    camera = camera or VIEW
    objects = {} if sky is None else {"sky": sky}
    if is_hidden:
        settings["logit_opacities"] = mi.TensorXf(np.full(40, -20, np.float32))
    integrator = integrator_of(Scene(camera).gaussians, **settings)
    return image_of(load(camera.sensor(), integrator, **objects), spp=spp, seed=seed)


def environment_image(sensor, emitter) -> np.ndarray:
    """Radiance of Mitsuba's own emitter and sensor along one ray through each pixel's centre."""
    loaded = load(sensor, {"type": "path"}, sky=EMITTERS[emitter]())
    own = loaded.sensors()[0]
    width, height = own.film().crop_size()
    pixel = dr.arange(mi.UInt32, width * height)
    place = mi.Point2f(pixel % width, pixel // width) + 0.5
    ray, weight = own.sample_ray(0.5, 0.5, place / mi.Vector2f(width, height), [0.5, 0.5])
    found = loaded.ray_intersect(ray)
    color = np.array(weight * loaded.environment().eval(found) + mi.Color3f(0 * place.x))
    return color.T.reshape(height, width, 3).astype(np.float64)


def composite_over(splats, behind, srgb_primitives) -> np.ndarray:
    """Splats (display space, premultiplied) in front of linear radiance; covered film."""
    transmittance = 1 - splats[..., 3:]
    if srgb_primitives:
        color = decode(splats[..., :3], splats[..., 3]) + transmittance * behind
    else:
        color = splats[..., :3] + transmittance * to_display(behind)
    return np.concatenate([color, np.ones_like(transmittance)], axis=-1)


# ----------------------------------------------------------------------------------------------
# Environments
# ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@both_emitters
@pytest.mark.parametrize("srgb_primitives", [True, False], ids=["linear", "display"])
@pytest.mark.parametrize("camera", CAMERAS)
def test_environment_shows_behind_the_splats(camera, srgb_primitives, emitter):
    camera = CAMERAS[camera]
    settings = {"srgb_primitives": srgb_primitives, "background": [0.2, 0.4, 0.6]}
    image = image_before(EMITTERS[emitter](), camera, **settings)
    splats = image_before(None, camera, **ON_BLACK)
    behind = environment_image(camera.sensor(), emitter)
    np.testing.assert_allclose(
        image, composite_over(splats, behind, srgb_primitives), atol=2 * IMAGE
    )
    assert splats[..., 3].max() > 0.9 and splats[..., 3].min() < 0.1
    assert (image[..., 3] == 1).all()


@both_emitters
def test_environment_behind_splats_matches_path(emitter):
    """With as many samples at the same points: Mitsuba's samplers give both the same."""
    actual = image_before(EMITTERS[emitter](), is_hidden=True, spp=9, seed=7)
    path, other = (
        image_of(load(VIEW.sensor(), {"type": "path"}, sky=EMITTERS[emitter]()), spp=9, seed=s)
        for s in (7, 8)
    )
    np.testing.assert_allclose(actual, path, atol=IMAGE)
    assert (np.abs(actual - other).max() > 0.1) == (emitter == "envmap")


@pytest.mark.parametrize("hide", [True, False])
def test_hide_emitters_keeps_the_background(hide):
    """A colour or a texture, which an environment replaces."""
    for background in ([0.2, 0.4, 0.6], rendered(texels())):
        settings = {"hide_emitters": hide, "background": background}
        image = image_before(EMITTERS["constant"](), **settings)
        assert np.array_equal(image, image_before(None, **settings)) == hide
        assert np.array_equal(image, image_before(EMITTERS["constant"]())) != hide
        assert (image[..., 3].min() < 0.1) == hide


def test_only_environment_emitters_are_visible():
    light = {"type": "point", "intensity": 10.0}
    np.testing.assert_array_equal(image_before(light), image_before(None))


@pytest.mark.parametrize("srgb_primitives", [True, False], ids=["linear", "display"])
@pytest.mark.parametrize("view", [VIEW, VIEWS[6], VIEWS[12], VIEWS[13]], ids=lambda v: v.name)
def test_a_background_texture_is_stretched_over_the_film_upright(view, srgb_primitives):
    """A texel for each pixel of the whole film, of which a crop window shows a part."""
    values = texels(view.height, view.width, seed=5)
    settings = {"background": rendered(values), "srgb_primitives": srgb_primitives}
    image = image_before(None, view, **settings)
    splats = image_before(None, view, **ON_BLACK)
    expected = composite_over(splats, values[view.window].astype(np.float64), srgb_primitives=False)
    if srgb_primitives:  # it is the last splat
        expected = to_linear(expected)
    np.testing.assert_allclose(image[..., :3], expected[..., :3], atol=2 * IMAGE)


# ----------------------------------------------------------------------------------------------
# Out of focus, in motion, and distorted
# ----------------------------------------------------------------------------------------------


def test_defocused_environment_is_the_mean_of_pinholes_in_the_aperture():
    """The pinholes' principal points agree on the plane in focus."""
    lens = reference_effects.ThinLens(0.25, 1.25)
    aperture = {"aperture_radius": 0.25, "focus_distance": 1.25}
    sensor = VIEW.with_sensor("thinlens", fov=55.0, **aperture)
    image = image_before(EMITTERS["envmap"](), sensor, is_hidden=True)
    height, width = image.shape[:2]
    focal = width / 2 / np.tan(np.radians(55) / 2)
    plain = reference.Camera(
        np.eye(3), np.zeros(3), focal, focal, width / 2, height / 2, width, height
    )
    images = []
    for camera in reference_effects.lens_cameras(plain, lens, 16):
        pinhole = calibrated(fx=focal, fy=focal, cx=camera.cx, cy=camera.cy)
        images.append(image_before(EMITTERS["envmap"](), pinhole, is_hidden=True))
    np.testing.assert_allclose(image, np.mean(images, axis=0), atol=IMAGE)
    assert np.abs(image - images[0]).max() > 0.3


def pose_at(time) -> np.ndarray:
    """Mitsuba's 4 x 4 between the two poses of a camera that moves, by the reference."""
    flip = np.diag([-1.0, -1.0, 1.0])
    ends = [(flip @ np.array(m)[:3, :3].T, np.array(m)[:3, 3]) for m in (VIEW.to_world, CLOSE)]
    rotation, center = reference_effects.interpolate_pose(*ends, time)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = (flip @ rotation).T, center
    return pose


def moving(**changes) -> View:
    return calibrated(to_world_close=lambda: mi.ScalarTransform4f(CLOSE), **changes)


@pytest.mark.parametrize("times", [{}, {"shutter_open": 2.0, "shutter_close": 2.5}])
def test_motion_blurs_environment_and_splats_alike(times):
    """The mean of images from where the camera was, whatever the clock says."""
    image = image_before(EMITTERS["envmap"](), moving(shutter_samples=3, **times))
    still = [
        image_before(
            EMITTERS["envmap"](),
            calibrated(to_world=lambda k=k: mi.ScalarTransform4f(pose_at((k + 0.5) / 3))),
        )
        for k in range(3)
    ]
    # Poses are interpolated in single precision on one side.
    np.testing.assert_allclose(image, np.mean(still, axis=0), atol=10 * IMAGE)
    assert np.abs(still[0] - still[-1]).max() > 0.2


@pytest.mark.parametrize(
    ("camera", "ignored"),
    [
        (calibrated(lens="opencv", k1=-0.25, k2=0.0625), "distortion"),
        (moving(shutter_samples=3), "motion"),
        (moving(shutter="rolling"), "motion"),
    ],
    ids=["distortion", "blur", "rolling shutter"],
)
def test_ignored_effects_do_not_apply_to_the_background(camera, ignored):
    image, expected = (
        image_before(EMITTERS["envmap"](), each, ignore=ignored) for each in (camera, calibrated())
    )
    np.testing.assert_allclose(image, expected, atol=IMAGE)


# ----------------------------------------------------------------------------------------------
# Derivatives and caches
# ----------------------------------------------------------------------------------------------


def floor() -> dict:
    """Behind the splats, in a part of the film."""
    to_world = mi.ScalarTransform4f(np.array(VIEW.to_world))
    bsdf = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.3, 0.2]}}
    to_world = to_world.translate([-0.5, -0.5, 4]).rotate([0, 1, 0], 180)
    return {"type": "rectangle", "to_world": to_world, "bsdf": bsdf}


KEYS = {
    "constant": "sky.radiance.value",
    "envmap": "sky.data",
    "image": "integrator.background.data",
}
"""The parameter of each kind of background."""

TWO_PATHS = "two images", "two losses", "two losses of one graph"
"""Cases in which a factor reaches the backdrop more than once."""

FACTORED = {
    **dict.fromkeys((*TWO_PATHS, "batch", "surface"), ()),
    "surface of the same": ("floor.bsdf.reflectance.value",),
    "splats of the same": ("integrator.sh0",),
}
"""Parameters that are multiplied by the factor, besides that of the background."""


@pytest.mark.slow
@pytest.mark.parametrize("kind", KEYS)
@pytest.mark.parametrize("way", FACTORED)
def test_gradients_reach_the_inputs_of_the_radiance(way, kind):
    """A factor of all of it, by central differences, from the same points of the emitters."""
    settings = {"background": rendered(texels(6, 8))} if kind == "image" else {}
    objects = {} if kind == "image" else {"sky": EMITTERS[kind]()}
    if way.startswith("surface"):
        objects["floor"] = floor()
        settings |= {"nested": {"type": "prb", "max_depth": 2}, "nested_spp": 4}
    sensor = side_by_side(VIEW, VIEWS[2]) if way == "batch" else VIEW.sensor()
    loaded = load(sensor, integrator_of(Scene().gaussians, **settings), **objects)
    params = mi.traverse(loaded)
    start = {key: type(params[key])(params[key]) for key in (KEYS[kind], *FACTORED[way])}
    shape = image_of(loaded).shape
    weights = mi.TensorXf(np.random.default_rng(1).uniform(0.5, 1.5, shape).astype(np.float32))

    def loss(factor, **seeds):
        for key, value in start.items():
            is_tensor = isinstance(value, mi.TensorXf)
            scaled = (value.array if is_tensor else value) * factor
            params[key] = mi.TensorXf(scaled, value.shape) if is_tensor else scaled
        params.update()
        renders = [mi.render(loaded, params, **seeds) for _ in range(2 if way in TWO_PATHS else 1)]
        return [dr.sum(image * weights, axis=None) for image in renders]

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


def test_derivatives_of_constant_radiance_have_the_same_bytes_in_two_runs():
    """Derivatives of texels are added in any order: they, alone, may differ by rounding."""
    runs, weights = [], np.random.default_rng(1).normal(size=(VIEW.height, VIEW.width, 4))
    for _ in range(2):
        integrator = integrator_of(Scene().gaussians)
        loaded = load(VIEW.sensor(), integrator, sky=EMITTERS["constant"]())
        runs.append(gradients_of(loaded, weights, [KEYS["constant"]], prefix="")[KEYS["constant"]])
    np.testing.assert_array_equal(*runs)
    assert runs[0].all()


def test_a_changed_environment_needs_no_new_frame_and_no_new_kernel():
    integrator = integrator_of(Scene().gaussians)
    loaded = load(VIEW.sensor(), integrator, sky=EMITTERS["constant"]())

    def set_to(value):
        params = mi.traverse(loaded)
        params[KEYS["constant"]] = mi.Color3f(value)
        params.update()
        dr.eval(mi.render(loaded))

    set_to([0.1, 0.2, 0.3])
    set_to([0.2, 0.3, 0.4])
    frames = loaded.integrator().state.cache.kept["frames 0"]
    history = launched(lambda: set_to([0.3, 0.4, 0.5]))
    assert history and all(kernel["cache_hit"] for kernel in history)
    assert loaded.integrator().state.cache.kept["frames 0"] is frames
