"""The page of a fit that runs: how far it is, how good, and buttons to pause and to end it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from drgs.datasets.types import Dataset
from drgs.training.loop import History, HistoryRow, StopCriterion, smoothed
from drgs.training.trainer import Trainer
from drgs.viewer.page import Page, StartView
from drgs.viewer.requests import Wishes
from drgs.viewer.training_viewer import UntilEnded, Watching

if TYPE_CHECKING:
    import viser

MOST_POINTS = 300
"""Of a curve."""

ROOM = 1.1
"""Iterations that curves have room for, in those that are expected once this has changed."""

STEP_BACK = 1.25
"""Distance of the first look, in that of a training camera: so that one sees where they stand."""

Curve = tuple[np.ndarray, np.ndarray]
"""Iterations and values, each (n,)."""

CURVES = {
    "training views": {"stroke": "#7fb0ff", "width": 2, "points": {"show": False}},
    "test views": {"stroke": "#f0937b", "width": 2, "points": {"show": True}},
}
"""By title: how the line is drawn."""


class FitPage(Page):
    """See :class:`drgs.viewer.training_viewer.FitScreen`."""

    def add_controls(self) -> None:
        """Progress, buttons and a curve."""
        gui = self.server.gui
        self._status = gui.add_markdown("The first iterations compile kernels …")
        self._bar = gui.add_progress_bar(0.0)
        self._pause = gui.add_button("Pause", icon="player-pause")
        self._end = gui.add_button("End and write results", icon="flag", color="gray")
        self._pause.on_click(self._toggle)
        self._end.on_click(self._ask_for_end)
        self._charts: list[viser.GuiUplotHandle] = []
        self._room = 0  # iterations that they have room for
        self._folder = gui.add_folder("PSNR [dB]")

    def tell(self, trainer: Trainer, history: History, total: int) -> None:
        """See :class:`FitScreen`."""
        last, done = history.rows[-1], trainer.iteration
        psnr = smoothed([row.psnr for row in history.rows])
        self._status.content = (
            f"**{done:,}** of {total:,} iterations, {last.iteration / max(last.wall_s, 1e-9):.1f} "
            f"a second\n\nPSNR {psnr[-1]:.2f} dB of training views, "
            f"{trainer.num_gaussians:,} Gaussians"
        )
        self._bar.value = min(100.0, 100.0 * done / max(total, 1))
        curves = curves_of(history.rows)
        if not self._room / ROOM**2 <= total <= self._room:
            # What a plan revises, twice a second perhaps, does not redraw them each time.
            self._room = round(ROOM * total) if self._charts else total
            self._draw(curves)
        for chart, curve in zip(self._charts, curves, strict=True):
            chart.data, chart.visible = curve, len(curve[0]) > 0

    def tell_end(self, iterations: int) -> None:
        """See :class:`FitScreen`."""
        self._status.content = f"**{iterations:,} iterations are done;** results are being written."
        self._bar.value = 100.0
        self._pause.disabled = self._end.disabled = True

    def _draw(self, curves: list[Curve]) -> None:
        """Charts for so many iterations: viser's own range follows what was shown, not the data.

        Nor does it know gaps, with which both lines would go into one chart.
        """
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

    async def _toggle(self, event: object) -> None:
        del event
        paused = not self.wishes.paused
        self.wishes.pause(paused)
        self._pause.label = "Go on" if paused else "Pause"
        self._pause.icon = "player-play" if paused else "player-pause"

    async def _ask_for_end(self, event: viser.GuiEvent) -> None:
        gui = event.client.gui
        with gui.add_modal("End the fit here?") as modal:
            gui.add_markdown("The results are those of a fit of as many iterations as are done.")
            end = gui.add_button("End it", color="red")
            stay = gui.add_button("Go on", color="gray")

        @end.on_click
        async def _(event: object) -> None:
            del event
            modal.close()
            self._pause.disabled = self._end.disabled = True
            self.wishes.end()

        @stay.on_click
        async def _(event: object) -> None:
            del event
            modal.close()


def watch(
    server: viser.ViserServer, trainer: Trainer, dataset: Dataset, criterion: StopCriterion
) -> tuple[Watching, StopCriterion]:
    """Put a fit on the server's page; return who serves that page, and when the fit then ends."""
    wishes, start = Wishes(), StartView.of(dataset.train).from_farther(STEP_BACK)
    criterion = UntilEnded(criterion, wishes)
    page = FitPage(server, wishes, start, trainer.config.model.approximations)
    page.add_cameras(dataset.train, visible=True)
    return Watching(wishes, page, dataset, criterion), criterion


def curves_of(rows: Sequence[HistoryRow]) -> list[Curve]:
    """PSNR of training views, smooth, and of test views, where it was measured."""
    kept = np.unique(np.linspace(0, len(rows) - 1, min(MOST_POINTS, len(rows))).round().astype(int))
    iterations = np.array([row.iteration for row in rows], np.float64)
    measured = [(row.iteration, row.test_psnr) for row in rows if row.test_psnr is not None]
    of_test = np.array(measured, np.float64).reshape(-1, 2).T
    of_training = smoothed([row.psnr for row in rows])
    return [(iterations[kept], of_training[kept]), (of_test[0], of_test[1])]
