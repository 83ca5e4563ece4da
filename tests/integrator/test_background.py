"""Environments and pictures behind splats: against Mitsuba's ``path``, numpy, and differences."""

from dataclasses import dataclass, field, replace
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import single
from support.views import VIEWS, Scene, View, image_of, tensors, to_linear

import drgs  # noqa: F401  (registers the plugins)
from drgs.core.arrays import from_host
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import effects
from drgs.reference import splatting as reference

# Single precision, of values up to 2: as in test_splats; the conversion to display space multiplies
# errors of dark pixels by up to 13.
PICTURE = 2e-5

VIEW = VIEWS[1]


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


# ----------------------------------------------------------------------------------------------
# Scenes
# ----------------------------------------------------------------------------------------------


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

CLOSE = single(
    np.array(VIEW.to_world) @ np.array([*np.eye(3, 4), [0, 0, 0, 1]])
    + np.array([[0, 0, 0, 0.1], [0, 0, 0, 0.05], [0, 0, 0, -0.1], [0, 0, 0, 0]])
)


def turned(to_world, axis, degrees) -> np.ndarray:
    """A pose, turned in its own axes."""
    half = np.radians(degrees) / 2
    quat = np.array([[np.cos(half), *(np.sin(half) * np.asarray(axis) / np.linalg.norm(axis))]])
    change = np.eye(4)
    change[:3, :3] = reference.quat_to_rotation(quat)[0]
    return single(np.array(to_world) @ change)


CLOSE = turned(CLOSE, (0.3, 1, 0.2), 8)

INTRINSICS = {"fx": 30.0, "fy": 27.0, "cx": 17.0, "cy": 12.5}


@dataclass(frozen=True)
class Camera:
    """A sensor; what replaces the view's own."""

    view: View = VIEW
    changes: dict = field(default_factory=dict)

    def dictionary(self, samples=1, **others) -> dict:
        sensor = self.view.sensor(samples=samples)
        if self.changes:
            kept = {k: sensor[k] for k in ("to_world", "film", "sampler", "near_clip")}
            sensor = kept | {k: v() if callable(v) else v for k, v in self.changes.items()}
        return sensor | others


def calibrated(**changes) -> Camera:
    return Camera(changes={"type": "calibrated", **INTRINSICS, **changes})


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

all_cameras = pytest.mark.parametrize("camera", CAMERAS)
both_emitters = pytest.mark.parametrize("emitter", EMITTERS)


def integrator_of(gaussians, **settings) -> dict:
    return {"type": "splats", **tensors(gaussians), **settings}


def load(sensor, integrator, **objects):
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **objects})


def path_image(sensor, emitter, samples=1, seed=0) -> np.ndarray:
    """Without splats, by Mitsuba's own integrator."""
    loaded = load(sensor, {"type": "path"}, sky=EMITTERS[emitter]())
    return image_of(loaded, spp=samples, seed=seed)


class PixelCenters:
    """Mitsuba's samplers choose points within pixels; here all are the centre."""

    @staticmethod
    def image(sensor, emitter) -> np.ndarray:
        """By Mitsuba's own emitter and sensor, one ray a pixel, alpha 1."""
        loaded = load(sensor, {"type": "path"}, sky=EMITTERS[emitter]())
        own = loaded.sensors()[0]
        width, height = own.film().crop_size()
        pixel = dr.arange(mi.UInt32, width * height)
        place = mi.Point2f(pixel % width, pixel // width) + 0.5
        ray, weight = own.sample_ray(0.5, 0.5, place / mi.Vector2f(width, height), [0.5, 0.5])
        found = loaded.ray_intersect(ray)
        color = np.array(weight * loaded.environment().eval(found) + mi.Color3f(0 * place.x))
        rgb = color.T.reshape(height, width, 3).astype(np.float64)
        return np.concatenate([rgb, np.ones((height, width, 1))], axis=-1)


def splats_alone(sensor, gaussians, **settings) -> np.ndarray:
    """On black, display space, with alpha."""
    settings = {"background": 0.0, "srgb_primitives": False, **settings}
    return image_of(load(sensor, integrator_of(gaussians, **settings)))


def to_display(x) -> np.ndarray:
    """From linear radiance (IEC 61966-2-1)."""
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)


