"""``viewer.html`` in a real browser, by the DevTools protocol: from disk, with the network off.

Images are made by software, as test machines have no graphics card.
"""

import base64
import io
import json
import os
import queue
import shutil
import signal
import tempfile
import threading
import time
from contextlib import contextmanager
from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation
from support.small_capture import FOCUS, RADIUS, decibels, pose_around

from drgs.cameras.viewpoints import pinhole
from drgs.config.approximations import Approximations
from drgs.config.schema import ModelConfig
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, render_views
from drgs.results.html_viewer import DisplaySettings, InitialView, viewer_page

fcntl = pytest.importorskip("fcntl", reason="needs POSIX")

PROGRAM = next(
    filter(None, map(shutil.which, ("google-chrome", "chrome", "chromium", "chromium-browser"))),
    None,
)
"""Debian's package is ``chromium``; None: there is none."""

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(PROGRAM is None, reason="needs Chromium or Chrome"),
]

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

TIMEOUT_SECONDS, EXIT_SECONDS = 120.0, 5.0  # of an unresponsive browser, on a busy core


class Browser:
    """A process with one page, and a profile of its own that goes with it.

    It listens to a pipe (``--remote-debugging-pipe``): messages are JSON, each ended by a zero
    byte, on its file descriptors 3 and 4. options: of graphics, as SOFTWARE_WEBGL; width, height:
    px, one of the screen for each of the page.
    """

    def __init__(self, options, width, height):
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
        self._count, self._heard, self._events, self._session = 0, queue.SimpleQueue(), [], {}
        threading.Thread(target=self._listen, daemon=True).start()
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        self._session = {"sessionId": session}
        for domain in ("Page", "Runtime", "Network", "Log"):
            self.call(f"{domain}.enable")
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)

    def close(self):
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

    def call(self, method, **parameters):
        """The answer to a command; what happens until then is noted."""
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters, **self._session}
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while (heard := self._heard.get(timeout=TIMEOUT_SECONDS)).get("id") != self._count:
            self._events.append(heard)
        assert "error" not in heard, f"{method}: {heard['error']}"
        return heard["result"]

    def _listen(self):
        begun = b""
        while data := os.read(self._in, 1 << 20):
            *messages, begun = (begun + data).split(b"\0")
            for message in messages:
                self._heard.put(json.loads(message))
        os.close(self._in)

    def cut_off(self):
        """Turn its network off."""
        nothing = {"latency": 0, "downloadThroughput": 0, "uploadThroughput": 0}
        self.call("Network.emulateNetworkConditions", offline=True, **nothing)

    def open(self, address: str):
        self.call("Page.navigate", url=address)
        self.wait_for("!!document.body")

    def evaluate(self, expression: str):
        """A JavaScript expression's value, or what its promise becomes."""
        answer = self.call(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in answer, answer
        return answer["result"].get("value")

    def wait_for(self, expression: str):
        end = time.monotonic() + TIMEOUT_SECONDS
        while not self.evaluate(expression):
            assert time.monotonic() < end, f"{expression} is not true; {self.console_errors()}"
            time.sleep(0.05)

    def rendered(self):
        """(height, width, 3) display space, 0 to 1."""
        data = self.call("Page.captureScreenshot", format="png")["data"]
        with Image.open(io.BytesIO(base64.b64decode(data))) as image:
            return np.asarray(image.convert("RGB")) / 255

    def drag(self, start: tuple[int, int], end: tuple[int, int], steps: int = 10):
        """Drag the mouse with its left button; px."""
        held = {"button": "left", "clickCount": 1}
        self._mouse("mousePressed", *start, buttons=1, **held)
        for step in range(1, steps + 1):
            x, y = (a + (b - a) * step / steps for a, b in zip(start, end, strict=True))
            self._mouse("mouseMoved", x, y, buttons=1, button="left")
            self.evaluate("new Promise(requestAnimationFrame)")
        self._mouse("mouseReleased", *end, **held)

    def requests(self):
        """The addresses of all that it has asked for."""
        return [p["request"]["url"] for p in self._parameters("Network.requestWillBeSent")]

    def console_errors(self):
        """Exceptions, errors and warnings."""
        levels = ("assert", "error", "warning")
        entries = [p["entry"] for p in self._parameters("Log.entryAdded")]
        calls = self._parameters("Runtime.consoleAPICalled")
        return [
            *(str(p["exceptionDetails"]) for p in self._parameters("Runtime.exceptionThrown")),
            *(entry["text"] for entry in entries if entry["level"] in levels),
            *(str(p["args"]) for p in calls if p["type"] in levels),
        ]

    def _mouse(self, kind: str, x: float, y: float, **others: object):
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **others)

    def _parameters(self, method: str):
        self.evaluate("0")  # what came before is heard now
        return [event["params"] for event in self._events if event["method"] == method]


