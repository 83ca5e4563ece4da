"""Derivatives in a sensor's parameters, through ``mi.render``, against differences in float64."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cache

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support.helpers import FLOAT64, device_camera, device_gaussians, rows, single
from support.views import VIEWS, Scene, View, gradients_of, image_of, tensors, to_linear

import drgs  # noqa: F401  (registers the plugins)
from drgs.cameras.camera import Camera
from drgs.cameras.motion import Motion, RollingShutter
from drgs.core.arrays import from_host
from drgs.reference import effects
from drgs.reference import splatting as reference
from drgs.splatting import rendering

# Single precision against float64: gradients of test_splats agree to 1e-5 of the largest of many;
# a camera's are sums of them. Measured 1.6e-5 for images, 2e-6 for sums of one sign.
IMAGE, VALUE = 1e-4, 2e-5

# Differences of float64: rounding 1e-16 / STEP, and a sixth of the third derivative times STEP^2.
STEP = 1e-6


AXIS, DIRECTION = np.array([0.6, -0.48, 0.64]), np.array([0.28, 0.96, 0.3])

BACKGROUND = np.array([0.875, 0.375, 0.03125])


def matrix_at(to_world, turn=0.0, shift=0.0) -> np.ndarray:
    """A pose, moved and turned in its own axes (those of Mitsuba's camera)."""
    change = np.eye(4)
    change[:3, :3] = Rotation.from_rotvec(turn * AXIS).as_matrix()
    change[:3, 3] = shift * DIRECTION
    return np.array(to_world) @ change


def transform_at(to_world, turn, shift):
    """The same by Mitsuba, attached to ``turn`` and ``shift``; both are 0 where it starts."""
    change = mi.Transform4f().translate([shift * float(d) for d in DIRECTION])
    return mi.Transform4f(to_world) @ change.rotate([float(a) for a in AXIS], dr.rad2deg(turn))


def rgba(rendered) -> np.ndarray:
    return np.concatenate([rendered.image, rendered.alpha[..., None]], axis=-1)


@dataclass(frozen=True)
class Case:
    """A sensor, its parameters at the start, and the float64 image (H, W, 4) at other ones."""

    name: str
    rendered: Callable  # of a scene and values by name
    start: dict  # by name; turn and shift are of to_world, with _close of to_world_close
    view: View = VIEWS[1]
    sensor: dict = field(default_factory=dict)  # instead of a perspective one
    integrator: dict = field(default_factory=dict)

    def load(self, scene, **changes):
        sensor = self.view.sensor()
        if self.sensor:
            kept = {k: sensor[k] for k in ("to_world", "film", "sampler", "near_clip")}
            sensor = kept | {k: v() if callable(v) else v for k, v in self.sensor.items()}
        integrator = {
            "type": "splats", "background": list(BACKGROUND), "srgb_primitives": False,
            **tensors(scene.gaussians), **self.integrator, **changes,
        }  # fmt: skip
        return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})

    def at(self, scene, name, step) -> np.ndarray:
        return self.rendered(scene, {**self.start, name: self.start[name] + step})

    def difference(self, scene, name) -> np.ndarray:
        """Return the difference of the images' window, (H, W, 4)."""
        step = STEP * max(1.0, abs(self.start[name]))
        return (self.at(scene, name, step) - self.at(scene, name, -step)) / (2 * step)


def camera_of(view, values) -> reference.Camera:
    moved = matrix_at(view.to_world, values.get("turn", 0), values.get("shift", 0))
    return replace(view, to_world=moved).camera


def closing(view, values) -> reference.Camera:
    moved = matrix_at(CLOSE, values.get("turn_close", 0), values.get("shift_close", 0))
    return replace(view, to_world=moved).camera


CLOSE = single(matrix_at(VIEWS[1].to_world, 0.06, 0.15))


def with_intrinsics(camera, values) -> reference.Camera:
    names = ("fx", "fy", "cx", "cy")
    return replace(camera, **{name: values[name] for name in names if name in values})


def perspective_image(view):
    def rendered(scene, values):
        camera = camera_of(replace(view, fov=values.get("x_fov", view.fov)), values)
        size, offsets = (camera.width, camera.height), ("offset_x", "offset_y")
        if "offset_x" in values:
            cx, cy = (s / 2 - values[name] * s for s, name in zip(size, offsets, strict=True))
            camera = replace(camera, cx=cx, cy=cy)
        return rgba(reference.render(scene.gaussians, camera, BACKGROUND))[view.window]

    return rendered


