"""Approximations that an error budget chooses, against the float64 reference of exact images."""

import argparse
import json
import shutil
from dataclasses import replace
from pathlib import Path

import drjit.llvm.ad as llvm
import mitsuba as mi
import numpy as np
import pytest
from matplotlib import colormaps
from PIL import Image
from support.commands import assert_refused
from support.render_command import run, sensor, write_scene
from support.small_capture import pose_around
from support.studies import load_study, reference_rays
from support.views import Scene, tensors

from drgs.accuracy import error_budget as budgets
from drgs.bench.scenes import device_camera
from drgs.cameras.lens import LENSES
from drgs.cameras.viewpoints import OPENCV_TO_MITSUBA
from drgs.config.approximations import FALLOFFS, Approximations, parse_error
from drgs.core.errors import PluginError, UserError
from drgs.core.registry import temporary_registrations
from drgs.gaussians.parameters import PARAMETER_NAMES
from drgs.integrator import error_budget as error_budget_of_scenes
from drgs.integrator.error_budget import renderer_of
from drgs.integrator.scene import film_description
from drgs.io.scenes import openexr_threads
from drgs.reference import splatting as reference
from drgs.render import __main__ as render
from drgs.render.images import viewpoints_of
from drgs.results import budget_memory
from drgs.results.model import load_model
from drgs.splatting.footprint import GaussianFalloff
from drgs.view import __main__ as view

SIZE, BLACK = 48, (0.0, 0.0, 0.0)
SCENE = Scene(count=300)
SHIPPED = Approximations()


@pytest.fixture(scope="module")
def scene():
    """Gaussians seen through a wide lens, and cameras beside each other."""
    gaussians, (camera,) = load_study("accuracy").stress_scene(SIZE)
    rng = np.random.default_rng(0)
    moved = [replace(camera, center=rng.normal(0, 0.15, 3)) for _ in range(12)]
    return gaussians, moved


def search(scene, given=SHIPPED):
    gaussians, cameras = scene
    on_device = [device_camera(camera, llvm.Float) for camera in cameras[::2]]
    renderer = renderer_of(gaussians.to(llvm.TensorXf), given, 3, BLACK)
    return budgets.Search(renderer, on_device)


@pytest.fixture(scope="module")
def found(scene):
    return search(scene)


def image(scene, camera, approximations):
    renderer = renderer_of(scene[0].to(llvm.TensorXf), approximations, 3, BLACK)
    return renderer.image(device_camera(camera, llvm.Float))


@pytest.fixture(scope="module")
def exact_images(scene):
    """Float64 images of the views at which nothing is measured."""
    gaussians, cameras = scene
    of_numpy = reference.Gaussians(*(getattr(gaussians, name) for name in PARAMETER_NAMES))
    model = reference_rays.ImageModel(
        projection="exact",
        order="pixel",
        sh_direction="pixel",
        alpha_cut=1e-6,
        transmittance_stop=0.0,
    )
    return [reference_rays.render(of_numpy, one, BLACK, model).image for one in cameras[1::2]]


@pytest.mark.slow
@pytest.mark.parametrize("budget", [0.05, 0.01])
def test_other_views_are_within_the_budget_of_exact_images(scene, found, exact_images, budget):
    chosen = found.choose(budget).chosen.approximations
    for camera, expected in zip(scene[1][1::2], exact_images, strict=True):
        error = np.sqrt(np.mean((image(scene, camera, chosen) - expected) ** 2))
        assert error < budget
    default = np.sqrt(np.mean((image(scene, camera, Approximations()) - expected) ** 2))
    assert default > 0.02, "a scene on which the smaller budgets take something"


@pytest.mark.slow
def test_smaller_budgets_cost_more_and_the_choice_is_the_same_in_every_run(scene, found):
    reports = [found.choose(budget) for budget in (0.05, 0.02)]
    costs = [report.chosen.cost for report in reports]
    assert costs == sorted(costs)
    assert costs[0] < costs[-1]
    again = search(scene).choose(0.02)
    assert again.chosen == reports[1].chosen
    assert again.errors == reports[1].errors
    for report in reports:
        assert report.faster is None or report.faster.error > report.chosen.error
        assert report.better is None or report.better.error < report.chosen.error


@pytest.mark.slow
def test_filters_and_other_settings_are_kept(scene):
    given = Approximations(low_pass=0.1, antialiased=True, alpha_max=0.9, extent=4.0)
    chosen = search(scene, given).choose(0.05).chosen
    assert replace(chosen.approximations, **{k: getattr(given, k) for k in chosen.changes}) == given


