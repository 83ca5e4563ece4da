"""The plugin renders Gaussians as their file says, unless a property says otherwise."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from support.ellipsoids import scene_with
from support.views import VIEWS, Scene, image_of, tensors

from drgs.core.errors import UserError
from drgs.gaussians.parameters import Gaussians

HEADER = {"antialiased": True, "low_pass": 0.1}
SCENE = Scene()


@pytest.fixture
def file(tmp_path):
    """A file of Gaussians with these settings in its header."""
    return saved(tmp_path / "model.ply", HEADER)


def saved(path, said):
    fields = {k: np.array(v) for k, v in tensors(SCENE.gaussians).items()}
    replace(Gaussians(**fields), rendered_with=said).save(path)
    return path


def scene_of(gaussians, **settings):
    """With the given source of the Gaussians: a file's name, or tensors."""
    integrator = {"type": "splats", "near": 0.2, **gaussians, **settings}
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": SCENE.view.sensor()})


@pytest.mark.parametrize(
    ("properties", "expected", "from_header"),
    [
        ({}, HEADER, {"antialiased", "low_pass"}),
        ({"low_pass": 0.3}, {"antialiased": True}, {"antialiased"}),
        ({"low_pass": 0.3, "antialiased": False}, {}, set()),  # the defaults
    ],
)
def test_a_file_is_rendered_with_its_header_unless_a_property_overrides_an_entry(
    file, properties, expected, from_header
):
    scene = scene_of({"filename": str(file)}, **properties)
    given = scene_of(tensors(SCENE.gaussians), **expected)
    image, plain = image_of(scene), image_of(scene_of(tensors(SCENE.gaussians)))
    np.testing.assert_array_equal(image, image_of(given))
    assert np.array_equal(image, plain) == (not expected)
    assert set(scene.integrator().state.header) == from_header


def test_moved_gaussians_are_rendered_with_the_header(file):
    still = mi.ScalarTransform4f().translate([0, 0, 0])
    integrator = scene_of({"filename": str(file)}, to_world=still).integrator()
    assert integrator.state.approximations.non_default == HEADER


def test_the_summary_lists_approximations_of_the_header(file):
    scene = scene_of({"filename": str(file)})
    lines = scene.integrator().summary(scene, *scene.sensors()).splitlines()
    assert (
        "  antialiasing: opacities compensated for the low-pass filter (set by the file)" in lines
    )
    assert "  approximations: low_pass = 0.1 (set by the file)" in lines
    scene = scene_of({"filename": str(file)}, **HEADER)
    lines = scene.integrator().summary(scene, *scene.sensors()).splitlines()
    assert "  antialiasing: opacities compensated for the low-pass filter (antialiased)" in lines
    assert not any("file" in line for line in lines)


def test_a_wrong_value_is_refused_unless_a_property_gives_another(tmp_path):
    file = saved(tmp_path / "model.ply", {"low_pass": -1.0})
    with pytest.raises((UserError, RuntimeError)) as error:
        scene_of({"filename": str(file)})
    assert f"{file}: the header's low_pass must be finite and not negative, got -1.0" in str(
        error.value
    )
    scene_of({"filename": str(file)}, low_pass=0.2)


def test_shapes_of_gaussians_ignore_the_header(file):
    """Mitsuba's loader reads the same file, comments and all, and keeps none of them."""
    shape = {"type": "ellipsoids", "filename": str(file)}
    scene = scene_with({}, VIEWS[0], shape=shape)
    mi.render(scene)
    assert scene.integrator().gaussians.num_gaussians == 40
    assert scene.integrator().state.approximations.non_default == {}
