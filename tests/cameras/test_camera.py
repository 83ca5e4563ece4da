"""The camera of a Mitsuba sensor against the rays that the sensor itself samples."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.kernels import kernel_hashes
from support.sensors import camera_of, numbers
from support.views import VIEWS, View, pose

from drgs.integrator.sensors import camera_from_sensor, read_sensor


def test_a_camera_far_from_the_origin_keeps_its_centre():
    """A translation -R c would have lost 0.06 units there, and 2 px on a film."""
    position = (1e6, -2e6, 5e5)
    view = View("far", to_world=pose([0.3, -1.0, 0.5], 40, position))
    camera = numbers(camera_of(mi.load_dict(view.sensor())))
    assert np.array_equal(camera["center"], position)


def test_unsupported_sensors_are_refused_by_name():
    sensor = mi.load_dict({"type": "batch", "id": "mine", "first": VIEWS[0].sensor()})
    message = (
        r"^splats: the sensor must be of type perspective, thinlens, orthographic or calibrated, "
        r"got \w+ 'mine'$"
    )
    with pytest.raises(TypeError, match=message):
        read_sensor(sensor, 0.01)


def test_sensors_of_all_poses_and_sizes_share_kernels():
    """No number of the sensor, its film or its crop window is compiled into a kernel."""

    def kernels(fov=40.0, turn=30, **film):
        pose_of_sensor = mi.ScalarTransform4f(pose([1, 2, 3], turn, (turn, 2, 3)))
        film = {"type": "hdrfilm", **film}
        sensor = mi.load_dict(
            {"type": "perspective", "film": film, "fov": fov, "to_world": pose_of_sensor}
        )
        return kernel_hashes(lambda: dr.eval(camera_from_sensor(read_sensor(sensor, 0.01))))

    first = kernels(width=33, height=21)
    assert first and kernels(fov=50.0, turn=70, width=57, height=40) == first
    window = {"crop_offset_x": 3, "crop_offset_y": 2, "crop_width": 11, "crop_height": 9}
    assert kernels(width=33, height=21, **window) == first
