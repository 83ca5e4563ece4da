"""``viewer.html``: Gaussians to walk around in, on one page that opens from disk.

The page holds PlayCanvas's supersplat-viewer, whose files lie in ``supersplat_viewer/`` with their
licence (``.ci/viewer.py`` fetches them for releases), and the Gaussians as a compressed PLY, with
their harmonics. It renders by WebGL 2, and its security policy lets it open no connection.

It renders with the low-pass filter that Gaussians were fitted with, and with opacities compensated
for it where they were fitted so: :func:`shows_as_fitted` says whether that is all they need. The
viewer itself would not: ``supersplat_viewer/MANIFEST.json`` has what is changed in it.
"""

from __future__ import annotations

import base64
import gzip
import html
import json
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import resources
from pathlib import Path
from string import Template

import numpy as np

from drgs.config.approximations import Approximations
from drgs.core.errors import UserNote
from drgs.core.files import atomic_path
from drgs.core.origin import WORLD
from drgs.datasets.orbits import Orbit, orbit_of_gaussians, orbit_of_views
from drgs.datasets.types import Dataset, Viewpoint
from drgs.datasets.viewpoints import FIELD_OF_VIEW
from drgs.gaussians.parameters import Gaussians
from drgs.gaussians.similarity import Similarity
from drgs.results.files import VIEWER
from drgs.results.refined_cameras import refined_viewpoints

MOST_BYTES = 25_000_000
"""Of a page that is written without being asked for: what mail services take. It holds half a
million Gaussians of degree 3. Browsers bear more: on two cores without a graphics card, Chromium
opens 195,000 in 3 s and a million in 5 s."""

LEAST_SHARE = 0.5
"""Of a compressed PLY's bytes, what gzip leaves at least: 0.55 to 0.61 of fits' Gaussians."""

SECONDS_PER_BYTE = 0.2e-6
"""Of a compressed PLY, to make the page: 0.15 to 0.2 measured on two cores (AMD Zen 4)."""

PAGE = "viewer_page.html"
"""Of this package: the page, with ``$names`` for what :func:`viewer_page` fills in."""

SUPERSPLAT = "supersplat_viewer"
"""Of this package: the folder with the viewer's files."""

HONOURED = frozenset({"low_pass", "antialiased"})
"""Approximations that the page renders with; of the others it has its own."""

DISTANCE = 3.0
"""From the first camera to what it looks at, in units of the page, where scales are kept in 8 bits
from 6e-6 to 8e3 and the nearest that one can come is 0.01."""

NEAREST = 0.1
"""Of an orbit's radius: nothing that is walked around is nearer to the first camera."""

LEVEL = 4
"""Of gzip, for the Gaussians: level 9 takes six times as long for 1.6 % less."""

FILE_AXES = np.diag([-1.0, -1.0, 1.0])
"""From the page's axes (x right, y up, z backward) to those of its PLY, which it turns by 180
degrees about z as it loads it."""


@dataclass(frozen=True, eq=False)
class Standpoint:
    """Where one stands when the page opens: a camera, and what there is to walk around."""

    camera: Viewpoint
    orbit: Orbit

    @staticmethod
    def of_views(views: Sequence[Viewpoint], gaussians: Gaussians) -> Standpoint:
        """That of the training camera which is the nearest in direction to where orbits start.

        views: of the training split; gaussians: say where the middle is, where no cameras do.
        """
        orbit = orbit_of_views(views, gaussians)
        level, height = math.cos(orbit.elevation), math.sin(orbit.elevation)
        start = level * orbit.start + height * orbit.up
        offsets = np.stack([view.center - orbit.focus for view in views])
        lengths = np.linalg.norm(offsets, axis=1)
        cosines = offsets @ start / np.where(lengths > 0, lengths, 1)
        return Standpoint(views[int(np.argmax(cosines))], orbit)

    @staticmethod
    def of_gaussians(gaussians: Gaussians, up: np.ndarray) -> Standpoint:
        """That from which all but outliers are in a square window; up: (3,) world, any length."""
        orbit = orbit_of_gaussians(gaussians, up, FIELD_OF_VIEW)
        (camera,) = orbit.viewpoints(1, 1, 1, FIELD_OF_VIEW)
        return Standpoint(camera, orbit)

    @property
    def target(self) -> np.ndarray:
        """(3,) world: the point on the camera's optical axis that is the nearest to the focus.

        In the orbit's distance, where that is behind the camera or next to it.
        """
        forward = self.camera.camera_to_world[:3, 2]
        depth = (self.orbit.focus - self.camera.center) @ forward
        radius = self.orbit.radius or 1.0
        return self.camera.center + (depth if depth > NEAREST * radius else radius) * forward

    @property
    def to_page(self) -> Similarity:
        """From the world to the axes and units of the page, whose origin is the target."""
        orbit = self.orbit
        rotation = np.stack([np.cross(orbit.up, orbit.start), orbit.up, orbit.start])
        scale = DISTANCE / np.linalg.norm(self.target - self.camera.center)
        return Similarity(float(scale), rotation, -scale * rotation @ self.target)


