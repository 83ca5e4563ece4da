"""Pages as viser serves them: what controls and cameras ask for."""

import logging
import socket
import warnings
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed (the extra viewer)")

import viser
from scipy.spatial.transform import Rotation
from support.small_capture import FOCUS, RADIUS, make_dataset, pose_around
from support.small_fits import make_trainer, plain_dataset
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from drgs.config.approximations import DECLARED, Approximations
from drgs.config.changes import with_changes
from drgs.core.errors import UserError
from drgs.fit.live_view import TrainingPage
from drgs.fit.loop import History, HistoryRow
from drgs.live_page.frames import FRAME_CONTENTS, VIEWER_LENSES
from drgs.live_page.page import ADJUSTABLE_APPROXIMATIONS, Page, StartView
from drgs.live_page.scheduler import RenderRequests
from drgs.live_page.server import run_server, url

FITTED = Approximations(low_pass=0.1, antialiased=True, extent=3.5)


@pytest.fixture
def server():
    with run_server(None, "--port") as server:
        yield server


@pytest.fixture
def page(server):
    return Page(server, RenderRequests(), StartView.from_views(make_dataset().train), FITTED)


def controls_of(server):
    """Controls by their labels."""
    handles = server.gui._gui_input_handle_from_uuid.values()  # viser has no public list
    return {handle.label: handle for handle in handles if hasattr(handle, "label")}


def browser_camera(width=1600, height=900):
    """A browser's camera, as viser tells it."""
    pose = pose_around(0.7, 0.2)
    return SimpleNamespace(
        wxyz=Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True),
        position=pose[:3, 3],
        look_at=pose[:3, 3] + 2.5 * pose[:3, 2],
        fov=np.radians(50),
        image_width=width,
        image_height=height,
    )


def requested(page, **size):
    return page.controls.request(browser_camera(**size))


def test_start_view_is_the_first_training_camera_at_the_common_focus():
    views = make_dataset().train
    start = StartView.from_views(views)
    assert start.camera.camera_to_world is views[0].camera_to_world
    assert start.camera.distance == pytest.approx(RADIUS)
    assert start.up == pytest.approx([0, 0, 1], abs=1e-9)
    assert pytest.approx(views[0].K) == start.camera.viewpoint(32, 24).K
    farther = start.move_back(1.5).camera
    pose = farther.camera_to_world
    assert farther.distance == pytest.approx(1.5 * RADIUS)
    assert pose[:3, 3] + farther.distance * pose[:3, 2] == pytest.approx(FOCUS)
    alone = StartView.from_views(views[:1])  # a camera alone looks at nothing
    assert alone.camera.distance > 0


def test_browser_camera_becomes_a_request(page):
    request = requested(page)
    assert request.camera.camera_to_world == pytest.approx(pose_around(0.7, 0.2))
    assert request.camera.fov == pytest.approx(50) and request.camera.distance == pytest.approx(2.5)
    assert (request.width, request.height) == (1280, 720)  # of 1600 x 900, at most 1280
    assert request.content == "color" and request.lens == "pinhole"
    assert request.approximations == FITTED
    request = requested(page, width=300, height=200)
    assert (request.width, request.height) == (300, 200)
    page.refuse(-1, "of a client that has left: nothing to show")


def test_every_control_is_in_the_request(page, server):
    controls = controls_of(server)
    assert tuple(controls["Show"].options) == tuple(FRAME_CONTENTS)
    controls["Show"].value, controls["Size"].value = "depth", "640"
    request = requested(page)
    assert request.content == "depth" and (request.width, request.height) == (640, 360)
    controls["Angle of view"].value = 30
    assert page.controls.fov(browser_camera()) == pytest.approx(np.radians(30))
    controls["k1"].value = -0.2
    lenses = {
        "opencv": {"k1": -0.2, "k2": 0.0},
        "fisheye": {"k1": -0.2, "k2": 0.0},
        "orthographic": {},
        "thin lens": {"aperture": 0.03, "focus": 1.0},
        "pinhole": {},
    }
    assert lenses.keys() == VIEWER_LENSES.keys()
    for name, numbers in lenses.items():
        controls["Lens"].value = name
        request = requested(page)
        assert (request.lens, request.lens_parameters) == (name, numbers)
        assert request.camera.fov == pytest.approx(90 if name == "fisheye" else 50)
    for name in ADJUSTABLE_APPROXIMATIONS:
        declared, value = DECLARED[name], getattr(FITTED, name)
        other = not value if declared.kind is bool else 2
        other = next((word for word in declared.words if word != value), other)
        other = 0.5 if name in ("alpha_cut", "transmittance_stop") else other
        controls[name].value = other
        assert getattr(requested(page).approximations, name) == other, name
    assert requested(page).approximations.extent == 3.5  # has no control


