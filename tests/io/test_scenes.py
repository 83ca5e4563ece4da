"""Scenes that commands are given: on one thread, and with what Mitsuba would not survive."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from drgs.capture.path_tracing import load_scene
from drgs.core.errors import UserError
from drgs.io.images import write_exr
from drgs.io.scenes import load_scene_file, openexr_threads


@pytest.fixture(autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture
def one_thread():
    before = dr.thread_count()
    dr.set_thread_count(1)
    yield
    assert dr.thread_count() == 1
    dr.set_thread_count(before)


SKY = """<scene version="3.0.0">
    <default name="sampler" value="independent"/>
    <default name="count" value="1"/>
    <emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>
    <sensor type="perspective"><sampler type="$sampler">
        <integer name="sample_count" value="$count"/>
    </sampler></sensor>
</scene>"""


@pytest.fixture
def sky(tmp_path):
    pixels = np.random.default_rng(0).random((4, 8, 3), np.float32)
    write_exr(tmp_path / "sky.exr", mi.Bitmap(pixels))
    path = tmp_path / "scene.xml"
    path.write_text(SKY)
    return path


def test_a_scene_with_openexr_files_is_loaded_on_one_thread(sky, one_thread):
    """Mitsuba alone would wait for ever."""
    scene = load_scene_file(sky)
    assert scene.environment() is not None


def test_dictionary_scene_with_openexr_files_is_loaded_on_one_thread(sky, one_thread):
    program = sky.with_name("scene.py")
    program.write_text(
        "def scene():\n"
        '    return {"type": "scene", "sky": {"type": "envmap", "filename": "sky.exr"}}\n'
    )
    assert load_scene(program).environment() is not None


def test_other_thread_counts_are_kept():
    before = dr.thread_count()
    dr.set_thread_count(3)
    try:
        with openexr_threads():
            assert dr.thread_count() == 3
    finally:
        dr.set_thread_count(before)


@pytest.mark.parametrize("sampler", ["independent", "multijitter", "stratified"])
def test_a_sampler_without_samples_is_refused(sky, sampler):
    """``multijitter`` ended the process with SIGFPE when it was made."""
    message = rf"^{sky}: the sampler '{sampler}' must have a sample_count of at least 1, got 0$"
    with pytest.raises(UserError, match=message):
        load_scene_file(sky, sampler=sampler, count="0")
    load_scene_file(sky, sampler=sampler, count="4")


def test_python_scene_with_a_sampler_without_samples_is_refused(tmp_path):
    program = tmp_path / "scene.py"
    sampler = {"type": "multijitter", "sample_count": 0}
    description = {"type": "scene", "sensor": {"type": "perspective", "sampler": sampler}}
    program.write_text(f"def scene():\n    return {description!r}\n")
    with pytest.raises(
        UserError, match=r"scene.py: the sampler 'multijitter' must have a sample_c"
    ):
        load_scene(program)


@pytest.mark.parametrize("name", ["config", "filename"])
def test_scene_parameters_may_be_named_like_parser_options(tmp_path, name):
    path = tmp_path / "scene.xml"
    path.write_text(
        '<scene version="3.0.0"><integrator type="path">'
        f'<integer name="max_depth" value="${name}"/></integrator></scene>'
    )
    assert "max_depth = 3" in str(load_scene_file(path, **{name: "3"}))


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "a.xml",
            b'<scene version="3.0.0"><\xa9/></scene>',
            "a.xml: not a valid scene: it holds bytes that are not UTF-8",
        ),
        ("\udcff.xml", b'<scene version="3.0.0"/>', "Mitsuba takes names in UTF-8 only"),
    ],
    ids=["content", "name"],
)
def test_files_that_are_not_utf_8_are_refused(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(UserError) as error:
        load_scene_file(tmp_path / name)
    assert message in str(error.value)