@contextmanager
def browser_page(width, height, options=SOFTWARE_WEBGL):
    """Yield a page of a new browser, without a window on the screen."""
    browser = Browser(options, width, height)
    try:
        yield browser
    finally:
        browser.close()


def _pipe():
    """Its ends, neither of which is a descriptor that the browser expects."""
    ends = []
    for end in os.pipe():
        ends.append(fcntl.fcntl(end, fcntl.F_DUPFD_CLOEXEC, 10))
        os.close(end)
    return tuple(ends)


WIDTH, HEIGHT = 240, 180
FIELD_OF_VIEW = 40.0  # degrees, horizontal
BACKGROUND = (0.15, 0.35, 0.6)
TITLE = "</title></script><script>window.intruder = 1</script> & Größe"
FITTED_WITH = {"low_pass": 0.1, "antialiased": True}

SIZES = {"desktop": (1280, 800), "phone": (390, 844)}

BUTTONS = """
[...document.querySelectorAll("button")].map((b) => b.getBoundingClientRect())
  .filter((r) => r.width && r.height).map((r) => [r.left, r.top, r.right, r.bottom])
"""
"""Left, top, right and bottom edge of each visible button, px."""

TURN = Rotation.from_euler("xyz", [40, -70, 25], degrees=True).as_matrix()
"""Rotation of the world, so that up is none of its axes."""

UP = TURN[:, 2]

CAMERA = "Array.from(viewer.app.root.findByName('camera').getWorldTransform().data)"
"""To the page's axes, by columns."""

ALIKE = 42.0
"""dB, at least: the browser's image against ours. Measured 45.9: what is left are whole numbers,
8 bits of opacities and of what is blended, steps of 1/32 of harmonics and of 8 % of scales."""

MAX_WRONG_PSNR_DB = 34.0
"""dB, at most: against our image with something left out. Measured 24 to 32."""


@pytest.fixture(scope="module")
def gaussians():
    """Splats below a pixel, which the low-pass decides, with strong harmonics of degree 3."""
    rng, count = np.random.default_rng(5), 20000
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    harmonics = [rng.normal(0, 0.8, (count, 1, 3)), rng.normal(0, 0.25, (count, 15, 3))]
    return Gaussians.from_numpy(
        means=TURN @ FOCUS + directions * rng.uniform(0.3, 1, (count, 1)),
        quats=rng.normal(size=(count, 4)),
        scales=np.exp(rng.normal(np.log(0.005), 0.6, (count, 3))),
        opacities=rng.uniform(0.3, 0.98, count),
        sh=np.concatenate(harmonics, axis=1),
    )


@pytest.fixture(scope="module")
def initial_view(gaussians):
    poses = [pose_around(azimuth, 0.4) for azimuth in np.arange(8) * np.pi / 4]
    turned = [np.block([[TURN @ pose[:3]], [pose[3:]]]) for pose in poses]
    cameras = [pinhole(f"{i}", pose, WIDTH, HEIGHT, FIELD_OF_VIEW) for i, pose in enumerate(turned)]
    return InitialView.from_views(cameras, gaussians)


@pytest.fixture(scope="module")
def path(tmp_path_factory, gaussians, initial_view):
    shown = DisplaySettings(gaussians, Approximations(**FITTED_WITH))
    path = tmp_path_factory.mktemp("viewer") / "a page & größe.html"
    path.write_bytes(viewer_page(TITLE, shown, initial_view, BACKGROUND))
    return path


@pytest.fixture(scope="module")
def page(path):
    with opened(path, "?noui") as page:
        yield page


@contextmanager
def opened(path, query="", size=(WIDTH, HEIGHT)):
    """The page with the network off."""
    with browser_page(*size) as page:
        page.cut_off()
        page.open(path.as_uri() + query)
        page.wait_for("window.viewer?.state.loaded")
        settle(page)
        yield page
        assert page.console_errors() == []
        own, *others = page.requests()
        assert own == path.as_uri() + query
        assert {address.partition(":")[0] for address in others} <= {"blob", "data"}


