"""The next image to render, and its size: by a clock that the tests set."""

from types import SimpleNamespace

import numpy as np
import pytest

from drgs.core.errors import UserError
from drgs.viewer import scheduler
from drgs.viewer.frames import FrameRequest, ViewerCamera, ViewerFrame
from drgs.viewer.scheduler import (
    MOVING_SECONDS,
    STILL_SECONDS,
    AdaptiveResolution,
    RenderRequests,
    RenderScheduler,
)

REQUEST = FrameRequest(ViewerCamera(np.eye(4), 40.0, 1.0), 800, 600)


class Clock(SimpleNamespace):
    """A clock that the test advances, seconds."""

    now = 100.0

    def monotonic(self):
        return self.now


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(scheduler, "time", clock)
    return clock


class Stage:
    """A scene that takes its time, and a screen that remembers what it was given."""

    def __init__(self, clock, seconds_a_pixel=0.0):
        self.clock, self.seconds_a_pixel = clock, seconds_a_pixel
        self.shown, self.refused = [], []

    def frame(self, request):
        if request.content == "nonsense":
            raise UserError("that cannot be seen")
        seconds = self.seconds_a_pixel * request.width * request.height
        self.clock.now += seconds
        return ViewerFrame(np.zeros((request.height, request.width, 3), np.uint8), seconds)

    def show(self, client, request, frame, is_whole):
        assert frame.pixels.shape == (request.height, request.width, 3)
        self.shown.append((client, request.width, is_whole))

    def refuse(self, client, reason):
        self.refused.append((client, reason))


def make(clock, seconds_a_pixel=0.0, refresh_after=None):
    stage, left = Stage(clock, seconds_a_pixel), RenderRequests()
    return stage, left, RenderScheduler(left, stage.show, stage.refuse, refresh_after)


def served(them, stage):
    return them.serve(lambda: stage)


def test_moving_camera_gets_small_images_and_static_one_full_size(clock):
    stage, left, them = make(clock)
    assert not served(them, stage)
    left.put(1, REQUEST)
    assert served(them, stage) and not served(them, stage)
    assert stage.shown == [(1, 400, False)]
    clock.now += STILL_SECONDS
    assert served(them, stage) and not served(them, stage)
    assert stage.shown[1:] == [(1, 800, True)]
    clock.now += 100
    assert not served(them, stage)  # nothing has changed


def test_images_of_a_moving_camera_meet_their_time_limit(clock):
    """At 1 microsecond a pixel the whole takes 0.48 s: a third of either side is in time."""
    stage, left, them = make(clock, 1e-6)
    for _ in range(8):
        left.put(1, REQUEST)
        assert served(them, stage)
    widths = [width for _, width, _ in stage.shown]
    assert widths == [400] + 7 * [267]
    assert 800 * 600 / 4 * 1e-6 > MOVING_SECONDS > 800 * 600 / 9 * 1e-6
    stage.seconds_a_pixel = 1e-8
    for _ in range(3):
        left.put(1, REQUEST)
        assert served(them, stage)
    assert [width for _, width, _ in stage.shown][-2:] == [400, 800]


def test_static_camera_gets_progressively_larger_images(clock):
    stage, left, them = make(clock, 3e-6)
    for _ in range(6):
        left.put(1, REQUEST)
        served(them, stage)
    assert stage.shown[-1] == (1, 133, False)  # a sixth
    clock.now += STILL_SECONDS
    assert served(them, stage) and stage.shown[-1] == (1, 267, False)
    left.put(1, REQUEST)
    assert served(them, stage) and stage.shown[-1] == (1, 133, False)
    clock.now += STILL_SECONDS
    assert served(them, stage) and served(them, stage) and not served(them, stage)
    assert [width for _, width, _ in stage.shown[-2:]] == [267, 800]


def test_small_windows_keep_a_minimum_resolution():
    resolution = AdaptiveResolution()
    for _ in range(9):
        resolution.update(1, 10.0)
    assert resolution.divisor(REQUEST) == 8
    assert resolution.divisor(FrameRequest(REQUEST.camera, 300, 130)) == 2
    assert resolution.divisor(FrameRequest(REQUEST.camera, 300, 20)) == 1


def test_changing_content_is_rendered_again_after_a_while(clock):
    stage, left, them = make(clock, 1e-6, lambda seconds: 10 * seconds)
    left.put(1, REQUEST)
    served(them, stage)
    clock.now += STILL_SECONDS
    served(them, stage)
    clock.now += 4.7  # of an image that took 0.48 s
    assert not served(them, stage)
    clock.now += 0.2
    assert served(them, stage)
    assert [whole for *_, whole in stage.shown] == [False, True, True]


def test_clients_are_served_in_turn_and_disconnected_ones_skipped(clock):
    stage, left, them = make(clock, 1e-7)
    for client in (3, 1, 2):
        left.put(client, REQUEST)
    assert all(served(them, stage) for _ in range(3))
    assert sorted(client for client, *_ in stage.shown) == [1, 2, 3]
    for client in (1, 2, 3):
        left.put(client, REQUEST)
    left.remove(2)
    assert served(them, stage) and served(them, stage) and not served(them, stage)
    assert sorted(client for client, *_ in stage.shown[3:]) == [1, 3]


def test_request_that_fails_is_reported_once(clock):
    stage, left, them = make(clock)
    left.put(1, FrameRequest(REQUEST.camera, 800, 600, content="nonsense"))
    assert served(them, stage)
    clock.now += 10
    assert not served(them, stage)
    assert stage.refused == [(1, "that cannot be seen")] and not stage.shown


def test_failing_request_is_reported_on_its_page_and_others_are_served(clock):
    """Mitsuba, for one, wraps what a plugin refuses as RuntimeError."""
    stage, left, them = make(clock)
    frame = stage.frame

    def fail(request):
        if request.width <= 3:
            raise RuntimeError("calibrated: fx must be positive\n  somewhere\nRuntimeError: here")
        return frame(request)

    stage.frame = fail
    left.put(1, FrameRequest(REQUEST.camera, 3, 3))
    left.put(2, REQUEST)
    assert served(them, stage) and served(them, stage) and not served(them, stage)
    assert stage.refused == [(1, "calibrated: fx must be positive here")]
    assert [client for client, *_ in stage.shown] == [2]