def linear_image(scene, values):
    """The conversion to what films expect comes after the background, the last splat."""
    rendered = reference.render(scene.gaussians, camera_of(VIEWS[1], values), BACKGROUND)
    return np.concatenate([to_linear(rendered.image), rendered.alpha[..., None]], axis=-1)


def channels_image(scene, values):
    rendered = reference.render(scene.gaussians, camera_of(VIEWS[1], values), BACKGROUND)
    others = rendered.depth[..., None], rendered.alpha[..., None]
    return np.concatenate([rgba(rendered), *others], axis=-1)


def lens_image(kind, names):
    def rendered(scene, values):
        camera = with_intrinsics(camera_of(VIEWS[1], values), values)
        lens = kind(**{name: values[name] for name in names})
        return rgba(effects.render(scene.gaussians, camera, lens, BACKGROUND))

    return rendered


def thin_lens_image(scene, values):
    camera = camera_of(replace(VIEWS[1], fov=values["x_fov"]), values)
    blur = effects.ThinLens(values["aperture_radius"], values["focus_distance"])
    return rgba(effects.render(scene.gaussians, camera, background=BACKGROUND, defocus=blur))


def orthographic_image(scene, values):
    camera = camera_of(VIEWS[1], values)
    camera = replace(camera, fx=camera.width / 2, fy=camera.width / 2)
    return rgba(effects.render(scene.gaussians, camera, effects.Orthographic(), BACKGROUND))


def blurred_image(scene, values):
    cameras = [with_intrinsics(c(VIEWS[1], values), values) for c in (camera_of, closing)]
    return rgba(effects.render_motion_blur(scene.gaussians, *cameras, 2, BACKGROUND))


def rolling_image(scene, values):
    """Render by the kernels in double precision: the reference has a time for each row, not each
    splat."""
    opened, closed = (with_intrinsics(c(VIEWS[1], values), values) for c in (camera_of, closing))
    camera: Camera = device_camera(opened, FLOAT64)
    other = device_camera(closed, FLOAT64)
    motion = Motion.relative_motion(camera, other.rotation, other.center)
    camera = replace(camera, shutter=RollingShutter(*motion))
    gaussians = device_gaussians(scene.gaussians, FLOAT64)
    frame = rendering.render(gaussians, camera, rendering.Pipeline(scene.degree))
    transmittance, *colors = [rows(p).reshape(opened.height, -1) for p in frame.planes()]
    image = [c + transmittance * b for c, b in zip(colors, BACKGROUND, strict=True)]
    return np.stack([*image, 1 - transmittance], axis=-1)


POSE = {"turn": 0.0, "shift": 0.0}
CLOSE_POSE = {"turn_close": 0.0, "shift_close": 0.0}
INTRINSICS = {"fx": 40.0, "fy": 37.0, "cx": 18.0, "cy": 12.0}
OPENCV = {"k1": -0.25, "k2": 0.0625, "p1": 0.0078125, "p2": -0.015625, "k4": 0.125}


def calibrated(**values):
    return {"type": "calibrated", **values}


CASES = {
    case.name: case
    for case in (
        Case("perspective", perspective_image(VIEWS[1]), {**POSE, "x_fov": 50.0}),
        Case(
            "linear radiance", linear_image, {"turn": 0.0}, integrator={"srgb_primitives": True}
        ),
        Case(
            "depth and alpha",
            channels_image,
            {"shift": 0.0},
            integrator={"aovs": "d:depth, a:alpha"},
        ),
        Case(
            "off-centre crop window",
            perspective_image(VIEWS[13]),
            {**POSE, "x_fov": 50.0, "offset_x": 0.125, "offset_y": 0.0625},
            view=VIEWS[13],
        ),
        Case(
            "thin lens",
            thin_lens_image,
            {**POSE, "x_fov": 50.0, "aperture_radius": 0.0625, "focus_distance": 2.0},
            sensor={
                "type": "thinlens", "fov": 50.0, "aperture_radius": 0.0625, "focus_distance": 2.0
            },
        ),
        Case("orthographic", orthographic_image, POSE, sensor={"type": "orthographic"}),
        Case(
            "opencv",
            lens_image(effects.OpenCV, tuple(OPENCV)),
            {**POSE, **INTRINSICS, **OPENCV},
            sensor=calibrated(**INTRINSICS, lens="opencv", **OPENCV),
        ),
        Case(
            "global shutter",
            blurred_image,
            {**POSE, **CLOSE_POSE, **INTRINSICS},
            sensor=calibrated(
                **INTRINSICS, to_world_close=lambda: mi.ScalarTransform4f(CLOSE), shutter_samples=2
            ),
        ),
        Case(
            "rolling shutter",
            rolling_image,
            {**POSE, **CLOSE_POSE, **INTRINSICS},
            sensor=calibrated(
                **INTRINSICS, to_world_close=lambda: mi.ScalarTransform4f(CLOSE), shutter="rolling"
            ),
        ),
    )
}  # fmt: skip

