"""Pages as viser serves them, without a browser: what controls and cameras ask for."""

import warnings
from dataclasses import replace
from importlib.metadata import version
from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed (the extra viewer)")

from support.small_capture import FOCUS, RADIUS, make_dataset, pose_around
from support.small_fits import make_trainer, plain_dataset
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from drgs.config.approximations import DECLARED, Approximations
from drgs.training.loop import History, HistoryRow
from drgs.viewer.frames import FRAME_CONTENTS, VIEWER_LENSES, ViewerFrame
from drgs.viewer.page import ADJUSTABLE_APPROXIMATIONS, Page, StartView
from drgs.viewer.scheduler import RenderRequests
from drgs.viewer.server import free_port, is_same_origin, run_server, url
from drgs.viewer.training_viewer import MAX_POINTS, TrainingPage, psnr_curves

FITTED = Approximations(low_pass=0.1, antialiased=True, extent=3.5)


@pytest.fixture(scope="module", autouse=True)
def variant():
    mi.set_variant("llvm_ad_rgb")


@pytest.fixture
def server():
    with run_server("127.0.0.1", None, ("--address", "--port")) as server:
        yield server


@pytest.fixture
def page(server):
    return Page(server, RenderRequests(), StartView.from_views(make_dataset().train), FITTED)


def client(width=1600, height=900, pose=None):
    """A browser's camera, as viser tells it."""
    pose = pose_around(0.7, 0.2) if pose is None else pose
    half_angle = np.arccos((np.trace(pose[:3, :3]) - 1) / 2) / 2
    axis = np.array([pose[2, 1] - pose[1, 2], pose[0, 2] - pose[2, 0], pose[1, 0] - pose[0, 1]])
    axis *= np.sin(half_angle) / np.linalg.norm(axis)
    camera = SimpleNamespace(
        wxyz=np.array([np.cos(half_angle), *axis]),  # by the rotation's angle and axis
        position=pose[:3, 3],
        look_at=pose[:3, 3] + 2.5 * pose[:3, 2],
        fov=np.radians(50),
        image_width=width,
        image_height=height,
    )
    return SimpleNamespace(client_id=7, camera=camera)


def pending_request(page, **camera):
    page.controls._angle.value = 50
    page._follow(client(**camera))
    return page.requests.pending[7].request


def test_start_view_is_the_first_training_camera_at_the_common_focus():
    views = make_dataset().train
    start = StartView.from_views(views)
    assert start.camera.camera_to_world is views[0].camera_to_world
    assert start.camera.distance == pytest.approx(RADIUS)
    assert start.up == pytest.approx([0, 0, 1], abs=1e-9)
    seen = start.camera.viewpoint(32, 24)
    assert pytest.approx(views[0].K) == seen.K
    farther = start.move_back(1.5).camera
    pose = farther.camera_to_world
    assert farther.distance == pytest.approx(1.5 * RADIUS)
    assert pose[:3, 3] + farther.distance * pose[:3, 2] == pytest.approx(FOCUS)
    alone = StartView.from_views(views[:1])  # a camera alone looks at nothing
    assert alone.camera.distance > 0


def test_browser_camera_becomes_a_request(page):
    request = pending_request(page)
    assert request.camera.camera_to_world == pytest.approx(pose_around(0.7, 0.2))
    assert request.camera.fov == pytest.approx(50) and request.camera.distance == pytest.approx(2.5)
    assert (request.width, request.height) == (1280, 720)  # of 1600 x 900, at most 1280
    assert request.content == "color" and request.lens == "pinhole"
    assert request.approximations == FITTED
    request = pending_request(page, width=300, height=200)
    assert (request.width, request.height) == (300, 200)


def test_every_control_is_in_the_request(page):
    controls = page.controls
    controls._content.value, controls._side.value = "depth", "640"
    request = pending_request(page)
    assert request.content == "depth" and (request.width, request.height) == (640, 360)
    controls._lens_sliders["k1"].value = -0.2
    lenses = {
        "opencv": {"k1": -0.2, "k2": 0.0},
        "fisheye": {"k1": -0.2, "k2": 0.0},
        "orthographic": {},
        "thin lens": {"aperture": 0.03, "focus": 1.0},
        "pinhole": {},
    }
    assert lenses.keys() == VIEWER_LENSES.keys()
    for name, numbers in lenses.items():
        controls._lens.value = name
        request = pending_request(page)
        assert (request.lens, request.lens_parameters) == (name, numbers)
        assert request.camera.fov == pytest.approx(90 if name == "fisheye" else 50)
    for name in ADJUSTABLE_APPROXIMATIONS:
        declared, value = DECLARED[name], getattr(FITTED, name)
        other = not value if declared.kind is bool else 2
        other = next((word for word in declared.words if word != value), other)
        other = 0.5 if name in ("alpha_cut", "transmittance_stop") else other
        controls._values[name].value = other
        assert getattr(pending_request(page).approximations, name) == other, name
    assert pending_request(page).approximations.extent == 3.5  # has no control