def test_number_beyond_its_limits_is_reported_and_not_rendered(page, server, monkeypatch):
    client = Mock(client_id=7, camera=browser_camera())
    monkeypatch.setattr(page.server, "get_clients", lambda: {7: client})
    page._texts[7] = text = Mock()  # private: only a browser has one
    controls_of(server)["alpha_cut"].value = 1.0
    page.update()
    assert "alpha_cut must be from 0 to below 1" in text.content
    assert not page.requests.pending


def test_server_listens_on_this_machine_only_and_prints_nothing(server, capfd):
    assert url(server) == f"http://127.0.0.1:{server.get_port()}"
    with run_server(None, "--port") as other:
        assert other.get_port() > server.get_port()
        assert other.request_share_url() is None
    with pytest.raises(UserError, match="cannot listen at 127"):
        run_server(server.get_port(), "--port").__enter__()
    assert capfd.readouterr() == ("", "")


def test_pages_and_browsers_that_leave_are_served_silently(capfd):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with run_server(None, "--port") as server:
            address = f"ws://127.0.0.1:{server.get_port()}"
            with connect(address, subprotocols=[f"viser-v{viser.__version__}"]) as connection:
                assert connection.recv(timeout=5)
            socket.create_connection(("127.0.0.1", server.get_port())).close()
            server._websock_server._broadcast_buffer.set_done()  # viser's, as when it is closed
            server.gui.add_markdown("late")
    assert capfd.readouterr() == ("", "")


def test_the_page_of_a_fit_follows_its_history(server):
    dataset = plain_dataset()
    trainer = make_trainer(dataset, iterations=40)
    page = TrainingPage(server, RenderRequests(), StartView.from_views(dataset.train), FITTED)
    page.add_cameras(dataset.train, visible=True)
    trainer.iteration = 12
    history = History()
    history.rows += [
        HistoryRow(10, 0.1, 20.0, 25, 1e-3, 0.5),
        HistoryRow(12, 0.1, 30.0, 25, 1e-3, 1.0),
    ]
    trainer.config = with_changes(trainer.config, {"stop_after": 40})
    page.show_progress(trainer, history)
    status, bar = page._status, page._bar  # private: viser has no public list of its texts
    assert "**12** of 40 iterations, 12.0 a second" in status.content
    assert "PSNR 21.00 dB" in status.content  # nine tenths of the past
    assert bar.value == 30
    trainer.config = with_changes(trainer.config, {"stop_after": 41})
    page.show_progress(trainer, history)  # charts whose axis is too short are drawn anew
    page.show_end(12)
    controls = controls_of(server)
    assert bar.value == 100 and controls["Pause"].disabled


REQUESTS = {
    "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}": 200,
    "GET / HTTP/1.1\r\nHost: localhost:81": 200,  # through a tunnel
    "GET / HTTP/1.1\r\nHost: [::1": 400,
    "GET / HTTP/1.1\r\nHost: a b": 400,
    "GET / HTTP/1.1\r\nHost: evil.example": 400,
    "GET / HTTP/1.1\r\nHost: 127.0.0.1.evil.example:{port}": 400,
    "GET / HTTP/1.1\r\nHost: 127.0.0.1:{port}\r\nHost: localhost": 400,
    "GET / HTTP/1.1": 400,
    f"GET /{'a' * 5000} HTTP/1.1\r\nHost: 127.0.0.1:{{port}}": 400,
    "GET /../a HTTP/1.1\r\nHost: 127.0.0.1:{port}": 404,
}


@pytest.mark.parametrize("request_", REQUESTS, ids=lambda text: text[:60])
def test_requests_that_no_browser_makes_are_refused(server, request_):
    head = request_.format(port=server.get_port()) + "\r\nConnection: close\r\n\r\n"
    with socket.create_connection(("127.0.0.1", server.get_port()), timeout=10) as client:
        client.sendall(head.encode())
        answer = client.recv(1000)
    assert answer.startswith(f"HTTP/1.1 {REQUESTS[request_]} ".encode()), answer


def test_a_page_is_not_connected_to_under_another_name(server):
    """A page of another site may have a name that leads to this machine."""
    options = {"subprotocols": [f"viser-v{viser.__version__}"], "proxy": None}
    connect(f"ws://127.0.0.1:{server.get_port()}", **options).close()
    with pytest.raises(InvalidStatus, match="HTTP 400"):
        connect(
            "ws://evil.example",
            sock=socket.create_connection(("127.0.0.1", server.get_port())),
            **options,
        )


def test_lost_connections_do_not_fill_the_terminal(server, caplog):
    """asyncio has no handler of its own: each write to a lost connection would be a line."""
    asyncio_log = logging.getLogger("asyncio")
    asyncio_log.warning("socket.send() raised exception.")
    assert not caplog.records and not asyncio_log.isEnabledFor(logging.ERROR)
