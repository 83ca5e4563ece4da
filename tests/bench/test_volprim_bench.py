"""What sets Mitsuba's ``volprim_rf_basic`` apart: the reference that makes its choices."""

import csv
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

from drgs.bench import __main__ as bench
from drgs.bench import accuracy, volprim
from drgs.bench.scenes import bench_camera, bench_gaussians
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.reference import rays as reference_rays
from drgs.reference import splatting as reference
from drgs.results import metrics


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture(scope="module")
def subject():
    """Splats of 1 to 5 pixels in several layers, of a size at which none is entered twice."""
    gaussians = bench_gaussians(400)
    log_scales = np.maximum(gaussians.log_scales + np.float32(1.8), np.float32(np.log(0.02)))
    gaussians = replace(gaussians, log_scales=log_scales)
    small = accuracy.Subject("small", gaussians, [bench_camera(48)], [], (0.0, 0.0, 0.0))
    return volprim.enlarged(small, 16)


def picture(subject, **changes):
    gaussians = reference.Gaussians(
        **{name: getattr(subject.gaussians, name) for name in PARAMETER_NAMES}
    )
    model = replace(volprim.VOLPRIM, **changes)
    return reference_rays.render(gaussians, subject.cameras[0], (0, 0, 0), model).image


def test_the_reference_reproduces_the_integrator(subject):
    """To single precision; of the choices that show in a small, faint scene each is needed."""
    image = volprim.volprim_image(subject.gaussians, subject.cameras[0])
    closest = metrics.psnr(picture(subject), image)
    assert closest > 60
    showing = ("alpha at least", "colours", "ordered by the peaks", "ordered by the", "a low-pass")
    for what, change in volprim.CHANGES.items():
        if what.startswith(showing):
            assert metrics.psnr(picture(subject, **change), image) < closest - 1, what


def test_an_enlarged_scene_is_the_same_picture(subject):
    """But for the step, which is not enlarged."""
    larger = picture(volprim.enlarged(subject, 4), step=0.0)
    np.testing.assert_allclose(larger, picture(subject, step=0.0), rtol=0, atol=1e-5)


def test_the_command_writes_its_table(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(accuracy, "SIZE", 32)
    monkeypatch.setattr(volprim, "FACTORS", (1, 16))
    bench_gaussians(100).save(tmp_path / "few.ply")
    bench.main(["volprim", str(tmp_path / "few.ply"), "--out", str(tmp_path)])
    printed = capsys.readouterr().out
    assert "| lengths x 1 | lengths x 16 |" in printed
    rows = list(csv.DictReader((tmp_path / "volprim.csv").open()))
    assert len(rows) == 2 * len(volprim.CHANGES)
