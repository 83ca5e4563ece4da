"""A fit with a viewer: the same bytes, a pause, an early end; no browser is needed."""

import time
from unittest.mock import Mock

import numpy as np
import pytest
from support.small_capture import HEIGHT, WIDTH, pose_around
from support.small_fits import (
    disturbed_blobs,
    everything_of,
    make_trainer,
    plain_dataset,
    true_dataset,
)

from drgs.config.approximations import Approximations
from drgs.fit.live_view import TrainingViewer, unless_ended
from drgs.fit.loop import History, iterations, until_planned_end
from drgs.integrator.scene import make_scene, render_views
from drgs.live_page.frames import FRAME_CONTENTS, FrameRequest, ViewerCamera
from drgs.live_page.scheduler import RenderRequests
from drgs.training.trainer import Trainer

EYE = ViewerCamera(pose_around(0.4, 0.3), 40.0, 4.0)

EVERYTHING = {
    "iterations": 12,
    "model__smoothing": True,
    "model__sh_increase_every": 4,
    "cameras__optimise": True,
    "colors__lr": 0.02,
    "data__random_background": True,
    "loss__depth_weight": 0.1,
    "densify__start": 2,
    "densify__stop": 9,
    "densify__strategy": "adc",
    "densify__adc__grad_threshold": 1e-7,
    "densify__every": 2,
}
"""Settings of a fit with effects, density control and a growing SH degree."""


def run(trainer, queue=None, before=lambda _: None, stops=lambda: False, show=None):
    """A whole fit, watched if there is a queue; before: is called before its requests are served.

    Returns the screen, a mock, and the history. show: what the screen does with an image.
    """
    screen, length, history = Mock(progress=[]), until_planned_end, History()
    screen.show.side_effect = show
    screen.show_progress.side_effect = lambda trainer, _: screen.progress.append(
        (trainer.iteration, trainer.config.last_iteration)
    )
    if queue is not None:
        length = unless_ended(length, queue)
        watching = TrainingViewer(queue, screen)
    for done in iterations(trainer, history, length):
        if queue is not None:
            before(done.report.iteration)
            watching.after_iteration(done, stops)
    screen.refuse.assert_not_called()
    return screen, history


def frames_of(screen):
    return [call.args[2].pixels for call in screen.show.call_args_list]


def assert_told(screen, iterations, total):
    """The last progress, and the end."""
    assert screen.progress[-1] == (iterations, total)
    screen.show_end.assert_called_once_with(iterations)


def requests():
    """One for each iteration: everything that can be shown, through several lenses."""
    for k in range(100):
        eye = ViewerCamera(pose_around(0.1 * k, 0.3), 40.0, 4.0)
        lenses = {"lens": "fisheye"}, {"lens": "thin lens", "lens_parameters": {"aperture": 0.05}}
        lens = lenses[k % 2] if k % 3 == 2 else {}
        approximations = Approximations(order="pixel") if k % 4 == 3 else None
        content = list(FRAME_CONTENTS)[k % len(FRAME_CONTENTS)]
        yield FrameRequest(eye, 40, 30, content=content, approximations=approximations, **lens)


def assert_same_bytes(trainer, other):
    expected, got = everything_of(trainer), everything_of(other)
    assert expected.keys() == got.keys()
    assert not [name for name, value in expected.items() if got[name] != value]


@pytest.mark.slow
def test_fit_with_a_viewer_has_the_same_bytes():
    dataset, queue, asked = true_dataset(), RenderRequests(), requests()
    alone = make_trainer(dataset, **EVERYTHING)
    run(alone)
    watched = make_trainer(dataset, **EVERYTHING)
    screen, _ = run(watched, queue, lambda _: queue.put(1, next(asked)))
    assert len({frame.tobytes() for frame in frames_of(screen)}) >= 12
    assert alone.num_gaussians != disturbed_blobs().num_gaussians
    assert_same_bytes(alone, watched)


def test_viewer_shows_the_fit_after_the_current_iteration():
    dataset, queue, stale = plain_dataset(), RenderRequests(), []
    trainer, view = make_trainer(dataset, iterations=5), EYE.viewpoint(WIDTH, HEIGHT)

    def ask(iteration):
        stale.extend(render_views(trainer.scene, [view]))  # before the step's result is there
        queue.put(1, FrameRequest(EYE, WIDTH, HEIGHT))

    screen, _ = run(trainer, queue, ask)
    scene = make_scene(trainer.gaussians(), trainer.config.model, (1.0, 1.0, 1.0))
    (expected,) = render_views(scene, [view])
    assert np.array_equal(frames_of(screen)[-1], np.round(255 * expected))
    assert not np.array_equal(frames_of(screen)[-1], np.round(255 * stale[-1]))
    assert_told(screen, 5, 5)


@pytest.mark.slow
@pytest.mark.parametrize("end_at", [1, 8])
def test_fit_ended_early_equals_a_fit_of_fewer_iterations(end_at):
    """And its configuration, fitted again from the start, gives its bytes."""
    dataset, queue = true_dataset(), RenderRequests()
    trainer = make_trainer(dataset, **EVERYTHING)
    screen, history = run(trainer, queue, lambda iteration: iteration == end_at and queue.end())
    done = trainer.iteration
    # The request came when this iteration's end was already decided.
    assert done == end_at + 1 == trainer.config.last_iteration
    assert history.rows[-1].iteration == done
    assert_told(screen, done, done)
    again = Trainer(trainer.config, dataset, disturbed_blobs())
    run(again)
    assert_same_bytes(trainer, again)


@pytest.mark.slow
def test_pause_stops_fit_and_clock_and_serves_requests():
    dataset, queue, during = plain_dataset(), RenderRequests(), []
    trainer = make_trainer(dataset, iterations=4)

    def ask_for_more(*frame):
        """Asks for more, and then lets the fit go on."""
        during.append(trainer.iteration)
        time.sleep(0.1)
        if len(during) < 5:
            queue.put(1, FrameRequest(EYE, 8 + len(during), 8))
        else:
            queue.pause(False)

    def pause(iteration):
        if iteration == 2:
            queue.pause(True)
            queue.put(1, FrameRequest(EYE, 8, 8))

    start = time.perf_counter()
    screen, history = run(trainer, queue, pause, show=ask_for_more)
    assert history.wall_s < time.perf_counter() - start - 0.5  # in the pause
    assert during == [2] * 5
    assert [frame.shape[1] for frame in frames_of(screen)] == [8, 9, 10, 11, 12]
    assert trainer.iteration == 4


@pytest.mark.parametrize("ends", [False, True])
def test_ctrl_c_and_ending_early_work_during_a_pause(ends):
    """Ending before the start or after the end has no effect."""
    queue, trainer = RenderRequests(), make_trainer(plain_dataset(), iterations=3)
    queue.pause(True)
    if ends:
        queue.end()
        assert unless_ended(until_planned_end, queue)(trainer)  # nothing is fitted yet
    run(trainer, queue, stops=lambda: not ends)
    assert trainer.iteration == (1 if ends else 3)
    queue, trainer = RenderRequests(), make_trainer(plain_dataset(), iterations=3)
    run(trainer, queue, lambda iteration: iteration == 3 and queue.end())
    assert trainer.iteration == trainer.config.iterations == 3
