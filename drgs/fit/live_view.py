"""A page of a running fit: frames, progress, pause and end, between two iterations.

Rendering for clients does not affect the fit: its bytes are the same with and without a viewer.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import drjit as dr
import numpy as np
from typing_extensions import override

from drgs.fit.loop import Continues, History, Iteration, Observer, exponential_mean
from drgs.live_page.frames import LiveScene
from drgs.live_page.page import Page, StartView, event_handler
from drgs.live_page.scheduler import RenderRequests, RenderScheduler
from drgs.results.history import HistoryRow
from drgs.training.trainer import Trainer

if TYPE_CHECKING:
    import viser
    from viser import uplot

REFRESH_SECONDS = 1.0  # minimum time between two frames of a still camera
REFRESH_SHARE = 0.05  # maximum share of the time for frames of a still camera
PROGRESS_SECONDS = 0.5  # minimum time between two updates of the progress
WAIT_SECONDS = 0.1  # response time to Ctrl-C in a pause
MAX_POINTS = 300  # points of a curve
CURVE_ROOM = 1.1
"""Length of the curves' axis in expected iterations, when these have changed."""

START_DISTANCE_FACTOR = 1.25  # moves back until the training cameras are visible

Curve = tuple[np.ndarray, np.ndarray]  # iterations (n,), values (n,)

CURVES: dict[str, uplot.Series] = {
    "training views": {"stroke": "#7fb0ff", "width": 2, "points": {"show": False}},
    "test views": {"stroke": "#f0937b", "width": 2, "points": {"show": True}},
}  # by title


def unless_ended(continues: Continues, requests: RenderRequests) -> Continues:
    """Also end a fit where a viewer client has asked for it."""
    return lambda trainer: not (requests.ended and trainer.iteration > 0) and continues(trainer)


class TrainingViewer(Observer):
    """Serves viewer clients during a fit: see :class:`drgs.fit.loop.Observer`."""

    def __init__(self, requests: RenderRequests, page: TrainingPage) -> None:
        self._requests, self._page = requests, page
        self._scheduler = RenderScheduler(
            requests, page.show, page.refuse, lambda s: max(REFRESH_SECONDS, s / REFRESH_SHARE)
        )
        self._scene: LiveScene | None = None
        self._progress_at = 0.0  # by time.monotonic
        self._fit_s = 0.0  # seconds that the fit's own kernels took here

    @override
    def after_iteration(self, done: Iteration, stops: Callable[[], bool]) -> None:
        """Render due frames, and wait while the fit is paused; its clock stops meanwhile."""
        trainer, history = done.trainer, done.history
        start, self._fit_s = time.perf_counter(), 0.0
        now = time.monotonic()
        is_due = self._requests.pending and now - self._progress_at >= PROGRESS_SECONDS
        if history.rows and (is_due or done.is_last):
            self._progress_at = now
            self._page.show_progress(trainer, history)
        self._serve(trainer)
        while self._requests.paused and not (self._requests.ended or done.is_last or stops()):
            if not self._serve(trainer):
                self._requests.wait(WAIT_SECONDS)
        self._scene = None  # frees its copy of the Gaussians
        history.leave_out(time.perf_counter() - start - self._fit_s)
        if done.is_last:
            self._page.show_end(trainer.iteration)

    def _serve(self, trainer: Trainer) -> bool:
        return self._scheduler.serve(lambda: self._live_scene(trainer))

    def _live_scene(self, trainer: Trainer) -> LiveScene:
        if self._scene is None:
            start = time.perf_counter()
            dr.sync_thread()  # the iteration's kernels may still be running
            self._fit_s += time.perf_counter() - start
            trainer.sync_scene()
            gaussians = dr.detach(trainer.integrator.gaussians)
            model, degree = trainer.config.model, trainer.sh_degree
            background = trainer.dataset.background
            self._scene = LiveScene(gaussians, model, background, sh_degree=degree)
        return self._scene