def over(splats, behind, srgb_primitives) -> np.ndarray:
    """Splats (display space, premultiplied) in front of linear radiance; covered film."""
    transmittance = 1 - splats[..., 3:]
    if srgb_primitives:
        color = to_linear(splats[..., :3]) + transmittance * behind[..., :3]
    else:
        color = splats[..., :3] + transmittance * to_display(behind[..., :3])
    return np.concatenate([color, np.ones_like(transmittance)], axis=-1)


def gaussians_before(camera):
    """Three groups: the corners of the film stay free."""
    return Scene(camera.view).gaussians


# ----------------------------------------------------------------------------------------------
# Environments
# ----------------------------------------------------------------------------------------------


@both_emitters
@pytest.mark.parametrize("srgb_primitives", [True, False], ids=["linear", "display"])
@all_cameras
def test_an_environment_is_seen_past_the_splats(camera, srgb_primitives, emitter):
    camera = CAMERAS[camera]
    gaussians = gaussians_before(camera)
    sensor = camera.dictionary()
    settings = {"srgb_primitives": srgb_primitives, "background": [0.2, 0.4, 0.6]}
    image = image_of(load(sensor, integrator_of(gaussians, **settings), sky=EMITTERS[emitter]()))
    splats, behind = splats_alone(sensor, gaussians), PixelCenters.image(sensor, emitter)
    np.testing.assert_allclose(image, over(splats, behind, srgb_primitives), atol=2 * PICTURE)
    assert splats[..., 3].max() > 0.9 and splats[..., 3].min() < 0.1
    assert (image[..., 3] == 1).all()


@both_emitters
def test_what_is_seen_past_the_splats_is_what_path_renders(emitter):
    """With as many samples at the same points: Mitsuba's samplers give both the same."""
    sensor, scene = Camera().dictionary(), Scene()
    far = {**tensors(scene.gaussians), "logit_opacities": mi.Float(np.full(40, -20, np.float32))}
    loaded = load(sensor, {"type": "splats", **far}, sky=EMITTERS[emitter]())
    actual = image_of(loaded, spp=9, seed=7)
    np.testing.assert_allclose(actual, path_image(sensor, emitter, 9, seed=7), atol=PICTURE)
    other = path_image(sensor, emitter, 9, seed=8)
    assert (np.abs(actual - other).max() > 0.1) == (emitter == "envmap")


@pytest.mark.parametrize("seed", [0, 3])
def test_several_samples_are_each_before_their_own_part_of_the_environment(seed):
    """Where splats are opaque nothing of it is seen, else what ``path`` sees at the same points."""
    sensor, gaussians = Camera().dictionary(), Scene(count=8, seed=1).gaussians
    loaded = load(sensor, integrator_of(gaussians), sky=EMITTERS["envmap"]())
    actual = image_of(loaded, spp=4, seed=seed)
    on_black = image_of(load(sensor, integrator_of(gaussians)), spp=4, seed=seed)
    behind = path_image(sensor, "envmap", 4, seed)
    free = on_black[..., 3] < 1e-6
    assert free.mean() > 0.05
    np.testing.assert_allclose(actual[free][:, :3], behind[free][:, :3], atol=PICTURE)
    assert np.abs(actual - behind)[~free].max() > 0.2
    assert (actual[..., 3] == 1).all()


@pytest.mark.parametrize("camera", ["barrel"])
def test_where_the_lens_model_ends_it_is_black(camera):
    camera = CAMERAS[camera]
    sensor = camera.dictionary()
    loaded = load(sensor, integrator_of(gaussians_before(camera)), sky=EMITTERS["constant"]())
    image = image_of(loaded)
    corner = PixelCenters.image(sensor, "constant")[0, 0, :3]
    assert (corner == 0).all() and (image[0, 0, :3] == 0).all()
    assert (image[12, 18, :3] > 0).all()


