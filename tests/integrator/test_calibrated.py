"""The ``calibrated`` sensor: its rays, and what ``splats`` and other integrators see through it.

Rays are compared with Mitsuba's own sensors, and projected again by the float64 reference. Also
here: cameras of Mitsuba's ``thinlens`` and ``orthographic``, against the rays of these sensors.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import NEAR_THRESHOLD
from support.lens_scenes import LENSES, points_at
from support.sensors import PIXELS, camera_of, numbers, points_on_rays, project
from support.views import VIEWS, View, image_of, pose, splats_before, tensors

from drgs.reference import effects
from drgs.reference import splatting as reference
from drgs.reference.effects import Fisheye, OpenCV, Orthographic, Pinhole, ThinLens


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


# ----------------------------------------------------------------------------------------------
# Sensors
# ----------------------------------------------------------------------------------------------

WINDOW = (13, 7, 29, 18)
CLOSE = pose([0.1, -1.0, 0.3], 43, (0.5, -0.65, 1.05))


@dataclass(frozen=True)
class Calibrated:
    """A sensor: its dictionary, and what the reference makes of it."""

    name: str
    lens: effects.Lens = Pinhole()  # noqa: RUF009
    view: View = View("", 53, 41, crop=WINDOW)  # noqa: RUF009
    f: tuple[float, float] = (40.0, 44.0)  # fx, fy, px
    c: tuple[float, float] = (24.0, 22.5)  # cx, cy, px
    close: tuple | None = None  # to_world_close
    shutter: str = "global"

    @property
    def coefficients(self) -> dict[str, float]:
        given = {} if isinstance(self.lens, Pinhole) else asdict(self.lens)
        return {name: value for name, value in given.items() if value != 0}

    def dictionary(self, **others) -> dict:
        common = self.view.sensor()
        kind = {Pinhole: "pinhole", OpenCV: "opencv", Fisheye: "fisheye"}[type(self.lens)]
        moves = {} if self.close is None else {"to_world_close": transform(self.close)}
        return {
            "type": "calibrated",
            "lens": kind,
            **dict(zip(("fx", "fy", "cx", "cy"), (*self.f, *self.c), strict=True)),
            **self.coefficients,
            **{name: common[name] for name in ("near_clip", "to_world", "film", "sampler")},
            **moves,
            "shutter": self.shutter,
            **others,
        }

    def load(self, **others) -> mi.Sensor:
        return mi.load_dict(self.dictionary(**others))

    @property
    def camera(self) -> reference.Camera:
        """Of the whole film, at time 0."""
        (fx, fy), (cx, cy) = self.f, self.c
        return replace(self.view.camera, fx=fx, fy=fy, cx=cx, cy=cy)

    @property
    def close_camera(self) -> reference.Camera:
        """At time 1."""
        at_close = replace(self.view, to_world=self.close or self.view.to_world).camera
        return replace(self.camera, rotation=at_close.rotation, center=at_close.center)

    def camera_at(self, time: float) -> reference.Camera:
        return effects.camera_at(self.camera, self.close_camera, time)

    @property
    def corner(self) -> np.ndarray:
        """Of the crop window in the film, px."""
        return np.array((self.view.crop or (0, 0))[:2])

    @property
    def size(self) -> np.ndarray:
        """Of the crop window, px."""
        rows, columns = self.view.window
        return np.array([columns.stop - columns.start, rows.stop - rows.start])


def transform(matrix) -> mi.ScalarTransform4f:
    return mi.ScalarTransform4f(np.array(matrix))


PINHOLE = Calibrated("pinhole")
OPENCV = Calibrated("opencv", LENSES["rational"])
FISHEYE = Calibrated("fisheye", LENSES["fisheye"], f=(13.0, 14.5))
FILM = View("", 37, 29)  # without a crop window
# A fold within the film.
BARREL = Calibrated("barrel", LENSES["barrel"], FILM, f=(26.0, 26.0), c=(19.0, 14.0))
MOVING = [
    replace(s, name=f"{s.name}, {shutter}", close=CLOSE, shutter=shutter)
    for s in (PINHOLE, OPENCV, FISHEYE)
    for shutter in ("global", "rolling")
]
STILL = [PINHOLE, OPENCV, FISHEYE]

by_name = {"ids": lambda sensor: sensor.name}


def sampled_rays(sensor, time=0.0, count=200, seed=3):
    """Rays through ``count`` random points of the film, their weights, and the samples (N, 2)."""
    sample = np.random.default_rng(seed).uniform(size=(2, count)).astype(np.float32)
    ray, weight = sensor.sample_ray(time, 0.5, mi.Point2f(sample), mi.Point2f(0.5))
    return ray, np.array(weight)[0], sample.T.astype(np.float64)


def points_along(ray, seed=4) -> np.ndarray:
    """(N, 3) float64, one on each ray."""
    distances = np.random.default_rng(seed).uniform(1, 8, dr.width(ray.o))
    return np.array(ray(mi.Float(distances))).T.astype(np.float64)


def film_of(world, camera, lens) -> np.ndarray:
    """(N, 2), px, of world points, by the reference."""
    points = (world - camera.center) @ camera.rotation.T
    assert lens.is_seen(camera, points).all()
    return lens.film_points(camera, points)


# ----------------------------------------------------------------------------------------------
# Rays
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("view", VIEWS, ids=lambda view: view.name)
def test_rays_of_a_pinhole_are_those_of_perspective(view):
    camera = view.camera
    focal, principal = (float(camera.fx),) * 2, (float(camera.cx), float(camera.cy))
    sensor = Calibrated("", view=view, f=focal, c=principal).load()
    (ray, weight, _), (expected, _, _) = map(
        sampled_rays, (sensor, mi.load_dict(view.sensor())), (0.25, 0.25)
    )
    assert (weight == 1).all()
    # Some roundings of numbers of size one; the origins are at the near plane.
    np.testing.assert_allclose(np.array(ray.d), np.array(expected.d), rtol=0, atol=5e-7)
    np.testing.assert_allclose(np.array(ray.o), np.array(expected.o), rtol=0, atol=2e-7)
    np.testing.assert_allclose(np.array(ray.maxt), np.array(expected.maxt), rtol=5e-7)
    np.testing.assert_array_equal(np.array(ray.time), np.array(expected.time))


@pytest.mark.parametrize("sensor", STILL, **by_name)
def test_points_on_rays_are_seen_where_the_rays_start(sensor):
    ray, weight, sample = sampled_rays(sensor.load())
    assert (weight == 1).all()
    film = film_of(points_along(ray), sensor.camera, sensor.lens)
    assert np.abs(film - (sample * sensor.size + sensor.corner)).max() < PIXELS


@pytest.mark.parametrize("sensor", [s for s in MOVING if s.shutter == "global"], **by_name)
@pytest.mark.parametrize("time", [0.0, 0.375, 1.0])
def test_a_global_shutter_sees_from_where_the_camera_is_at_the_rays_time(sensor, time):
    ray, _, sample = sampled_rays(sensor.load(), time)
    film = film_of(points_along(ray), sensor.camera_at(time), sensor.lens)
    assert np.abs(film - (sample * sensor.size + sensor.corner)).max() < PIXELS
    np.testing.assert_array_equal(np.array(ray.time), time)


@pytest.mark.parametrize("sensor", [s for s in MOVING if s.shutter == "rolling"], **by_name)
def test_a_rolling_shutter_sees_from_where_the_camera_is_when_the_row_is_read(sensor):
    """Rows of the whole film, not of the crop window; whatever the ray's time."""
    ray, _, sample = sampled_rays(sensor.load(), time=0.75)
    expected = sample * sensor.size + sensor.corner
    for point, place in zip(points_along(ray), expected, strict=True):
        camera = sensor.camera_at(place[1] / sensor.view.height)
        assert np.abs(film_of(point[None], camera, sensor.lens) - place).max() < PIXELS


