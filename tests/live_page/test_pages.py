"""Pages as viser serves them: what controls and cameras ask for, and messages that are invalid."""

import dataclasses
import gc
import socket
import threading
import time
import warnings
from contextlib import suppress
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed (the extra viewer)")

import msgspec
import viser
from scipy.spatial.transform import Rotation
from support.small_capture import FOCUS, RADIUS, make_dataset, pose_around
from support.small_fits import everything_of, make_trainer, plain_dataset, true_dataset
from viser import _messages
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException
from websockets.sync.client import connect

from drgs.config.approximations import DECLARED, Approximations
from drgs.fit.live_view import TrainingPage, watch
from drgs.fit.loop import History, HistoryRow, iterations, until_planned_end
from drgs.live_page.frames import FRAME_CONTENTS, VIEWER_LENSES
from drgs.live_page.page import ADJUSTABLE_APPROXIMATIONS, Page, StartView
from drgs.live_page.scheduler import RenderRequests
from drgs.live_page.server import (
    MAX_CONNECTIONS,
    MAX_MESSAGE_BYTES,
    accepts_value,
    free_port,
    is_same_origin,
    is_valid,
    run_server,
    url,
)


def connect_to(port, protocol=f"viser-v{viser.__version__}", **options):
    """Connect as a page does; what the server sends is kept, and need not be read."""
    settings = {"max_size": None, "max_queue": None, "compression": None, "proxy": None}
    address = f"ws://127.0.0.1:{port}"
    return connect(address, subprotocols=[protocol], **settings, **options)


FITTED = Approximations(low_pass=0.1, antialiased=True, extent=3.5)


@pytest.fixture
def server():
    with run_server("127.0.0.1", None, ("--address", "--port")) as server:
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


def test_page_of_another_origin_and_closed_browsers_get_nothing():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with run_server("127.0.0.1", None, ("", "")) as server:
            with connect_to(server.get_port(), origin=url(server)) as connection:
                assert connection.recv(timeout=5)
            with pytest.raises(InvalidStatus, match="403"):
                connect_to(server.get_port(), origin="https://elsewhere.org")
            server._websock_server._broadcast_buffer.set_done()  # viser's, as when it is closed
            server.gui.add_markdown("late")


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
    page.show_progress(trainer, history, 40)
    status, bar = page._status, page._bar  # private: viser has no public list of its texts
    assert "**12** of 40 iterations, 12.0 a second" in status.content
    assert "PSNR 21.00 dB" in status.content  # nine tenths of the past
    assert bar.value == 30
    for total in (39, 41, 30):  # charts whose axis is too long or too short are drawn anew
        page.show_progress(trainer, history, total)
    page.show_end(12)
    controls = controls_of(server)
    assert bar.value == 100 and controls["Pause"].disabled


CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": (1.0, 0.0, 0.0, 0.0),
    "position": (0.0, 0.0, -4.0),
    "fov": 1.0,
    "near": 0.01,
    "far": 100.0,
    "image_height": 64,
    "image_width": 64,
    "look_at": (0.0, 0.0, 0.0),
    "up_direction": (0.0, 0.0, 1.0),
}

CLICK = {
    "type": "SceneNodeClickMessage",
    "name": "/cameras/0",
    "instance_index": None,
    "ray_origin": (0.0, 0.0, 0.0),
    "ray_direction": (0.0, 0.0, 1.0),
    "screen_pos": (0.5, 0.5),
    "modifier": None,
    "owner": "",
}

VALUES = [
    *(None, True, False, "", "evil", "color", "\0", "x" * 10_000, b"\xff\xfe", [], {}, [[[]]]),
    *(0, -1, 1, 2**63, -(2**63), 1e9, -1e9, 1e308, 5e-324, 0.5),
    *(float("nan"), float("inf"), -float("inf")),
    *((0.0, 0.0, 0.0), (float("nan"),) * 3, (1e300,) * 3, (0.0,) * 4, (1e14,) * 3, (0.5, 0.5)),
    {"value": {"value": 1}},
]

PROPERTIES = ["value", "visible", "options", "update_cb", "removed", "props", "uuid", "nonsense"]

BROWSER_MESSAGES = [
    *("GuiButtonHoldMessage", "GuiFormSubmitMessage", "GuiFormDirtyMessage"),
    *("FileTransferStartUpload", "FileTransferPart", "CommandTriggerMessage"),
    *("ScenePointerMessage", "SceneNodeDragMessage", "GetRenderResponseMessage"),
    *("TransformControlsUpdateMessage", "TransformControlsDragStartMessage"),
    *("ShareUrlRequest", "ShareUrlDisconnect", "LocalStorageGetItemResponseMessage"),
]

