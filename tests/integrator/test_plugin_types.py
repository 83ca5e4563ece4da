"""Plugin errors have a type of their own, and plugins are recognised by type."""

import mitsuba as mi
import numpy as np
import pytest

from drgs.core.errors import PluginError, PluginTypeError, UnsupportedError, UserError
from drgs.integrator.sensors import CameraSensor, is_batch, read_sensor
from drgs.integrator.types import is_splats


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


def splats():
    one = np.zeros((1, 3), np.float32)
    quats = np.array([[1, 0, 0, 0]], np.float32)
    tensors = {"means": one, "log_scales": one - 1, "quats": quats}
    tensors |= {"sh0": one[:, None], "logit_opacities": one[:, 0]}
    return mi.load_dict({"type": "splats", **{k: mi.TensorXf(v) for k, v in tensors.items()}})


def test_plugin_errors_have_their_types():
    """They are user errors, and Python's ValueError or TypeError."""
    assert issubclass(PluginError, UserError) and issubclass(UserError, ValueError)
    assert issubclass(PluginTypeError, PluginError) and issubclass(PluginTypeError, TypeError)
    assert issubclass(UnsupportedError, PluginError)
    assert issubclass(UnsupportedError, NotImplementedError)


def test_unsupported_sensor_is_a_type_error():
    sensor = mi.load_dict({"type": "batch", "one": {"type": "perspective"}})
    with pytest.raises(PluginTypeError, match=r"^splats: the sensor must be of type perspective"):
        read_sensor(sensor, 0.01)


def test_degree_above_that_of_the_gaussians_is_a_plugin_error():
    integrator = splats()
    integrator.sh_degree = 2
    scene = mi.load_dict({"type": "scene", "sensor": {"type": "perspective"}})
    with pytest.raises(PluginError, match=r"^splats: sh_degree must be an integer from 0 to 0"):
        integrator.render(scene)


def test_sensors_are_recognised_by_their_protocol():
    calibrated, perspective = (mi.load_dict({"type": t}) for t in ("calibrated", "perspective"))
    assert isinstance(calibrated, CameraSensor) and not isinstance(perspective, CameraSensor)
    batch = mi.load_dict({"type": "batch", "one": {"type": "perspective"}})
    assert is_batch(batch) and not is_batch(perspective) and not is_batch(calibrated)


def test_the_integrator_splats_is_recognised_by_its_state():
    assert is_splats(splats()) and not is_splats(mi.load_dict({"type": "path"}))


def test_only_nested_spp_can_be_set():
    integrator = splats()
    integrator.nested_spp = 3
    assert integrator.nested_spp == 3 and "nested_spp = 3" in str(integrator)
    for name in ("near", "ignore", "srgb_primitives", "gaussians", "pipeline"):
        with pytest.raises(AttributeError):
            setattr(integrator, name, getattr(integrator, name))


def test_repr_contains_the_lens_name():
    assert "lens = Pinhole" in str(mi.load_dict({"type": "calibrated"}))
