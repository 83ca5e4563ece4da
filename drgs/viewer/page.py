"""A page with an image that follows the camera of each client.

Server threads read the controls and queue requests; images come from the thread that renders.
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
from drgs.viewer.controls import CameraControls, event_handler
from drgs.viewer.frames import Frame, FrameRequest, ViewerCamera
from drgs.viewer.scheduler import RenderRequests

if TYPE_CHECKING:
    import viser

JPEG_QUALITY = {False: 70, True: 92}  # quality of images of a moving camera, and of whole ones
MAX_FRUSTUMS = 200  # training cameras that are drawn, spread over all of them
FRUSTUM_SIZE = 0.04  # size of a frustum in distances from the first camera to its target


@dataclass(frozen=True, eq=False)
class StartView:
    """The camera of a page when it is opened."""

    camera: ViewerCamera
    up: np.ndarray  # (3,) unit, world

    @staticmethod
    def from_views(views: Sequence[Viewpoint], middle: np.ndarray | None = None) -> StartView:
        """Return the first camera of a capture, which turns about what all of them look at.

        middle: (3,) world, the target of cameras whose axes meet nowhere; None: not known.
        """
        first = views[0]
        try:
            target, _ = focus_of(views)
        except UserError:  # their axes meet nowhere
            target = first.center if middle is None else middle
        distance = float((target - first.center) @ first.camera_to_world[:3, 2])
        if not distance > 0:
            spread = np.ptp([view.center for view in views], axis=0).max()
            distance = float(spread) or 1.0
        fov = 2 * math.degrees(math.atan(0.5 * first.height / first.fy))
        return StartView(ViewerCamera(first.camera_to_world, fov, distance), up_of(views))

    def from_farther(self, factor: float) -> StartView:
        """Return the view from behind, at ``factor`` times the distance."""
        camera, pose = self.camera, self.camera.camera_to_world.copy()
        pose[:3, 3] -= (factor - 1) * camera.distance * pose[:3, 2]
        return replace(self, camera=ViewerCamera(pose, camera.fov, factor * camera.distance))

    def upright(self, up: np.ndarray) -> StartView:
        """Return the view with another up direction; up: (3,) world, any length.

        Raises :class:`UserError` if it is zero or along the camera's axis.
        """
        camera, position = self.camera, self.camera.camera_to_world[:3, 3]
        pose = look_at(position, position + camera.distance * camera.camera_to_world[:3, 2], up)
        return StartView(replace(camera, camera_to_world=pose), up / np.linalg.norm(up))


class Page:
    """A page that shows Gaussians; the base of a fit's."""

    def __init__(
        self,
        server: viser.ViserServer,
        requests: RenderRequests,
        start: StartView,
        fitted: Approximations,
    ) -> None:
        """fitted: the approximations that the Gaussians were fitted with."""
        self.server, self.requests = server, requests
        self._texts: dict[int, viser.GuiMarkdownHandle] = {}
        self._frustums: list[viser.CameraFrustumHandle] = []
        self._as_fitted: dict[int, tuple[object, float]] = {}  # what each client saw, and ms
        self._fitted, self._distance = fitted, start.camera.distance
        pose, camera = start.camera.camera_to_world, server.initial_camera
        server.scene.set_up_direction(tuple(start.up))
        camera.position = tuple(pose[:3, 3])
        camera.look_at = tuple(pose[:3, 3] + self._distance * pose[:3, 2])
        camera.up = tuple(start.up)
        camera.fov = math.radians(start.camera.fov)
        camera.near, camera.far = 1e-3 * self._distance, 1e3 * self._distance
        self.add_controls()
        with server.gui.add_folder("Looking"):
            self.controls = CameraControls(server.gui, fitted, start.camera.fov, self.update)
        server.on_client_connect(self._connect)
        server.on_client_disconnect(self._disconnect)

    def add_controls(self) -> None:
        """Add what a page has above the controls of its camera."""

    def add_cameras(self, views: Sequence[Viewpoint], visible: bool) -> None:
        """Draw cameras, through which a click looks, and a box that hides them."""
        chosen = np.linspace(0, len(views) - 1, min(MAX_FRUSTUMS, len(views))).round().astype(int)
        self._cameras = self.server.gui.add_checkbox("Cameras", visible)
        self._cameras.on_update(event_handler(self._show_frustums))
        for view in (views[index] for index in chosen):
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
        """Queue a request for each client, after a control has changed."""
        self._show_frustums()
        for client in self.server.get_clients().values():
            self._follow(client)

    def show(self, client: int, request: FrameRequest, frame: Frame, is_whole: bool) -> None:
        """Show a frame to a client, unless it has gone; is_whole: it is as large as requested."""
        handle = self.server.get_clients().get(client)
        if handle is None:
            return
        handle.scene.set_background_image(
            frame.pixels, format="jpeg", jpeg_quality=JPEG_QUALITY[is_whole]
        )
        handle.flush()
        if is_whole:
            self._set_text(client, self._describe(client, request, frame))

    def refuse(self, client: int, reason: str) -> None:
        """Show in one line why there is no frame."""
        self._set_text(client, f"**No picture:** {one_line(reason)}")

    def _describe(self, client: int, request: FrameRequest, frame: Frame) -> str:
        """Return how long an image took, and what its colours mean."""
        took, size = 1e3 * frame.seconds, (request.width, request.height)
        text = f"**{took:.0f} ms** for {size[0]}×{size[1]}"
        pose = request.camera.camera_to_world.tobytes()
        shown = (*size, request.shows, request.lens, request.lens_numbers, pose)
        if request.approximations in (None, self._fitted):
            self._as_fitted[client] = shown, took
        elif self._as_fitted.get(client, (None, 0.0))[0] == shown:
            text += f"; as fitted {self._as_fitted[client][1]:.0f} ms"
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
        self._as_fitted.pop(client.client_id, None)

    def _follow(self, client: viser.ClientHandle) -> None:
        """Queue a request for what a client's camera sees."""
        client.camera.fov = self.controls.fov(client.camera)
        try:
            self.requests.put(client.client_id, self.controls.request(client.camera))
        except ValueError as error:
            self.refuse(client.client_id, str(error))

    def _show_frustums(self) -> None:
        """Show the frustums where they lie on the image: browsers draw them through a pinhole."""
        for frustum in self._frustums:
            frustum.visible = self._cameras.value and self.controls.is_straight

    def _look_through(self, view: Viewpoint) -> Callable[..., Coroutine]:
        async def look_through(event: viser.SceneNodePointerEvent) -> None:
            camera = event.client.camera
            with event.client.atomic():
                camera.position = tuple(view.center)
                camera.look_at = tuple(view.center + self._distance * view.camera_to_world[:3, 2])

        return look_through
