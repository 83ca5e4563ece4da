"""``drgs capture`` and ``drgs render`` mean the same by the same option: degrees, W H, black."""

import json
import math

import imageio.v3 as iio
import mitsuba as mi
import numpy as np
import pytest
from support.commands import run_in_process
from support.small_capture import blobs

from drgs import render
from drgs.capture import __main__ as capture

BALL = """
<scene version="3.0.0">
    <emitter type="constant"/>
    <shape type="sphere"/>
</scene>
"""

CAPTURE = ["a.xml", "--out", "out"]
RENDER = ["a.ply", "--origin", "0", "0", "3", "--out", "out"]


@pytest.mark.parametrize(("main", "words"), [(capture.main, CAPTURE), (render.main, RENDER)])
def test_single_number_size_is_refused_with_the_new_spelling(main, words):
    outcome = run_in_process(main, *words, "--size", "400")
    assert outcome.returncode == 2
    assert "argument --size: expected 2 arguments: --size W H" in outcome.stderr


@pytest.mark.parametrize(("main", "words"), [(capture.main, CAPTURE), (render.main, RENDER)])
@pytest.mark.parametrize("fov", ["0", "180", "-40"])
def test_a_field_of_view_is_between_0_and_180_degrees(main, words, fov):
    outcome = run_in_process(main, *words, "--fov", fov)
    assert outcome.returncode == 2
    assert "argument --fov: must be between 0 and 180 degrees" in outcome.stderr


@pytest.mark.parametrize("main", [capture.main, render.main])
def test_help_states_units_and_background(main):
    text = " ".join(run_in_process(main, "--help").stdout.split())
    assert "--fov DEGREES" in text
    assert "--size W H" in text
    assert "default: 400 400" in text
    assert ("or black without one" in text) == (main is render.main)
    assert ("background is transparent" in text) == (main is capture.main)


@pytest.fixture
def ball(tmp_path):
    mi.set_variant("llvm_ad_rgb")
    path = tmp_path / "ball.xml"
    path.write_text(BALL)
    return path


def test_image_has_the_given_size_and_field_of_view(ball, tmp_path):
    out = tmp_path / "out"
    options = ["--views", 1, "--test-views", 0, "--spp", 1, "--points", 20]
    options += ["--size", 24, 12, "--fov", 60]
    outcome = run_in_process(capture.main, ball, "--out", out, *options)
    assert outcome.returncode == 0, outcome.stderr
    assert "24x12" in outcome.stdout
    alpha = iio.imread(out / "train" / "r_0.png")[:, :, 3]
    assert alpha.shape == (12, 24)
    assert alpha[6, 12] == 255
    # The ball is within the image's smaller side as well.
    assert not alpha[[0, -1]].any()
    transforms = json.loads((out / "transforms_train.json").read_text())
    assert transforms["camera_angle_x"] == math.radians(60)


def test_capture_mismatch_is_reported_in_units_of_the_options(ball, tmp_path):
    words = [ball, "--out", tmp_path / "out", "--views", 1, "--test-views", 0]
    words += ["--spp", 1, "--points", 0]
    assert run_in_process(capture.main, *words, "--size", 4, 4).returncode == 0
    refused = run_in_process(capture.main, *words, "--size", 4, 8)
    assert refused.returncode == 2
    assert "size is [4, 4], requested is [4, 8]" in refused.stderr
    refused = run_in_process(capture.main, *words, "--size", 4, 4, "--fov", 50)
    assert "fov is 39.5978, requested is 50.0" in refused.stderr


def test_gaussians_without_a_configuration_use_the_default_background(tmp_path):
    blobs().save(tmp_path / "blobs.ply")
    words = [tmp_path / "blobs.ply", "--origin", 0, 0, 30, "--up", 0, 1, 0, "--size", 8, 8]
    outcome = run_in_process(render.main, *words, "--out", tmp_path / "out")
    assert outcome.returncode == 0, outcome.stderr
    assert not iio.imread(tmp_path / "out" / "camera.png")[0].any()
    integrator = mi.load_dict({"type": "splats", "filename": str(tmp_path / "blobs.ply")})
    assert np.array(mi.traverse(integrator)["background"]).ravel().tolist() == [0, 0, 0]