def test_hidden_emitters_leave_the_background():
    scene = Scene()
    for hide, expected_alpha in ((True, None), (False, 1)):
        settings = {"hide_emitters": hide, "background": [0.2, 0.4, 0.6]}
        sensor = Camera().dictionary()
        objects = {"sky": EMITTERS["constant"]()}
        image = image_of(load(sensor, integrator_of(scene.gaussians, **settings), **objects))
        plain = image_of(load(sensor, integrator_of(scene.gaussians, **settings)))
        assert np.array_equal(image, plain) == hide
        if expected_alpha is not None:
            assert (image[..., 3] == expected_alpha).all()
        else:
            assert image[..., 3].min() < 0.1


def test_emitters_that_surround_nothing_are_not_seen():
    """A point light is no environment."""
    scene, sensor = Scene(), Camera().dictionary()
    light = {"type": "point", "intensity": 10.0}
    image = image_of(load(sensor, integrator_of(scene.gaussians), light=light))
    assert np.array_equal(image, image_of(load(sensor, integrator_of(scene.gaussians))))


def test_without_an_environment_alpha_is_that_of_the_splats():
    scene, sensor = Scene(), Camera().dictionary()
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(texels()), "raw": True}
    image = image_of(load(sensor, integrator_of(scene.gaussians, background=bitmap)))
    np.testing.assert_array_equal(image[..., 3], splats_alone(sensor, scene.gaussians)[..., 3])


# ----------------------------------------------------------------------------------------------
# Through an aperture
# ----------------------------------------------------------------------------------------------

SHARP = {"ignore": "defocus"}
APERTURE = {"aperture_radius": 0.25, "focus_distance": 1.25}


def thin_lens(**changes) -> Camera:
    return Camera(changes={"type": "thinlens", "fov": 55.0, **APERTURE, **changes})


def smooth_sky() -> dict:
    """Waves of 60 degrees: longer than the 23 degrees of the aperture as it is seen in focus."""
    y, x = np.mgrid[:64, :128]
    phases = 6 * np.pi * x / 64 + np.array([0, 2, 4])[:, None, None], 6 * np.pi * y / 64
    values = np.moveaxis(1 + 0.8 * np.sin(phases[0]) * np.sin(phases[1]), 0, -1)
    return {"type": "envmap", "bitmap": mi.Bitmap(values.astype(np.float32))}


def hidden_splats() -> dict:
    gaussians = tensors(Scene().gaussians)
    return {"type": "splats", **gaussians, "logit_opacities": mi.Float(np.full(40, -20.0))}


def test_an_environment_out_of_focus_is_the_mean_of_what_pinholes_in_the_aperture_see():
    """Whose principal points agree on the plane in focus. Far away, where they are is all one."""
    sensor = thin_lens().dictionary()
    image = image_of(load(sensor, hidden_splats(), sky=EMITTERS["envmap"]()))
    height, width = image.shape[:2]
    focal = width / 2 / np.tan(np.radians(55) / 2)
    plain = reference.Camera(
        np.eye(3), np.zeros(3), focal, focal, width / 2, height / 2, width, height
    )
    lens = effects.ThinLens(APERTURE["aperture_radius"], APERTURE["focus_distance"])
    pictures = []
    for camera in effects.lens_cameras(plain, lens, 16):
        pinhole = calibrated(fx=focal, fy=focal, cx=camera.cx, cy=camera.cy).dictionary()
        pictures.append(image_of(load(pinhole, hidden_splats(), sky=EMITTERS["envmap"]())))
    np.testing.assert_allclose(image, np.mean(pictures, axis=0), atol=PICTURE)
    assert np.abs(image - pictures[0]).max() > 0.3


def test_an_environment_out_of_focus_is_what_path_renders():
    """Of many rays through the aperture; in focus at another distance it is less blurred."""
    for distance in (1.25, 2.5):
        sensor = thin_lens(focus_distance=distance).dictionary()
        image = image_of(load(sensor, hidden_splats(), sky=smooth_sky()))
        traced = image_of(load(sensor, {"type": "path"}, sky=smooth_sky()), spp=2048)
        sharp = image_of(load(sensor, hidden_splats() | SHARP, sky=smooth_sky()))
        # Rays are also spread over the pixels, and 16 points are few. Measured: 0.036 and 0.017,
        # and four deviations of the mean of 2048 rays, 0.006 each of contrasts of 0.3.
        assert np.abs(image - traced).max() < {1.25: 0.06, 2.5: 0.04}[distance]
        assert np.abs(sharp - traced).max() > {1.25: 0.24, 2.5: 0.07}[distance]


