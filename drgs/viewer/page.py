"""A page with a picture that follows the camera of whoever has opened it.

Between viser and :class:`drgs.viewer.requests.Wishes`. What is called by the server's threads reads
the controls and leaves requests; pictures come from the thread that renders.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from drgs.config.approximations import Approximations
from drgs.core.errors import UserError, one_line
from drgs.datasets.orbits import up_of
from drgs.datasets.types import Viewpoint
from drgs.datasets.viewpoints import focus_of, look_at
from drgs.viewer.controls import LookControls
from drgs.viewer.frames import Frame, FrameRequest
from drgs.viewer.optics import Eye
from drgs.viewer.requests import Wishes
from drgs.viewer.scheduler import Screen

if TYPE_CHECKING:
    import viser

JPEG_QUALITY = {False: 70, True: 92}
"""Of pictures of a moving camera, and of whole ones."""

MOST_FRUSTUMS = 200
"""Training cameras that are drawn, spread over all of them."""

FRUSTUM_SIZE = 0.04
"""Of the distance from the first camera to what is looked at."""


MOST_FOV = 150.0
"""Degrees, vertical."""


@dataclass(frozen=True, eq=False)
class StartView:
    """Where the camera of a page stands when it is opened."""

    eye: Eye
    up: np.ndarray  # (3,) unit, world

    @staticmethod
    def of(views: Sequence[Viewpoint], middle: np.ndarray | None = None) -> StartView:
        """The first of the cameras of a capture, which turns about what all of them look at.

        middle: (3,) world, what that is where their axes meet nowhere; None: not known.
        """
        first = views[0]
        try:
            focus, _ = focus_of(views)
            distance = float((focus - first.center) @ first.camera_to_world[:3, 2])
        except UserError:  # their axes meet nowhere
            offset = np.zeros(3) if middle is None else middle - first.center
            distance = float(offset @ first.camera_to_world[:3, 2])
        if not distance > 0:
            spread = np.ptp([view.center for view in views], axis=0).max()
            distance = float(spread) or 1.0
        fov = 2 * math.degrees(math.atan(0.5 * first.height / first.fy))
        return StartView(Eye(first.camera_to_world, fov, distance), up_of(views))

    def from_farther(self, factor: float) -> StartView:
        """From behind, at ``factor`` times the distance."""
        eye, pose = self.eye, self.eye.camera_to_world.copy()
        pose[:3, 3] -= (factor - 1) * eye.distance * pose[:3, 2]
        return replace(self, eye=Eye(pose, eye.fov, factor * eye.distance))

    def upright(self, up: np.ndarray) -> StartView:
        """From the same place, with another direction upright; up: (3,) world, any length.

        Raises :class:`UserError` where that is how the camera looks, or zero.
        """
        eye, place = self.eye, self.eye.camera_to_world[:3, 3]
        pose = look_at(place, place + eye.distance * eye.camera_to_world[:3, 2], up)
        return StartView(replace(eye, camera_to_world=pose), up / np.linalg.norm(up))


class Page(Screen):
    """What is common to a fit's page and to a viewer's."""

    def __init__(
        self,
        server: viser.ViserServer,
        wishes: Wishes,
        start: StartView,
        fitted: Approximations,
    ) -> None:
        """fitted: the approximations that the Gaussians were fitted with."""
        self.server, self.wishes = server, wishes
        self._texts: dict[int, viser.GuiMarkdownHandle] = {}
        self._frustums: list[viser.CameraFrustumHandle] = []
        self._as_fitted: dict[int, tuple[object, float]] = {}  # by client: of what, and ms
        self._fitted, self._distance = fitted, start.eye.distance
        pose, camera = start.eye.camera_to_world, server.initial_camera
        server.scene.set_up_direction(tuple(start.up))
        camera.position = tuple(pose[:3, 3])
        camera.look_at = tuple(pose[:3, 3] + start.eye.distance * pose[:3, 2])
        camera.up = tuple(start.up)
        camera.fov = math.radians(start.eye.fov)
        camera.near, camera.far = 1e-3 * start.eye.distance, 1e3 * start.eye.distance
        self.add_controls()
        with server.gui.add_folder("Looking"):
            self._angle = server.gui.add_slider(
                "Angle of view", 5.0, MOST_FOV, 0.5, round(min(MOST_FOV, start.eye.fov), 1)
            )
            self._angle.on_update(self._turn_lens)
            self.controls = LookControls(server.gui, fitted, self.ask_again)
        server.on_client_connect(self._welcome)
        server.on_client_disconnect(self._part)

    def add_controls(self) -> None:
        """What a page has above the controls of looking."""

    def add_cameras(self, views: Sequence[Viewpoint], visible: bool) -> None:
        """Draw cameras, through which one looks with a click, and a box that hides them."""
        chosen = np.linspace(0, len(views) - 1, min(MOST_FRUSTUMS, len(views))).round().astype(int)
        self._cameras = self.server.gui.add_checkbox("Cameras", visible)
        self._cameras.on_update(self._show_frustums)
        for view in (views[index] for index in chosen):
            frustum = self.server.scene.add_camera_frustum(
                f"/cameras/{view.name}",
                fov=2 * math.atan(0.5 * view.height / view.fy),
                aspect=view.width * view.fy / (view.height * view.fx),
                scale=FRUSTUM_SIZE * self._distance,
                thickness=1.0,
                thickness_units="screen",
                color=(240, 150, 40),
                wxyz=_wxyz_of(view.camera_to_world),
                position=tuple(view.center),
                visible=visible,
            )
            frustum.on_click(self._looker_through(view))
            self._frustums.append(frustum)

    def ask_again(self) -> None:
        """With what the controls say now, of everybody's camera."""
        self._place_frustums()
        for client in self.server.get_clients().values():
            self._ask(client)

    def show(self, client: int, request: FrameRequest, frame: Frame, is_whole: bool) -> None:
        """See :class:`Screen`; where the browser was closed meanwhile, nothing happens."""
        handle = self.server.get_clients().get(client)
        if handle is None:
            return
        handle.scene.set_background_image(
            frame.pixels, format="jpeg", jpeg_quality=JPEG_QUALITY[is_whole]
        )
        handle.flush()
        if is_whole:
            self._say(client, self._described(client, request, frame))

    def refuse(self, client: int, reason: str) -> None:
        """See :class:`Screen`."""
        self._say(client, f"**No picture:** {one_line(reason)}")

    def _described(self, client: int, request: FrameRequest, frame: Frame) -> str:
        """How long a picture took, and what its colours mean."""
        took, size = 1e3 * frame.seconds, (request.width, request.height)
        text = f"**{took:.0f} ms** for {size[0]}×{size[1]}"
        of = (*size, request.shows, request.optics, request.eye.camera_to_world.tobytes())
        if request.approximations in (None, self._fitted):
            self._as_fitted[client] = of, took
        elif self._as_fitted.get(client, (None, 0.0))[0] == of:
            text += f"; as fitted {self._as_fitted[client][1]:.0f} ms"
        return f"{text}\n\n{frame.note}" if frame.note else text

    def _say(self, client: int, text: str) -> None:
        if (handle := self._texts.get(client)) is not None:
            handle.content = text

    def _ask(self, client: viser.ClientHandle) -> None:
        """Leave a request for what this camera sees."""
        try:
            looking = self.controls.looking
        except ValueError as error:
            self.refuse(client.client_id, str(error))
            return
        camera = client.camera
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(camera.wxyz, scalar_first=True).as_matrix()
        pose[:3, 3] = camera.position
        fov = math.degrees(camera.fov) if looking.fisheye_angle is None else looking.fisheye_angle
        distance = float(np.linalg.norm(camera.look_at - camera.position))
        size = max(1, camera.image_width), max(1, camera.image_height)
        scale = min(1.0, looking.max_side / max(size))
        width, height = (max(1, round(scale * side)) for side in size)
        eye, shows = Eye(pose, fov, distance), looking.shows
        request = FrameRequest(eye, width, height, looking.optics, shows, looking.approximations)
        self.wishes.ask(client.client_id, request)

    async def _welcome(self, client: viser.ClientHandle) -> None:
        self._texts[client.client_id] = client.gui.add_markdown("…", order=1e6)

        @client.camera.on_update
        async def _(camera: object) -> None:
            del camera
            self._follow(client)

        self._follow(client)

    def _follow(self, client: viser.ClientHandle) -> None:
        """The angle of view is that of the window's shorter side, whatever its shape becomes."""
        camera = client.camera
        upright = max(1.0, camera.image_height / max(camera.image_width, 1))
        half = upright * math.tan(math.radians(self._angle.value) / 2)
        camera.fov = min(2 * math.atan(half), math.radians(MOST_FOV))
        self._ask(client)

    async def _part(self, client: viser.ClientHandle) -> None:
        self.wishes.leave(client.client_id)
        self._texts.pop(client.client_id, None)
        self._as_fitted.pop(client.client_id, None)

    async def _turn_lens(self, event: object) -> None:
        del event
        for client in self.server.get_clients().values():
            self._follow(client)

    async def _show_frustums(self, event: object) -> None:
        del event
        self._place_frustums()

    def _place_frustums(self) -> None:
        """Where the browser's lines would not lie on what is rendered, there are none."""
        if self._frustums:
            visible = self._cameras.value and self.controls.keeps_lines
            for frustum in self._frustums:
                frustum.visible = visible

    def _looker_through(self, view: Viewpoint) -> Callable[..., Coroutine]:
        async def look_through(event: viser.SceneNodePointerEvent) -> None:
            camera = event.client.camera
            with event.client.atomic():
                camera.position = tuple(view.center)
                camera.look_at = tuple(view.center + self._distance * view.camera_to_world[:3, 2])

        return look_through


def _wxyz_of(pose: np.ndarray) -> np.ndarray:
    return Rotation.from_matrix(pose[:3, :3]).as_quat(scalar_first=True)
