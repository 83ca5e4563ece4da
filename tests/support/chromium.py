"""A headless Chromium with software WebGL, driven through its DevTools protocol.

https://chromedevtools.github.io/devtools-protocol; what carries it is the package ``websockets``.
"""

from __future__ import annotations

import base64
import io
import itertools
import json
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from urllib.request import urlopen

import imageio.v3 as iio
import numpy as np
import pytest

NAMES = ("chromium", "chromium-browser", "google-chrome")

FLAGS = (
    *("--headless=new", "--no-sandbox", "--remote-debugging-port=0", "--no-first-run"),
    *("--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--hide-scrollbars"),
    *("--disable-background-networking", "--disable-component-update", "--disable-extensions"),
)

SECONDS = 60
"""That anything may take."""


def browser() -> str:
    """The program; the test is skipped where there is none, or no way to talk to it."""
    pytest.importorskip("websockets")
    found = next((path for path in map(shutil.which, NAMES) if path), None)
    if found is None:
        pytest.skip(f"there is no browser: {', '.join(NAMES)}")
    return found


class Chromium:
    """A context manager: one page of a browser of its own."""

    def __init__(self, width: int, height: int) -> None:
        """px, of the window's contents."""
        self._size = width, height
        self._program = browser()
        self._ids = itertools.count(1)
        self.errors: list[str] = []  # of the console, and exceptions
        self.requests: list[str] = []  # addresses that were asked for

    def __enter__(self) -> Chromium:
        from websockets.sync.client import connect

        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        folder = self._profile.name
        self._process = subprocess.Popen(
            [self._program, *FLAGS, f"--user-data-dir={folder}", "about:blank"],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        port_file = Path(folder, "DevToolsActivePort")
        wait_until(lambda: port_file.is_file() and port_file.read_text().count("\n"))
        port = port_file.read_text().split()[0]
        wait_until(lambda: self._pages(port))
        address = self._pages(port)[0]["webSocketDebuggerUrl"]
        self._socket = connect(address, max_size=None, open_timeout=SECONDS)
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")
        self.resize(*self._size)
        return self

    def __exit__(self, *error: object) -> None:
        self._socket.close()
        self._process.terminate()
        self._process.wait(SECONDS)
        self._profile.cleanup()

    def call(self, method: str, **params: object) -> dict:
        """A command's result; events that come meanwhile are noted."""
        number = next(self._ids)
        self._socket.send(json.dumps({"id": number, "method": method, "params": params}))
        while True:
            message = json.loads(self._socket.recv(SECONDS))
            if message.get("id") == number:
                assert "error" not in message, message["error"]
                return message["result"]
            self._note(message)

    def resize(self, width: int, height: int) -> None:
        """px, of the page."""
        self.call(
            "Emulation.setDeviceMetricsOverride",
            **{"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False},
        )

    def open(self, address: str) -> None:
        """Go to a page, and wait until it is there."""
        self._is_loaded = False
        self.call("Page.navigate", url=address)
        while not self._is_loaded:
            self._note(json.loads(self._socket.recv(SECONDS)))

    def evaluate(self, expression: str) -> object:
        """What an expression of JavaScript is."""
        answer = self.call("Runtime.evaluate", expression=expression, returnByValue=True)
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait_for(self, expression: str) -> None:
        """Until an expression of JavaScript is true."""
        wait_until(lambda: self.evaluate(expression), expression)

    def click(self, words: str) -> None:
        """The button with these words, at its middle."""
        button = (
            f"[...document.querySelectorAll('button')].find(b => b.innerText.trim() == {words!r})"
        )
        self.wait_for(f"!!{button}")
        x, y = self.evaluate(
            f"(() => {{ const b = {button}; b.scrollIntoView({{block: 'center'}}); "
            "const r = b.getBoundingClientRect(); "
            "return [r.x + r.width / 2, r.y + r.height / 2] })()"
        )
        for kind in ("mousePressed", "mouseReleased"):
            self._mouse(kind, x, y)

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 8) -> None:
        """With the left button, px."""
        self._mouse("mousePressed", *start)
        for share in np.linspace(0, 1, steps + 1)[1:]:
            x, y = ((1 - share) * a + share * b for a, b in zip(start, end, strict=True))
            self._mouse("mouseMoved", x, y)
            time.sleep(0.03)
        self._mouse("mouseReleased", *end)

    def picture(self) -> np.ndarray:
        """(H, W, 3) uint8: the page as it is seen."""
        data = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return iio.imread(io.BytesIO(data))[:, :, :3]

    def _mouse(self, kind: str, x: float, y: float) -> None:
        moved = kind == "mouseMoved"
        self.call(
            "Input.dispatchMouseEvent",
            **{"type": kind, "x": x, "y": y, "button": "left", "buttons": 1},
            **({} if moved else {"clickCount": 1}),
        )

    def _note(self, message: dict) -> None:
        method, params = message.get("method"), message.get("params", {})
        if method == "Page.loadEventFired":
            self._is_loaded = True
        elif method == "Runtime.exceptionThrown":
            self.errors.append(str(params["exceptionDetails"]))
        elif method == "Runtime.consoleAPICalled" and params["type"] == "error":
            self.errors.append(str(params["args"]))
        elif method == "Log.entryAdded" and params["entry"]["level"] == "error":
            self.errors.append(str(params["entry"]))
        elif method == "Network.requestWillBeSent":
            self.requests.append(params["request"]["url"])

    @staticmethod
    def _pages(port: str) -> list[dict]:
        with urlopen(f"http://127.0.0.1:{port}/json/list", timeout=SECONDS) as answer:
            return [page for page in json.load(answer) if page["type"] == "page"]


def wait_until(happens, what: object = "") -> None:
    """Ask until it is true; fails after :data:`SECONDS`."""
    end = time.monotonic() + SECONDS
    while not happens():
        assert time.monotonic() < end, f"did not happen: {what}"
        time.sleep(0.1)
