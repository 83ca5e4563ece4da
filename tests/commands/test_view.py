"""``drgs view``: what it shows, and what it refuses."""

import shutil
import sys

import numpy as np
import pytest
import yaml
from support.commands import assert_refused
from support.small_capture import FOCUS, RADIUS, make_dataset

import drgs
from drgs.cli.commands import CommandParser
from drgs.core.errors import UserError
from drgs.effects.cameras import REFINED_CAMERAS
from drgs.live_page.page import StartView
from drgs.results.folder import VIEWS
from drgs.results.model import load_model
from drgs.results.refined_cameras import write_views
from drgs.view import __main__ as view


def opened(*arguments):
    """Return the parsed arguments, their model and its cameras."""
    parser = CommandParser()
    view.add_arguments(parser)
    args = parser.parse_args([str(argument) for argument in arguments])
    model = load_model(args.what, background=view.background_of(args))
    return args, model, view.cameras_of(args, model)


@pytest.mark.parametrize("refined", [False, True])
def test_fit_is_viewed_from_its_training_cameras(fit, tmp_path, refined):
    """Refined cameras are used, where the fit has refined them."""
    run = shutil.copytree(fit, tmp_path / "run")
    with (run / "config.yml").open("a") as file:
        yaml.safe_dump({"cameras": {"optimise": refined}}, file)
    few, others = make_dataset(train=3), make_dataset(train=5)
    write_views(run / VIEWS, few)
    write_views(run / REFINED_CAMERAS, others)
    _, model, cameras = opened(run)
    assert model.background == (1.0, 1.0, 1.0)  # of its configuration
    for camera, expected in zip(cameras, (others if refined else few).train, strict=True):
        assert np.allclose(camera.camera_to_world, expected.camera_to_world)


def test_single_file_is_viewed_as_a_whole(fit):
    _, model, (camera,) = opened(fit / "point_cloud.ply", "--background", 0.5, 0.25, 0)
    assert model.background == (0.5, 0.25, 0.0)
    middle = camera.K @ (camera.viewmat @ [*FOCUS, 1])[:3]
    assert np.abs(middle[:2] / middle[2] - 200).max() < 60  # px of 400
    assert 0.3 * RADIUS < np.linalg.norm(camera.center - FOCUS) < 2 * RADIUS
    middle = np.median(model.gaussians.numpy().means, axis=0)
    distance = StartView.from_views([camera], middle).camera.distance
    assert distance == pytest.approx(np.linalg.norm(camera.center - middle), rel=0.2)


def test_without_a_model_the_shipped_truck_is_viewed():
    args, model, (camera,) = opened()
    assert args.what == drgs.EXAMPLE and model.background == (1.0, 1.0, 1.0)
    assert model.gaussians.num_gaussians > 10_000
    assert 1 < np.linalg.norm(camera.center) < 10


@pytest.mark.parametrize("name", ["", "point_cloud.ply"])
def test_up_direction_can_be_set(fit, name):
    args, model, cameras = opened(fit / name, "--up", 0, -2, 0)
    start = view.start_of(args, model, cameras)
    assert np.array_equal(start.up, [0, -1, 0])
    right, down, forward = start.camera.camera_to_world[:3, :3].T
    assert abs(right @ start.up) < 1e-9 and down @ start.up < 0
    for up in (-forward, (0, 0, 0)):
        args.up = up
        with pytest.raises(UserError, match="must not be zero or parallel to up"):
            view.start_of(args, model, cameras)


def test_missing_input_and_extra_are_reported(fit, tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="viser is not installed (the extra viewer)")
    for path, message in (
        (tmp_path / "nothing", "there is no such file or folder"),
        (tmp_path, "must be the output folder of a fit that has ended"),
    ):
        assert_refused(view.main, path, folder=tmp_path, message=message)
    monkeypatch.setitem(sys.modules, "viser", None)
    message = "drgs view: needs viser, which is not installed; pip install 'drgs[viewer]'"
    assert_refused(view.main, fit, folder=fit, message=message)