@pytest.mark.parametrize("name", ["sensor.aperture_radius", "sensor.focus_distance", "sky.data"])
def test_an_environment_out_of_focus_is_differentiated(name):
    """Against differences, in single precision."""
    scene = load(thin_lens().dictionary(), hidden_splats(), sky=smooth_sky())
    # What is lost by blurring: a loss that all of them change.
    sharp = load(thin_lens().dictionary(), hidden_splats() | SHARP, sky=smooth_sky())
    weights = image_of(sharp) - image_of(scene)
    params = mi.traverse(scene)
    value = type(params[name])(params[name])
    direction = np.random.default_rng(1).uniform(0.5, 1, np.array(value).shape)
    step = 4e-3
    losses = []
    for sign in (1, -1):
        params[name] = value + type(value)((sign * step * direction).astype(np.float32))
        params.update()
        losses.append(np.sum(weights * image_of(scene)))
    params[name] = value
    params, leaves = attached(scene, name)
    image = mi.render(scene, params)
    dr.backward(dr.sum(image * mi.TensorXf(weights.astype(np.float32)), axis=None))
    actual = np.sum(direction * np.array(dr.grad(leaves[name])))
    expected = (losses[0] - losses[1]) / (2 * step)
    # Where a ray crosses from one texel to the next within a step, the slope changes by some
    # percent: of one ray in 20, of either sign. Measured: 1e-3.
    assert actual == pytest.approx(expected, rel=4e-3)
    assert abs(actual) > 1


# ----------------------------------------------------------------------------------------------
# Movement, and what is ignored
# ----------------------------------------------------------------------------------------------


def pose_at(time) -> np.ndarray:
    """Mitsuba's 4 x 4 between the two poses of a camera that moves, by the reference."""
    flip = np.diag([-1.0, -1.0, 1.0])
    ends = [(flip @ np.array(m)[:3, :3].T, np.array(m)[:3, 3]) for m in (VIEW.to_world, CLOSE)]
    rotation, center = effects.interpolate_pose(*ends, time)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = (flip @ rotation).T, center
    return pose


def moving(**changes) -> Camera:
    return calibrated(to_world_close=lambda: mi.ScalarTransform4f(CLOSE), **changes)


@pytest.mark.parametrize("times", [{}, {"shutter_open": 2.0, "shutter_close": 2.5}])
def test_motion_blurs_the_environment_as_it_does_the_splats(times):
    """The mean of pictures from where the camera was, whatever the clock says."""
    gaussians = Scene().gaussians
    count = 3
    sensor = moving(shutter_samples=count, **times).dictionary()
    image = image_of(load(sensor, integrator_of(gaussians), sky=EMITTERS["envmap"]()))
    still = []
    for k in range(count):
        pose = mi.ScalarTransform4f(pose_at((k + 0.5) / count))
        alone = calibrated().dictionary(to_world=pose)
        still.append(image_of(load(alone, integrator_of(gaussians), sky=EMITTERS["envmap"]())))
    # Poses are interpolated in single precision on one side.
    np.testing.assert_allclose(image, np.mean(still, axis=0), atol=10 * PICTURE)
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
def test_what_is_ignored_is_ignored_behind_the_splats_as_well(camera, ignored):
    gaussians = Scene().gaussians
    image, expected = (
        image_of(
            load(c.dictionary(), integrator_of(gaussians, ignore=ignored), sky=EMITTERS["envmap"]())
        )
        for c in (camera, calibrated())
    )
    np.testing.assert_allclose(image, expected, atol=PICTURE)


# ----------------------------------------------------------------------------------------------
# Pictures
# ----------------------------------------------------------------------------------------------


def picture_of_film(width, height) -> np.ndarray:
    """Linear (height, width, 3), different in every pixel."""
    return texels(height, width, seed=5)