MALFORMED = [
    *(b"", b"\0", b"\xc1", b"\x81", b"\x91" * 5000, b"\x81\xa1\x61" * 5000, "text", "", "{}"),
    *(msgspec.msgpack.encode(value) for value in VALUES),
    *(msgspec.msgpack.encode({"type": value}) for value in VALUES),
    msgspec.msgpack.encode({"type": "RunJavascriptMessage", "source": "alert(1)"}),
    msgspec.msgpack.encode({"type": "GuiUpdateMessage"}),
    msgspec.msgpack.encode([CAMERA, CAMERA]),
]


def hostile_messages(seed, count, uuids):
    """Yield messages; uuids: of the controls whose values are changed."""
    rng = np.random.default_rng(seed)

    def pick(values):
        return values[rng.integers(len(values))]

    for _ in range(count):
        kind = pick(["camera", "control", "control", "click", "other", "bytes", "malformed"])
        if kind == "bytes":
            yield rng.bytes(rng.integers(200))
        elif kind == "malformed":
            yield pick(MALFORMED)
        elif kind == "control":
            updates = {pick(PROPERTIES[: pick([1, 8])]): pick(VALUES) for _ in range(pick([1, 2]))}
            message = {"type": "GuiUpdateMessage", "uuid": pick([*uuids, "none"])}
            yield msgspec.msgpack.encode(message | {"updates": pick([updates, updates, *VALUES])})
        else:
            message = {"camera": CAMERA, "click": CLICK}.get(kind) or random_fields(pick, uuids)
            name = pick([*message, "unknown"])
            yield msgspec.msgpack.encode(message | {name: pick(VALUES)})


def random_fields(pick, uuids):
    """Return a message of a type that browsers send to viser, with arbitrary contents."""
    name = pick(BROWSER_MESSAGES)
    fields = dataclasses.fields(getattr(_messages, name))
    values = {field.name: pick([*VALUES, pick(uuids)]) for field in fields if field.init}
    return {"type": name} | values


def send_all(port, messages):
    """Send messages, over a new connection where the last one was closed."""
    connection = connect_to(port)
    for message in messages:
        try:
            connection.send(message)
        except ConnectionClosed:
            connection = connect_to(port)
            connection.send(msgspec.msgpack.encode(CAMERA))
            connection.send(message)
    connection.close()


STOPPING = ("Pause", "End and write results")
"""Buttons that any client may press."""

NAN, INF = float("nan"), float("inf")


@pytest.mark.parametrize(
    ("control", "accepted", "rejected"),
    [
        ({"value": "a", "options": ("a", "b")}, ["a", "b"], ["c", "", 0, True, NAN]),
        ({"value": 1.0, "min": 0.0, "max": 2.0}, [0, 2, 0.5], [-1, 2.1, NAN, INF, "1", True]),
        ({"value": 1.0, "min": 0.0, "max": None}, [1e9], [-1, NAN, INF]),
        ({"value": True}, [True, False], [1, 0.0, "True", "evil"]),
    ],
)
def test_control_accepts_only_offered_values(control, accepted, rejected):
    control = SimpleNamespace(**control)
    assert all(accepts_value(control, value) for value in accepted)
    assert not any(accepts_value(control, value) for value in rejected)


def test_camera_message_must_be_finite_with_a_direction():
    def valid(message, **changes):
        return is_valid(msgspec.msgpack.encode(message | changes), {}.get)

    assert valid(CAMERA) and valid(CLICK)
    assert valid(CAMERA, image_width=812.5, fov=1)  # JavaScript has one type of number
    for name in CAMERA:
        assert not valid(CAMERA, **{name: NAN})
        assert not valid(CAMERA, **{name: None})
    for wrong in ({"wxyz": (0.0,) * 4}, {"position": (0.0,) * 4}, {"position": (1e300, 0.0, 0.0)}):
        assert not valid(CAMERA, **wrong)
    assert not valid(CAMERA, image_height=-1) and not valid(CAMERA, image_width=2**40)
    assert not valid(CAMERA, type="ShareUrlRequest")