def test_times_are_between_those_at_which_the_shutter_opens_and_closes():
    """As Mitsuba's integrators choose them: a camera that moves is open from 0 to 1 by default."""
    sensor = replace(PINHOLE, close=CLOSE)
    loaded = sensor.load()
    assert (loaded.shutter_open(), loaded.shutter_open_time()) == (0, 1)
    assert PINHOLE.load().shutter_open_time() == 0
    late = sensor.load(shutter_open=2.0, shutter_close=4.0)
    ray, _, sample = sampled_rays(late, time=2.5)
    film = film_of(points_along(ray), sensor.camera_at(0.25), sensor.lens)
    assert np.abs(film - (sample * sensor.size + sensor.corner)).max() < PIXELS
    assert (np.array(ray.time) == 2.5).all()
    instant = sensor.load(shutter_open=2.0, shutter_close=2.0)
    ray, _, sample = sampled_rays(instant, time=2.0)
    film = film_of(points_along(ray), sensor.camera_at(0), sensor.lens)
    assert np.abs(film - (sample * sensor.size + sensor.corner)).max() < PIXELS


# Its picture is a circle of a radius of 16 px.
WIDE_FISHEYE = Calibrated(
    "wide fisheye", LENSES["plain fisheye"], FILM, f=(5.5, 5.5), c=(19.0, 14.0)
)


@pytest.mark.parametrize("sensor", [BARREL, WIDE_FISHEYE], **by_name)
def test_rays_carry_no_weight_where_the_lens_shows_nothing(sensor):
    ray, weight, sample = sampled_rays(sensor.load(), count=2000)
    points = points_at(sensor.lens, sensor.camera, sample * sensor.size, np.ones(2000))
    shown = ~np.isnan(points).any(axis=1)
    assert 0.2 < shown.mean() < 0.9
    assert set(weight) == {0, 1}
    # At the fold itself, to within the hundredth of a pixel that the sensor allows.
    assert (weight != shown).mean() < 2e-3
    assert np.isfinite(np.array(ray.o)).all()
    np.testing.assert_allclose(np.linalg.norm(np.array(ray.d), axis=0), 1, atol=1e-6)


