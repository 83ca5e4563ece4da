"""Code that tests of the ``splats`` integrator share: settings, tolerances, files and scenes."""

import numpy as np

import drgs  # noqa: F401  (registers the plugin)
from drgs.gaussians.parameters import PARAMETER_NAMES
from support.helpers import assert_arrays_agree, host_gaussians
from support.views import image_of

# Relative to the largest value of an array, in single precision: test_rendering derives 2e-5 and
# 2e-4 for films up to twice this size. Converting to linear radiance multiplies relative errors by
# at most 2.4. Measured 1e-6 and 1e-5.
IMAGE = 1e-5

GRADIENTS = 1e-4

ALL_PARAMETERS = (*PARAMETER_NAMES, "background")


def assert_images_agree(actual, expected, tolerance=IMAGE):
    assert_arrays_agree({"image": actual}, {"image": expected}, tolerance)


def assert_gradients_agree(actual, expected, tolerance=GRADIENTS):
    assert_arrays_agree(actual, {name: expected[name] for name in actual}, tolerance)


def ball_lamp_and_sky(camera, distance, bsdf) -> dict:
    """A ball amid the splats that a camera sees, and emitters that shade them."""
    center = camera.center + distance * camera.rotation[2]
    return {
        "ball": {"type": "sphere", "center": center.tolist(), "radius": 0.4, "bsdf": bsdf},
        "lamp": {"type": "point", "position": np.add(camera.center, [0, 0, 1]).tolist()},
        "sky": {"type": "constant"},
    }


def fresh_image(scene, **film):
    return image_of(scene.load(**film))


def write_gaussians(path, gaussians) -> str:
    host_gaussians(gaussians).save(path)
    return str(path)


# Rec. 709 primaries and white point D65 (Mitsuba's color.h).
XYZ = np.array(
    [[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]]
)