def test_windows_show_a_part_of_the_image(scene):
    gaussians, (camera, *_) = scene
    lens = LENSES.get("opencv").value.from_coefficients(k1=0.1, k2=0.01, p1=0.0, p2=0.0)
    renderer = renderer_of(gaussians.to(llvm.TensorXf), Approximations(), 3, (1, 0.5, 0))
    whole = device_camera(camera, llvm.Float).with_lens(lens)
    # Tolerance: that of single precision, as in the documents.
    part = renderer.image(budgets.crop(whole, 12, 7, 20, 16))
    np.testing.assert_allclose(part, renderer.image(whole)[7:23, 12:32], atol=2e-5)


def test_a_bound_holds_for_most_views_of_the_same_kind():
    """Errors are log-normal, with the typical spread; 0.93 to 0.98: the bound is of 0.95."""
    rng = np.random.default_rng(0)
    errors = np.exp(rng.normal(-6, budgets.TYPICAL_SPREAD, (4000, 5)))
    within = [one <= budgets.bound(measured) for *measured, one in errors]
    assert 0.93 < np.mean(within) < 0.98


UNITS = [(0.002, 0.002), ("0.002", 0.002), ("54 dB", 10**-2.7), ("54dB", 10**-2.7)]
UNITS += [("0.5 steps", 0.5 / 255), ("1step", 1 / 255), (" 2e-5 ", 2e-5)]


@pytest.mark.parametrize(("given", "error"), UNITS)
def test_budgets_have_units(given, error):
    assert parse_error(given) == pytest.approx(error)


WRONG = [0, "0", -0.1, 1, "1e-5", "nan", "inf", "100 dB", "-3dB", "0 steps", "dB", "", "x", True]
WRONG += ["0.5 step s", None]


@pytest.mark.parametrize("given", WRONG)
def test_wrong_budgets_are_refused(given):
    with pytest.raises(
        ValueError, match=r"must be a number from 0\.000020, which single precision"
    ):
        parse_error(given)


@pytest.mark.slow
def test_impossible_budgets_say_what_is_possible(found):
    with pytest.raises(ValueError, match=r"^0.0001 cannot be met here: .* is within 0.0\d+$"):
        found.choose(1e-4)


@pytest.mark.slow
def test_times_of_an_open_shutter_are_chosen(scene):
    """More than the sensor has for a small budget, fewer for a large one; its image follows."""
    gaussians, (camera, *_) = scene
    moved = np.array([[1.5], [0.5], [0.0]])
    pose = np.vstack([np.hstack([camera.rotation.T, camera.center[:, None]]), [0, 0, 0, 1]])
    close = pose.copy()
    close[:3, 3:] += moved
    intrinsics = {name: getattr(camera, name) for name in ("fx", "fy", "cx", "cy")}
    to_mitsuba = [mi.ScalarTransform4f(each @ OPENCV_TO_MITSUBA) for each in (pose, close)]
    sensor = {
        "type": "calibrated", "to_world": to_mitsuba[0], "to_world_close": to_mitsuba[1],
        "shutter": "global", "shutter_samples": 4, **intrinsics,
        "film": film_description(SIZE, SIZE),
    }  # fmt: skip
    settings = {"srgb_primitives": False, "near": camera.near, **tensors(gaussians)}
    chosen = {}
    for error in (0.2, 0.02):
        integrator = {"type": "splats", "error": error, **settings}
        loaded = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor})
        image = np.array(mi.render(loaded, spp=1))[..., :3]
        chosen[error] = loaded.integrator().budget_report.chosen
        alone = mi.load_dict(
            {
                "type": "scene",
                "integrator": {
                    "type": "splats",
                    **chosen[error].approximations.non_default,
                    **settings,
                },
                "sensor": sensor | {"shutter_samples": chosen[error].shutter_samples},
            }
        )
        np.testing.assert_array_equal(image, np.array(mi.render(alone, spp=1))[..., :3])
    assert chosen[0.2].shutter_samples < 4 <= chosen[0.02].shutter_samples


def test_budgets_are_refused_with_extensions(scene):
    with temporary_registrations():
        FALLOFFS.register("mine")(GaussianFalloff)
        with pytest.raises(ValueError, match="cannot be met with the falloff 'mine', which is not"):
            search(scene, replace(SHIPPED, falloff="mine"))


