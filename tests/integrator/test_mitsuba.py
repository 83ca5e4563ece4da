"""``splats`` among Mitsuba's sensors, films, samplers and ways to call: see ``docs/mitsuba.md``."""

from __future__ import annotations

import gc
from collections.abc import Callable
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.calibrated_sensors import (
    CLOSE,
    FISHEYE,
    OPENCV,
    PINHOLE,
    POSES,
    SCALED,
    WINDOW,
    own_camera,
    own_sensor,
)
from support.helpers import clear
from support.lens_scenes import points_at
from support.openexr import read_exr
from support.splats_checks import GRADIENTS, IMAGE, write_gaussians
from support.splats_checks import XYZ as TO_XYZ
from support.views import VIEWS, Scene, View, gradient, image_of, tensors

import drgs  # noqa: F401  (registers the plugins)
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.io.scenes import openexr_threads
from drgs.reference import splatting as reference
from drgs.reference.effects import Lens, Orthographic, Pinhole, camera_at


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def load(scene, sensor, **others):
    """A Mitsuba scene; others: settings of the integrator."""
    integrator = scene.settings | tensors(scene.gaussians) | others
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})


# ----------------------------------------------------------------------------------------------
# Surfaces through every sensor
# ----------------------------------------------------------------------------------------------

VIEW = View("", 53, 41, crop=WINDOW)
OWN_VIEWS = {name: replace(VIEW, to_world=to_world) for name, to_world in (POSES | SCALED).items()}
ROLLING, BLURRED = (replace(OPENCV, close=CLOSE, shutter=s) for s in ("rolling", "global"))
TIMES = 3


@dataclass(frozen=True)
class SensorCase:
    """A sensor, and what the reference makes of it."""

    sensor: Callable[[], dict]
    camera: reference.Camera
    lens: Lens = Pinhole()  # noqa: RUF009
    close: reference.Camera | None = None
    rolling: bool = False

    def depths(self, plane) -> np.ndarray:
        """(H, W) of the window: of the plane, at the pixels' centres, the mean over the times."""
        if self.close is None:
            return self._depths(plane, self.camera)
        height = self.camera.height
        if self.rolling:
            times = (np.arange(height)[VIEW.window[0]] + 0.5) / height
            rows = [self._depths(plane, camera_at(self.camera, self.close, t)) for t in times]
            return np.stack([image[k] for k, image in enumerate(rows)])
        times = (np.arange(TIMES) + 0.5) / TIMES
        return np.mean(
            [self._depths(plane, camera_at(self.camera, self.close, t)) for t in times], axis=0
        )

    def _depths(self, plane, camera) -> np.ndarray:
        rows, columns = VIEW.window
        y, x = np.mgrid[rows, columns] + 0.5
        film = np.column_stack([x.ravel(), y.ravel()])
        near, far = (points_at(self.lens, camera, film, np.full(x.size, d)) for d in (1.0, 2.0))
        # Along a ray, what the plane measures is linear in the depth.
        normal, offset = plane
        at_near, at_far = (p @ camera.rotation + camera.center for p in (near, far))
        f_near, f_far = at_near @ normal - offset, at_far @ normal - offset
        return (1 - f_near / (f_far - f_near)).reshape(x.shape)


SENSORS = {
    "perspective": SensorCase(VIEW.sensor, VIEW.camera),
    "thinlens": SensorCase(lambda: own_sensor("thinlens", VIEW), VIEW.camera),
    **{
        f"orthographic, {name}": SensorCase(
            lambda view=view: own_sensor("orthographic", view), own_camera(view), Orthographic()
        )
        for name, view in OWN_VIEWS.items()
    },
    "calibrated": SensorCase(PINHOLE.dictionary, PINHOLE.camera),
    "calibrated, opencv": SensorCase(OPENCV.dictionary, OPENCV.camera, OPENCV.lens),
    "calibrated, fisheye": SensorCase(FISHEYE.dictionary, FISHEYE.camera, FISHEYE.lens),
    "calibrated, rolling shutter": SensorCase(
        ROLLING.dictionary, OPENCV.camera, OPENCV.lens, ROLLING.close_camera, rolling=True
    ),
    "calibrated, blurred": SensorCase(
        lambda: BLURRED.dictionary(shutter_samples=TIMES),
        OPENCV.camera,
        OPENCV.lens,
        BLURRED.close_camera,
    ),
}


