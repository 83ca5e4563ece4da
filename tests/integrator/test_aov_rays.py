"""``splats`` inside Mitsuba's ``aov``, against the same integrator alone."""

from dataclasses import replace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.views import VIEWS, Scene, View, gradient, image_of, side_by_side, tensors

import drgs  # noqa: F401  (registers the plugins)
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.integrator.aov_rays import ImageRays

# Both evaluate the same splats at the same points, which one of them finds by looking back at the
# rays: single precision, on films of 40 pixels with colours and depths up to 4, so that a place is
# off by 1e-5 px and a colour by the same times its slope. Measured 3e-6.
TOLERANCE = 3e-5

OWN_AOVS = "t:depth, a:alpha"

LENS = {"fx": 40.0, "lens": "opencv", "k1": -0.1}
THIN = {"fov": 50.0, "aperture_radius": 0.05, "focus_distance": 2.3}
PLAIN = View("")
SENSORS = {
    "perspective": VIEWS[1],
    "crop window": VIEWS[12],
    "thinlens": PLAIN.with_sensor("thinlens", **THIN),
    "orthographic": PLAIN.with_sensor("orthographic"),
    "calibrated": PLAIN.with_sensor("calibrated", **LENS),
    "fisheye": PLAIN.with_sensor("calibrated", fx=40.0, lens="fisheye", k1=-0.02),
}
"""Views; another type's lens need not see the same part."""


def wall(view) -> dict:
    """A rectangle that covers a part of the film, amid the splats."""
    place = mi.ScalarTransform4f().translate([0.5, 0, 2.3]).rotate([1, 0.1, 0], 170)
    radiance = {"type": "rgb", "value": [0.25, 0.5, 1.5]}
    return {
        "type": "rectangle",
        "to_world": mi.ScalarTransform4f(np.array(view.to_world)) @ place,
        "emitter": {"type": "area", "radiance": radiance},
    }


def load(scene, outer=None, own=OWN_AOVS, shapes=None, **film):
    """A Mitsuba scene; outer: what the integrator is nested in."""
    integrator = scene.settings | tensors(scene.gaussians) | ({"aovs": own} if own else {})
    integrator = integrator if outer is None else outer | {"img": integrator}
    objects = {"integrator": integrator, "sensor": scene.view.sensor(**film), **(shapes or {})}
    return mi.load_dict({"type": "scene", **objects})


AOV = {"type": "aov", "aovs": "far:depth"}


@pytest.mark.parametrize(
    ("view", "surfaces"),
    [(SENSORS["perspective"], False), *((view, True) for view in SENSORS.values())],
    ids=["splats alone", *SENSORS],
)
def test_aov_outputs_the_image_and_its_own_channels(view, surfaces):
    """Channels: colour, alpha and AOVs of the nested image, those AOVs again, and its own."""
    scene, shapes = Scene(view), {"wall": wall(view)} if surfaces else {}
    alone = image_of(load(scene, shapes=shapes, samples=3), seed=5)
    nested = load(scene, AOV, shapes=shapes, samples=3)
    image = image_of(nested, seed=5)
    film = np.array(nested.sensors()[0].film().develop())
    assert image.shape[-1] == 9 and np.ptp(alone[..., 0]) > 0.1
    assert np.array_equal(image[..., :6], alone)
    np.testing.assert_allclose(image[..., 6:8], alone[..., 4:], rtol=0, atol=TOLERANCE)
    direct = mi.load_dict(AOV | {"img": {"type": "direct"}})
    expected = image_of(nested, integrator=direct, seed=5)[..., -1]
    assert (expected.max() > 0) == surfaces
    assert np.array_equal(image[..., -1], expected)
    for first in (0, 4):  # the film's own colours, and those that it has under the nested name
        np.testing.assert_allclose(
            film[..., first:][..., :3], alone[..., :3], rtol=0, atol=TOLERANCE
        )


@pytest.mark.parametrize("srgb_primitives", [False, True])
@pytest.mark.parametrize(
    ("rfilter", "samples", "sampler"),
    [("box", 16, "stratified"), ("gaussian", 2, "independent"), ("mitchell", 4, "multijitter")],
)
def test_any_filter_and_sampler_may_be_used(srgb_primitives, rfilter, samples, sampler):
    scene = replace(Scene(), srgb_primitives=srgb_primitives)
    film = {"rfilter": rfilter, "samples": samples, "sampler": sampler}
    alone = image_of(load(scene, **film), seed=2)
    image = image_of(load(scene, AOV, **film), seed=2)
    # Filters other than a box are added up in an order that varies.
    np.testing.assert_allclose(image[..., :6], alone, rtol=0, atol=TOLERANCE)
    np.testing.assert_allclose(image[..., 6:8], alone[..., 4:], rtol=0, atol=TOLERANCE)


