"""``drgs.render`` on the Gaussians of a small fit."""

import imageio.v3 as iio
import numpy as np

from drgs.render import __main__ as render
from support.small_capture import (
    FIELD_OF_VIEW,
    FOCUS,
    HEIGHT,
    WIDTH,
    assert_images_agree,
    blobs,
    photograph,
)

WHITE = (1.0, 1.0, 1.0)
BLACK = (0.0, 0.0, 0.0)


def rendered(path):
    return iio.imread(path) / 255


def run(*arguments):
    render.main([str(argument) for argument in arguments])


# An image of 8 bits is within half a level of what was rendered; the renderer is within 1e-4.
EIGHT_BITS = 0.5 / 255 + 1e-4


def assert_shows(path, camera, background):
    """The file is the image that the reference makes of the blobs."""
    expected = photograph(blobs(), camera, background)
    assert_images_agree(rendered(path), np.clip(expected.image, 0, 1), expected, EIGHT_BITS)
    return np.clip(expected.image, 0, 1)


def sensor(pose, pixel_format="rgb"):
    origin, target = (", ".join(map(repr, v)) for v in (pose[:3, 3].tolist(), FOCUS.tolist()))
    return f"""
    <sensor type="perspective">
        <float name="fov" value="{np.degrees(FIELD_OF_VIEW)}"/>
        <float name="near_clip" value="0.2"/>
        <transform name="to_world"><lookat origin="{origin}" target="{target}" up="0, 0, 1"/>
        </transform>
        <film type="hdrfilm">
            <integer name="width" value="{WIDTH}"/><integer name="height" value="{HEIGHT}"/>
            <string name="pixel_format" value="{pixel_format}"/><rfilter type="box"/>
            <string name="component_format" value="float32"/>
        </film>
        <sampler type="independent"><integer name="sample_count" value="1"/></sampler>
    </sensor>"""


def write_scene(folder, *sensors, settings=""):
    blobs().save(folder / "model.ply")
    path = folder / "blobs.xml"
    path.write_text(
        f"""<scene version="3.0.0">
        <integrator type="splats">
            <string name="filename" value="model.ply"/>
            <rgb name="background" value="1, 1, 1"/>
            {settings}
        </integrator>
        {"".join(sensors)}
        </scene>"""
    )
    return path