def test_pages_of_other_versions_and_oversized_messages_are_refused_silently(server, capfd):
    """An oversized message ends its connection only."""
    for protocol in ("viser-v0.0.1", "chat"):
        with pytest.raises(InvalidStatus, match="403"):
            connect_to(server.get_port(), protocol)
    with connect_to(server.get_port()) as connection, connect_to(server.get_port()) as other:
        connection.send(bytes(MAX_MESSAGE_BYTES + 1))
        with pytest.raises(ConnectionClosed):
            while True:
                connection.recv(timeout=5)
        assert other.recv(timeout=5)
    assert capfd.readouterr() == ("", "")


def is_closed(connection):
    """Whether the server has closed a connection to which it sends nothing."""
    try:
        return connection.recv(1) == b""
    except BlockingIOError:
        return False
    except ConnectionError:
        return True


def is_served(server):
    with suppress(OSError, EOFError, WebSocketException), connect_to(server.get_port()) as page:
        return bool(page.recv(timeout=5))


@pytest.mark.slow
def test_flood_of_connections_leaves_room_for_files_and_clients(server, capfd):
    address, deadline = ("127.0.0.1", server.get_port()), time.monotonic() + 20
    flood = [socket.create_connection(address) for _ in range(3 * MAX_CONNECTIONS)]
    for connection in flood:
        connection.setblocking(False)
    while sum(map(is_closed, flood)) != 2 * MAX_CONNECTIONS:
        assert time.monotonic() < deadline
        time.sleep(0.02)
    for connection in flood:
        connection.close()
    while not is_served(server):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    assert capfd.readouterr() == ("", "")


PATHS = [
    *("/../../../../../../etc/passwd", "/%2e%2e/%2e%2e/_viser.py", "/..%5c..%5c_viser.py"),
    *("//etc/passwd", "/C:/Windows/win.ini", "/C%3A/x", "/%00", "/x" * 3000, "/assets"),
]


@pytest.mark.parametrize(
    "request_bytes",
    [
        *(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n".encode() for path in PATHS),
        b"POST / HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nHost: elsewhere.org\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: [\r\n\r\n",
        b"GET / HTTP/1.1\r\nX: " + b"x" * 100_000 + b"\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: a\r\nUpgrade: b\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",  # TLS
        b"\0" * 100,
        b"",
    ],
)
def test_malformed_requests_get_no_page_and_no_file_and_print_nothing(server, request_bytes, capfd):
    address = "127.0.0.1", server.get_port()
    with socket.create_connection(address, timeout=5) as connection:
        connection.sendall(
            request_bytes.replace(b": 127.0.0.1\r", b": 127.0.0.1:%d\r" % address[1])
        )
        connection.shutdown(socket.SHUT_WR)
        answer = b""
        with suppress(ConnectionError):
            answer = connection.recv(100)
    assert not answer.startswith(b"HTTP/1.1 200")
    assert capfd.readouterr() == ("", "")


@pytest.mark.slow
def test_fit_with_hostile_clients_has_the_same_bytes(server, capfd, monkeypatch):
    settings = {"iterations": 40, "densify__start": 2, "densify__stop": 30, "densify__every": 5}
    dataset = true_dataset()
    alone, watched = (make_trainer(dataset, **settings) for _ in range(2))
    for _ in iterations(alone, History()):
        pass
    history, served = History(), Mock(wraps=TrainingPage.show)
    monkeypatch.setattr(TrainingPage, "show", lambda *arguments: served(*arguments))
    watching, length = watch(server, watched, dataset, until_planned_end)
    controls = server.gui._gui_input_handle_from_uuid  # viser has no public list
    harmless = [u for u, c in controls.items() if getattr(c, "label", "") not in STOPPING]
    is_over = threading.Event()

    def attack():
        seed = 0
        while not is_over.is_set():
            seed += 1
            send_all(server.get_port(), hostile_messages(seed, 100, harmless))

    attacker = threading.Thread(target=attack)
    attacker.start()
    try:
        with connect_to(server.get_port()) as honest:
            for done in iterations(watched, history, length):
                honest.send(msgspec.msgpack.encode(CAMERA))
                time.sleep(0.05)
                watching.after_iteration(watched, history, done, lambda: False)
    finally:
        is_over.set()
        attacker.join()
    assert served.call_count >= 10
    expected, got = everything_of(alone), everything_of(watched)
    assert expected.keys() == got.keys()
    assert not [name for name, value in expected.items() if got[name] != value]
    gc.collect()
    assert capfd.readouterr() == ("", "")