def tilted_plane(camera) -> tuple[np.ndarray, float, np.ndarray]:
    """A plane before the camera: its normal and offset in the world, and a rectangle's matrix."""
    normal = np.array([0.2, -0.3, 1.0])
    normal /= np.linalg.norm(normal)
    right = np.cross([0, 1, 0], normal)
    right /= np.linalg.norm(right)
    axes = np.stack([right, np.cross(normal, right), normal]) @ camera.rotation
    middle = camera.center + camera.rotation[2] * 5
    to_world = np.eye(4)
    to_world[:3] = np.column_stack([*(axes * [[100], [100], [1]]), middle])
    return axes[2], float(axes[2] @ middle), to_world


@pytest.mark.slow
@pytest.mark.parametrize("seen", SENSORS.values(), ids=SENSORS)
def test_depth_of_a_plane_matches_rays_for_every_sensor(seen):
    """Without a splat in sight."""
    normal, offset, to_world = tilted_plane(seen.camera)
    behind = replace(
        Scene(count=4).gaussians,
        means=np.float32(np.tile(seen.camera.center - 50 * seen.camera.rotation[2], (4, 1))),
    )
    loaded = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "splats", **tensors(behind), "aovs": "z:depth, a:alpha"},
            "sensor": seen.sensor(),
            "plane": {"type": "rectangle", "to_world": mi.ScalarTransform4f(to_world)},
            "light": {"type": "constant"},
        }
    )
    image = image_of(loaded)
    expected = seen.depths((normal, offset))
    assert np.ptp(expected) > 0.1 and (image[..., 5] == 1).all()
    # Positions of up to 10 units in float32, seen along rays that are 30 degrees off the normal.
    np.testing.assert_allclose(image[..., 4], expected, rtol=2e-5)


# ----------------------------------------------------------------------------------------------
# Films
# ----------------------------------------------------------------------------------------------

COLORS = {"luminance": TO_XYZ[1:2], "xyz": TO_XYZ, "rgb": np.eye(3)}


@pytest.mark.parametrize("component_format", ["float16", "float32"])
@pytest.mark.parametrize("alpha", [False, True], ids=["without alpha", "with alpha"])
@pytest.mark.parametrize("colors", COLORS)
def test_every_film_format_has_the_same_image(colors, alpha, component_format, tmp_path):
    scene = clear(Scene(srgb_primitives=True))
    names = {"luminance": "luminance_alpha", "xyz": "xyza", "rgb": "rgba"}
    pixel_format = names[colors] if alpha else colors
    loaded = scene.load(pixel_format=pixel_format, component_format=component_format)
    image = image_of(loaded)
    expected = scene.image()
    expected = np.dstack([expected[..., :3] @ COLORS[colors].T, *([expected[..., 3]] * alpha)])
    # Mitsuba rounds the weights of luminance to four digits.
    tolerance = 1e-3 if colors == "luminance" else IMAGE
    np.testing.assert_allclose(image, expected, rtol=0, atol=tolerance * expected.max())
    path = str(tmp_path / "image.exr")
    with openexr_threads():
        loaded.sensors()[0].film().write(path)
    bitmap = read_exr(path)
    assert bitmap.component_format() == getattr(mi.Struct.Type, component_format.capitalize())
    written = np.array(bitmap).astype(np.float64).reshape(image.shape)
    # The colours of float32 are converted anew.
    rounding, least = {"float16": (2**-11, 1e-6), "float32": (2**-22, 0)}[component_format]
    np.testing.assert_allclose(written, image, rtol=rounding, atol=least)