class TrainingPage(Page):
    """The page of a fit."""

    @override
    def add_controls(self) -> None:
        from viser import Icon

        gui = self.server.gui
        self._icons = {True: Icon.PLAYER_PLAY, False: Icon.PLAYER_PAUSE}  # by "is paused"
        self._status = gui.add_markdown("The first iterations compile kernels …")
        self._bar = gui.add_progress_bar(0.0)
        self._pause = gui.add_button("Pause", icon=self._icons[False])
        self._end = gui.add_button("End and write results", icon=Icon.FLAG, color="gray")
        self._pause.on_click(event_handler(self._toggle_pause))
        self._end.on_click(self._confirm_end)
        self._charts: list[viser.GuiUplotHandle] = []
        self._room = 0  # range of their x axis, iterations
        self._folder = gui.add_folder("PSNR [dB]")

    def show_progress(self, trainer: Trainer, history: History) -> None:
        """Show the progress without synchronizing."""
        last, done = history.rows[-1], trainer.iteration
        total = max(done, trainer.config.last_iteration)  # a clock may end the fit later
        psnr = exponential_mean([row.psnr for row in history.rows])
        self._status.content = (
            f"**{done:,}** of {total:,} iterations, {last.iteration / max(last.wall_s, 1e-9):.1f} "
            f"a second\n\nPSNR {psnr[-1]:.2f} dB of training views, "
            f"{trainer.num_gaussians:,} Gaussians"
        )
        self._bar.value = min(100.0, 100.0 * done / max(total, 1))
        curves = psnr_curves(history.rows)
        if total > self._room:
            self._room = round(CURVE_ROOM * total) if self._charts else total
            self._draw(curves)
        for chart, curve in zip(self._charts, curves, strict=True):
            chart.data, chart.visible = curve, len(curve[0]) > 0

    def show_end(self, iterations: int) -> None:
        """Show that the iterations are done and results are being written."""
        self._status.content = f"**{iterations:,} iterations are done;** results are being written."
        self._bar.value = 100.0
        self._pause.disabled = self._end.disabled = True

    def _draw(self, curves: list[Curve]) -> None:
        """Redraw the charts with a range of our own: viser's follows earlier data."""
        for chart in self._charts:
            chart.remove()
        with self._folder:
            self._charts = [
                self.server.gui.add_uplot(
                    curve,
                    ({"label": "iteration"}, {"label": "dB", **line}),
                    title=title,
                    aspect=2.4,
                    visible=len(curve[0]) > 0,
                    scales={"x": {"time": False, "range": (0, self._room)}},
                    legend={"show": False},
                )
                for (title, line), curve in zip(CURVES.items(), curves, strict=True)
            ]

    def _toggle_pause(self) -> None:
        paused = not self.requests.paused
        self.requests.pause(paused)
        self._pause.label = "Continue" if paused else "Pause"
        self._pause.icon = self._icons[paused]

    async def _confirm_end(self, event: viser.GuiEvent[viser.GuiButtonHandle]) -> None:
        assert event.client is not None, "a client has clicked"
        gui = event.client.gui
        with gui.add_modal("End the fit here?") as modal:
            gui.add_markdown("The results are those of a fit with the iterations so far.")
            end = gui.add_button("End", color="red")
            stay = gui.add_button("Continue", color="gray")
        for button in (end, stay):
            button.on_click(event_handler(modal.close))
        end.on_click(event_handler(self._end_fit))

    def _end_fit(self) -> None:
        self._pause.disabled = self._end.disabled = True
        self.requests.end()


def watch(
    server: viser.ViserServer, trainer: Trainer, continues: Continues
) -> tuple[TrainingViewer, Continues]:
    """Show a fit on the server's page; return the observer that serves it, and its end."""
    requests, train = RenderRequests(), trainer.dataset.train
    start = StartView.from_views(train).move_back(START_DISTANCE_FACTOR)
    page = TrainingPage(server, requests, start, trainer.config.model.approximations)
    page.add_cameras(train, visible=True)
    return TrainingViewer(requests, page), unless_ended(continues, requests)


def psnr_curves(rows: Sequence[HistoryRow]) -> list[Curve]:
    """Return the smoothed PSNR of training views, and the measured one of test views."""
    kept = np.unique(np.linspace(0, len(rows) - 1, min(MAX_POINTS, len(rows))).round().astype(int))
    iterations = np.array([row.iteration for row in rows], np.float64)
    training = exponential_mean([row.psnr for row in rows])
    measured = [(row.iteration, row.test_psnr) for row in rows if row.test_psnr is not None]
    test = np.array(measured, np.float64).reshape(-1, 2).T
    return [(iterations[kept], training[kept]), (test[0], test[1])]