# ----------------------------------------------------------------------------------------------
# Plugin and commands
# ----------------------------------------------------------------------------------------------


def test_the_plugin_chooses_at_its_first_rendering():
    scene = SCENE.load_with(error="48 dB")
    integrator = scene.integrator()
    assert integrator.budget_report is None
    image = np.array(mi.render(scene, spp=1))
    report = integrator.budget_report
    assert report.budget == pytest.approx(10**-2.4)
    chosen = report.chosen.approximations.non_default
    alone = SCENE.load_with(**chosen)
    np.testing.assert_array_equal(image, np.array(mi.render(alone, spp=1)))
    integrator.error = "6 dB"
    mi.render(scene, spp=1)
    assert integrator.budget_report.chosen.cost < report.chosen.cost
    integrator.error = None
    default = np.array(mi.render(SCENE.load_with(), spp=1))
    np.testing.assert_array_equal(np.array(mi.render(scene, spp=1)), default)
    with pytest.raises(PluginError, match="splats: error must be a number from"):
        integrator.error = 0


def test_the_plugin_refuses_what_cannot_be_met():
    with pytest.raises(RuntimeError, match=r"splats: error must be a number from 0\.000020"):
        SCENE.load_with(error=0.0)
    scene = SCENE.load_with(error=2e-5)
    with pytest.raises(PluginError, match=r"splats: error 2e-05 cannot be met here"):
        scene.integrator().render(scene, spp=1)


def test_render_records_the_choice_beside_images(tmp_path, fit):
    run(fit / "point_cloud.ply", "--orbit", 2, "--error", "0.5 steps", "--out", tmp_path / "out")
    record = json.loads((tmp_path / "out" / "error_budget.json").read_text())
    assert record["budget"] == pytest.approx(0.5 / 255)
    assert max(record["measured_errors"]) <= record["budget"]
    for path in (tmp_path / "out").glob("*.png"):
        assert json.loads(Image.open(path).text["drgs error budget"]) == record


@pytest.fixture
def copied(fit, tmp_path):
    """A file of its own, and how often a choice for it was searched."""
    path = tmp_path / "copy" / "point_cloud.ply"
    path.parent.mkdir()
    shutil.copy(fit / "point_cloud.ply", path)
    return path


def memory_of(path):
    return path.with_name("point_cloud.ply.error_budgets.json")


def record_of(path, out, *words):
    run(path, "--orbit", 2, "--out", out, *words)
    return json.loads((out / "error_budget.json").read_text())


def test_choices_are_remembered_beside_the_file(copied, tmp_path, monkeypatch):
    found = record_of(copied, tmp_path / "out", "--error", 0.01)
    files = {path.name: path.read_bytes() for path in (tmp_path / "out").glob("*.png")}
    search = error_budget_of_scenes.Search

    def refuse(*args):
        raise AssertionError("a choice that is remembered is not searched")

    monkeypatch.setattr(error_budget_of_scenes, "Search", refuse)
    assert record_of(copied, tmp_path / "again", "--error", 0.01) == found
    for name, content in files.items():
        assert (tmp_path / "again" / name).read_bytes() == content
    others = [("--error", 0.02), ("--error", 0.01, "--background", "white")]
    others += [("--error", 0.01, "--size", 64, 48), ("--error", 0.01, "--fov", 50)]
    for words in others:
        with pytest.raises(AssertionError, match="not searched"):
            record_of(copied, tmp_path / "others", *words)
    content = copied.read_bytes()
    copied.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(AssertionError, match="not searched"):
        record_of(copied, tmp_path / "changed", "--error", 0.01)
    monkeypatch.setattr(error_budget_of_scenes, "Search", search)
    copied.write_bytes(content)
    damaged = memory_of(copied).read_text()
    for text in (damaged[:-20], damaged.replace('"error": ', '"error": "x", "e": '), "[]", ""):
        memory_of(copied).write_text(text)
        assert record_of(copied, tmp_path / "out", "--error", 0.01) == found


@pytest.mark.parametrize("content", ["notes of mine", '{"mine": 1}'])
def test_files_of_others_are_not_overwritten(copied, tmp_path, content):
    memory_of(copied).write_text(content)
    record_of(copied, tmp_path / "out", "--error", 0.01)
    assert memory_of(copied).read_text() == content