@pytest.mark.parametrize("sensor", [*STILL, MOVING[3], BARREL], **by_name)
def test_differentials_are_the_rays_of_the_neighbouring_pixels(sensor):
    loaded = sensor.load()
    sample = np.random.default_rng(0).uniform(0.1, 0.8, (2, 50)).astype(np.float32)
    arguments = (0.0, 0.5, mi.Point2f(sample), mi.Point2f(0.5))
    ray, weight = loaded.sample_ray_differential(*arguments)
    assert ray.has_differentials
    plain, plain_weight = loaded.sample_ray(*arguments)
    for a, b in ((ray.o, plain.o), (ray.d, plain.d), (weight, plain_weight)):
        np.testing.assert_array_equal(np.array(a), np.array(b))
    for axis, o, d in ((0, ray.o_x, ray.d_x), (1, ray.o_y, ray.d_y)):
        step = np.zeros((2, 1), np.float32)
        step[axis] = 1 / sensor.size[axis]
        beside, _ = loaded.sample_ray(0.0, 0.5, mi.Point2f(sample + step), mi.Point2f(0.5))
        # The sample is one rounding away.
        np.testing.assert_allclose(np.array(d), np.array(beside.d), rtol=0, atol=1e-6)
        np.testing.assert_allclose(np.array(o), np.array(beside.o), rtol=0, atol=1e-6)
        turned = np.linalg.norm(np.array(d) - np.array(plain.d), axis=0)
        shown = np.broadcast_to(np.array(weight)[0] == 1, turned.shape)
        assert turned[shown].min() > 0.3 / 44


@pytest.mark.parametrize("sensor", [*STILL, MOVING[3]], **by_name)
def test_rays_are_as_long_as_what_is_seen(sensor):
    """From depth ``near_clip`` to ``far_clip``: z, with a fisheye the distance."""
    near_view = replace(sensor.view, near_clip=0.5)
    loaded = replace(sensor, view=near_view).load(far_clip=8.0)
    assert (loaded.near_clip(), loaded.far_clip()) == (0.5, 8.0)
    ray, _, sample = sampled_rays(loaded)
    for world, depth in ((ray.o, 0.5), (ray(ray.maxt), 8.0)):
        for place, y in zip(np.array(world).T.astype(np.float64), sample[:, 1], strict=True):
            row = (y * sensor.size[1] + sensor.corner[1]) / sensor.view.height
            camera = sensor.camera_at(row)
            point = (place - camera.center) @ camera.rotation.T
            assert sensor.lens.depths(camera, point[None])[0] == pytest.approx(depth, rel=2e-6)


@pytest.mark.parametrize("name", ["fx", "cy", "k1", "p2"])
def test_rays_are_differentiable_in_the_calibration(name):
    """Against central differences, in single precision; the search for a ray is not unrolled."""
    loaded = OPENCV.load()
    params = mi.traverse(loaded)
    value = float(params[name][0])
    sample = mi.Point2f(np.random.default_rng(0).uniform(size=(2, 20)).astype(np.float32))

    def directions() -> mi.Vector3f:
        return loaded.sample_ray(0.0, 0.5, sample, mi.Point2f(0.5))[0].d

    found = []
    step = 2.0**-6 if name in ("fx", "cy") else 2.0**-10
    for sign in (1, -1):
        params[name] = mi.Float(value + sign * step)
        params.update()
        found.append(np.array(directions()).astype(np.float64))
    expected = (found[0] - found[1]) / (2 * step)
    params[name] = mi.Float(value)
    dr.enable_grad(params[name])
    params.update()
    d = directions()
    dr.forward(params[name], flags=dr.ADFlag.ClearEdges)
    # Differences: 1e-7 / step of rounding, step^2 times a third derivative.
    size = np.abs(expected).max()
    np.testing.assert_allclose(np.array(dr.grad(d)), expected, rtol=0, atol=3e-3 * size)


# ----------------------------------------------------------------------------------------------
# Integrators
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("integrator", ["path", "prb"])
@pytest.mark.parametrize("view", [VIEWS[1], VIEWS[12]], ids=lambda view: view.name)
def test_integrators_that_trace_rays_see_through_it_what_they_see_through_perspective(
    integrator, view
):
    """With the same samples: to rounding, and to pixels whose ray just misses or hits."""
    camera = view.camera
    focal, principal = (float(camera.fx),) * 2, (float(camera.cx), float(camera.cy))
    center = (np.array(view.to_world) @ [0.2, 0.1, 5, 1])[:3]
    images = []
    for sensor in (Calibrated("", view=view, f=focal, c=principal).dictionary(), view.sensor()):
        scene = {
            "type": "scene",
            "integrator": {"type": integrator},
            "sensor": sensor,
            "light": {"type": "constant"},
            "shape": {"type": "sphere", "center": list(center), "radius": 1.5},
        }
        images.append(image_of(mi.load_dict(scene), spp=16, seed=1))
    different = np.abs(images[0] - images[1]).max(axis=-1) > 1e-4
    assert different.mean() < 0.01 and images[0].std() > 0.05