@pytest.mark.parametrize(
    "film", [{"samples": 3}, {"samples": 2, "rfilter": "gaussian"}], ids=["box", "gaussian"]
)
def test_develop_false_leaves_sampled_images_in_the_film(film):
    loaded = Scene(count=12).load(**film)
    assert dr.width(loaded.integrator().render(loaded, seed=2, develop=False)) == 0
    developed = np.array(loaded.sensors()[0].film().develop())
    # Other filters than a box are added up in an order that varies.
    np.testing.assert_allclose(developed, image_of(loaded, seed=2), rtol=0, atol=1e-6)


# ----------------------------------------------------------------------------------------------
# Derivatives through every sensor
# ----------------------------------------------------------------------------------------------


def batch() -> dict:
    whole = VIEW.sensor()
    film = {"type": "hdrfilm", "width": 74, "height": 23, "rfilter": {"type": "box"}}
    views = {f"view_{k}": VIEWS[k].sensor() for k in (1, 2)}
    return {"type": "batch", "film": film | {"pixel_format": "rgba"}, **views} | {
        "sampler": whole["sampler"]
    }


DIFFERENTIATED = {
    "crop window": VIEW.sensor,
    "orthographic": SENSORS["orthographic, rotated"].sensor,
    "thinlens": SENSORS["thinlens"].sensor,
    "batch": batch,
}


@pytest.mark.parametrize("sensor", DIFFERENTIATED.values(), ids=DIFFERENTIATED)
def test_forward_mode_is_the_transpose_of_the_gradients_through_every_sensor(sensor):
    """<w, J d> = <J^T w, d>, with all parameters at once; terms are summed in float64."""
    loaded = load(Scene(VIEW), sensor())
    params, rng = mi.traverse(loaded), np.random.default_rng(0)
    values = [params[f"integrator.{name}"] for name in PARAMETER_NAMES]
    directions = [rng.normal(size=np.array(v).shape).astype(np.float32) for v in values]
    for value, direction in zip(values, directions, strict=True):
        dr.enable_grad(value)
        dr.set_grad(value, type(value)(direction))
    tangent = np.array(loaded.integrator().render_forward(loaded, params)).astype(np.float64)
    weights = rng.normal(size=tangent.shape).astype(np.float32)
    dr.clear_grad(values)
    loaded.integrator().render_backward(loaded, params, mi.TensorXf(weights))
    terms = [
        np.array(dr.grad(v)).astype(np.float64) * d for v, d in zip(values, directions, strict=True)
    ]
    left, right = np.sum(weights * tangent), sum(t.sum() for t in terms)
    size = np.abs(weights * tangent).sum() + sum(np.abs(t).sum() for t in terms)
    assert size > 0 and abs(left - right) < 1e-5 * size


def test_two_renders_are_both_differentiated_at_the_current_parameters():
    """The backward pass knows the scene as it is then."""
    before, after = clear(Scene()), clear(Scene(seed=100))
    loaded = before.load()
    params = mi.traverse(loaded)
    first, second = before.weights(1), before.weights(2)

    def enable():
        for name in PARAMETER_NAMES:
            dr.enable_grad(params[f"integrator.{name}"])

    enable()
    loss = dr.sum(mi.render(loaded, params) * mi.TensorXf(np.float32(first)), axis=None)
    for name, value in tensors(after.gaussians).items():
        params[f"integrator.{name}"] = value
    params.update()
    enable()
    loss += dr.sum(mi.render(loaded, params) * mi.TensorXf(np.float32(second)), axis=None)
    dr.backward(loss)
    expected = after.gradients(first + second)
    for name in PARAMETER_NAMES:
        actual = gradient(params[f"integrator.{name}"])
        tolerance = GRADIENTS * np.abs(expected[name]).max()
        np.testing.assert_allclose(actual, expected[name], rtol=0, atol=tolerance)
    assert loaded.integrator().last.means2d_grad.shape == (40, 2)