def picture(values, **changes) -> dict:
    return {
        "type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True, "filter_type": "nearest",
        **changes,
    }  # fmt: skip


@pytest.mark.parametrize("srgb_primitives", [True, False], ids=["linear", "display"])
@pytest.mark.parametrize("view", [VIEW, VIEWS[6], VIEWS[12], VIEWS[13]], ids=lambda v: v.name)
def test_a_picture_is_stretched_over_the_film_upright(view, srgb_primitives):
    """A texel for each pixel of the whole film, of which a crop window shows a part."""
    camera = Camera(view)
    values = picture_of_film(view.width, view.height)
    gaussians = gaussians_before(camera)
    settings = {"background": picture(values), "srgb_primitives": srgb_primitives}
    image = image_of(load(camera.dictionary(), integrator_of(gaussians, **settings)))
    splats = splats_alone(camera.dictionary(), gaussians)
    expected = over(splats, values[view.window].astype(np.float64), srgb_primitives)
    np.testing.assert_allclose(image[..., :3], expected[..., :3], atol=2 * PICTURE)


def test_a_picture_of_another_size_is_interpolated():
    """Bilinearly, between the middles of texels, as numpy does it."""
    values = texels(4, 5, seed=6)
    sensor = Camera().dictionary()
    background = picture(values, filter_type="bilinear", wrap_mode="clamp")
    nothing = {"logit_opacities": mi.Float(np.full(40, -20, np.float32))}
    integrator = integrator_of(Scene().gaussians, background=background) | nothing
    image = image_of(load(sensor, integrator))
    height, width = image.shape[:2]
    x = np.clip((np.arange(width) + 0.5) / width * 5 - 0.5, 0, 4)
    y = np.clip((np.arange(height) + 0.5) / height * 4 - 0.5, 0, 3)
    along = np.stack([[np.interp(x, range(5), row[:, c]) for row in values] for c in range(3)])
    expected = np.stack(
        [[np.interp(y, range(4), column) for column in plane.T] for plane in along], axis=-1
    ).transpose(1, 0, 2)
    np.testing.assert_allclose(image[..., :3], expected, atol=PICTURE)


def test_an_environment_is_before_a_picture():
    """Both are given: the environment is seen, unless it is hidden."""
    sensor, gaussians = Camera().dictionary(), Scene().gaussians
    settings = {"background": picture(texels())}
    sky = {"sky": EMITTERS["constant"]()}
    both = image_of(load(sensor, integrator_of(gaussians, **settings), **sky))
    alone = image_of(load(sensor, integrator_of(gaussians), **sky))
    assert np.array_equal(both, alone)
    hidden = image_of(load(sensor, integrator_of(gaussians, hide_emitters=True, **settings), **sky))
    assert np.array_equal(hidden, image_of(load(sensor, integrator_of(gaussians, **settings))))


@pytest.mark.parametrize(
    ("background", "got"),
    [
        ("sky.png", "str"),
        ({"type": "constant"}, None),
        (lambda: mi.ScalarTransform4f(), None),
        ({"type": "spectrum", "value": 0.5}, None),
    ],
    ids=["text", "emitter", "transform", "spectrum"],
)
def test_a_background_that_is_neither_color_nor_texture_is_refused(background, got):
    value = background() if callable(background) else background
    with pytest.raises(RuntimeError) as caught:
        mi.load_dict(integrator_of(Scene(count=8).gaussians, background=value))
    message = str(caught.value).strip().splitlines()[-1]
    assert message.startswith(
        "PluginTypeError: splats: background must be an RGB colour, such as [1, 1, 1] or "
        "<rgb value='1, 1, 1'/>, or a texture, got "
    )
    assert got is None or message.endswith(got)


# ----------------------------------------------------------------------------------------------
# Derivatives
# ----------------------------------------------------------------------------------------------


def tensor(values):
    values = np.asarray(values)
    return mi.TensorXf(from_host(mi.Float, values), values.shape)


def weights_of(loaded, seed=1) -> np.ndarray:
    return single(np.random.default_rng(seed).normal(size=image_of(loaded).shape))


