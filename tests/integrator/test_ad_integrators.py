"""``splats`` as Mitsuba tests its differentiable integrators: small scenes, of each the image and
its forward and backward derivatives.

Images are compared with stored ones (``tests/references``), derivatives with finite differences
of ``mi.render``, and with each other: <J v, w> = <v, J^T w>. Errors are measured as Mitsuba's
``test_ad_integrators.py`` does, and its thresholds are upper bounds of those here. Light paths have
the same seed on both sides, so that a derivative is that of the same estimate.

    python tests/integrator/test_ad_integrators.py --write [NAME...]

stores images anew, all or some.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from support.differentiable_scenes import (
    HEIGHT,
    LENSES,
    SCENES,
    UNSTORED_SCENES,
    WIDTH,
    ZEROS,
    load,
    scene,
    tensor,
)
from support.kernels import kernels_of
from support.openexr import read_exr
from support.views import gradients_of

import drgs  # noqa: F401  (registers the plugins)
from drgs.cameras.camera import Camera
from drgs.gaussians.parameters import PARAMETER_NAMES

REFERENCES = REPOSITORY / "tests" / "references"
SEED = 3

# ----------------------------------------------------------------------------------------------
# Parameters that depend on a number theta, 0 at the start
# ----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Thresholds:
    """Mitsuba's are 0.05, 0.5 and 0.05.

    Images are single: rounding of 1e-6 over a step of 0.01 is 1e-4 of derivatives around 1, and
    averages out in sums. In linear radiance the maximum is that of pixels within a step of the kink
    of the conversion, where slopes differ by 1.8 %, half of which is missed. Measured: mean 1.1e-4,
    maximum 9.8e-3, of sums 4.6e-5.
    """

    mean: float = 3e-4
    max: float = 2e-2
    backward: float = 2e-4


# The ends of splats are not differentiated: Mitsuba's thresholds allow for that. At the end of a
# splat alpha jumps by 1/255. Where a step of theta moves that past a pixel, differences are off by
# 8 / (12 epsilon 255), 0.13 of Mitsuba's floor. Large splats end flatly, so that larger steps are
# as good. Measured: mean 0.018, maximum 0.22, of the sum 0.005.
OF_CUTOFFS = Thresholds(0.03, 0.5, 0.02)


@dataclass(frozen=True, eq=False)
class Parameter:
    """A parameter of a scene; a pose is moved along its own axes, or turned about one of them."""

    scene: str
    key: str
    along: Any = 1.0  # derivative of the parameter in theta, broadcast to its shape
    row: int | None = None  # the only one that changes, where it is a tensor; None: all
    epsilon: float = 0.01  # step of theta
    thresholds: Thresholds = Thresholds()

    def at(self, initial, theta) -> Any:
        if isinstance(initial, mi.AffineTransform4f):
            axis, change = self.along[:3], mi.AffineTransform4f()
            if self.along is GROWING:
                return initial @ change.scale(1 + self.along[0] * theta)
            if len(self.along) == 4:
                return initial @ change.rotate(axis, self.along[3] * theta)
            return initial @ change.translate([theta * a for a in axis])
        if isinstance(initial, mi.Color3f):
            return initial + self.along * theta
        direction = np.zeros(initial.shape)
        rows = slice(None) if self.row is None else self.row
        direction[rows] = np.broadcast_to(self.along, initial.shape)[rows]
        if isinstance(initial, mi.Float):
            return initial + tensor(direction).array * theta
        return mi.TensorXf(initial.array + tensor(direction).array * theta, initial.shape)


RIGHT, BACK, OBLIQUE = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.8, -0.6, 0.5)
AROUND = (0.6, -0.48, 0.64, 10.0)  # an axis, and degrees for each unit of theta
GROWING = (0.5,)  # of a scale
TURN = (0.3, -0.5, 0.8, 0.4)  # of a quaternion
FACTORS = np.linspace(0.5, 1.5, 24)  # factors of 24 Gaussians
ALONG = {
    "means": RIGHT,
    "quats": TURN,
    "shN": ((1.0,), (-0.5,), (0.25,)),
    "data": np.outer(FACTORS, [*RIGHT, 0.1, 0.1, 0.1, *TURN]).ravel(),
    "opacities": FACTORS,
    "sh_coeffs": np.repeat(FACTORS, 12),
}
"""Directions of parameters, by the ends of their keys; others change by theta."""

# Cameras move all pixels: rounding averages out. Measured: of sums 4.0e-5, a turn's third order.
SENSORS = Thresholds(backward=5e-5)

# Where rays cross into another texel within a step, slopes change. Measured: mean 4e-4, maximum
# 0.024, of sums 5.6e-5.
TEXELS = Thresholds(1e-3, 0.05, 1e-4)


def keys_of(owner: str, names: str) -> list[str]:
    return [f"{owner}.{name}" for name in names.split()]


def pairs(scenes: str, keys: list[str], *along, **options) -> list[Parameter]:
    """Each of the parameters, along each of the directions, in each of the scenes."""
    usual = {"thresholds": SENSORS} if keys[0].startswith("sensor.") else {}
    return [
        Parameter(scene, key, direction, **{**usual, **options})
        for scene in scenes.split()
        for key in keys
        for direction in along or (ALONG.get(key.rpartition(".")[2], 1.0),)
    ]


LARGER_STEPS = {"k2": 0.12}  # of coefficients whose derivatives are small

OWN = keys_of("integrator", "means log_scales quats logit_opacities sh0 shN")
SHAPE = keys_of("shape", "data opacities sh_coeffs")

PARAMETERS = [
    # Gaussians
    *pairs("splats", keys_of("integrator", "means logit_opacities shN background")),
    *pairs("splats", keys_of("integrator", "log_scales quats sh0"), row=5),
    *pairs("default_cutoffs", OWN[:1], epsilon=0.1, thresholds=OF_CUTOFFS),
    *pairs("aovs", keys_of("integrator", "feature_mark quats logit_opacities log_scales")),
    *pairs("aovs", OWN[:1], BACK),
    *pairs("antialiased", keys_of("integrator", "log_scales")),
    *pairs("display_space unscented exact sampled crop_window batch thin_lens", OWN[:1]),
    *pairs("exact", keys_of("integrator", "log_scales quats"), row=3),
    *pairs("orthographic merged constant_emitter", OWN[:1]),
    *pairs("rolling_shutter global_shutter", keys_of("integrator", "means log_scales sh0")),
    *pairs("rolling_shutter global_shutter", keys_of("integrator", "logit_opacities")),
    *pairs("placed hybrid hybrid_display", OWN),  # also of splats that the ball hides
    *pairs(
        "sky sky_display image image_display", keys_of("integrator", "means sh0 logit_opacities")
    ),
    *pairs("merged", keys_of("integrator", "feature_x")),
    *pairs("merged", SHAPE),
    *pairs("shapes", SHAPE),
    # Places: of objects without one and with one, and of cameras
    *pairs(
        "splats placed placed_smoothed", keys_of("integrator", "to_world"), OBLIQUE, AROUND, GROWING
    ),
    *pairs("batch", keys_of("sensor", "left.to_world"), OBLIQUE),
    *pairs("splats aovs thin_lens orthographic", keys_of("sensor", "to_world"), OBLIQUE, AROUND),
    *pairs("calibrated off_centre", keys_of("sensor", "to_world"), OBLIQUE, AROUND),
    *pairs(
        "rolling_shutter global_shutter",
        keys_of("sensor", "to_world to_world_close"),
        *(OBLIQUE, AROUND),
    ),
    *pairs("sky", keys_of("sensor", "to_world"), AROUND, thresholds=TEXELS),
    # Lenses: degrees, pixels, scene units and coefficients
    *pairs("splats crop_window off_centre thin_lens", keys_of("sensor", "x_fov"), epsilon=0.4),
    *pairs(
        "calibrated rolling_shutter global_shutter", keys_of("sensor", "fx fy cx cy"), epsilon=0.2
    ),
    *pairs(
        "off_centre",
        keys_of("sensor", "principal_point_offset_x principal_point_offset_y"),
        epsilon=2e-3,
    ),
    *pairs("thin_lens", keys_of("sensor", "aperture_radius focus_distance")),
    *pairs("sky_defocused", keys_of("sensor", "aperture_radius focus_distance"), thresholds=TEXELS),
    *pairs("calibrated", keys_of("sensor", "k1 p1 p2")),
    *pairs("calibrated", keys_of("sensor", "k2"), epsilon=0.04),
    *pairs("rolling_shutter", keys_of("sensor", "k4"), epsilon=0.04),
    *(
        parameter
        for lens, names in ZEROS.items()
        for name in names
        for parameter in pairs(
            f"{lens}_of_zeros", [f"sensor.{name}"], epsilon=LARGER_STEPS.get(name, 0.03)
        )
    ),
    *(
        parameter
        for lens, values in LENSES.items()
        for names, size in (("fx cy", 10.0), (" ".join(values), 0.2))
        for parameter in pairs(f"sky_{lens}", keys_of("sensor", names), size, thresholds=TEXELS)
    ),
    # Surfaces and lights
    Parameter("hybrid", "ball.bsdf.reflectance.value"),
    *pairs("hybrid hidden_emitters hybrid_display", ["light.emitter.radiance.value"]),
    Parameter("point_light", "light.intensity.value"),
    Parameter("constant_emitter", "light.radiance.value"),
    Parameter("hybrid_display", "sky.radiance.value"),
    *(Parameter(scene, "sky.data") for scene in ("sky", "sky_display", "sky_defocused")),
    *(Parameter(scene, "integrator.background.data") for scene in ("image", "image_display")),
]


# ----------------------------------------------------------------------------------------------
# Images and derivatives
# ----------------------------------------------------------------------------------------------


@contextmanager
def moved(parameter: Parameter, theta: mi.Float) -> Iterator[tuple[mi.Scene, Any]]:
    """The scene and its parameters, at ``theta``; they are put back afterwards."""
    loaded, key = load(parameter.scene), parameter.key
    params = mi.traverse(loaded)
    initial = type(params[key])(params[key])
    params[key] = parameter.at(initial, theta)
    params.update()
    try:
        yield loaded, params
    finally:
        params[key] = initial
        params.update()


def rendered(loaded: mi.Scene) -> np.ndarray:
    """(H, W, C)."""
    return np.array(mi.render(loaded, seed=SEED)).astype(np.float64)


@contextmanager
def attached(parameter: Parameter) -> Iterator[tuple[mi.Float, mi.TensorXf]]:
    """Theta, and an image whose derivative in theta is that of :func:`rendered`."""
    theta = mi.Float(0)
    dr.enable_grad(theta)
    with moved(parameter, theta) as (loaded, params):
        # Mitsuba wants another seed for the image than for its derivative.
        yield theta, mi.render(loaded, params, seed=SEED + 1, seed_grad=SEED)


@cache
def differences(parameter: Parameter) -> np.ndarray:
    """Central ones of fourth order, (H, W, C)."""
    images, h = [], parameter.epsilon
    for theta in (-2 * h, -h, h, 2 * h):
        with moved(parameter, dr.opaque(mi.Float, theta)) as (loaded, _):
            images.append(rendered(loaded))
    a, b, c, d = images
    return (8 * (c - b) - (d - a)) / (12 * h)


def relative(actual, expected, floor) -> np.ndarray:
    """Mitsuba's measure: the error over what was expected, or over ``floor`` if that is more."""
    return np.abs(actual - expected) / np.maximum(np.abs(expected), floor)


