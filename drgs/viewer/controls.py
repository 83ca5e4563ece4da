"""The controls of a page that say what is looked at, and through what."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from drgs.config.approximations import DECLARED, Approximations, Value
from drgs.viewer.frames import SHOWN
from drgs.viewer.optics import FisheyeLens, OpenCVLens, Optics, Orthographic, Pinhole, ThinLens

if TYPE_CHECKING:
    import viser

SWITCHED = (
    *("projection", "order", "order_window", "sh_direction"),
    *("alpha_cut", "transmittance_stop", "low_pass", "antialiased"),
)
"""The approximations that have a control: ``extent`` may be infinite, for which fields of numbers
have no word, and ``alpha_max`` is a part of the model rather than of how it is approximated."""

LENSES = {
    "pinhole": (),
    "opencv": ("k1", "k2"),
    "fisheye": ("angle", "k1", "k2"),
    "orthographic": (),
    "thin lens": ("aperture", "focus"),
}
"""By name: the numbers that each lens has."""

SLIDERS = {
    "angle": (30.0, 220.0, 1.0, 90.0),
    "k1": (-0.5, 0.5, 0.01, 0.0),
    "k2": (-0.5, 0.5, 0.01, 0.0),
    "aperture": (0.0, 0.2, 0.002, 0.03),
    "focus": (0.3, 3.0, 0.01, 1.0),
}
"""By name: least, largest, step and first value. Degrees; OpenCV's coefficients; the rest in units
of the distance to what the camera turns about."""

MAX_SIDES = ("640", "960", "1280", "1920")
FIRST_SIDE = "1280"
"""px: of the longer side of a picture."""


MAX_NUMBER = 100.0
"""The largest value of an approximation without an upper limit: of ``low_pass``, a standard
deviation of 10 px. With more, each splat soon covers the whole film, for which memory runs out."""


@dataclass(frozen=True)
class Looking:
    """What the controls say."""

    shows: str
    optics: Optics
    fisheye_angle: float | None  # degrees, vertical; None: the eye's field of view
    approximations: Approximations
    max_side: int  # px


class LookControls:
    """Controls in viser's panel; ``changed`` is called, by a thread of the server, when one is."""

    def __init__(
        self, gui: viser.GuiApi, fitted: Approximations, changed: Callable[[], None]
    ) -> None:
        """fitted: the approximations that the Gaussians were fitted with."""
        self._gui, self._fitted, self._changed = gui, fitted, changed
        self._shows = self._told(gui.add_dropdown("Show", tuple(SHOWN)))
        self._side = self._told(gui.add_dropdown("Size", MAX_SIDES, initial_value=FIRST_SIDE))
        self._lens = self._told(gui.add_dropdown("Lens", tuple(LENSES)))
        self._numbers = {
            name: self._told(gui.add_slider(name, low, high, step, first, visible=False))
            for name, (low, high, step, first) in SLIDERS.items()
        }
        self._lens.on_update(self._show_numbers)
        with gui.add_folder("Accuracy", expand_by_default=False):
            self._values = {name: self._told(self._control(name)) for name in SWITCHED}
            gui.add_button("As fitted").on_click(self._reset)

    @property
    def keeps_lines(self) -> bool:
        """Whether lines that the browser draws, a pinhole's, lie on what is rendered."""
        return self._lens.value in ("pinhole", "thin lens")

    @property
    def looking(self) -> Looking:
        """What the controls say now.

        Raises ValueError for an approximation outside of its limits.
        """
        values = {name: DECLARED[name].kind(c.value) for name, c in self._values.items()}
        others = {name: getattr(self._fitted, name) for name in DECLARED if name not in values}
        lens = self._lens.value
        numbers = {name: float(self._numbers[name].value) for name in LENSES[lens]}
        angle = numbers.pop("angle", None)
        return Looking(
            shows=self._shows.value,
            optics=_optics(lens, numbers),
            fisheye_angle=angle,
            approximations=Approximations(**others, **values),
            max_side=int(self._side.value),
        )

    def _control(self, name: str) -> Any:
        """One of viser's inputs for an approximation."""
        declared, gui, value = DECLARED[name], self._gui, getattr(self._fitted, name)
        if declared.words:
            return gui.add_dropdown(
                name, declared.words, initial_value=value, hint=declared.description
            )
        if declared.kind is bool:
            return gui.add_checkbox(name, value, hint=declared.description)
        limits = declared.limits
        step = 1 if declared.kind is int else 1e-4
        most = max(MAX_NUMBER, value) if limits.le is None else limits.le
        return gui.add_number(
            name, value, min=limits.ge, max=most, step=step, hint=declared.description
        )

    def _told(self, control: Any) -> Any:
        @control.on_update
        async def _(event: object) -> None:
            del event
            self._changed()

        return control

    async def _show_numbers(self, event: object) -> None:
        del event
        for name, slider in self._numbers.items():
            slider.visible = name in LENSES[self._lens.value]

    async def _reset(self, event: object) -> None:
        del event
        values: dict[str, Value] = {name: getattr(self._fitted, name) for name in SWITCHED}
        for name, value in values.items():
            self._values[name].value = value
        self._changed()


def _optics(lens: str, numbers: dict[str, float]) -> Optics:
    if lens == "opencv":
        return OpenCVLens(numbers)
    if lens == "fisheye":
        return FisheyeLens(numbers)
    if lens == "orthographic":
        return Orthographic()
    return ThinLens(**numbers) if lens == "thin lens" else Pinhole()