@pytest.mark.parametrize(
    "sensor", [OPENCV, FISHEYE, BARREL, WIDE_FISHEYE, MOVING[3], MOVING[5]], **by_name
)
def test_a_path_traced_picture_shows_a_sphere_where_the_reference_sees_it(sensor):
    """A luminous sphere, seen by pixels whose rays are nearer to its centre than its radius."""
    middle = sensor.corner + sensor.size / 2
    middle_time = middle[1] / sensor.view.height
    camera = sensor.camera_at(middle_time)
    axis = points_at(sensor.lens, camera, middle[None] + 2.0, np.array([4.0]))[0]
    center, radius = axis @ camera.rotation + camera.center, 4 * 5 / max(sensor.f)
    scene = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": sensor.dictionary(),
        "shape": {
            "type": "sphere", "center": list(center), "radius": radius,
            "emitter": {"type": "area", "radiance": 2.0},
        },
    }  # fmt: skip
    image = image_of(mi.load_dict(scene), spp=64)[..., 0]
    width, height = sensor.size
    missed_by = np.full((height, width), np.inf)
    for row in range(height):
        place = sensor.corner + np.column_stack([np.arange(width), np.full(width, row)]) + 0.5
        camera = sensor.camera_at(place[0, 1] / sensor.view.height)
        points = points_at(sensor.lens, camera, place, np.ones(width))
        rays = points @ camera.rotation / np.linalg.norm(points, axis=1, keepdims=True)
        to_center = center - camera.center
        along = rays @ to_center
        nearest = np.linalg.norm(to_center - along[:, None] * rays, axis=1)
        missed_by[row] = np.where(along > 0, nearest, np.inf) - radius
    # A pixel reaches 0.7 px from its centre; 1 px where the lens shows less of the world.
    pixel = 4 / min(sensor.f)
    inside, outside = missed_by < -pixel, missed_by > pixel
    assert inside.sum() > 10 and outside.sum() > 10
    np.testing.assert_allclose(image[inside], 2.0, rtol=1e-5)
    assert not image[outside].any()


def test_a_camera_that_moves_blurs_a_path_traced_picture():
    """With a global shutter: a point is spread over the path that the reference says it takes."""
    sensor = replace(PINHOLE, view=FILM, close=pose([0.3, -1.0, 0.5], 40, (0.7, -0.7, 1.1)))
    center = (np.array(FILM.to_world) @ [0, 0, 4, 1])[:3]
    scene = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": sensor.dictionary(),
        "shape": {
            "type": "sphere", "center": list(center), "radius": 0.15,
            "emitter": {"type": "area", "radiance": 1.0},
        },
    }  # fmt: skip
    image = image_of(mi.load_dict(scene), spp=1024)[..., 0]
    y, x = np.mgrid[: FILM.height, : FILM.width] + 0.5
    found = np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
    path = np.array([
        film_of(center[None], sensor.camera_at(t), sensor.lens)[0] for t in np.linspace(0, 1, 65)
    ])  # fmt: skip
    assert np.linalg.norm(path[-1] - path[0]) > 2
    # A thousand samples in each of some ten pixels.
    np.testing.assert_allclose(found, path.mean(axis=0), atol=0.05)


def splats_scene(sensor, gaussians, **settings) -> mi.Scene:
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {
                "type": "splats", "srgb_primitives": False, **tensors(gaussians), **settings
            },
            "sensor": sensor.dictionary() if isinstance(sensor, Calibrated) else sensor,
        }
    )  # fmt: skip


def clear_gaussians(sensor, render, view=None):
    """Gaussians before the view, and their picture, which no threshold is near to."""
    for seed in range(100):
        gaussians = splats_before(view or sensor.view, 1, 40, seed)
        picture = render(gaussians)
        if not picture.near_threshold[sensor.view.window].any():
            return gaussians, picture
    raise AssertionError(f"{sensor.name}: no clear seed among 100")


@pytest.mark.parametrize("sensor", [*STILL, BARREL], **by_name)
def test_splats_are_seen_through_it_as_by_the_reference(sensor):
    camera = replace(sensor.camera, near=0.01)
    gaussians, picture = clear_gaussians(
        sensor,
        lambda gaussians: effects.render(
            gaussians, camera, sensor.lens, threshold_width=NEAR_THRESHOLD
        ),
    )
    image = image_of(splats_scene(sensor, gaussians))
    expected = np.concatenate([picture.image, picture.alpha[..., None]], axis=-1)
    # As in test_rendering, float32; Mitsuba's numbers are float32 too.
    np.testing.assert_allclose(image, expected[sensor.view.window], rtol=0, atol=5e-5)
    assert image[..., 3].max() > 0.8


# ----------------------------------------------------------------------------------------------
# Parameters
# ----------------------------------------------------------------------------------------------

OTHER_POSE = pose([1, 2, 3], 30, (0.5, -0.6, 1.0))
CHANGES = {
    "to_world": (transform, OTHER_POSE),
    "fx": (mi_float := lambda value: mi.Float(value), 33.0),
    "fy": (mi_float, 33.0),
    "cx": (mi_float, 19.0),
    "cy": (mi_float, 19.0),
    "k1": (mi_float, -0.125),
    "p1": (mi_float, -0.03125),
    "to_world_close": (transform, OTHER_POSE),
}
CHANGING = replace(OPENCV, close=CLOSE, shutter="rolling")