def errors_of_image(actual, expected) -> tuple[float, float]:
    """The mean, and the part of the pixels that differ by more than what storing changes.

    float16 rounds by 2^-11. Single precision is off by 1e-5, 5e-4 of Mitsuba's floor of 0.02.
    """
    errors = relative(actual, expected, 2e-2)
    return errors.mean(), np.mean(errors.max(axis=-1) > 2**-11 + 1e-3)


def errors_of_forward(parameter, actual) -> tuple[float, float]:
    """Mean and maximum. Mitsuba's floor of 0.2 is lowered where derivatives are small."""
    expected = differences(parameter)
    errors = relative(actual, expected, min(0.2, 0.1 * np.abs(expected).max()))
    return errors.mean(), errors.max()


def read_reference(name: str) -> np.ndarray:
    return np.array(read_exr(REFERENCES / f"{name}.exr")).astype(np.float64)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_images_equal_the_stored_ones(name):
    """The second, which is as the first: nothing is left behind by one that it could show.

    Machines round differently, so that a light path or a splat's end may fall otherwise.
    """
    first, actual = (rendered(load(name)) for _ in range(2))
    np.testing.assert_allclose(actual, first, rtol=0, atol=1e-5)  # filters add in any order
    expected = read_reference(name)
    assert actual.shape == expected.shape
    error_mean, differing = errors_of_image(actual, expected)
    assert differing <= 0.01
    # Rounding to float16 is 2^-12 of a value at most, on the mean; pixels that differ may do so by
    # Mitsuba's maximum.
    assert error_mean <= 2**-12 + 0.5 * differing
    _, brighter = errors_of_image(1.01 * expected, expected)
    assert brighter > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("parameter", PARAMETERS, ids=lambda p: f"{p.scene}-{p.key}")