@dataclass(frozen=True, eq=False)
class Shown:
    """Gaussians, and how they are to be seen."""

    gaussians: Gaussians  # numpy or Dr.Jit, without a smoothing filter
    approximations: Approximations  # those of HONOURED count


def shows_as_fitted(approximations: Approximations) -> bool:
    """Whether the page renders with all of them that are not the default."""
    return approximations.others_than_default.keys() <= HONOURED


def viewer_page(
    title: str,
    shown: Shown,
    standpoint: Standpoint,
    background: tuple[float, float, float],
) -> bytes:
    """The page, UTF-8; equal arguments give equal bytes.

    background: display space. Of the camera are not shown: its roll about the optical axis, its
    principal point and its lens.

    Raises ``drgs.core.errors.UserError`` for Gaussians with numbers that are not finite.
    """
    move = standpoint.to_page
    in_file = Similarity(move.scale, FILE_AXES @ move.rotation, FILE_AXES @ move.translation)
    gaussians = replace(shown.gaussians.numpy(), origin=WORLD)  # the page has no world
    splats = in_file.of_gaussians(gaussians).to_bytes("compressed-ply")
    files = resources.files("drgs.results")
    page = Template(files.joinpath(PAGE).read_text("utf-8")).substitute(
        title=html.escape(title),
        licence=files.joinpath(SUPERSPLAT, "LICENSE").read_text("utf-8"),
        style=files.joinpath(SUPERSPLAT, "viewer.css").read_text("utf-8"),
        scene=_in_script(_scene(shown.approximations, standpoint, background)),
        code=_text(files.joinpath(SUPERSPLAT, "viewer.js.gz").read_bytes()),
        splats=_text(gzip.compress(splats, LEVEL, mtime=0)),
    )
    return page.encode("utf-8", "backslashreplace")


def least_bytes(num_gaussians: int, sh_degree: int) -> int:
    """What a page has at least: its Gaussians, in base64."""
    return int(4 / 3 * LEAST_SHARE * _bytes_of_file(num_gaussians, sh_degree))


def seconds_of_page(num_gaussians: int, sh_degree: int) -> float:
    """About what :func:`write_viewer` takes."""
    if least_bytes(num_gaussians, sh_degree) > MOST_BYTES:
        return 0.0
    return SECONDS_PER_BYTE * _bytes_of_file(num_gaussians, sh_degree)


def write_viewer(out: Path, dataset: Dataset, shown: Shown) -> None:
    """Write the page of a fit into its folder, atomically.

    One stands at one of the cameras as the fit has refined them, if it has.

    Where it would have more than :data:`MOST_BYTES`, a ``UserNote`` says how it can be had. What is
    too large by its number of Gaussians alone is not built.
    """
    gaussians = shown.gaussians
    least = least_bytes(gaussians.num_gaussians, gaussians.sh_degree)
    if least > MOST_BYTES:
        _note_size(out, f"at least {least / 1e6:.0f}")
        return
    views = refined_viewpoints(out, dataset.origin) or dataset.train
    standpoint = Standpoint.of_views(views, gaussians)
    page = viewer_page(out.resolve().name, shown, standpoint, dataset.background)
    if len(page) > MOST_BYTES:
        _note_size(out, f"{len(page) / 1e6:.0f}")
        return
    with atomic_path(out / VIEWER) as temporary:
        temporary.write_bytes(page)


def _bytes_of_file(num_gaussians: int, sh_degree: int) -> int:
    """Of a compressed PLY, but for its header and the bounds of its groups."""
    return num_gaussians * (16 + 3 * ((sh_degree + 1) ** 2 - 1))


def _note_size(out: Path, megabytes: str) -> None:
    note = (
        f"{out / VIEWER}: not written, as it would have {megabytes} MB, more than "
        f"{MOST_BYTES / 1e6:.0f}; drgs export {out} --format html writes it"
    )
    warnings.warn(UserNote(note), stacklevel=3)


def _scene(
    approximations: Approximations, standpoint: Standpoint, background: tuple[float, float, float]
) -> Mapping[str, object]:
    """What the page's script reads."""
    camera, move = standpoint.camera, standpoint.to_page
    position = move.scale * move.rotation @ camera.center + move.translation
    return {
        "settings": _settings(position, background),
        "tangents": [camera.width / (2 * camera.fx), camera.height / (2 * camera.fy)],
        "lowPass": approximations.low_pass,  # square pixels
        "antialiased": approximations.antialiased,
    }


def _settings(position: np.ndarray, background: tuple[float, float, float]) -> Mapping[str, object]:
    """Of the viewer: version 2 of its schema, but for the field of view, which windows decide."""
    off = {"enabled": False}
    return {
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


def _in_script(values: Mapping[str, object]) -> str:
    """JSON that no value can end the script element with."""
    return json.dumps(values).replace("<", "\\u003c")


def _text(data: bytes) -> str:
    return base64.b64encode(data).decode("ascii")