def scene_with(kind, srgb_primitives=True, camera=None, **settings):
    """A scene with a background of a kind, and the name of its parameter."""
    sensor, gaussians = (camera or Camera()).dictionary(), Scene().gaussians
    settings = {"srgb_primitives": srgb_primitives, **settings}
    if kind == "picture":
        settings["background"] = picture(texels(6, 8), filter_type="bilinear")
        return load(sensor, integrator_of(gaussians, **settings)), "integrator.background.data"
    loaded = load(sensor, integrator_of(gaussians, **settings), sky=EMITTERS[kind]())
    return loaded, "sky.radiance.value" if kind == "constant" else "sky.data"


def attached(loaded, *keys):
    """The parameters, and what those of ``keys`` are now computed from: a scene changes its own."""
    params, leaves = mi.traverse(loaded), {}
    for key in keys:
        leaves[key] = type(params[key])(params[key])
        dr.enable_grad(leaves[key])
        params[key] = leaves[key]
    params.update()
    return params, leaves


def gradient_of(loaded, key, weights) -> np.ndarray:
    params, leaves = attached(loaded, key)
    dr.backward(dr.sum(mi.render(loaded, params) * tensor(weights), axis=None))
    return np.array(dr.grad(leaves[key])).astype(np.float64)


def like(parameter, values):
    """Numbers as a value of a parameter: of a colour, of a flat array, of a tensor."""
    values = np.asarray(values, np.float32)
    if isinstance(parameter, mi.Color3f):
        return mi.Color3f(values.ravel().tolist())
    flat = from_host(mi.Float, values)
    return flat if isinstance(parameter, mi.Float) else mi.TensorXf(flat, values.shape)


KINDS = ["constant", "envmap", "picture"]
all_kinds = pytest.mark.parametrize("kind", KINDS)


@all_kinds
@pytest.mark.parametrize("srgb_primitives", [True, False], ids=["linear", "display"])
def test_derivatives_of_the_radiance_are_differences(kind, srgb_primitives):
    """Along random directions. In linear radiance the picture is linear in it: any step is exact
    up to rounding; in display space a step of 1e-2 leaves its square.
    """
    loaded, key = scene_with(kind, srgb_primitives)
    weights = weights_of(loaded)
    gradient = gradient_of(loaded, key, weights)
    start = np.array(mi.traverse(loaded)[key])
    rng, step = np.random.default_rng(3), 0.01
    for _ in range(3):
        direction = (np.sign(gradient) * np.abs(rng.normal(size=gradient.shape))).astype(np.float32)
        both = []
        for sign in (1, -1):
            params = mi.traverse(loaded)
            params[key] = like(params[key], start + np.float32(sign * step) * direction)
            params.update()
            both.append(np.sum(weights * image_of(loaded)))
        difference = (both[0] - both[1]) / (2 * step)
        assert np.sum(gradient * direction) == pytest.approx(difference, rel=3e-3)
    assert np.abs(gradient).max() > 0


def batch_of(first, second, width) -> dict:
    """Two views of one size, side by side."""
    film = first["film"] | {"width": 2 * width}
    return {"type": "batch", "film": film, "sampler": first["sampler"], "a": first, "b": second}


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


FLOOR = "floor.bsdf.reflectance.value"

TWICE = "two pictures", "two losses", "two losses of one graph"
"""What a factor reaches the backdrop through, more than once."""


def factored(way, kind):
    """A scene, and the parameters that are multiplied by the factor."""
    if way == "batch":
        views = [Camera(view).dictionary() for view in (VIEW, VIEWS[2])]
        sensor = batch_of(*views, VIEW.width)
    else:
        sensor = Camera().dictionary()
    objects, settings = {}, {}
    if kind == "picture":
        settings["background"] = picture(texels(6, 8), filter_type="bilinear")
    else:
        objects["sky"] = EMITTERS[kind]()
    keys = [{"constant": "sky.radiance.value", "envmap": "sky.data"}.get(kind, BACKGROUND)]
    if way.startswith("surface"):
        objects["floor"] = floor()
        settings |= {"nested": {"type": "prb", "max_depth": 2}, "nested_spp": 4}
    if way == "surface of the same":
        keys.append(FLOOR)
    if way == "splats of the same":
        keys.append("integrator.sh0")
    return load(sensor, integrator_of(Scene().gaussians, **settings), **objects), keys


