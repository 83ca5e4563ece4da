"""Chromium without a window, by the DevTools protocol: pages, a mouse, and what went wrong.

It listens to a pipe (``--remote-debugging-pipe``): messages are JSON, each ended by a zero byte, on
file descriptors 3 and 4 of the browser. Images are made by software, as test machines have no
graphics card.
"""

from __future__ import annotations

import base64
import fcntl
import io
import json
import os
import queue
import shutil
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from PIL import Image

PROGRAM = next(
    filter(None, map(shutil.which, ("google-chrome", "chrome", "chromium", "chromium-browser"))),
    None,
)
"""Debian's package is ``chromium``; None: there is none."""

OPTIONS = (
    "--headless=new",
    "--no-sandbox",  # which containers do not allow
    "--remote-debugging-pipe",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-dev-shm-usage",
    "--disable-extensions",
)

SOFTWARE_WEBGL = ("--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader")
NO_WEBGL = ("--disable-gpu", "--disable-software-rasterizer", "--disable-3d-apis")

TIMEOUT_SECONDS = 120.0
"""Timeout of an unresponsive browser, seconds, on one of two busy cores."""

EXIT_SECONDS = 5.0


class Browser:
    """A process, with a profile of its own that goes with it."""

    def __init__(self, *options: str) -> None:
        """options: of graphics, as SOFTWARE_WEBGL."""
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        theirs_in, self._out = _pipe()
        self._in, theirs_out = _pipe()
        arguments = [PROGRAM, *OPTIONS, *options, f"--user-data-dir={self._profile.name}"]
        silence = [(os.POSIX_SPAWN_OPEN, n, os.devnull, os.O_WRONLY, 0) for n in (1, 2)]
        ends = [(os.POSIX_SPAWN_DUP2, theirs_in, 3), (os.POSIX_SPAWN_DUP2, theirs_out, 4)]
        self._process = os.posix_spawn(
            PROGRAM, arguments, os.environ, file_actions=[*silence, *ends], setpgroup=0
        )
        os.close(theirs_in)
        os.close(theirs_out)
        self._count, self._heard = 0, queue.SimpleQueue()
        self.events: list[dict] = []
        threading.Thread(target=self._listen, daemon=True).start()

    def close(self) -> None:
        """End the browser's own process group: nothing else."""
        os.killpg(self._process, signal.SIGTERM)
        end = time.monotonic() + EXIT_SECONDS
        while os.waitpid(self._process, os.WNOHANG) == (0, 0):
            if time.monotonic() > end:
                os.killpg(self._process, signal.SIGKILL)
                os.waitpid(self._process, 0)
                break
            time.sleep(0.05)
        os.close(self._out)
        self._profile.cleanup()

    def call(self, method: str, session: str | None = None, **parameters: object) -> dict:
        """The answer to a command; what happens until then is added to ``events``."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if session is not None:
            message["sessionId"] = session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while (heard := self._heard.get(timeout=TIMEOUT_SECONDS)).get("id") != self._count:
            self.events.append(heard)
        assert "error" not in heard, f"{method}: {heard['error']}"
        return heard["result"]

    def _listen(self) -> None:
        begun = b""
        while data := os.read(self._in, 1 << 20):
            *messages, begun = (begun + data).split(b"\0")
            for message in messages:
                self._heard.put(json.loads(message))
        os.close(self._in)


class Page:
    """A window of a browser; width, height: px, one of the screen for each of the page."""

    def __init__(self, browser: Browser, width: int, height: int) -> None:
        self._browser = browser
        target = browser.call("Target.createTarget", url="about:blank")["targetId"]
        answer = browser.call("Target.attachToTarget", targetId=target, flatten=True)
        self._session = answer["sessionId"]
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def call(self, method: str, **parameters: object) -> dict:
        return self._browser.call(method, self._session, **parameters)

    def cut_off(self) -> None:
        """Turn its network off."""
        nothing = {"latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
        self.call("Network.emulateNetworkConditions", offline=True, **nothing)

    def open(self, address: str) -> None:
        self.call("Page.navigate", url=address)
        self.wait_for("!!document.body")

    def evaluate(self, expression: str) -> object:
        """A JavaScript expression's value, or what its promise becomes."""
        answer = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait_for(self, expression: str) -> None:
        end = time.monotonic() + TIMEOUT_SECONDS
        while not self.evaluate(expression):
            assert time.monotonic() < end, f"{expression} is not true; {self.console_errors()}"
            time.sleep(0.05)

    def rendered(self) -> np.ndarray:
        """(height, width, 3) display space, 0 to 1."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            return np.asarray(image.convert("RGB")) / 255

    def drag(self, start: tuple[int, int], end: tuple[int, int], steps: int = 10) -> None:
        """Drag the mouse with its left button; px."""
        held = {"button": "left", "clickCount": 1}
        self._mouse("mousePressed", *start, buttons=1, **held)
        for step in range(1, steps + 1):
            x, y = (a + (b - a) * step / steps for a, b in zip(start, end, strict=True))
            self._mouse("mouseMoved", x, y, buttons=1, button="left")
            self.evaluate("new Promise(requestAnimationFrame)")
        self._mouse("mouseReleased", *end, **held)

    def requests(self) -> list[str]:
        """The addresses of all that it has asked for."""
        return [p["request"]["url"] for p in self._events("Network.requestWillBeSent")]

    def console_errors(self) -> list[str]:
        """Exceptions, errors and warnings."""
        levels = ("assert", "error", "warning")
        entries = [p["entry"] for p in self._events("Log.entryAdded")]
        calls = self._events("Runtime.consoleAPICalled")
        return [
            *(str(p["exceptionDetails"]) for p in self._events("Runtime.exceptionThrown")),
            *(entry["text"] for entry in entries if entry["level"] in levels),
            *(str(p["args"]) for p in calls if p["type"] in levels),
        ]

    def _mouse(self, kind: str, x: float, y: float, **others: object) -> None:
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **others)

    def _events(self, method: str) -> list[dict]:
        self.evaluate("0")  # what came before is heard now
        events = self._browser.events
        mine = (event for event in events if event.get("sessionId") == self._session)
        return [event["params"] for event in mine if event["method"] == method]


@contextmanager
def browser_page(width: int, height: int, options=SOFTWARE_WEBGL) -> Iterator[Page]:
    """Yield a page of a new browser."""
    browser = Browser(*options)
    try:
        yield Page(browser, width, height)
    finally:
        browser.close()


def _pipe() -> tuple[int, int]:
    """Its ends, neither of which is a descriptor that the browser expects."""
    ends = []
    for end in os.pipe():
        ends.append(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10))
        os.close(end)
    return tuple(ends)
