"""Environments and images behind splats: against Mitsuba's ``path``, numpy, and differences."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.backgrounds import (
    CLOSE,
    EMITTERS,
    IMAGE,
    VIEW,
    Camera,
    calibrated,
    integrator_of,
    load,
    rendered,
    splats_alone,
    texels,
)
from support.views import VIEWS, Scene, decode, image_of, tensors, to_linear

import drgs  # noqa: F401  (registers the plugins)

# ----------------------------------------------------------------------------------------------
# Scenes
# ----------------------------------------------------------------------------------------------


CAMERAS = {
    "perspective": Camera(),
    "rolled": Camera(VIEWS[2]),
    "mirrored": Camera(VIEWS[3]),
    "principal point": Camera(VIEWS[10]),
    "crop window": Camera(VIEWS[13]),
    "orthographic": Camera(changes={"type": "orthographic"}),
    "calibrated": calibrated(),
    "opencv": calibrated(lens="opencv", k1=-0.25, k2=0.0625, p1=0.0078125),
    "barrel": calibrated(lens="opencv", k1=-0.3125, fx=18.0, fy=18.0),
    "fisheye": calibrated(lens="fisheye", k1=-0.03125, fx=12.0, fy=12.0),
    "rolling shutter": calibrated(
        to_world_close=lambda: mi.ScalarTransform4f(CLOSE), shutter="rolling"
    ),
}


both_emitters = pytest.mark.parametrize("emitter", EMITTERS)


def path_image(sensor, emitter, samples=1, seed=0) -> np.ndarray:
    """Without splats, by Mitsuba's own integrator."""
    loaded = load(sensor, {"type": "path"}, sky=EMITTERS[emitter]())
    return image_of(loaded, spp=samples, seed=seed)


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


def to_display(x) -> np.ndarray:
    """From linear radiance (IEC 61966-2-1)."""
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


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
    gaussians = Scene(camera.view).gaussians
    sensor = camera.dictionary()
    settings = {"srgb_primitives": srgb_primitives, "background": [0.2, 0.4, 0.6]}
    image = image_of(load(sensor, integrator_of(gaussians, **settings), sky=EMITTERS[emitter]()))
    splats, behind = splats_alone(sensor, gaussians), environment_image(sensor, emitter)
    np.testing.assert_allclose(
        image, composite_over(splats, behind, srgb_primitives), atol=2 * IMAGE
    )
    assert splats[..., 3].max() > 0.9 and splats[..., 3].min() < 0.1
    assert (image[..., 3] == 1).all()


@both_emitters
def test_environment_behind_splats_matches_path(emitter):
    """With as many samples at the same points: Mitsuba's samplers give both the same."""
    sensor, scene = Camera().dictionary(), Scene()
    far = {**tensors(scene.gaussians), "logit_opacities": mi.Float(np.full(40, -20, np.float32))}
    loaded = load(sensor, {"type": "splats", **far}, sky=EMITTERS[emitter]())
    actual = image_of(loaded, spp=9, seed=7)
    np.testing.assert_allclose(actual, path_image(sensor, emitter, 9, seed=7), atol=IMAGE)
    other = path_image(sensor, emitter, 9, seed=8)
    assert (np.abs(actual - other).max() > 0.1) == (emitter == "envmap")


@pytest.mark.parametrize("hide", [True, False])
def test_hide_emitters_keeps_the_background_color(hide):
    settings = {"hide_emitters": hide, "background": [0.2, 0.4, 0.6]}
    sensor, integrator = Camera().dictionary(), integrator_of(Scene().gaussians, **settings)
    image = image_of(load(sensor, integrator, sky=EMITTERS["constant"]()))
    assert np.array_equal(image, image_of(load(sensor, integrator))) == hide
    assert (image[..., 3].min() < 0.1) == hide


def test_only_environment_emitters_are_visible():
    """A point light is no environment."""
    scene, sensor = Scene(), Camera().dictionary()
    light = {"type": "point", "intensity": 10.0}
    image = image_of(load(sensor, integrator_of(scene.gaussians), light=light))
    assert np.array_equal(image, image_of(load(sensor, integrator_of(scene.gaussians))))


# ----------------------------------------------------------------------------------------------
# Images
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("srgb_primitives", [True, False], ids=["linear", "display"])
@pytest.mark.parametrize("view", [VIEW, VIEWS[6], VIEWS[12], VIEWS[13]], ids=lambda v: v.name)
def test_a_background_texture_is_stretched_over_the_film_upright(view, srgb_primitives):
    """A texel for each pixel of the whole film, of which a crop window shows a part."""
    camera = Camera(view)
    values = texels(view.height, view.width, seed=5)
    gaussians = Scene(camera.view).gaussians
    settings = {"background": rendered(values), "srgb_primitives": srgb_primitives}
    image = image_of(load(camera.dictionary(), integrator_of(gaussians, **settings)))
    splats = splats_alone(camera.dictionary(), gaussians)
    expected = composite_over(splats, values[view.window].astype(np.float64), srgb_primitives=False)
    if srgb_primitives:  # it is the last splat
        expected = to_linear(expected)
    np.testing.assert_allclose(image[..., :3], expected[..., :3], atol=2 * IMAGE)


def test_an_environment_replaces_a_background_texture():
    """Both are given: the environment is seen, unless it is hidden."""
    sensor, gaussians = Camera().dictionary(), Scene().gaussians
    settings = {"background": rendered(texels())}
    sky = {"sky": EMITTERS["constant"]()}
    both = image_of(load(sensor, integrator_of(gaussians, **settings), **sky))
    alone = image_of(load(sensor, integrator_of(gaussians), **sky))
    assert np.array_equal(both, alone)
    hidden = image_of(load(sensor, integrator_of(gaussians, hide_emitters=True, **settings), **sky))
    assert np.array_equal(hidden, image_of(load(sensor, integrator_of(gaussians, **settings))))
