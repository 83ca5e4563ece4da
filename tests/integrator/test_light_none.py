"""A scene that asks for no light between splats and surfaces has nothing of it."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.helpers import FLOAT32, device_gaussians
from support.kernels import kernels_of
from support.splats_checks import ball_lamp_and_sky
from support.views import Scene, image_of

import drgs  # noqa: F401  (registers the plugins)
from drgs.gaussians.parameters import PARAMETER_NAMES

SCENE = Scene(degree=3, srgb_primitives=True)


def gaussians():
    """The same arrays for all scenes: how one lies in memory is part of a kernel."""
    on_device = device_gaussians(SCENE.gaussians, FLOAT32)
    tensors = {name: getattr(on_device, name) for name in PARAMETER_NAMES}
    dr.eval(tensors)
    return tensors


def surfaces():
    return ball_lamp_and_sky(SCENE.camera, 3, {"type": "roughconductor", "alpha": 0.2})


def load(tensors, objects, **settings):
    integrator = SCENE.settings | tensors | settings
    scene = {"type": "scene", "integrator": integrator, "sensor": SCENE.view.sensor(), **objects}
    return mi.load_dict(scene, parallel=False)  # kernels of other threads have no history


def kernels_and_bytes(*arguments, **settings) -> tuple[list, list[bytes]]:
    """Load a scene, render it, differentiate the splats' colours; return kernels and bytes."""
    arrays = []

    def act():
        scene = load(*arguments, **settings)
        params = mi.traverse(scene)
        dr.enable_grad(params["integrator.sh0"])
        rendered = mi.render(scene, params, seed=1, spp=1)
        dr.backward(dr.mean(rendered, axis=None))
        arrays.extend(np.array(a) for a in (rendered, dr.grad(params["integrator.sh0"])))
        dr.eval()

    dr.eval()  # what is still pending would be found here
    kernels = kernels_of(act)
    assert arrays[1].any()
    return kernels, [array.tobytes() for array in arrays]


@pytest.mark.parametrize("objects", [dict, surfaces], ids=["splats alone", "splats and surfaces"])
def test_light_defaults_to_none(objects):
    """The same kernels and bytes, also after another scene had light."""
    tensors = gaussians()
    plain = kernels_and_bytes(tensors, objects())
    assert len(plain[0]) > 30
    assert kernels_and_bytes(tensors, objects(), light="none") == plain

    images = [image_of(load(tensors, surfaces(), light=light)) for light in ("rays", "none")]
    assert np.abs(images[0] - images[1]).max() > 0.1
    assert kernels_and_bytes(tensors, objects()) == plain
    assert kernels_and_bytes(tensors, objects(), light="none") == plain


def test_light_has_no_effect_without_surfaces():
    """The property makes no kernel of its own, and no difference."""
    tensors = gaussians()
    plain = kernels_and_bytes(tensors, {})
    lit = {"light": "rays", "radiance_scale": 3.0, "light_samples": 0}
    assert kernels_and_bytes(tensors, {}, **lit) == plain
    assert kernels_and_bytes(tensors, {}, light="rays", nested={"type": "splatpath"}) == plain
    # An environment sends light, but it has no surface to send it to.
    sky = {"sky": {"type": "constant"}}
    assert kernels_and_bytes(tensors, sky, light="rays") == kernels_and_bytes(tensors, sky)


def test_nested_integrator_forgets_the_transport_of_its_previous_owner():
    tensors, shared = gaussians(), mi.load_dict({"type": "splatpath"})

    def rendered(nested, **settings):
        return image_of(load(tensors, surfaces(), nested=nested, **settings), seed=1)

    dark = rendered({"type": "splatpath"})
    lit = rendered(shared, light="rays")
    assert np.abs(lit - dark).max() > 0.1
    np.testing.assert_array_equal(rendered(shared, light="none"), dark)
    np.testing.assert_array_equal(rendered(shared, light="rays"), lit)