def test_frame_times_are_compared_with_the_fitted_settings(page):
    page._texts[7] = SimpleNamespace(content="")
    switched = Approximations(order="pixel")
    frames = [
        ViewerFrame(np.zeros((2, 2, 3), np.uint8), s, note) for s, note in ((0.02, ""), (0.05, "x"))
    ]
    request = pending_request(page)
    other = replace(request, approximations=switched)
    assert page._describe(7, request, frames[0]) == "**20 ms** for 1280×720"
    assert page._describe(7, other, frames[1]).startswith("**50 ms** for 1280×720; as fitted 20 ms")
    assert page._describe(7, other, frames[1]).endswith("\n\nx")
    elsewhere = replace(other, camera=replace(other.camera, camera_to_world=pose_around(0.1, 0.1)))
    for changed in (replace(other, width=640), replace(other, content="depth"), elsewhere):
        assert "as fitted" not in page._describe(7, changed, frames[1])


def test_number_beyond_its_limits_is_reported_and_not_rendered(page):
    page._texts[7] = SimpleNamespace(content="")
    page.controls._values["alpha_cut"].value = 1.0
    page._follow(client())
    assert "alpha_cut must be from 0 to below 1" in page._texts[7].content
    assert not page.requests.pending


def test_server_uses_the_printed_address_and_prints_nothing(server, capfd):
    assert url(server) == f"http://127.0.0.1:{server.get_port()}"
    second = free_port("127.0.0.1", None, ("", ""))
    assert second != server.get_port()
    with run_server("127.0.0.1", None, ("", "")) as other:
        assert other.get_port() == second
        assert other.request_share_url() is None
    assert capfd.readouterr().out == ""


@pytest.mark.parametrize(
    ("host", "origin", "address", "expected"),
    [
        ("127.0.0.1:8080", None, "127.0.0.1", True),
        ("localhost:8080", "http://localhost:8080", "127.0.0.1", True),  # as through a tunnel
        ("[::1]:8080", "http://[::1]:8080", "::1", True),
        ("127.0.0.1:8080", "https://elsewhere.org", "127.0.0.1", False),
        ("127.0.0.1:8080", "http://127.0.0.1:9000", "127.0.0.1", False),
        ("127.0.0.1:8080", "null", "127.0.0.1", False),
        ("elsewhere.org:8080", "http://elsewhere.org:8080", "127.0.0.1", False),  # leads here
        ("machine:8080", "http://machine:8080", "0.0.0.0", True),
        ("machine:8080", "http://elsewhere.org", "0.0.0.0", False),
    ],
)
def test_only_same_origin_requests_are_served(host, origin, address, expected):
    headers = {"Host": host} | ({} if origin is None else {"Origin": origin})
    assert is_same_origin(headers, address) == expected


def test_page_of_another_origin_cannot_connect(server):
    protocol, place = f"viser-v{version('viser')}", f"ws://127.0.0.1:{server.get_port()}"
    with connect(place, subprotocols=[protocol], origin=url(server)) as connection:
        assert connection.recv(timeout=5)
    with pytest.raises(InvalidStatus, match="403"):
        connect(place, subprotocols=[protocol], origin="https://elsewhere.org")


def test_images_for_a_closed_browser_give_no_warning():
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        with run_server("127.0.0.1", None, ("", "")) as server:
            server._websock_server._broadcast_buffer.set_done()
            server.gui.add_markdown("late")
    assert not said


def test_the_page_of_a_fit_follows_its_history(server):
    dataset = plain_dataset()
    trainer = make_trainer(dataset, iterations=40)
    page = TrainingPage(server, RenderRequests(), StartView.from_views(dataset.train), FITTED)
    page.add_cameras(dataset.train, visible=True)
    assert len(page._frustums) == len(dataset.train)
    trainer.iteration = 12
    history = History()
    history.rows += [
        HistoryRow(10, 0.1, 20.0, 25, 1e-3, 0.5),
        HistoryRow(12, 0.1, 30.0, 25, 1e-3, 1.0),
    ]
    page.show_progress(trainer, history, 40)
    assert "**12** of 40 iterations, 12.0 a second" in page._status.content
    assert "PSNR 21.00 dB" in page._status.content  # nine tenths of the past
    assert page._bar.value == 30
    charts, drawn = page._charts, []
    for total in (39, 41, 42, 43, 40, 30):  # revised: now and then there are others
        page.show_progress(trainer, history, total)
        drawn.append(page._charts is not charts)
        charts = page._charts
        assert total <= page._room < 1.3 * total
    assert drawn == [False, True, False, False, False, True]
    page.show_end(12)
    assert page._pause.disabled and page._end.disabled


def test_curves_have_few_points_including_ends_and_measurements():
    rows = [
        HistoryRow(k, 0.1, 20.0, 25, 1e-3, 0.1, 25.0 if k % 400 == 0 else None)
        for k in range(1, 1001)
    ]
    (x, y), (at, test) = psnr_curves(rows)
    assert len(x) == MAX_POINTS and x[0] == 1 and x[-1] == 1000
    assert y == pytest.approx(20)
    step = [replace(row, psnr=30.0 if row.iteration > 1 else 20.0) for row in rows[:20]]
    assert psnr_curves(step)[0][1] == pytest.approx(30 - 10 * 0.9 ** np.arange(20))
    assert list(at) == [400, 800] and list(test) == [25, 25]
    assert [len(curve[0]) for curve in psnr_curves(rows[:3])] == [3, 0]


def test_every_content_is_offered(page):
    assert tuple(page.controls._content.options) == tuple(FRAME_CONTENTS)