@pytest.mark.parametrize("name", CHANGES)
def test_a_changed_parameter_is_followed(name):
    convert, value = CHANGES[name]
    given = transform(value) if name.startswith("to_world") else value
    expected = CHANGING.load(**{name: given})
    gaussians = splats_before(CHANGING.view, 1, 40, 0)
    scene = splats_scene(CHANGING, gaussians)
    before = image_of(scene)
    sensor = scene.sensors()[0]
    params = mi.traverse(scene)
    key = next(key for key in params.keys() if key.split(".")[-1] == name)  # noqa: SIM118
    params[key] = convert(value)
    params.update()
    (ray, weight, _), (other, other_weight, _) = map(sampled_rays, (sensor, expected))
    np.testing.assert_allclose(np.array(ray.d), np.array(other.d), rtol=0, atol=1e-6)
    np.testing.assert_allclose(np.array(ray.o), np.array(other.o), rtol=0, atol=1e-6)
    np.testing.assert_array_equal(weight, other_weight)
    image = image_of(scene)
    np.testing.assert_array_equal(image, image_of(scene, sensor=expected))
    assert np.abs(image - before).max() > 0.01


def test_where_the_lens_model_ends_follows_its_coefficients():
    scene = splats_scene(BARREL, splats_before(FILM, 1, 40, 0))
    params = mi.traverse(scene)
    key = next(key for key in params.keys() if key.endswith("k1"))  # noqa: SIM118
    params[key] = mi.Float(-0.0625)
    params.update()
    sensor = scene.sensors()[0]
    assert sensor.lens.max_squared_radius == pytest.approx(1 / (3 * 0.0625))
    _, weight, _ = sampled_rays(sensor)
    assert (weight == 1).all()


def test_coefficients_that_are_not_given_are_not_exposed():
    assert set(mi.traverse(PINHOLE.load()).keys()) >= {"to_world", "fx", "fy", "cx", "cy"}
    keys = set(mi.traverse(replace(OPENCV, lens=OpenCV(k1=0.125)).load()).keys())
    assert "k1" in keys and not keys & {"k2", "k3", "k4", "p1", "to_world_close"}
    assert "to_world_close" in mi.traverse(CHANGING.load()).keys()  # noqa: SIM118


@pytest.mark.parametrize(
    ("sensor", "names"),
    [(OPENCV, ("k1", "k2", "p1")), (FISHEYE, ("k1", "k4"))],
    ids=["opencv", "fisheye"],
)
def test_coefficients_that_are_given_as_zero_can_be_optimised(sensor, names):
    """Each has a derivative, that of a difference across 0, and stays when another is changed.

    Of splats on the film: without distortion, all places on a side of the film bound the slopes at
    which the others are projected, and what bounds them beside 0 is another one on either side.
    """
    zeros = replace(sensor, lens=type(sensor.lens)(), view=FILM)
    dictionary = zeros.dictionary(**dict.fromkeys(names, 0.0))
    gaussians = splats_before(FILM, 1, 40, 0)
    film = effects.project(gaussians, zeros.camera, zeros.lens).means2d
    on_film = ((film > 0) & (film < zeros.size)).all(axis=1)
    gaussians = reference.Gaussians(**{k: v[on_film] for k, v in vars(gaussians).items()})
    scene = splats_scene(dictionary, gaussians, alpha_cut=0.0, transmittance_stop=0.0)
    params = mi.traverse(scene)
    keys = {key.split(".")[-1]: key for key in params.keys()}  # noqa: SIM118
    assert set(names) <= set(keys)
    weights = np.random.default_rng(1).normal(size=(*zeros.size[::-1], 4))

    def loss(name, value) -> float:
        params[keys[name]] = mi.Float(value)
        params.update()
        return float(np.sum(weights * image_of(scene)))

    for name in names:
        step = 1e-3 if name == "p1" else 4e-3
        expected = (loss(name, step) - loss(name, -step)) / (2 * step)
        loss(name, 0.0)
        dr.enable_grad(params[keys[name]])
        params.update()
        image = mi.render(scene, params)
        dr.backward(dr.sum(image * mi.TensorXf(weights.astype(np.float32)), axis=None))
        actual = float(dr.grad(params[keys[name]])[0])
        params[keys[name]] = dr.detach(params[keys[name]])
        # The differences': 1e-6 of 4000 numbers of either sign, over the step, and its square.
        assert actual == pytest.approx(expected, rel=2e-3, abs=1e-4 / step), name
        assert abs(actual) > 2e-4 / step, name


def test_an_opencv_lens_without_coefficients_is_a_pinhole():
    (ray, weight, _), (expected, _, _) = (
        sampled_rays(replace(OPENCV, lens=lens).load()) for lens in (OpenCV(), Pinhole())
    )
    assert (weight == 1).all()
    np.testing.assert_allclose(np.array(ray.d), np.array(expected.d), rtol=0, atol=2e-7)


