"""The page of a fit that runs: how far it is, how good, and buttons to pause and to end it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from drgs.data.types import Dataset
from drgs.live.page import Page, StartView
from drgs.live.watching import UntilEnded, Watching
from drgs.live.wishes import Wishes
from drgs.training.history import History, HistoryRow
from drgs.training.loop import Length
from drgs.training.trainer import Trainer

if TYPE_CHECKING:
    import viser

MOST_POINTS = 300
"""Of a curve."""

STEP_BACK = 1.25
"""Distance of the first look, in that of a training camera: so that one sees where they stand."""

SMOOTHING = 0.9
"""Weight of the past in the PSNR of training views, each of which is another photograph."""

SERIES = (
    {"label": "iteration"},
    {"label": "training views", "stroke": "#7fb0ff", "width": 2},
    {"label": "test views", "stroke": "#f0937b", "width": 2, "points": {"show": True}},
)


class FitPage(Page):
    """See :class:`drgs.live.watching.FitScreen`."""

    def add_controls(self) -> None:
        """Progress, buttons and a curve."""
        gui = self.server.gui
        self._status = gui.add_markdown("The first iterations compile kernels …")
        self._bar = gui.add_progress_bar(0.0)
        self._pause = gui.add_button("Pause", icon="player-pause")
        self._end = gui.add_button("End and write results", icon="flag", color="gray")
        self._pause.on_click(self._toggle)
        self._end.on_click(self._ask_for_end)
        nothing = tuple(np.array([0.0, 1.0]) for _ in SERIES)
        self._curve = gui.add_uplot(
            nothing,
            SERIES,
            title="PSNR [dB]",
            aspect=1.7,
            visible=False,
            scales={"x": {"time": False}},
        )

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
        if len(history.rows) > 1:
            self._curve.data = curves_of(history.rows)
            self._curve.visible = True

    def tell_end(self, iterations: int) -> None:
        """See :class:`FitScreen`."""
        self._status.content = f"**{iterations:,} iterations are done;** results are being written."
        self._bar.value = 100.0
        self._pause.disabled = self._end.disabled = True

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
    server: viser.ViserServer, trainer: Trainer, dataset: Dataset, length: Length
) -> tuple[Watching, Length]:
    """Put a fit on the server's page; who serves that page, and how long the fit then is."""
    wishes, start = Wishes(), StartView.of(dataset.train).from_farther(STEP_BACK)
    length = UntilEnded(length, wishes)
    page = FitPage(server, wishes, start, trainer.config.model.approximations)
    page.add_cameras(dataset.train, visible=True)
    return Watching(wishes, page, dataset, length), length


def smoothed(values: Sequence[float]) -> np.ndarray:
    """Exponential mean of the past, (n,)."""
    result = np.array(values, np.float64)
    for i in range(1, len(result)):
        result[i] = SMOOTHING * result[i - 1] + (1 - SMOOTHING) * result[i]
    return result


def curves_of(rows: Sequence[HistoryRow]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Iterations, smooth PSNR of training views, and that of test views as last measured."""
    psnr, test, known = smoothed([row.psnr for row in rows]), np.full(len(rows), np.nan), np.nan
    for i, row in enumerate(rows):
        known = test[i] = known if row.test_psnr is None else row.test_psnr
    kept = np.unique(np.linspace(0, len(rows) - 1, min(MOST_POINTS, len(rows))).round().astype(int))
    return np.array([rows[i].iteration for i in kept], np.float64), psnr[kept], test[kept]