all_cases = pytest.mark.parametrize("name", CASES)
every_parameter = pytest.mark.parametrize(
    ("name", "parameter"), [(c.name, p) for c in CASES.values() for p in c.start]
)


@cache
def clear_scene(name) -> Scene:
    """Return a scene in which single and double precision take the same decisions everywhere."""
    case = CASES[name]
    for seed in range(40):
        scene = Scene(case.view, seed=seed)
        expected = case.rendered(scene, case.start)
        if np.abs(image_of(case.load(scene)) - expected).max() < 1e-5:
            return scene
    raise AssertionError(f"{name}: no clear seed")


KEYS = {"offset_x": "principal_point_offset_x", "offset_y": "principal_point_offset_y"}


def attach(loaded, *parameters):
    """The scene's parameters, of which the sensor's depend on numbers; and these, in order."""
    params, numbers = mi.traverse(loaded), {}
    for parameter in parameters:
        if not parameter.startswith(("turn", "shift")):
            numbers[parameter] = params[f"sensor.{KEYS.get(parameter, parameter)}"]
        else:
            numbers[parameter] = mi.Float(0)
        dr.enable_grad(numbers[parameter])
    for end in ("", "_close"):
        if f"turn{end}" in numbers or f"shift{end}" in numbers:
            turn, shift = (numbers.get(f"{kind}{end}", mi.Float(0)) for kind in ("turn", "shift"))
            key = f"sensor.to_world{end}"
            params[key] = transform_at(params[key].matrix, turn, shift)
    params.update()
    return params, list(numbers.values())


def weights_like(difference, seed=2) -> np.ndarray:
    """Random, of the derivative's signs: the terms of the sum do not cancel."""
    numbers = np.abs(np.random.default_rng(seed).normal(size=difference.shape))
    return single(np.sign(difference) * numbers)


def backward(loaded, weights, *parameters) -> np.ndarray:
    """Derivatives of sum(weights * image)."""
    params, numbers = attach(loaded, *parameters)
    dr.backward(dr.sum(mi.render(loaded, params) * tensor(weights), axis=None))
    return np.array([dr.grad(number)[0] for number in numbers])


def tensor(weights):
    """Aligned as Dr.Jit's own memory is: other memory is read by other kernels."""
    return mi.TensorXf(from_host(mi.Float, weights), weights.shape)


def forward(loaded, **directions) -> np.ndarray:
    """Derivative of the image along directions of parameters."""
    params, numbers = attach(loaded, *directions)
    for number, direction in zip(numbers, directions.values(), strict=True):
        dr.set_grad(number, dr.opaque(mi.Float, direction))
    return np.array(dr.forward_to(mi.render(loaded, params))).astype(np.float64)


@pytest.mark.slow
@every_parameter
def test_derivatives_equal_central_differences(name, parameter):
    """Backward of a weighted sum, and forward, of every pixel."""
    case, scene = CASES[name], clear_scene(name)
    expected = case.difference(scene, parameter)
    assert np.abs(expected).max() > 0
    weights = weights_like(expected)
    gradients = backward(case.load(scene), weights, *case.start)
    actual = gradients[list(case.start).index(parameter)]
    assert actual == pytest.approx(np.sum(weights * expected), rel=VALUE)
    image = forward(case.load(scene), **{p: float(p == parameter) for p in case.start})
    assert np.abs(image - expected).max() <= IMAGE * np.abs(expected).max()


@all_cases
def test_derivatives_are_transposed_and_reproducible(name):
    """<J v, w> = <v, J^T w>, for random w; and gradients have the same bytes in two runs."""
    case, scene = CASES[name], clear_scene(name)
    weights = single(np.random.default_rng(3).normal(size=(*image_of(case.load(scene)).shape,)))
    sizes = {"x_fov": 10.0, **dict.fromkeys(INTRINSICS, 10.0)}
    directions = {p: sizes.get(p, 1.0) * (-1) ** k for k, p in enumerate(case.start)}
    terms = weights * forward(case.load(scene), **directions)
    gradients = backward(case.load(scene), weights, *directions)
    products = gradients * list(directions.values())
    allowed = 2e-5 * (np.abs(terms).sum() + np.abs(products).sum())
    assert abs(products.sum() - terms.sum()) <= allowed
    assert np.abs(products).max() > 100 * allowed
    again = backward(case.load(scene), weights, *directions)
    assert gradients.all() and again.tobytes() == gradients.tobytes()