@pytest.mark.parametrize("sensor", STILL, **by_name)
def test_gradients_of_a_picture_reach_the_calibration(sensor):
    """Against central differences in single precision; some slopes are clamped."""
    gaussians = splats_before(FILM, 1, 40, 0)
    # Nothing is cut: nothing jumps.
    sensor = replace(sensor, view=FILM)
    scene = splats_scene(sensor, gaussians, alpha_cut=0.0, transmittance_stop=0.0)
    params = mi.traverse(scene)
    weights = np.random.default_rng(1).normal(size=(29, 37, 4)).astype(np.float32)

    def loss(key, value) -> float:
        params[key] = value
        params.update()
        return float(np.sum(weights.astype(np.float64) * image_of(scene)))

    for name, step in {
        "fx": 0.02,
        "fy": 0.02,
        "cx": 0.02,
        "cy": 0.02,
        "k1": 1e-3,
        "p1": 1e-3,
    }.items():
        keys = [key for key in params.keys() if key.split(".")[-1] == name]  # noqa: SIM118
        if not keys:
            continue
        value = mi.Float(params[keys[0]])
        expected = (loss(keys[0], value + step) - loss(keys[0], value - step)) / (2 * step)
        params[keys[0]] = mi.Float(value)
        dr.enable_grad(params[keys[0]])
        params.update()
        image = mi.render(scene, params)
        dr.backward(dr.sum(image * mi.TensorXf(weights), axis=None))
        actual = float(dr.grad(params[keys[0]])[0])
        params[keys[0]] = dr.detach(params[keys[0]])
        # Of the differences: 1e-6 of 4000 numbers of either sign, over the step, and its square.
        assert actual == pytest.approx(expected, rel=2e-3, abs=1e-4 / step), name


REFUSED = {
    "lens": (
        {"lens": "opencvv"},
        "PluginError: calibrated: lens must be one of pinhole, opencv, fisheye, got 'opencvv'; "
        "did you mean opencv?",
    ),
    "lens that is no name": (
        {"lens": 3},
        "PluginError: calibrated: lens must be one of pinhole, opencv, fisheye, got 3",
    ),
    "coefficient of another lens": (
        {"lens": "fisheye", "k5": 0.1},
        "PluginError: calibrated: lens 'fisheye' has the coefficients k1, k2, k3, k4, got k5",
    ),
    "coefficient of a pinhole": (
        {"k1": 0.1},
        "PluginError: calibrated: lens 'pinhole' has no coefficients, got k1",
    ),
    "focal length": (
        {"fx": "long"},
        "PluginTypeError: calibrated: fx must be a positive number, got 'long'",
    ),
    "truth": ({"cx": True}, "PluginTypeError: calibrated: cx must be a finite number, got True"),
    "no focal length": (
        {"fy": 0.0},
        "PluginError: calibrated: fy must be a positive number, got 0.0",
    ),
    "coefficient": (
        {"lens": "opencv", "k1": "a"},
        "PluginTypeError: calibrated: k1 must be a finite number, got 'a'",
    ),
    "infinite": ({"cy": np.inf}, "PluginError: calibrated: cy must be a finite number, got inf"),
    "near": (
        {"near_clip": -1.0},
        "PluginError: calibrated: near_clip must be a positive number, got -1.0",
    ),
    "far": (
        {"far_clip": 0.005},
        "PluginError: calibrated: far_clip must be larger than near_clip, 0.01, got 0.005",
    ),
    "shutter": (
        {"shutter": "leaf"},
        "PluginError: calibrated: shutter must be one of global, rolling, got 'leaf'",
    ),
    "no samples": (
        {"shutter_samples": 0},
        "PluginError: calibrated: shutter_samples must be an integer of at least 1, got 0",
    ),
    "part of a sample": (
        {"shutter_samples": 2.5},
        "PluginTypeError: calibrated: shutter_samples must be an integer of at least 1, got 2.5",
    ),
    "pose": (
        {"to_world_close": 3.0},
        "PluginTypeError: calibrated: to_world_close must be a transform, got float",
    ),
}


@pytest.mark.parametrize(("values", "message"), REFUSED.values(), ids=REFUSED)
def test_wrong_values_are_refused(values, message):
    with pytest.raises(RuntimeError) as caught:
        mi.load_dict({"type": "calibrated", **values})
    assert str(caught.value).strip().splitlines()[-1].removeprefix("drgs.core.errors.") == message


def test_a_property_that_there_is_not_is_refused():
    with pytest.raises(RuntimeError, match=r'unreferenced property[\s\S]*"focal"'):
        mi.load_dict({"type": "calibrated", "focal": 3.0})


def test_defaults_are_those_of_the_description():
    sensor = mi.load_dict({"type": "calibrated", "film": {"type": "hdrfilm", "width": 30}})
    width, height = sensor.film().size()
    values = [float(v[0]) for v in (sensor.fx, sensor.fy, sensor.cx, sensor.cy)]
    assert values == [30, 30, 15, height / 2] and width == 30
    focal = mi.load_dict({"type": "calibrated", "fx": 43.5})
    assert (float(focal.fx[0]), float(focal.fy[0])) == (43.5, 43.5)
    assert (sensor.near_clip(), sensor.far_clip(), sensor.shutter_samples) == (0.01, 1e4, 8)
    assert not sensor.needs_aperture_sample()


