"""A page with an image rendered for each client's camera, and its controls.

Server threads read the controls and queue requests; the render thread sends images.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from scipy.spatial.transform import Rotation

from drgs.cameras.orbits import up_of
from drgs.cameras.viewpoints import Viewpoint, focus_of, look_at
from drgs.config.approximations import DECLARED, Approximations
from drgs.core.errors import UserError, one_line
from drgs.datasets.types import evenly_spaced
from drgs.live_page.frames import (
    FRAME_CONTENTS,
    VIEWER_LENSES,
    FrameRequest,
    ViewerCamera,
    ViewerFrame,
)
from drgs.live_page.scheduler import RenderRequests

if TYPE_CHECKING:
    import viser

    FrustumClick = viser.SceneNodePointerEvent[viser.CameraFrustumHandle]

Control = TypeVar("Control", bound="viser.GuiInputHandle[Any]")

EventHandler = Callable[[object], Coroutine[None, None, None]]  # runs in viser's event loop

JPEG_QUALITY = {False: 70, True: 92}  # by "is full resolution"
MAX_FRUSTUMS = 200  # number of training cameras drawn, evenly spaced
FRUSTUM_SIZE = 0.04  # in distances from the first camera to its target

ADJUSTABLE_APPROXIMATIONS = (
    *("projection", "order", "order_window", "sh_direction"),
    *("alpha_cut", "transmittance_stop", "low_pass", "antialiased"),
)
"""Approximations with a control. No number field accepts an infinite ``extent``, and ``alpha_max``
is a part of the model."""

LENS_SLIDERS = {
    "angle": (30.0, 220.0, 1.0, 90.0),
    "k1": (-0.5, 0.5, 0.01, 0.0),
    "k2": (-0.5, 0.5, 0.01, 0.0),
    "aperture": (0.0, 0.2, 0.002, 0.03),
    "focus": (0.3, 3.0, 0.01, 1.0),
}
"""Minimum, maximum, step and initial value of lens parameters: a fisheye's vertical angle
(degrees), OpenCV's k1 and k2, aperture and focus (distances to the camera's target)."""

MAX_SIDES_PX = ("640", "960", "1280", "1920")  # choices for the longer side of an image
MAX_FOV = 150.0  # degrees, vertical

MAX_CONTROL_VALUE = 100.0
"""Maximum of an approximation without an upper limit: a standard deviation of 10 px for
``low_pass``. Beyond it, splats soon cover the whole film and exhaust memory."""


@dataclass(frozen=True, eq=False)
class StartView:
    """The camera of a page when it is opened."""

    camera: ViewerCamera
    up: np.ndarray  # (3,) unit, world

    @staticmethod
    def from_views(views: Sequence[Viewpoint], middle: np.ndarray | None = None) -> StartView:
        """Return the first camera of a capture; it orbits the point that all cameras face.

        middle: (3,) world, the orbit centre of cameras whose axes do not meet; None: unknown.
        """
        first = views[0]
        try:
            target, _ = focus_of(views)
        except UserError:  # their axes meet nowhere
            target = first.center if middle is None else middle
        distance = float((target - first.center) @ first.camera_to_world[:3, 2])
        if not distance > 0:
            distance = float(np.ptp([view.center for view in views], axis=0).max()) or 1.0
        fov = 2 * math.degrees(math.atan(0.5 * first.height / first.fy))
        return StartView(ViewerCamera(first.camera_to_world, fov, distance), up_of(views))

    def move_back(self, factor: float) -> StartView:
        """Return the view moved back along its axis to ``factor`` times the distance."""
        camera, pose = self.camera, self.camera.camera_to_world.copy()
        pose[:3, 3] -= (factor - 1) * camera.distance * pose[:3, 2]
        return replace(self, camera=ViewerCamera(pose, camera.fov, factor * camera.distance))

    def upright(self, up: np.ndarray) -> StartView:
        """Return the view turned to ``up`` (3,), world; UserError if zero or along the axis."""
        camera, position = self.camera, self.camera.camera_to_world[:3, 3]
        pose = look_at(position, position + camera.distance * camera.camera_to_world[:3, 2], up)
        return StartView(replace(camera, camera_to_world=pose), up / np.linalg.norm(up))


def event_handler(function: Callable[[], None]) -> EventHandler:
    """Return a handler of any viser event that calls ``function`` in the event loop."""

    async def handle(event: object) -> None:
        function()

    return handle


class CameraControls:
    """Controls in viser's panel; a server thread calls ``changed`` after each change."""

    def __init__(
        self, gui: viser.GuiApi, fitted: Approximations, fov: float, changed: Callable[[], None]
    ) -> None:
        """fitted: the fit's approximations; fov: initial, degrees."""
        self._gui, self._fitted, self._changed = gui, fitted, event_handler(changed)
        first = round(min(MAX_FOV, fov), 1)
        self._angle = self._observe(gui.add_slider("Angle of view", 5.0, MAX_FOV, 0.5, first))
        self._content = self._observe(gui.add_dropdown("Show", tuple(FRAME_CONTENTS)))
        self._side = self._observe(gui.add_dropdown("Size", MAX_SIDES_PX, initial_value="1280"))
        self._lens = self._observe(gui.add_dropdown("Lens", tuple(VIEWER_LENSES)))
        self._lens_sliders = {
            name: self._observe(gui.add_slider(name, low, high, step, first, visible=False))
            for name, (low, high, step, first) in LENS_SLIDERS.items()
        }
        self._lens.on_update(event_handler(self._show_lens_sliders))
        with gui.add_folder("Accuracy", expand_by_default=False):
            names = ADJUSTABLE_APPROXIMATIONS
            self._values = {name: self._observe(self._control(name)) for name in names}
            button = gui.add_button("As fitted")
        button.on_click(event_handler(self._reset))
        button.on_click(self._changed)

    @property
    def is_straight(self) -> bool:
        """True if the lens shows straight lines where the browser's pinhole draws them."""
        return self._lens.value in ("pinhole", "thin lens")

    def fov(self, camera: viser.CameraHandle) -> float:
        """Return the vertical field of view, radians; the slider sets that of the shorter side."""
        upright = max(1.0, camera.image_height / max(camera.image_width, 1))
        half = upright * math.tan(math.radians(self._angle.value) / 2)
        return min(2 * math.atan(half), math.radians(MAX_FOV))

    def request(self, camera: viser.CameraHandle) -> FrameRequest:
        """Return the request for a client's camera and controls; ValueError beyond their limits."""
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(camera.wxyz, scalar_first=True).as_matrix()
        pose[:3, 3] = camera.position
        lens, fov = self._lens.value, math.degrees(camera.fov)
        if lens == "fisheye":
            fov = float(self._lens_sliders["angle"].value)
        distance = float(np.linalg.norm(camera.look_at - camera.position))
        size = max(1, camera.image_width), max(1, camera.image_height)
        scale = min(1.0, int(self._side.value) / max(size))
        width, height = (max(1, round(scale * side)) for side in size)
        names = VIEWER_LENSES[lens].parameters
        parameters = {name: float(self._lens_sliders[name].value) for name in names}
        view, content = ViewerCamera(pose, fov, distance), self._content.value
        how = self._approximations()
        return FrameRequest(view, width, height, lens, parameters, content, how)

    def _approximations(self) -> Approximations:
        values = {name: getattr(self._fitted, name) for name in DECLARED}
        values |= {name: DECLARED[name].kind(c.value) for name, c in self._values.items()}
        return Approximations(**values)

    def _control(self, name: str) -> viser.GuiInputHandle[Any]:
        declared, gui, value = DECLARED[name], self._gui, getattr(self._fitted, name)
        hint = declared.description
        if declared.words:
            return gui.add_dropdown(name, declared.words, initial_value=value, hint=hint)
        if declared.kind is bool:
            return gui.add_checkbox(name, value, hint=hint)
        limits = declared.limits
        assert limits is not None, "numbers have limits"
        step = 1 if declared.kind is int else 1e-4
        largest = max(MAX_CONTROL_VALUE, value) if limits.le is None else limits.le
        return gui.add_number(name, value, min=limits.ge, max=largest, step=step, hint=hint)

    def _observe(self, control: Control) -> Control:
        control.on_update(self._changed)
        return control

    def _show_lens_sliders(self) -> None:
        lens = self._lens.value
        shown = {*VIEWER_LENSES[lens].parameters, *(("angle",) if lens == "fisheye" else ())}
        for name, slider in self._lens_sliders.items():
            slider.visible = name in shown

    def _reset(self) -> None:
        for name, control in self._values.items():
            control.value = getattr(self._fitted, name)


