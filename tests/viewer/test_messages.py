"""Messages of browsers: invalid ones change nothing, and print nothing."""

import gc
import socket
import threading
import time
from contextlib import suppress
from types import SimpleNamespace

import pytest

pytest.importorskip("viser", reason="viser is not installed (the extra viewer)")

import msgspec
from support.hostile_client import CAMERA, CLICK, connect_to, hostile_messages, send_all
from support.small_fits import everything_of, make_trainer, true_dataset
from websockets.exceptions import ConnectionClosed, InvalidStatus, WebSocketException

from drgs.training.loop import History, StopCriterion, iterations
from drgs.viewer.server import (
    MAX_CONNECTIONS,
    MAX_MESSAGE_BYTES,
    accepts_value,
    is_valid,
    run_server,
)
from drgs.viewer.training_viewer import TrainingPage, watch

STOPPING = ("Pause", "End and write results")
"""Buttons that any client may press."""

NAN, INF = float("nan"), float("inf")


@pytest.fixture
def server():
    with run_server("127.0.0.1", None, ("", "")) as server:
        yield server


def harmless_uuids(server):
    controls = server.gui._gui_input_handle_from_uuid  # viser has no public list
    return [u for u, control in controls.items() if getattr(control, "label", "") not in STOPPING]


def wait_until(condition, seconds=10):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


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


@pytest.mark.slow
def test_flood_of_connections_leaves_room_for_files_and_clients(server, capfd):
    address = "127.0.0.1", server.get_port()
    flood = [socket.create_connection(address) for _ in range(3 * MAX_CONNECTIONS)]
    for connection in flood:
        connection.setblocking(False)
    wait_until(lambda: sum(map(is_closed, flood)) == 2 * MAX_CONNECTIONS)
    for connection in flood:
        connection.close()

    def is_served():
        with (
            suppress(OSError, EOFError, WebSocketException),
            connect_to(server.get_port()) as connection,
        ):
            return bool(connection.recv(timeout=5))

    wait_until(is_served)
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
    for _ in iterations(alone, History(), StopCriterion()):
        pass
    served, history, show = [], History(), TrainingPage.show
    monkeypatch.setattr(
        *(TrainingPage, "show"), lambda page, *frame: (served.append(frame), show(page, *frame))
    )
    watching, length = watch(server, watched, dataset, StopCriterion())
    uuids, is_over = harmless_uuids(server), threading.Event()

    def attack():
        seed = 0
        while not is_over.is_set():
            seed += 1
            send_all(server.get_port(), hostile_messages(seed, 100, uuids))

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
    assert len(served) >= 10
    expected, got = everything_of(alone), everything_of(watched)
    assert expected.keys() == got.keys()
    assert not [name for name, value in expected.items() if got[name] != value]
    gc.collect()
    assert capfd.readouterr() == ("", "")