def test_a_sensor_describes_itself():
    description = str(replace(OPENCV, lens=OpenCV(k1=0.125, p2=0.25)).load())
    assert description.startswith("CalibratedSensor[\n  fx = [40], fy = [44],\n  cx = [24]")
    assert "lens = RadialTangential, k1, p1, p2" in description
    assert "HDRFilm" in description and "0.9" in description


XML = """
<scene version="3.0.0">
    <sensor type="calibrated">
        <float name="fx" value="40"/> <float name="fy" value="44"/>
        <float name="cx" value="24"/> <float name="cy" value="22.5"/>
        <string name="lens" value="opencv"/>
        <float name="k1" value="-0.25"/> <float name="p2" value="0.015625"/>
        <string name="shutter" value="rolling"/> <integer name="shutter_samples" value="3"/>
        <transform name="to_world"> <matrix value="{open}"/> </transform>
        <transform name="to_world_close"> <matrix value="{close}"/> </transform>
        <film type="hdrfilm">
            <integer name="width" value="53"/> <integer name="height" value="41"/>
            <integer name="crop_offset_x" value="13"/> <integer name="crop_offset_y" value="7"/>
            <integer name="crop_width" value="29"/> <integer name="crop_height" value="18"/>
        </film>
    </sensor>
</scene>
"""


def test_a_sensor_of_an_xml_file_is_that_of_a_dictionary():
    sensor = replace(OPENCV, lens=OpenCV(k1=-0.25, p2=0.015625), close=CLOSE, shutter="rolling")
    open, close = (
        " ".join(repr(float(value)) for row in matrix for value in row)
        for matrix in (sensor.view.to_world, CLOSE)
    )
    scene = mi.load_string(XML.format(open=open, close=close))
    by_xml, by_dictionary = scene.sensors()[0], sensor.load()
    assert by_xml.shutter_samples == 3
    (ray, _, _), (expected, _, _) = map(sampled_rays, (by_xml, by_dictionary))
    np.testing.assert_array_equal(np.array(ray.d), np.array(expected.d))
    np.testing.assert_array_equal(np.array(ray.o), np.array(expected.o))


# ----------------------------------------------------------------------------------------------
# Mitsuba's own sensors
# ----------------------------------------------------------------------------------------------


def scaled(matrix, *factors) -> tuple:
    """A ``to_world`` that scales first."""
    return tuple(map(tuple, np.array(matrix) @ np.diag([*factors, 1.0])))


SENSORS = {
    "thinlens": {"aperture_radius": 0.125, "focus_distance": 3.0},
    "orthographic": {},
}
POSES = {"rotated": VIEWS[1].to_world, "mirrored": VIEWS[3].to_world}
SCALED = {
    "scaled": scaled(VIEWS[1].to_world, 3.0, 3.0, 3.0),
    "scaled unevenly": scaled(VIEWS[1].to_world, 2.0, 0.5, 1.0),
}
"""Mitsuba refuses them for a thin lens."""


def own_sensor(kind, view) -> dict:
    dictionary = view.sensor()
    others = {name: dictionary[name] for name in ("to_world", "film", "sampler", "near_clip")}
    if kind == "thinlens":
        others["fov"] = view.fov
    return {"type": kind, **others, **SENSORS[kind]}


@pytest.mark.parametrize("crop", [None, WINDOW])
@pytest.mark.parametrize("to_world", POSES.values(), ids=POSES)
def test_points_on_the_rays_of_a_thin_lens_are_seen_where_the_rays_start(crop, to_world):
    """Those through the middle of its aperture."""
    view = View("", 53, 41, crop=crop, to_world=to_world)
    sensor = mi.load_dict(own_sensor("thinlens", view))
    points, expected = points_on_rays(sensor)
    camera = camera_of(sensor)
    assert np.abs(project(camera, points) - expected).max() < PIXELS


@pytest.mark.parametrize("to_world", POSES.values(), ids=POSES)
def test_rays_of_a_thin_lens_start_on_its_aperture_and_meet_where_it_is_in_focus(to_world):
    """Those of one place on the film."""
    view = View("", 53, 41, to_world=to_world)
    sensor = mi.load_dict(own_sensor("thinlens", view))
    camera = camera_of(sensor)
    sample = np.random.default_rng(0).uniform(size=(2, 1000)).astype(np.float32)
    ray, _ = sensor.sample_ray(0.0, 0.5, mi.Point2f(0.3, 0.7), mi.Point2f(sample))
    c = numbers(camera)
    origins, directions = (
        c["rotation"] @ (np.array(v).astype(np.float64) - shift)
        for v, shift in ((ray.o, c["center"][:, None]), (ray.d, 0))
    )
    on_aperture = origins - directions * origins[2] / directions[2]
    radius, focus_distance = (
        float(v[0]) for v in (camera.aperture.radius, camera.aperture.focus_distance)
    )
    assert np.linalg.norm(on_aperture, axis=0).max() == pytest.approx(radius, rel=0.01)
    in_focus = on_aperture + directions * focus_distance / directions[2]
    # Positions of up to 10 units in float32.
    assert np.ptp(in_focus, axis=1).max() < 1e-5 * focus_distance
    assert (radius, focus_distance) == pytest.approx((0.125, 3.0), rel=1e-6)