def test_derivatives_equal_differences(parameter):
    """Forward mode for the image, reverse mode for a weighted sum whose terms do not cancel."""
    expected, thresholds = differences(parameter), parameter.thresholds
    with attached(parameter) as (theta, image):
        dr.set_grad(theta, 1.0)
        tangent = np.array(dr.forward_to(image)).astype(np.float64)
    error_mean, error_max = errors_of_forward(parameter, tangent)
    assert error_mean <= thresholds.mean and error_max <= thresholds.max
    numbers = np.random.RandomState(2).normal(size=expected.shape)
    weights = np.sign(expected) * np.abs(numbers)

    def backward():
        with attached(parameter) as (theta, image):
            dr.backward(dr.sum(image * tensor(weights), axis=None))
            return dr.grad(theta)[0]

    actual = backward()
    assert actual == pytest.approx(np.sum(weights * expected), rel=thresholds.backward)
    # Transposed: sums of the same terms in another order, in single precision.
    assert actual == pytest.approx(np.sum(weights * tangent), rel=1e-5)
    # Mitsuba adds what several threads find about texels and materials, and filters, in any order.
    is_ordered = parameter.key.startswith(("sensor.", "integrator."))
    if is_ordered and not parameter.key.endswith("data") and parameter.scene != "sampled":
        assert backward() == actual
    if thresholds is not OF_CUTOFFS:  # an error of one percent is noticed
        assert errors_of_forward(parameter, 1.01 * expected)[0] > thresholds.mean


