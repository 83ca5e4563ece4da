"""Messages of viser's protocol that no page sends, and some that one sends."""

import dataclasses
from collections.abc import Iterable, Iterator

import msgspec
import numpy as np
import viser
from viser import _messages
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import ClientConnection, connect

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


def hostile_messages(seed: int, count: int, uuids: list[str]) -> Iterator[bytes | str]:
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


def random_fields(pick, uuids: list[str]) -> dict[str, object]:
    """Return a message of a type that browsers send to viser, with arbitrary contents."""
    name = pick(BROWSER_MESSAGES)
    fields = dataclasses.fields(getattr(_messages, name))
    values = {field.name: pick([*VALUES, pick(uuids)]) for field in fields if field.init}
    return {"type": name} | values


def connect_to(
    port: int, protocol: str = f"viser-v{viser.__version__}", **options
) -> ClientConnection:
    """Connect as a page does; what the server sends is kept, and need not be read."""
    settings = {"max_size": None, "max_queue": None, "compression": None, "proxy": None}
    address = f"ws://127.0.0.1:{port}"
    return connect(address, subprotocols=[protocol], **settings, **options)


def send_all(port: int, messages: Iterable[bytes | str]) -> None:
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
