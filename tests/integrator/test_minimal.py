"""The readable twin of ``splats`` gives its images and gradients, to the last bit."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from support.views import VIEWS, Scene

from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians


@pytest.fixture(scope="module")
def ply(tmp_path_factory):
    """A file of the Gaussians of a scene."""
    path = tmp_path_factory.mktemp("minimal") / "splats.ply"
    Gaussians(**vars(Scene(degree=3).gaussians)).save(path)
    return path


@pytest.mark.parametrize("pixel_format", ["rgb", "rgba"])
def test_images_and_gradients_match_splats_with_defaults(ply, pixel_format):
    results = []
    for kind in ("splats", "splats_minimal"):
        sensor = VIEWS[1].sensor(pixel_format)
        integrator = {"type": kind, "filename": str(ply)}
        scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})
        params = mi.traverse(scene)
        keys = [f"integrator.{name}" for name in PARAMETER_NAMES]
        for key in keys:
            dr.enable_grad(params[key])
        image = mi.render(scene, params)
        dr.backward(dr.mean(dr.square(image - 0.3), axis=None))
        gradients = [np.array(dr.grad(params[key])) for key in keys]
        assert all(gradient.any() for gradient in gradients)
        results.append([np.array(image).tobytes(), *(g.tobytes() for g in gradients)])
    assert results[0] == results[1]


def test_the_minimal_integrator_fits_one_page():
    assert len((REPOSITORY / "plugins" / "minimal.py").read_text().splitlines()) <= 120
