"""The next image to render, and its size: by a clock that the tests set."""

from dataclasses import replace
from types import SimpleNamespace
from unittest.mock import Mock

import numpy as np
import pytest

from drgs.core.errors import UserError
from drgs.live_page import scheduler
from drgs.live_page.frames import FrameRequest, ViewerCamera, ViewerFrame
from drgs.live_page.scheduler import MOVING_SECONDS, STILL_SECONDS, RenderRequests, RenderScheduler

REQUEST = FrameRequest(ViewerCamera(np.eye(4), 40.0, 1.0), 800, 600)


class Stage:
    """A scene that takes its time by a clock, and a screen that remembers what it was given."""

    def __init__(self, refresh_after):
        self.clock = SimpleNamespace(now=100.0, monotonic=lambda: self.clock.now)
        self.seconds_a_pixel, self.shown, self.refuse = 0.0, [], Mock()
        self.requests = RenderRequests()
        self._scheduler = RenderScheduler(self.requests, self.show, self.refuse, refresh_after)

    def frame(self, request):
        if request.content == "nonsense":
            raise UserError("that cannot be seen")
        if request.width <= 3:
            raise RuntimeError("calibrated: fx must be positive\n  somewhere\nRuntimeError: here")
        seconds = self.seconds_a_pixel * request.width * request.height
        self.clock.now += seconds
        return ViewerFrame(np.zeros((request.height, request.width, 3), np.uint8), seconds)

    def show(self, client, request, frame, is_whole):
        assert frame.pixels.shape == (request.height, request.width, 3)
        self.shown.append((client, request.width, is_whole))

    def serve(self):
        return self._scheduler.serve(lambda: self)

    def ask(self, *clients):
        for client in clients:
            self.requests.put(client, REQUEST)


@pytest.fixture
def stage(monkeypatch, request):
    """Parameter: seconds until an image is rendered again, of its own seconds; None: never."""
    stage = Stage(getattr(request, "param", None))
    monkeypatch.setattr(scheduler, "time", stage.clock)
    return stage


def test_moving_camera_gets_small_images_and_static_one_full_size(stage):
    assert not stage.serve()
    stage.ask(1)
    assert stage.serve() and not stage.serve()
    assert stage.shown == [(1, 400, False)]
    stage.clock.now += STILL_SECONDS
    assert stage.serve() and not stage.serve()
    assert stage.shown[1:] == [(1, 800, True)]
    stage.clock.now += 100
    assert not stage.serve()  # nothing has changed


def test_images_of_a_moving_camera_meet_their_time_limit(stage):
    """At 1 microsecond a pixel the whole takes 0.48 s: a third of either side is in time."""
    stage.seconds_a_pixel = 1e-6
    for _ in range(8):
        stage.ask(1)
        assert stage.serve()
    assert [width for _, width, _ in stage.shown] == [400] + 7 * [267]
    assert 800 * 600 / 4 * 1e-6 > MOVING_SECONDS > 800 * 600 / 9 * 1e-6
    stage.seconds_a_pixel = 1e-8
    for _ in range(2):
        stage.ask(1)
        assert stage.serve()
    assert [width for _, width, _ in stage.shown[-2:]] == [267, 800]


@pytest.mark.parametrize("stage", [lambda seconds: 10 * seconds], indirect=True)
def test_changing_content_is_rendered_again_after_a_while(stage):
    stage.seconds_a_pixel = 1e-6
    stage.ask(1)
    stage.serve()
    stage.clock.now += STILL_SECONDS
    stage.serve()
    stage.clock.now += 4.7  # of an image that took 0.48 s
    assert not stage.serve()
    stage.clock.now += 0.2
    assert stage.serve()
    assert [whole for *_, whole in stage.shown] == [False, True, True]


def test_clients_are_served_in_turn_and_disconnected_ones_skipped(stage):
    stage.ask(3, 1, 2)
    assert all(stage.serve() for _ in range(3))
    assert sorted(client for client, *_ in stage.shown) == [1, 2, 3]
    stage.ask(1, 2, 3)
    stage.requests.remove(2)
    assert stage.serve() and stage.serve() and not stage.serve()
    assert sorted(client for client, *_ in stage.shown[3:]) == [1, 3]


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"content": "nonsense"}, "that cannot be seen"),
        # Mitsuba, for one, wraps what a plugin refuses as RuntimeError.
        ({"width": 3, "height": 3}, "calibrated: fx must be positive here"),
    ],
)
def test_failing_request_is_reported_once_on_its_page_and_others_are_served(stage, changes, reason):
    stage.requests.put(1, replace(REQUEST, **changes))
    stage.ask(2)
    assert stage.serve() and stage.serve() and not stage.serve()
    stage.requests.remove(2)
    stage.clock.now += 10
    assert not stage.serve()
    stage.refuse.assert_called_once_with(1, reason)
    assert [client for client, *_ in stage.shown] == [2]