@pytest.mark.parametrize("crop", [None, WINDOW])
@pytest.mark.parametrize("to_world", (POSES | SCALED).values(), ids=POSES | SCALED)
def test_points_on_the_rays_of_an_orthographic_sensor_are_seen_where_they_start(crop, to_world):
    view = View("", 53, 41, crop=crop, to_world=to_world)
    sensor = mi.load_dict(own_sensor("orthographic", view))
    points, expected = points_on_rays(sensor)
    camera = camera_of(sensor)
    c = numbers(camera)
    x, y, z = c["rotation"] @ (points - c["center"]).T
    film = np.stack([x, y], axis=-1) * c["focal"] + c["principal"]
    assert np.abs(film - expected).max() < PIXELS and (z > 0).all()


def own_camera(view) -> reference.Camera:
    """Of an orthographic sensor, by the manual: its film is 2 units of its own wide."""
    matrix = np.array(view.to_world)[:3, :3]
    scales = np.linalg.norm(matrix, axis=0)
    rotation = np.diag([-1.0, -1.0, 1.0]) @ (matrix / scales).T
    fx, fy = view.width / 2 / scales[:2]
    return replace(
        view.camera, rotation=rotation, fx=fx, fy=fy, cx=view.width / 2, cy=view.height / 2,
        near=0.01,
    )  # fmt: skip


@pytest.mark.parametrize("factors", [(2.0, 2.0, 1.0), (2.0, 1.5, 1.0)])
def test_an_orthographic_picture_is_that_of_the_reference(factors):
    view = View("", 53, 41, crop=WINDOW, to_world=scaled(VIEWS[1].to_world, *factors))
    sensor = Calibrated("orthographic", view=view)
    camera = own_camera(view)
    plain = replace(view, to_world=VIEWS[1].to_world)
    gaussians, picture = clear_gaussians(
        sensor,
        lambda gaussians: effects.render(
            gaussians, camera, Orthographic(), threshold_width=NEAR_THRESHOLD
        ),
        view=plain,
    )
    image = image_of(splats_scene(own_sensor("orthographic", view), gaussians))
    expected = np.concatenate([picture.image, picture.alpha[..., None]], axis=-1)
    np.testing.assert_allclose(image, expected[view.window], rtol=0, atol=5e-5)
    assert image[..., 3].max() > 0.8


def test_a_picture_through_a_thin_lens_is_that_of_the_reference():
    view = View("", 53, 41, crop=WINDOW)
    sensor = Calibrated("thin lens", view=view)
    camera, defocus = replace(view.camera, near=0.01), ThinLens(0.125, 3.0)
    gaussians, picture = clear_gaussians(
        sensor,
        lambda gaussians: effects.render(
            gaussians, camera, defocus=defocus, threshold_width=NEAR_THRESHOLD
        ),
    )
    image = image_of(splats_scene(own_sensor("thinlens", view), gaussians))
    expected = np.concatenate([picture.image, picture.alpha[..., None]], axis=-1)
    np.testing.assert_allclose(image, expected[view.window], rtol=0, atol=5e-5)
    sharp = effects.render(gaussians, camera)
    assert np.abs(sharp.image - picture.image)[view.window].max() > 0.05


def test_colours_along_rays_turn_with_a_rolling_shutter():
    """Of splats that are small, rays have the direction of the mean, with which colours change."""
    count = 3000
    directions = np.random.default_rng(0).normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    gaussians = {
        "means": 4 * directions,
        "quats": np.tile([1.0, 0, 0, 0], (count, 1)),
        "log_scales": np.full((count, 3), np.log(0.05)),
        "logit_opacities": np.full(count, 3.0),
        "sh0": np.zeros((count, 1, 3)),
        "shN": np.tile(np.eye(3), (count, 1, 1)),
    }
    tensors = {name: mi.TensorXf(value.astype(np.float32)) for name, value in gaussians.items()}
    transform = mi.ScalarTransform4f()
    sensor = {
        "type": "calibrated", "fx": 40.0, "fy": 40.0, "shutter": "rolling",
        "to_world": transform.look_at([0, 0, 0], [0, 0, 1], [0, -1, 0]),
        "to_world_close": transform.look_at([0, 0, 0], [1.2, 0, 0.7], [0, -1, 0]),
        "film": {"type": "hdrfilm", "width": 48, "height": 40, "rfilter": {"type": "box"}},
    }  # fmt: skip
    images = [
        image_of(mi.load_dict({
            "type": "scene", "sensor": sensor,
            "integrator": {"type": "splats", "sh_direction": name, **tensors},
        }))
        for name in ("mean", "pixel")
    ]  # fmt: skip
    assert np.ptp(images[0][..., :3]) > 0.5
    # Three standard deviations are 0.04 radians, over which colours of degree 1 change by 0.02.
    np.testing.assert_allclose(images[1], images[0], rtol=0, atol=0.03)
