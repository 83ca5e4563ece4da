"""``viewer.html``: an interactive page of Gaussians that opens from disk.

The page contains the Gaussians as a compressed PLY and PlayCanvas's supersplat-viewer, whose files
and licence are in ``supersplat_viewer/`` (``.ci/viewer.py`` fetches them for releases). It renders
by WebGL 2 with the fit's low-pass filter and opacity compensation, for which ``MANIFEST.json``
there lists the changes in the viewer. Its security policy forbids connections.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np

from drgs.cameras.orbits import Orbit, orbit_of_gaussians, orbit_of_views
from drgs.cameras.viewpoints import FIELD_OF_VIEW, Viewpoint
from drgs.config.approximations import Approximations
from drgs.core.errors import note_user
from drgs.core.files import write_bytes
from drgs.core.origin import WORLD
from drgs.datasets.types import Dataset
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.similarity import Similarity
from drgs.results.folder import VIEWER
from drgs.results.refined_cameras import refined_viewpoints

MAX_PAGE_BYTES = 25_000_000
"""Maximum size of a fit's page, a usual limit of mail attachments: half a million Gaussians of
degree 3. Chromium opens a million in 5 s on two cores without a graphics card."""

GZIP_RATIO = 0.6  # of a compressed PLY; measured: 0.55 to 0.61 for fits
SECONDS_PER_BYTE = 0.2e-6  # of a compressed PLY; measured: 0.15e-6 to 0.2e-6 on two cores (Zen 4)

HONOURED = frozenset({"low_pass", "antialiased"})
"""Approximations that the page supports."""

PAGE_DISTANCE = 3.0
"""Distance from the first camera to its target in units of the page, where scales are kept in 8
bits from 6e-6 to 8e3 and the nearest that one can come is 0.01."""

MIN_TARGET_DEPTH = 0.1  # least depth of the target in the first camera, in radii of the orbit
GZIP_LEVEL = 4  # level 9 takes six times as long for 1.6 % less

PAGE_TO_FILE_AXES = np.diag([-1.0, -1.0, 1.0])
"""Rotation from the page's axes (x right, y up, z backward) to those of its PLY."""


@dataclass(frozen=True, eq=False)
class InitialView:
    """The initial camera of the page and its orbit."""

    camera: Viewpoint
    orbit: Orbit

    @staticmethod
    def from_views(views: Sequence[Viewpoint], gaussians: Gaussians) -> InitialView:
        """Return the training camera nearest to the orbit's start; gaussians: as orbit_of_views."""
        orbit = orbit_of_views(views, gaussians)
        level, height = math.cos(orbit.elevation), math.sin(orbit.elevation)
        start = level * orbit.start + height * orbit.up
        offsets = np.stack([view.center - orbit.focus for view in views])
        lengths = np.linalg.norm(offsets, axis=1)
        cosines = offsets @ start / np.where(lengths > 0, lengths, 1)
        return InitialView(views[int(np.argmax(cosines))], orbit)

    @staticmethod
    def from_gaussians(gaussians: Gaussians, up: np.ndarray) -> InitialView:
        """Return a camera that frames all but outliers; up: (3,) world, any length."""
        orbit = orbit_of_gaussians(gaussians, up, FIELD_OF_VIEW)
        (camera,) = orbit.viewpoints(1, 1, 1, FIELD_OF_VIEW)
        return InitialView(camera, orbit)

    @property
    def target(self) -> np.ndarray:
        """The point (3,) of the optical axis nearest to the focus, world.

        If that is behind or near the camera, the point at the orbit's radius.
        """
        forward = self.camera.camera_to_world[:3, 2]
        depth = (self.orbit.focus - self.camera.center) @ forward
        radius = self.orbit.radius or 1.0
        distance = depth if depth > MIN_TARGET_DEPTH * radius else radius
        return self.camera.center + distance * forward

    @property
    def to_page(self) -> Similarity:
        """The similarity from the world to the page, whose origin is the target."""
        orbit = self.orbit
        rotation = np.stack([np.cross(orbit.up, orbit.start), orbit.up, orbit.start])
        scale = PAGE_DISTANCE / np.linalg.norm(self.target - self.camera.center)
        return Similarity(float(scale), rotation, -scale * rotation @ self.target)


@dataclass(frozen=True, eq=False)
class DisplaySettings:
    """Gaussians on the page and their approximations."""

    gaussians: Gaussians  # numpy or Dr.Jit, without a smoothing filter
    approximations: Approximations  # those of HONOURED count