def test_image_derivatives_are_the_same_without_aov():
    """With the same seed; aov hands on what is asked of the first channels."""
    scene = Scene()
    weights = scene.weights()
    results = []
    for outer, prefix in ((None, ""), (AOV, "integrator_0.")):
        loaded = load(scene, outer, own="", samples=2)
        params = mi.traverse(loaded)
        keys = {name: f"integrator.{prefix}{name}" for name in PARAMETER_NAMES}
        for key in keys.values():
            dr.enable_grad(params[key])
        image = mi.render(loaded, params, seed=1, seed_grad=4)
        channels = image[:, :, :4]
        dr.backward(dr.sum(channels * mi.TensorXf(weights.astype(np.float32)), axis=None))
        results.append({name: gradient(params[key]) for name, key in keys.items()})
        dr.set_grad(params[keys["means"]], 1.0)
        tangent = dr.forward_to(mi.render(loaded, params, seed=1, seed_grad=4))
        results[-1]["tangent"] = np.array(tangent)[..., :4]
    alone, nested = results
    for name, value in alone.items():
        assert np.abs(value).max() > 0 and np.array_equal(value, nested[name]), name


def last_line(error) -> str:
    while error.__cause__ is not None:
        error = error.__cause__
    return str(error).strip().splitlines()[-1].removeprefix("drgs.core.errors.UnsupportedError: ")


def refusal(loaded, **arguments) -> str:
    with pytest.raises(RuntimeError) as caught:
        dr.eval(mi.render(loaded, **arguments))
    return last_line(caught.value)


def test_derivatives_with_own_aovs_are_refused():
    loaded = load(Scene(), AOV)
    params = mi.traverse(loaded)
    dr.enable_grad(params["integrator.integrator_0.means"])
    image = mi.render(loaded, params)
    with pytest.raises(RuntimeError) as caught:
        dr.backward(dr.sum(image, axis=None))
    assert last_line(caught.value) == (
        "splats: inside 'aov', derivatives with 'aovs' of this integrator are not supported: "
        "leave them out, or render it alone"
    )


def test_unsupported_integrators_are_refused():
    assert refusal(load(Scene(), {"type": "moment"})) == (
        "splats: this integrator renders whole images: of those that sample the rays of another "
        "one, such as 'moment', it can only be nested in 'aov'"
    )


@pytest.mark.parametrize("case", ["border", "moving", "batch"])
def test_rays_not_covering_the_film_are_refused(case):
    view, film = VIEWS[1], {}
    if case == "border":
        film = {"sample_border": True, "rfilter": "gaussian"}
    if case == "moving":
        close = {"to_world_close": lambda: mi.ScalarTransform4f().translate([0.1, 0, 0])}
        view = PLAIN.with_sensor("calibrated", **LENS, shutter_close=1.0, **close)
    loaded = load(Scene(view), AOV, **film)
    arguments = {}
    if case == "batch":
        arguments = {"sensor": mi.load_dict(side_by_side(view, view))}
    message = refusal(loaded, **arguments)
    assert message.startswith("splats: inside 'aov', rays must be those of the whole film")


def test_rays_of_another_sensor_are_refused():
    """Other wavefronts may have as many rays as an image."""
    first = mi.load_dict(VIEWS[1].sensor())
    pixel = dr.arange(mi.UInt32, 37 * 23)
    place = (mi.Point2f(pixel % 37, pixel // 37) + 0.5) / mi.Point2f(37, 23)

    def rays(sensor, place=place):
        return sensor.sample_ray_differential(0, 0, place, mi.Point2f(0.5))[0]

    found = ImageRays.from_rays(first, 0.01, rays(first))
    np.testing.assert_allclose(
        np.array([(p.x, p.y) for p in found.positions]), 0.5, rtol=0, atol=1e-4
    )
    wrong = [rays(first, mi.Point2f(1 - place.x, place.y))]
    wrong.append(dr.gather(mi.Ray3f, mi.Ray3f(rays(first)), pixel[:-1]))
    moved = mi.ScalarTransform4f().translate([0.05, 0, 0])
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 3)
    for change in (moved, turned):
        sensor = VIEWS[1].sensor()
        wrong.append(rays(mi.load_dict(sensor | {"to_world": sensor["to_world"] @ change})))
    for each in wrong:
        with pytest.raises(NotImplementedError, match="inside 'aov'"):
            ImageRays.from_rays(first, 0.01, each)