def test_two_images_have_twice_the_derivatives_of_one():
    """Two passes differentiate the inputs of the sensor's parameters; sums of the same terms."""
    case, scene = CASES["rolling shutter"], clear_scene("rolling shutter")
    weights = scene.weights()
    loaded = case.load(scene)
    params, numbers = attach(loaded, *case.start)
    losses = [dr.sum(mi.render(loaded, params) * tensor(weights), axis=None) for _ in range(2)]
    dr.backward(losses[0], flags=dr.ADFlag.ClearVertices)
    dr.backward(losses[1])
    expected = 2 * backward(case.load(scene), weights, *case.start)
    np.testing.assert_allclose([dr.grad(x)[0] for x in numbers], expected, rtol=1e-6)


def test_camera_and_gaussian_derivatives_are_computed_together():
    """To the last bits as they come alone."""
    case, scene = CASES["perspective"], clear_scene("perspective")
    weights = scene.weights()
    alone = gradients_of(case.load(scene), weights)
    of_camera = backward(case.load(scene), weights, "turn")
    loaded = case.load(scene)
    params, (number,) = attach(loaded, "turn")
    for name in alone:
        dr.enable_grad(params[f"integrator.{name}"])
    image = mi.render(loaded, params)
    dr.backward(dr.sum(image * tensor(weights), axis=None))
    np.testing.assert_array_equal(np.array(dr.grad(number)), of_camera)
    for name, values in alone.items():
        together = np.array(dr.grad(params[f"integrator.{name}"])).astype(np.float64)
        np.testing.assert_array_equal(together.reshape(values.shape), values, err_msg=name)


def kernels_of(action) -> list:
    """Hashes and operation counts of what ``action`` launches."""
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
        dr.kernel_history_clear()
        action()
        history = dr.kernel_history([dr.KernelType.JIT])
    return [(kernel["hash"], kernel["operation_count"]) for kernel in history]


@pytest.mark.parametrize("name", ["perspective", "rolling shutter"])
def test_derivatives_of_detached_parameters_are_not_computed(name, monkeypatch):
    """Kernels of the Gaussians' derivatives are the same before and after a camera's were wanted;
    nothing is stored for each lane."""
    case, scene = CASES[name], clear_scene(name)
    loaded, other = case.load(scene), case.load(scene)
    weights, params = tensor(scene.weights()), mi.traverse(loaded)
    dr.enable_grad(params["integrator.means"])

    def plain():
        loaded.integrator().state.cache.forget("frames")
        dr.backward(dr.sum(mi.render(loaded, params) * weights, axis=None))
        dr.eval(dr.grad(params["integrator.means"]))

    for _ in range(3):  # until there are gradients to add to
        plain()
    calls = []
    original = Camera.by_lane
    monkeypatch.setattr(
        Camera, "by_lane", lambda *arguments: calls.append(1) or original(*arguments)
    )
    before = kernels_of(plain)
    assert not calls
    more = kernels_of(lambda: backward(other, scene.weights(), "turn"))
    assert calls == [1]
    assert kernels_of(plain) == before
    assert sum(count for _, count in more) > sum(count for _, count in before) + 50


def test_pixel_sh_direction_refuses_camera_derivatives():
    """They do not depend on the camera through the splats alone."""
    case, scene = CASES["perspective"], clear_scene("perspective")
    loaded, weights = case.load(scene, sh_direction="pixel"), scene.weights()
    for derivative in (lambda: backward(loaded, weights, "turn"), lambda: forward(loaded, turn=1)):
        with pytest.raises(Exception) as caught:
            derivative()
        error = caught.value
        while error.__cause__ or error.__context__:
            error = error.__cause__ or error.__context__
        assert isinstance(error, NotImplementedError)
        assert "sh_direction" in str(error) and "'mean'" in str(error)


IGNORED = [
    ("opencv", "distortion", "k1"),
    ("thin lens", "defocus", "aperture_radius"),
    ("rolling shutter", "motion", "shift_close"),
    ("global shutter", "motion", "turn_close"),
]


@pytest.mark.parametrize(("name", "ignored", "parameter"), IGNORED)
def test_ignored_effect_has_no_derivative(name, ignored, parameter):
    case, scene = CASES[name], clear_scene(name)
    weights = scene.weights()
    loaded = case.load(scene, ignore=ignored)
    (value,) = backward(loaded, weights, parameter)
    assert value == 0
    (other,) = backward(case.load(scene, ignore=ignored), weights, "turn")
    assert other != 0