def test_two_images_have_twice_the_derivatives_of_one():
    """Two passes differentiate the inputs of the sensor's parameters; sums of the same terms."""
    gradients = []
    for count in (1, 2):
        theta = mi.Float(0)
        dr.enable_grad(theta)
        with moved(Parameter("rolling_shutter", "sensor.to_world_close", OBLIQUE), theta) as args:
            losses = [dr.sum(dr.square(mi.render(*args)), axis=None) for _ in range(count)]
            for loss in losses[:-1]:
                dr.backward(loss, flags=dr.ADFlag.ClearVertices)
            dr.backward(losses[-1])
        gradients.append(dr.grad(theta)[0])
    assert gradients[1] == pytest.approx(2 * gradients[0], rel=1e-6) and gradients[0] != 0


def test_camera_and_gaussian_derivatives_are_the_same_together_and_alone():
    of_gaussians, of_camera = [f"integrator.{name}" for name in PARAMETER_NAMES], ["sensor.x_fov"]
    alone, camera, together = (
        gradients_of(mi.load_dict(scene()), np.ones((HEIGHT, WIDTH, 4)), keys, prefix="")
        for keys in (of_gaussians, of_camera, of_gaussians + of_camera)
    )
    for name, values in (alone | camera).items():
        np.testing.assert_array_equal(together[name], values, name)


