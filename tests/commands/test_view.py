"""``drgs view``: what it shows, and what it refuses; browsers are in ``tests/live``."""

import shutil
import sys

import numpy as np
import pytest
import yaml
from support.commands import assert_refused
from support.folders import contents
from support.small_capture import FOCUS, RADIUS, make_dataset

from drgs import view
from drgs.cli.commands import CommandParser
from drgs.core.errors import UserError
from drgs.render import parse_background
from drgs.results.files import CAMERAS, VIEWS
from drgs.results.model import load_model
from drgs.results.refined_cameras import write_views
from drgs.viewer.page import StartView


def parsed(*arguments):
    parser = CommandParser()
    view.add_arguments(parser)
    return parser.parse_args([str(argument) for argument in arguments])


def model_of(args):
    return load_model(args.what, background=parse_background(args.background))


@pytest.mark.parametrize("refined", [False, True])
def test_fit_is_viewed_from_its_training_cameras(fit, tmp_path, refined):
    """Refined cameras are used, where the fit has refined them."""
    run = tmp_path / "run"
    shutil.copytree(fit, run)
    config = yaml.safe_load((run / "config.yml").read_text())
    config["cameras"] = {"optimise": refined}
    (run / "config.yml").write_text(yaml.safe_dump(config))
    few, others = make_dataset(train=3), make_dataset(train=5)
    write_views(run / VIEWS, few)
    write_views(run / CAMERAS, others)
    args = parsed(run)
    model = model_of(args)
    assert model.background == (1.0, 1.0, 1.0)  # of its configuration
    cameras = view.cameras_of(args, model)
    for camera, expected in zip(cameras, (others if refined else few).train, strict=True):
        assert np.allclose(camera.camera_to_world, expected.camera_to_world)


def test_single_file_is_viewed_as_a_whole(fit):
    args = parsed(fit / "point_cloud.ply", "--background", "0.5", "0.25", "0")
    model = model_of(args)
    assert model.background == (0.5, 0.25, 0.0)
    (camera,) = view.cameras_of(args, model)
    middle = camera.K @ (camera.viewmat @ [*FOCUS, 1])[:3]
    assert np.abs(middle[:2] / middle[2] - 200).max() < 60  # px of 400
    assert 0.3 * RADIUS < np.linalg.norm(camera.center - FOCUS) < 2 * RADIUS
    middle = np.median(model.gaussians.numpy().means, axis=0)
    distance = StartView.from_views([camera], middle).camera.distance
    assert distance == pytest.approx(np.linalg.norm(camera.center - middle), rel=0.2)


@pytest.mark.parametrize("name", ["", "point_cloud.ply"])
def test_up_direction_can_be_set(fit, name):
    args = parsed(fit / name, "--up", "0", "-2", "0")
    model = model_of(args)
    start = view.start_of(args, model, view.cameras_of(args, model))
    assert np.array_equal(start.up, [0, -1, 0])
    right, down, forward = start.camera.camera_to_world[:3, :3].T
    assert abs(right @ start.up) < 1e-9 and down @ start.up < 0
    along = [str(-x) for x in forward]
    for up in (along, ["0", "0", "0"]):
        with pytest.raises(UserError, match="must not be zero or parallel to up"):
            view.start_of(parsed(fit / name, "--up", *up), model, view.cameras_of(args, model))


def test_missing_input_is_refused(fit, tmp_path):
    pytest.importorskip("viser", reason="viser is not installed (the extra viewer)")
    for what, message in (
        (tmp_path / "nothing", "there is no such file or folder"),
        (tmp_path, "must be the output folder of a fit that has ended"),
    ):
        assert_refused(view.main, what, folder=tmp_path, message=message)


def test_missing_extra_is_reported_with_what_to_install(fit, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    message = "drgs view: needs viser, which is not installed; pip install 'drgs[viewer]'"
    before = contents(fit)
    assert_refused(view.main, fit, folder=tmp_path, message=message)
    assert contents(fit) == before