BACKGROUND = "integrator.background.data"


@all_kinds
@pytest.mark.parametrize(
    "way", [*TWICE, "batch", "surface", "surface of the same", "splats of the same"]
)
def test_gradients_reach_what_the_radiance_was_computed_from(way, kind):
    """A factor of all of it, by central differences, from the same points of the emitters."""
    loaded, keys = factored(way, kind)
    start = {key: np.array(mi.traverse(loaded)[key]) for key in keys}
    count = 2 if way in TWICE else 1
    weights = single(np.random.default_rng(1).uniform(0.5, 1.5, image_of(loaded).shape))

    def loss(factor, **seeds):
        params = mi.traverse(loaded)
        for key, values in start.items():
            params[key] = like(params[key], values) * factor
        params.update()
        pictures = [mi.render(loaded, params, **seeds) for _ in range(count)]
        return [dr.sum(image * tensor(weights), axis=None) for image in pictures]

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


def test_the_derivative_of_a_constant_radiance_is_what_passes_the_splats():
    """By hand, from the transmittance."""
    loaded, key = scene_with("constant")
    weights = weights_of(loaded)
    gradient = gradient_of(loaded, key, weights).ravel()
    transmittance = 1 - splats_alone(Camera().dictionary(), Scene().gaussians)[..., 3:]
    expected = np.sum(weights[..., :3] * transmittance, axis=(0, 1))
    size = np.sum(np.abs(weights[..., :3]) * transmittance, axis=(0, 1))
    # Sums of 851 terms of both signs.
    assert (np.abs(gradient - expected) <= 1e-6 * size).all()
    assert (np.abs(expected) > 1e-3 * size).all()


@all_kinds
def test_derivatives_of_the_gaussians_know_what_is_behind_them(kind):
    """By the reference: its gradients with respect to colour and transmittance, chained by hand."""
    scene = Scene()
    loaded, _ = scene_with(kind)
    weights = weights_of(loaded)
    params = mi.traverse(loaded)
    for name in PARAMETER_NAMES:
        dr.enable_grad(params[f"integrator.{name}"])
    dr.backward(dr.sum(mi.render(loaded, params) * tensor(weights), axis=None))
    nothing = {"integrator.logit_opacities": mi.Float(np.full(40, -20, np.float32))}
    empty, _ = scene_with(kind)
    hidden = mi.traverse(empty)
    for key, value in nothing.items():
        hidden[key] = value
    hidden.update()
    behind = image_of(empty)[..., :3]
    picture = reference.render(scene.gaussians, scene.camera, np.zeros(3), threshold_width=1e-4)
    assert not picture.near_threshold.any()
    covered = 0 if kind != "picture" else 1  # alpha is 1 before an environment
    d_alpha = covered * weights[..., 3] - np.sum(weights[..., :3] * behind, axis=-1)
    slope = np.where(
        picture.image <= 0.04045,
        1 / 12.92,
        2.4 / 1.055 * ((np.maximum(picture.image, 0) + 0.055) / 1.055) ** 1.4,
    )
    expected = reference.render_gradients(
        scene.gaussians,
        scene.camera,
        np.zeros(3),
        weights[..., :3] * slope,
        d_alpha,
        None,
        1,
        False,
    )
    for name in PARAMETER_NAMES:
        actual = np.array(dr.grad(params[f"integrator.{name}"])).astype(np.float64)
        # As in test_splats.
        np.testing.assert_allclose(
            actual, expected[name], atol=1e-4 * np.abs(expected[name]).max(), err_msg=name
        )


