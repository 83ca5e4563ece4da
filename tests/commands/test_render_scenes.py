"""``python -m drgs.render`` on Mitsuba scenes."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import REPOSITORY
from support.folders import visible
from support.openexr import read_exr
from support.render_command import (
    EIGHT_BITS,
    WHITE,
    assert_shows,
    rendered,
    run,
    sensor,
    write_scene,
)
from support.small_capture import (
    HEIGHT,
    WIDTH,
    assert_images_agree,
    blobs,
    photograph,
    pose_around,
)
from support.small_capture import view as small_view

from drgs.io.images import write_exr


def to_linear(x):
    return np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)


def to_srgb(x):
    return np.where(x <= 0.0031308, x * 12.92, 1.055 * x ** (1 / 2.4) - 0.055)


def test_a_mitsuba_scene_becomes_linear_exr_and_srgb_png(tmp_path):
    pose = pose_around(0.8, 0.3)
    run(write_scene(tmp_path, sensor(pose)), "--out", tmp_path / "out")
    assert visible(tmp_path / "out") == {"blobs.exr", "blobs.png"}
    image_on_black = photograph(blobs(), small_view("", pose, None), (0, 0, 0))
    linear = to_linear(image_on_black.image + image_on_black.transmittance[..., None])
    exr = np.array(read_exr(tmp_path / "out" / "blobs.exr"))
    assert_images_agree(exr, linear, image_on_black, 1e-4)
    encoded = np.clip(to_srgb(linear), 0, 1)
    png = rendered(tmp_path / "out" / "blobs.png")
    assert_images_agree(png, encoded, image_on_black, EIGHT_BITS)


def test_a_scene_in_display_space_is_not_encoded_again(tmp_path):
    pose = pose_around(0.8, 0.3)
    settings = '<boolean name="srgb_primitives" value="false"/>'
    run(write_scene(tmp_path, sensor(pose), settings=settings), "--out", tmp_path / "out")
    camera = small_view("", pose, None)
    assert_shows(tmp_path / "out" / "blobs.png", camera, WHITE)
    expected = photograph(blobs(), camera, WHITE)
    exr = np.array(read_exr(tmp_path / "out" / "blobs.exr"))
    assert_images_agree(exr, expected.image, expected, 1e-4)


def test_every_sensor_of_a_scene_is_rendered(tmp_path):
    sensors = sensor(pose_around(0.8, 0.3)), sensor(pose_around(2.0, 0.3), "rgba")
    run(write_scene(tmp_path, *sensors), "--out", tmp_path / "out")
    expected = {f"blobs_{i}.{suffix}" for i in range(2) for suffix in ("exr", "png")}
    assert visible(tmp_path / "out") == expected
    assert np.array(read_exr(tmp_path / "out" / "blobs_1.exr")).shape == (HEIGHT, WIDTH, 4)
    assert rendered(tmp_path / "out" / "blobs_1.png").shape == (HEIGHT, WIDTH, 3)


def test_scene_without_splats_is_rendered(tmp_path):
    path = tmp_path / "sphere.xml"
    body = f'{sensor(pose_around(0.0, 0.2))}<shape type="sphere"/><emitter type="constant"/>'
    path.write_text(f'<scene version="3.0.0"><integrator type="direct"/>{body}</scene>')
    run(path, "--out", tmp_path / "out")
    assert rendered(tmp_path / "out" / "sphere.png").shape == (HEIGHT, WIDTH, 3)


def test_parameters_of_a_scene_file_can_be_given(tmp_path):
    path = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)))
    run(path, "--out", tmp_path / "written")
    text = path.read_text().replace('"model.ply"', '"$model"').replace("1, 1, 1", "$color")
    path.write_text(text)
    (tmp_path / "model.ply").rename(tmp_path / "a=b.ply")
    run(path, "-D", "model=a=b.ply", "--define", "color=1, 1, 1", "--out", tmp_path / "given")
    images = [rendered(tmp_path / folder / "blobs.png") for folder in ("given", "written")]
    np.testing.assert_array_equal(*images)


@pytest.mark.slow
def test_the_shipped_scene_shows_objects_among_splats(tmp_path):
    """Some pixels show what is seen there without the model, others do not."""
    path = REPOSITORY / "scenes" / "hybrid.xml"
    values = {"model": str(REPOSITORY / "scenes" / "shapes" / "knot.ply"), "spp": "4"}
    values |= {"width": "60", "height": "40", "light": "none", "shadows": ""}
    definitions = [word for name in values for word in ("-D", f"{name}={values[name]}")]
    run(path, *definitions, "--out", tmp_path)
    shown = np.array(read_exr(tmp_path / "hybrid.exr"))
    scene = mi.load_file(str(path), **values)
    objects = np.array(mi.render(scene, integrator=scene.integrator().state.nested, spp=4))
    # The file has half precision: 11 bits.
    agree = np.all(np.abs(shown - objects) <= 1e-3 * (1 + objects), axis=-1)
    assert 0.3 < agree.mean() < 0.9


def test_a_scene_with_an_environment_is_rendered_on_one_thread(tmp_path):
    """Files of OpenEXR are read and written, by threads that there are none of."""
    write_exr(tmp_path / "sky.exr", mi.Bitmap(np.full((4, 8, 3), 0.5, np.float32)))
    path = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)))
    sky = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter></scene>'
    path.write_text(path.read_text().replace("</scene>", sky))
    for threads in (1, 2):
        run(path, "--out", tmp_path / f"out_{threads}", "--threads", threads)
    one, two = (tmp_path / f"out_{threads}" / "blobs.exr" for threads in (1, 2))
    np.testing.assert_array_equal(np.array(read_exr(one)), np.array(read_exr(two)))
