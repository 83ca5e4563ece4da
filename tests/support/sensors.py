"""Mitsuba's sensors and the cameras that drgs makes of them."""

import numpy as np

from drgs.cameras.camera import Camera
from drgs.integrator.sensors import camera_from_sensor, read_sensor

# px. A float32 direction is good to 1e-7, which over a focal length of 50 px is 5e-6 px; the ray's
# origin adds as much at a distance of 1. Measured 8e-6.
PIXELS = 5e-5


def camera_of(sensor, near=0.01) -> Camera:
    return camera_from_sensor(read_sensor(sensor, near))


def numbers(camera) -> dict[str, np.ndarray]:
    """Return the numbers of a Dr.Jit camera in float64."""
    names = ("rotation", "center", "focal", "principal", "near")
    return {n: np.array(getattr(camera, n)).astype(np.float64)[..., 0] for n in names}