@all_kinds
@pytest.mark.parametrize("srgb_primitives", [True, False], ids=["linear", "display"])
def test_forward_and_backward_derivatives_are_transposed(kind, srgb_primitives):
    """Of radiance and Gaussians together."""
    loaded, key = scene_with(kind, srgb_primitives)
    keys = [key, "integrator.means", "integrator.sh0", "integrator.logit_opacities"]
    weights, rng = weights_of(loaded), np.random.default_rng(8)

    scene, _ = scene_with(kind, srgb_primitives)
    params, leaves = attached(scene, *keys)
    dr.backward(dr.sum(mi.render(scene, params) * tensor(weights), axis=None))
    gradients = {k: np.array(dr.grad(leaf)).astype(np.float64) for k, leaf in leaves.items()}

    params, leaves = attached(loaded, *keys)
    # No two terms of a sum cancel.
    directions = {
        k: single(np.sign(g) * np.abs(rng.normal(size=g.shape))) for k, g in gradients.items()
    }
    for k, direction in directions.items():
        dr.set_grad(leaves[k], like(leaves[k], direction))
    tangent = np.array(dr.forward_to(mi.render(loaded, params))).astype(np.float64)
    terms = [np.sum(directions[k] * gradients[k]) for k in keys]
    size = np.abs(weights * tangent).sum()
    assert np.sum(weights * tangent) == pytest.approx(sum(terms), abs=2e-5 * size)
    assert min(terms) > 5e-4 * size


def test_derivatives_of_a_sensor_see_the_environment_move():
    """A smooth one, before splats that end nowhere: a quotient in single precision."""
    y, x = np.mgrid[:32, :64]
    waves = [np.sin(x / 32 * np.pi), np.cos(y / 32 * np.pi), np.cos(x / 16 * np.pi)]
    values = (1 + 0.5 * np.stack(waves, axis=-1)).astype(np.float32)
    settings = {"alpha_cut": 0.0, "extent": 6.0, "transmittance_stop": 0.0}

    def loaded():
        sky = {"type": "envmap", "bitmap": mi.Bitmap(values)}
        integrator = integrator_of(Scene().gaussians, **settings)
        return load(Camera().dictionary(), integrator, sky=sky)

    def moved(scene, turn):
        params = mi.traverse(scene)
        matrix = params["sensor.to_world"].matrix
        params["sensor.to_world"] = mi.Transform4f(matrix).rotate([0.6, -0.48, 0.64], turn)
        params.update()
        return params

    scene, turn = loaded(), mi.Float(0)
    weights = weights_of(scene)
    dr.enable_grad(turn)
    params = moved(scene, turn)
    dr.backward(dr.sum(mi.render(scene, params) * tensor(weights), axis=None))
    step = 0.05  # degrees
    both = []
    for sign in (1, -1):
        scene = loaded()
        moved(scene, mi.Float(sign * step))
        both.append(np.sum(weights * image_of(scene)))
    difference = (both[0] - both[1]) / (2 * step)
    assert dr.grad(turn)[0] == pytest.approx(difference, rel=0.01)
    # Of a constant behind the splats it would be another.
    plain = load(Camera().dictionary(), integrator_of(Scene().gaussians, **settings))
    turn = mi.Float(0)
    dr.enable_grad(turn)
    params = moved(plain, turn)
    dr.backward(dr.sum(mi.render(plain, params) * tensor(weights), axis=None))
    assert dr.grad(turn)[0] != pytest.approx(difference, rel=0.1)


def test_pictures_and_constant_radiance_are_the_same_bytes_in_two_runs():
    """Derivatives of texels are added in any order: they, alone, may differ by rounding."""
    for kind in KINDS:
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
    frames = loaded.integrator().memory.rendered[0]
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        set_to([0.3, 0.4, 0.5])
        history = dr.kernel_history([dr.KernelType.JIT])
    assert history and all(kernel["cache_hit"] for kernel in history)
    assert loaded.integrator().memory.rendered[0] is frames


def test_a_new_view_before_an_environment_needs_no_new_kernel():
    loaded, _ = scene_with("envmap")
    poses = [replace(VIEW, to_world=VIEWS[k].to_world) for k in (1, 2, 3)]
    sensors = [mi.load_dict(Camera(view).dictionary()) for view in poses]
    for sensor in sensors[:2]:
        dr.eval(mi.render(loaded, sensor=sensor))
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        dr.eval(mi.render(loaded, sensor=sensors[2]))
        history = dr.kernel_history([dr.KernelType.JIT])
    assert len(history) > 10 and all(kernel["cache_hit"] for kernel in history)