# ----------------------------------------------------------------------------------------------
# XML
# ----------------------------------------------------------------------------------------------

XML = """
<scene version="3.0.0">
    <integrator type="splats">
        <string name="filename" value="{path}"/>
        <rgb name="background" value="0.5, 0.25, 1"/>
        <boolean name="srgb_primitives" value="false"/>
        <string name="aovs" value="z:depth"/>
        <float name="low_pass" value="0.5"/>
        <integer name="sh_degree" value="1"/>
    </integrator>
    <sensor type="{kind}">
        <transform name="to_world"> <matrix value="{matrix}"/> </transform>
        {others}
        <film type="hdrfilm">
            <integer name="width" value="53"/> <integer name="height" value="41"/>
            <integer name="crop_offset_x" value="13"/> <integer name="crop_offset_y" value="7"/>
            <integer name="crop_width" value="29"/> <integer name="crop_height" value="18"/>
            <string name="pixel_format" value="rgba"/>
            <rfilter type="box"/>
        </film>
        <sampler type="stratified"> <integer name="sample_count" value="4"/> </sampler>
    </sensor>
</scene>
"""


@pytest.mark.parametrize("kind", ["perspective", "thinlens", "orthographic"])
def test_xml_and_dictionary_give_the_same_image(kind, tmp_path):
    scene, path = Scene(VIEW), tmp_path / "splats.ply"
    write_gaussians(path, scene.gaussians)
    sensor = VIEW.sensor(samples=4, sampler="stratified")
    others = {"perspective": {"fov": 50.0}, "orthographic": {}}
    others["thinlens"] = {"fov": 50.0, "aperture_radius": 0.125, "focus_distance": 3.0}
    given = others[kind]
    sensor = {"type": kind, **given, **{k: sensor[k] for k in ("to_world", "film", "sampler")}}
    settings = {"type": "splats", "filename": str(path), "background": [0.5, 0.25, 1]}
    settings |= {"srgb_primitives": False, "aovs": "z:depth", "low_pass": 0.5, "sh_degree": 1}
    by_dictionary = mi.load_dict({"type": "scene", "integrator": settings, "sensor": sensor})
    xml = XML.format(
        path=path,
        kind=kind,
        matrix=" ".join(repr(float(v)) for row in VIEW.to_world for v in row),
        others=" ".join(f'<float name="{k}" value="{v}"/>' for k, v in given.items()),
    )
    image = image_of(mi.load_string(xml), seed=3)
    assert image.shape == (18, 29, 5)
    assert np.array_equal(image, image_of(by_dictionary, seed=3))


# ----------------------------------------------------------------------------------------------
# Frozen functions
# ----------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("call", ["render", "render_backward", "render_forward"])
def test_dr_freeze_is_refused_without_side_effects(call):
    gc.collect()  # scenes of other tests that die while Dr.Jit records change its own message
    scene = Scene()
    loaded = scene.load()
    params, expected = mi.traverse(loaded), image_of(loaded)
    integrator = loaded.integrator()

    @dr.freeze
    def frozen(weights):
        if call == "render":
            return mi.render(loaded) * weights
        if call == "render_forward":
            return integrator.render_forward(loaded, params) * weights
        integrator.render_backward(loaded, params, weights)
        return weights

    with pytest.raises(RuntimeError) as caught:
        frozen(mi.TensorXf(np.float32(scene.weights())))
    error = caught.value
    while error.__cause__ is not None:
        error = error.__cause__
    assert str(error) == (
        "splats: rendering cannot be recorded by dr.freeze, as it reads counts back from the "
        "device: call mi.render outside of the frozen function"
    )
    assert np.array_equal(image_of(loaded), expected)
