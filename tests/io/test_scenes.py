"""OpenEXR files on one thread, and scenes that Mitsuba would not survive."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from support.formats import refusal
from support.openexr import read_exr

from drgs.capture.path_tracing import load_scene
from drgs.core.errors import UserError
from drgs.io.images import write_exr
from drgs.io.scenes import load_scene_file, openexr_threads

SKY = """<scene version="3.0.0">
    <default name="sampler" value="independent"/>
    <default name="count" value="1"/>
    <default name="filename" value="4"/>
    <emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>
    <integrator type="path"><integer name="max_depth" value="$filename"/></integrator>
    <sensor type="perspective"><sampler type="$sampler">
        <integer name="sample_count" value="$count"/>
    </sampler></sensor>
</scene>"""

PROGRAM = """def scene():
    sampler = {"type": "multijitter", "sample_count": 0}
    sky = {"type": "envmap", "filename": "sky.exr"}
    return {"type": "scene", "sky": sky, "sensor": {"type": "perspective", "sampler": sampler}}
"""


@pytest.fixture
def sky(tmp_path):
    mi.set_variant("llvm_ad_rgb")
    pixels = np.random.default_rng(0).random((4, 8, 3), np.float32)
    write_exr(tmp_path / "sky.exr", mi.Bitmap(pixels))
    (tmp_path / "scene.xml").write_text(SKY)
    (tmp_path / "scene.py").write_text(PROGRAM)
    return tmp_path / "scene.xml"


@pytest.mark.parametrize("count", [1, 3])
def test_openexr_files_are_written_and_loaded_on_any_number_of_threads(sky, count):
    """Mitsuba alone would wait for ever on one."""
    before = dr.thread_count()
    dr.set_thread_count(count)
    pixels = np.random.default_rng(0).normal(size=(5, 7, 4)).astype(np.float32)
    program = sky.with_name("scene.py")
    program.write_text(PROGRAM.replace('"sample_count": 0', '"sample_count": 4'))
    try:
        write_exr(sky.parent / "new" / "a.exr", mi.Bitmap(pixels))
        for scene in (load_scene_file(sky), load_scene(program)):
            assert scene.environment() is not None and dr.thread_count() == count
        with openexr_threads():
            assert dr.thread_count() == max(count, 2)
    finally:
        dr.set_thread_count(before)
    np.testing.assert_array_equal(np.array(read_exr(sky.parent / "new" / "a.exr")), pixels)


@pytest.mark.parametrize("sampler", ["independent", "multijitter", "stratified"])
def test_a_sampler_without_samples_is_refused(sky, sampler):
    """``multijitter`` ended the process with SIGFPE when it was made."""
    refused = refusal(sky, lambda path: load_scene_file(path, sampler=sampler, count="0"))
    assert refused == f"the sampler '{sampler}' must have a sample_count of at least 1, got 0"
    refused = refusal(sky.with_name("scene.py"), load_scene)
    assert refused == "the sampler 'multijitter' must have a sample_count of at least 1, got 0"
    # Parameters may be named like options of Mitsuba's parser.
    scene = load_scene_file(sky, sampler=sampler, count="4", filename="3")
    assert "max_depth = 3" in str(scene)


def test_names_that_are_not_utf8_are_refused():
    """They would crash Mitsuba."""
    with pytest.raises(UserError, match=r"takes names in UTF-8 only, got .*; rename it"):
        load_scene_file(Path("a\udca9.xml"))
