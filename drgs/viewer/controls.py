"""The controls of a page: what is shown, through which lens, with which approximations."""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from drgs.config.approximations import DECLARED, Approximations
from drgs.viewer.frames import SHOWN, VIEWER_LENSES, FrameRequest, ViewerCamera

if TYPE_CHECKING:
    import viser

CONTROLLED = (
    *("projection", "order", "order_window", "sh_direction"),
    *("alpha_cut", "transmittance_stop", "low_pass", "antialiased"),
)
"""Approximations with a control. ``extent`` may be infinite, which no field of numbers takes, and
``alpha_max`` is a part of the model rather than of how it is approximated."""

SLIDERS = {
    "angle": (30.0, 220.0, 1.0, 90.0),
    "k1": (-0.5, 0.5, 0.01, 0.0),
    "k2": (-0.5, 0.5, 0.01, 0.0),
    "aperture": (0.0, 0.2, 0.002, 0.03),
    "focus": (0.3, 3.0, 0.01, 1.0),
}
"""Least, largest, step and first value of a lens's numbers. The angle is a fisheye's, in degrees,
vertical; k1 and k2 are OpenCV's; the rest is in units of the distance to the camera's target."""

MAX_SIDES_PX = ("640", "960", "1280", "1920")  # choices for the longer side of an image
MAX_FOV = 150.0  # degrees, vertical

MAX_NUMBER = 100.0
"""The largest value of an approximation without an upper limit: of ``low_pass``, a standard
deviation of 10 px. With more, each splat soon covers the whole film, for which memory runs out."""


def event_handler(function: Callable[[], None]) -> Callable[[object], Coroutine]:
    """Return a handler of any event of viser's, which its event loop runs."""

    async def handle(event: object) -> None:
        function()

    return handle


class CameraControls:
    """Controls in viser's panel; ``changed`` is called, by a thread of the server, when one is."""

    def __init__(
        self, gui: viser.GuiApi, fitted: Approximations, fov: float, changed: Callable[[], None]
    ) -> None:
        """fitted: the approximations of the fit; fov: degrees, at first."""
        self._gui, self._fitted, self._changed = gui, fitted, event_handler(changed)
        first = round(min(MAX_FOV, fov), 1)
        self._angle = self._observed(gui.add_slider("Angle of view", 5.0, MAX_FOV, 0.5, first))
        self._shows = self._observed(gui.add_dropdown("Show", tuple(SHOWN)))
        self._side = self._observed(gui.add_dropdown("Size", MAX_SIDES_PX, initial_value="1280"))
        self._lens = self._observed(gui.add_dropdown("Lens", tuple(VIEWER_LENSES)))
        self._numbers = {
            name: self._observed(gui.add_slider(name, low, high, step, first, visible=False))
            for name, (low, high, step, first) in SLIDERS.items()
        }
        self._lens.on_update(event_handler(self._show_numbers))
        with gui.add_folder("Accuracy", expand_by_default=False):
            self._values = {name: self._observed(self._control(name)) for name in CONTROLLED}
            button = gui.add_button("As fitted")
        button.on_click(event_handler(self._reset))
        button.on_click(self._changed)

    @property
    def is_straight(self) -> bool:
        """Whether the lens shows straight lines where the browser's pinhole draws them."""
        return self._lens.value in ("pinhole", "thin lens")

    def fov(self, camera: viser.CameraHandle) -> float:
        """Return the vertical field of view, radians; the slider sets that of the shorter side."""
        upright = max(1.0, camera.image_height / max(camera.image_width, 1))
        half = upright * math.tan(math.radians(self._angle.value) / 2)
        return min(2 * math.atan(half), math.radians(MAX_FOV))

    def request(self, camera: viser.CameraHandle) -> FrameRequest:
        """Return the request for what a client's camera sees, with the values of all controls.

        Raises ValueError for an approximation outside of its limits.
        """
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(camera.wxyz, scalar_first=True).as_matrix()
        pose[:3, 3] = camera.position
        lens, fov = self._lens.value, math.degrees(camera.fov)
        if lens == "fisheye":
            fov = float(self._numbers["angle"].value)
        distance = float(np.linalg.norm(camera.look_at - camera.position))
        size = max(1, camera.image_width), max(1, camera.image_height)
        scale = min(1.0, int(self._side.value) / max(size))
        width, height = (max(1, round(scale * side)) for side in size)
        return FrameRequest(
            camera=ViewerCamera(pose, fov, distance),
            width=width,
            height=height,
            lens=lens,
            lens_numbers={n: float(self._numbers[n].value) for n in VIEWER_LENSES[lens].numbers},
            shows=self._shows.value,
            approximations=self._approximations(),
        )

    def _approximations(self) -> Approximations:
        values = {name: getattr(self._fitted, name) for name in DECLARED}
        values |= {name: DECLARED[name].kind(c.value) for name, c in self._values.items()}
        return Approximations(**values)

    def _control(self, name: str) -> Any:
        """Return an input of viser's for an approximation."""
        declared, gui, value = DECLARED[name], self._gui, getattr(self._fitted, name)
        hint = declared.description
        if declared.words:
            return gui.add_dropdown(name, declared.words, initial_value=value, hint=hint)
        if declared.kind is bool:
            return gui.add_checkbox(name, value, hint=hint)
        limits = declared.limits
        step = 1 if declared.kind is int else 1e-4
        largest = max(MAX_NUMBER, value) if limits.le is None else limits.le
        return gui.add_number(name, value, min=limits.ge, max=largest, step=step, hint=hint)

    def _observed(self, control: Any) -> Any:
        control.on_update(self._changed)
        return control

    def _show_numbers(self) -> None:
        lens = self._lens.value
        shown = {*VIEWER_LENSES[lens].numbers, *(("angle",) if lens == "fisheye" else ())}
        for name, slider in self._numbers.items():
            slider.visible = name in shown

    def _reset(self) -> None:
        for name, control in self._values.items():
            control.value = getattr(self._fitted, name)