@pytest.mark.parametrize("name", ["splats", "rolling_shutter"])
def test_derivatives_of_detached_cameras_are_not_computed(name, monkeypatch):
    """Kernels of the Gaussians' derivatives are the same before and after a camera's were wanted;
    nothing is stored for each lane."""
    loaded, other = (mi.load_dict((SCENES | UNSTORED_SCENES)[name]()) for _ in range(2))
    params = mi.traverse(loaded)
    dr.enable_grad(params["integrator.means"])

    def plain():
        loaded.integrator().state.cache.forget("frames")
        dr.backward(dr.mean(mi.render(loaded, params), axis=None))
        dr.eval(dr.grad(params["integrator.means"]))

    for _ in range(3):  # until there are gradients to add to
        plain()
    calls, original = [], Camera.by_lane
    monkeypatch.setattr(Camera, "by_lane", lambda *a: calls.append(1) or original(*a))
    before = kernels_of(plain)
    assert not calls
    key = "sensor.x_fov" if name == "splats" else "sensor.fx"
    more = kernels_of(lambda: gradients_of(other, np.ones((HEIGHT, WIDTH, 4)), [key], prefix=""))
    assert calls == [1]
    assert kernels_of(plain) == before
    assert sum(count for _, count in more) > sum(count for _, count in before) + 50


def test_pixel_sh_direction_refuses_camera_derivatives():
    """They do not depend on the camera through the splats alone."""
    loaded = mi.load_dict(scene(sh_direction="pixel"))
    params = mi.traverse(loaded)
    dr.enable_grad(params["sensor.x_fov"])
    for derivative in (dr.backward, dr.forward_to):
        with pytest.raises(NotImplementedError, match=r"sh_direction.*'mean'"):
            derivative(mi.render(loaded, params))


@pytest.mark.parametrize(
    ("name", "ignored", "key"),
    [
        ("calibrated", "distortion", "sensor.k1"),
        ("thin_lens", "defocus", "sensor.aperture_radius"),
        ("rolling_shutter", "motion", "sensor.to_world_close"),
        ("global_shutter", "motion", "sensor.to_world_close"),
    ],
)
def test_ignored_effect_has_no_derivative(name, ignored, key):
    description = (SCENES | UNSTORED_SCENES)[name]()
    description["integrator"]["ignore"] = ignored
    params = mi.traverse(loaded := mi.load_dict(description))
    for changed in (key, "sensor.to_world"):
        along = OBLIQUE if "to_world" in changed else 1.0
        theta, initial = mi.Float(0), type(params[changed])(params[changed])
        dr.enable_grad(theta)
        params[changed] = Parameter(name, changed, along).at(initial, theta)
        params.update()
        dr.backward(dr.sum(dr.square(mi.render(loaded, params)), axis=None))
        assert (dr.grad(theta)[0] == 0) == (changed == key)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description="Store images anew, by name, or all.")
    parser.add_argument("--write", nargs="*", choices=SCENES, metavar="NAME", required=True)
    mi.set_variant("llvm_ad_rgb")
    REFERENCES.mkdir(exist_ok=True)
    for name in parser.parse_args().write or SCENES:
        bitmap = mi.Bitmap(tensor(rendered(load(name))))
        bitmap = bitmap.convert(component_format=mi.Struct.Type.Float16)
        bitmap.write(str(REFERENCES / f"{name}.exr"))