def test_a_folder_that_cannot_be_written_is_no_error(copied, tmp_path, monkeypatch):
    def refuse(path, content):
        raise UserError("read-only")

    monkeypatch.setattr(budget_memory, "write_json", refuse)
    record_of(copied, tmp_path / "out", "--error", 0.01)
    assert not memory_of(copied).exists()
    shipped = Path(budget_memory.drgs.EXAMPLE)
    assert budget_memory.memory_path(shipped) is None


def test_error_images_show_where_errors_are(copied, tmp_path, capsys):
    """Against the float64 reference of exact images; 4 budgets are the brightest colour."""
    run(
        copied, "--origin", 0, -3, 1, "--size", 40, 32, "--error", 0.05, "--error-image",
        "--out", tmp_path / "out",
    )  # fmt: skip
    shown = np.asarray(Image.open(tmp_path / "out" / "camera.error.png"), np.float64) / 255
    model = load_model(copied)
    (camera,) = viewpoints_of(
        argparse.Namespace(
            camera=None, origin=[0, -3, 1], target=None, up=None, fov=None, size=[40, 32],
            panorama=None,
        ), model,
    )  # fmt: skip
    of_numpy = reference.Gaussians(*(getattr(model.gaussians, name) for name in PARAMETER_NAMES))
    pose = camera.camera_to_world
    exact = reference_rays.render(
        of_numpy,
        reference.Camera(
            pose[:3, :3].T, pose[:3, 3], camera.fx, camera.fy, camera.cx, camera.cy, 40, 32,
            model.settings.near_plane,
        ),
        BLACK,
        reference_rays.ImageModel(
            projection="exact", order="pixel", sh_direction="pixel", alpha_cut=1e-6,
            transmittance_stop=0.0, low_pass=model.settings.low_pass,
            antialiased=model.settings.antialiased,
        ),
    ).image  # fmt: skip
    image = np.asarray(Image.open(tmp_path / "out" / "camera.png"), np.float64) / 255
    error = np.sqrt(np.mean((image - np.clip(exact, 0, 1)) ** 2, axis=-1))
    expected = colormaps["inferno"](error / 0.2)[..., :3]
    # Half a level of 8 bits is 2.5 of the 256 colours, each a step of 0.02 at most.
    assert np.abs(shown - expected).max() < 0.06
    assert error.max() > 0.02, "a scene with errors"
    total = np.sqrt(np.mean(error**2))
    line = next(x for x in capsys.readouterr().out.splitlines() if x.startswith("camera.error"))
    assert float(line.split()[1].rstrip(",")) == pytest.approx(total, rel=0.1)
    assert "(brightest from 0.2)" in line


def test_error_images_need_a_budget(copied, tmp_path):
    words = (copied, "--orbit", 2, "--error-image", "--out", tmp_path / "out")
    assert_refused(render.main, *words, folder=tmp_path / "out", message="needs --error ERROR")


def test_viewers_show_images_within_the_budget(fit, capsys):
    model = load_model(fit / "point_cloud.ply")
    args = argparse.Namespace(what=fit / "point_cloud.ply", up=None)
    found = model.within_error(0.002, view.cameras_of(args, model))
    assert "error at most 0.002: " in capsys.readouterr().out
    assert found.settings.approximations != model.settings.approximations
    assert found.gaussians is model.gaussians


@pytest.mark.parametrize(
    ("words", "settings"), [(("--error", 0.01), ""), ((), '<string name="error" value="40 dB"/>')]
)
def test_mitsuba_scenes_are_rendered_within_the_budget(tmp_path, words, settings):
    path = write_scene(tmp_path, sensor(pose_around(0.8, 0.3)), settings=settings)
    run(path, *words, "--out", tmp_path / "out")
    record = json.loads((tmp_path / "out" / "error_budget.json").read_text())
    assert record["budget"] == pytest.approx(0.01)
    with openexr_threads():
        metadata = mi.Bitmap(str(tmp_path / "out" / "blobs.exr")).metadata()
    assert json.loads(metadata["drgs error budget"]) == record


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--error", 0), "argument --error: must be a number from 0.000020"),
        (("--error", "2e-5"), "error 2e-05 cannot be met here: the most accurate choice is within"),
    ],
)
def test_wrong_budgets_end_the_command(fit, tmp_path, words, message):
    words = (fit / "point_cloud.ply", "--orbit", 2, *words, "--out", tmp_path / "out")
    assert_refused(render.main, *words, folder=tmp_path, message=message)