def settle(page):
    """Wait until the camera stands still, and what it sees is sorted and drawn."""
    before = None
    while before != (before := page.evaluate(CAMERA)):
        page.evaluate("new Promise((done) => setTimeout(done, 700))")


def ours(camera, gaussians, **model):
    mi.set_variant("llvm_ad_rgb")
    scene = make_scene(gaussians, ModelConfig(**{**FITTED_WITH, **model}), BACKGROUND)
    (image,) = render_views(scene, [camera])
    return image


def shown_camera(page, initial_view):
    """The page's camera in the world of the Gaussians."""
    in_page, move = np.reshape(page.evaluate(CAMERA), (4, 4)).T, initial_view.to_page
    pose = np.eye(4)
    pose[:3, :3] = move.rotation.T @ in_page[:3, :3] * [1, -1, -1]
    pose[:3, 3] = move.rotation.T @ (in_page[:3, 3] - move.translation) / move.scale
    return pinhole("shown", pose, WIDTH, HEIGHT, FIELD_OF_VIEW)


def assert_shown_as_fitted(rendered, camera, gaussians):
    """With harmonics, low-pass and compensation."""
    flat = replace(gaussians, shN=0 * gaussians.shN)
    left_out = {
        "harmonics": ours(camera, flat),
        "low-pass": ours(camera, gaussians, low_pass=0.0),
        "compensation": ours(camera, gaussians, antialiased=False),
    }
    assert decibels(rendered, ours(camera, gaussians)) >= ALIKE
    for name, image in left_out.items():
        assert decibels(rendered, image) <= MAX_WRONG_PSNR_DB, name


def test_first_view_is_the_training_camera(page, gaussians, initial_view):
    camera = shown_camera(page, initial_view)
    np.testing.assert_allclose(
        camera.camera_to_world, initial_view.camera.camera_to_world, atol=1e-5 * RADIUS
    )
    assert_shown_as_fitted(page.rendered(), initial_view.camera, gaussians)


def test_dragging_orbits_the_focus_at_the_same_height(page, gaussians, initial_view):
    before, first = shown_camera(page, initial_view), page.rendered()
    page.drag((30, 90), (210, 90))
    settle(page)
    after = shown_camera(page, initial_view)
    offsets = [camera.center - TURN @ FOCUS for camera in (before, after)]
    heights = [offset @ UP for offset in offsets]
    assert heights[0] == pytest.approx(heights[1], abs=1e-3 * RADIUS)
    assert [np.linalg.norm(offset) for offset in offsets] == pytest.approx([RADIUS] * 2, rel=1e-3)
    level = [offset - height * UP for offset, height in zip(offsets, heights, strict=True)]
    cosine = level[0] @ level[1] / np.prod(np.linalg.norm(level, axis=1))
    assert 15 < np.degrees(np.arccos(cosine)) < 90
    assert abs(after.camera_to_world[:3, 0] @ UP) < 1e-3  # upright
    assert decibels(first, page.rendered()) < MAX_WRONG_PSNR_DB
    assert_shown_as_fitted(page.rendered(), after, gaussians)


@pytest.mark.parametrize("size", SIZES)
def test_page_with_controls_fits_the_window_and_orbits(path, size):
    width, height = SIZES[size]
    with opened(path, size=(width, height)) as page:
        edges = np.array(page.evaluate(BUTTONS))
        assert len(edges) >= 7  # play, orbit, fly, settings, keys, about, full screen
        assert edges.min() >= 0 and (edges[:, 2:] <= [width, height]).all()
        before, middle = page.rendered(), (width // 2, height // 2)
        page.drag(middle, (middle[0] + 80, middle[1] + 20))
        settle(page)
        shown = np.s_[height // 3 : height // 2, width // 4 : 3 * width // 4]
        assert decibels(page.rendered()[shown], before[shown]) < MAX_WRONG_PSNR_DB


def test_page_without_webgl_explains_what_it_needs(path):
    with browser_page(WIDTH, HEIGHT, NO_WEBGL) as page:
        page.cut_off()
        page.open(path.as_uri())
        page.wait_for("document.querySelector('p.trouble') !== null")
        assert "WebGL 2" in page.evaluate("document.querySelector('p.trouble').textContent")