class Page:
    """A page that shows Gaussians."""

    def __init__(
        self,
        server: viser.ViserServer,
        requests: RenderRequests,
        start: StartView,
        fitted: Approximations,
    ) -> None:
        self.server, self.requests = server, requests
        self._texts: dict[int, viser.GuiMarkdownHandle] = {}
        self._frustums: list[viser.CameraFrustumHandle] = []
        self._fitted_times: dict[int, tuple[object, float]] = {}  # each client's view, ms
        self._fitted, self._distance = fitted, start.camera.distance
        pose, camera = start.camera.camera_to_world, server.initial_camera
        server.scene.set_up_direction(tuple(start.up))
        camera.position = tuple(pose[:3, 3])
        camera.look_at = tuple(pose[:3, 3] + self._distance * pose[:3, 2])
        camera.up = tuple(start.up)
        camera.fov = math.radians(start.camera.fov)
        camera.near, camera.far = 1e-3 * self._distance, 1e3 * self._distance
        self.add_controls()
        with server.gui.add_folder("View"):
            self.controls = CameraControls(server.gui, fitted, start.camera.fov, self.update)
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    def add_controls(self) -> None:
        """Add controls above those of the camera."""

    def add_cameras(self, views: Sequence[Viewpoint], visible: bool) -> None:
        """Draw camera frustums and a checkbox that hides them; a click moves to a camera."""
        self._cameras = self.server.gui.add_checkbox("Cameras", visible)
        self._cameras.on_update(event_handler(self._show_frustums))
        for view in evenly_spaced(views, MAX_FRUSTUMS):
            frustum = self.server.scene.add_camera_frustum(
                f"/cameras/{view.name}",
                fov=2 * math.atan(0.5 * view.height / view.fy),
                aspect=view.width * view.fy / (view.height * view.fx),
                scale=FRUSTUM_SIZE * self._distance,
                thickness=1.0,
                thickness_units="screen",
                color=(240, 150, 40),
                wxyz=Rotation.from_matrix(view.camera_to_world[:3, :3]).as_quat(scalar_first=True),
                position=tuple(view.center),
                visible=visible,
            )
            frustum.on_click(self._look_through(view))
            self._frustums.append(frustum)

    def update(self) -> None:
        """Queue a request for each client."""
        self._show_frustums()
        for client in self.server.get_clients().values():
            self._follow(client)

    def show(self, client: int, request: FrameRequest, frame: ViewerFrame, is_whole: bool) -> None:
        """Show a frame to a client if it is connected; is_whole: at full resolution."""
        handle = self.server.get_clients().get(client)
        if handle is None:
            return
        quality = JPEG_QUALITY[is_whole]
        handle.scene.set_background_image(frame.pixels, format="jpeg", jpeg_quality=quality)
        handle.flush()
        if is_whole:
            self._set_text(client, self._describe(client, request, frame))

    def refuse(self, client: int, reason: str) -> None:
        """Show the reason of a missing frame in one line."""
        self._set_text(client, f"**No image:** {one_line(reason)}")

    def _describe(self, client: int, request: FrameRequest, frame: ViewerFrame) -> str:
        took, size = 1e3 * frame.seconds, (request.width, request.height)
        text = f"**{took:.0f} ms** for {size[0]}×{size[1]}"
        pose = request.camera.camera_to_world.tobytes()
        shown = (*size, request.content, request.lens, request.lens_parameters, pose)
        if request.approximations in (None, self._fitted):
            self._fitted_times[client] = shown, took
        elif self._fitted_times.get(client, (None, 0.0))[0] == shown:
            text += f"; as fitted {self._fitted_times[client][1]:.0f} ms"
        return f"{text}\n\n{frame.note}" if frame.note else text

    def _set_text(self, client: int, text: str) -> None:
        if (handle := self._texts.get(client)) is not None:
            handle.content = text

    async def _connect(self, client: viser.ClientHandle) -> None:
        self._texts[client.client_id] = client.gui.add_markdown("…", order=1e6)
        client.camera.on_update(event_handler(lambda: self._follow(client)))
        self._follow(client)

    async def _disconnect(self, client: viser.ClientHandle) -> None:
        self.requests.remove(client.client_id)
        self._texts.pop(client.client_id, None)
        self._fitted_times.pop(client.client_id, None)

    def _follow(self, client: viser.ClientHandle) -> None:
        client.camera.fov = self.controls.fov(client.camera)
        try:
            self.requests.put(client.client_id, self.controls.request(client.camera))
        except ValueError as error:
            self.refuse(client.client_id, str(error))

    def _show_frustums(self) -> None:
        """Show the frustums if they align with the image: browsers draw them by a pinhole."""
        for frustum in self._frustums:
            frustum.visible = self._cameras.value and self.controls.is_straight

    def _look_through(
        self, view: Viewpoint
    ) -> Callable[[FrustumClick], Coroutine[None, None, None]]:
        async def look_through(event: FrustumClick) -> None:
            camera = event.client.camera
            with event.client.atomic():
                camera.position = tuple(view.center)
                camera.look_at = tuple(view.center + self._distance * view.camera_to_world[:3, 2])

        return look_through