def shows_as_fitted(approximations: Approximations) -> bool:
    """Return whether the page supports all non-default approximations."""
    return approximations.non_default.keys() <= HONOURED


def viewer_page(
    title: str,
    shown: DisplaySettings,
    initial_view: InitialView,
    background: tuple[float, float, float],
) -> bytes:
    """Return the page, UTF-8; equal arguments give equal bytes.

    background: display space. The camera's roll, principal point and lens are ignored.

    Raises ``drgs.core.errors.UserError`` for non-finite Gaussians.
    """
    move = initial_view.to_page
    axes = PAGE_TO_FILE_AXES
    in_file = Similarity(move.scale, axes @ move.rotation, axes @ move.translation)
    gaussians = replace(shown.gaussians.numpy(), origin=WORLD)  # the page has no world
    splats = in_file.of_gaussians(gaussians).to_bytes("compressed-ply")
    files = resources.files("drgs.results")
    program = files.joinpath("supersplat_viewer")
    scene = json.dumps(_scene(shown.approximations, initial_view, background))
    page = Template(files.joinpath("viewer_page.html").read_text("utf-8")).substitute(
        title=html.escape(title),
        licence=program.joinpath("LICENSE").read_text("utf-8"),
        style=program.joinpath("viewer.css").read_text("utf-8"),
        scene=scene.replace("<", "\\u003c"),  # does not end the script element
        code=_base64(program.joinpath("viewer.js.gz").read_bytes()),
        splats=_base64(gzip.compress(splats, GZIP_LEVEL, mtime=0)),
    )
    return page.encode("utf-8", "backslashreplace")


def estimate_page_bytes(num_gaussians: int, sh_degree: int) -> int:
    """Estimate a page's size: its Gaussians in base64."""
    return int(4 / 3 * GZIP_RATIO * _file_bytes(num_gaussians, sh_degree))


def seconds_of_page(num_gaussians: int, sh_degree: int) -> float:
    """Estimate the time of :func:`write_viewer`."""
    if estimate_page_bytes(num_gaussians, sh_degree) > MAX_PAGE_BYTES:
        return 0.0
    return SECONDS_PER_BYTE * _file_bytes(num_gaussians, sh_degree)


def write_viewer(out: Path, dataset: Dataset, shown: DisplaySettings) -> None:
    """Write the page of a fit into its folder, atomically; it starts at a refined camera, if any.

    Warns with a ``UserNote`` instead if the page would exceed :data:`MAX_PAGE_BYTES`.
    """
    gaussians = shown.gaussians
    size = estimate_page_bytes(gaussians.num_gaussians, gaussians.sh_degree)
    if size > MAX_PAGE_BYTES:
        note_user(
            f"{out / VIEWER}: not written, as it would have about {size / 1e6:.0f} MB, more than "
            f"{MAX_PAGE_BYTES / 1e6:.0f}; drgs export {out} --format html writes it"
        )
        return
    views = refined_viewpoints(out, dataset.origin) or dataset.train
    initial_view = InitialView.from_views(views, gaussians)
    page = viewer_page(out.resolve().name, shown, initial_view, dataset.background)
    write_bytes(out / VIEWER, page)


def _file_bytes(num_gaussians: int, sh_degree: int) -> int:
    """Return the size of a compressed PLY without header and group bounds."""
    return num_gaussians * (16 + 3 * ((sh_degree + 1) ** 2 - 1))


def _scene(
    approximations: Approximations, view: InitialView, background: tuple[float, float, float]
) -> Mapping[str, object]:
    camera, move, off = view.camera, view.to_page, {"enabled": False}
    position = move.scale * move.rotation @ camera.center + move.translation
    settings = {  # of the viewer, without the field of view
        "version": 2,
        "tonemapping": "none",
        "highPrecisionRendering": False,
        "background": {"color": [float(value) for value in background]},
        "postEffectSettings": {
            "sharpness": {**off, "amount": 0},
            "bloom": {**off, "intensity": 0, "blurLevel": 2},
            "grading": {**off, "brightness": 1, "contrast": 1, "saturation": 1, "tint": [1, 1, 1]},
            "vignette": {**off, "intensity": 0, "inner": 0.3, "outer": 0.75, "curvature": 1},
            "fringing": {**off, "intensity": 0},
        },
        "animTracks": [],
        "cameras": [{"initial": {"position": position.tolist(), "target": [0, 0, 0]}}],
        "annotations": [],
        "startMode": "default",
    }
    return {
        "settings": settings,
        "tangents": [camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)],
        "lowPass": approximations.low_pass,  # square pixels
        "antialiased": approximations.antialiased,
    }


def _base64(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
