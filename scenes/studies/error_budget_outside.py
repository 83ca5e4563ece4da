"""Does an error budget keep its word at views that it has not measured, by an independent truth?

Twelve kinds of scene are rendered by the plugin with an error budget. The truth is
``reference_rays``: numpy in double precision, the peak of each Gaussian along each pixel's
ray, in the order of the peaks, without cut-offs; it shares no code with the kernels. Errors are
root mean squares of display values.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import drgs  # noqa: F401  (chooses libLLVM)
import mitsuba as mi
import numpy as np
import reference_rays as rays
from drgs.accuracy.error_budget import measured_places
from drgs.bench.output import machine, markdown_table
from drgs.core.errors import UserError
from drgs.reference.splatting import Gaussians
from scipy.spatial.transform import Rotation

BUDGETS = (0.03, 0.015, 0.008, 0.004, 0.002)
NUM_VIEWS, NUM_JUDGED = 24, 6
NUM_POINTS = 32  # of an aperture, or times of an open shutter
WIDTH, HEIGHT, FOCAL = 64, 48, 60.0
NO_CUTS = rays.ImageModel(
    projection="exact", order="pixel", sh_direction="pixel", low_pass=0.0, alpha_cut=0.0,
    transmittance_stop=0.0,
)  # fmt: skip
MAX_PAIRS = 2_000_000  # of pixels and Gaussians at a time
DEGREE = 1
FISHEYE_ANGLE = 0.95 * np.pi  # between the axis and means that are shown
BACKGROUND = (0.2, 0.5, 0.8)


@dataclass(frozen=True)
class Pose:
    """A camera: rotation, world to camera (x right, y down, z forward), and centre."""

    rotation: np.ndarray
    center: np.ndarray

    def to_world(self) -> mi.ScalarTransform4f:
        """Return Mitsuba's transform."""
        matrix = np.eye(4)
        matrix[:3, :3] = self.rotation.T @ np.diag([-1.0, -1.0, 1.0])
        matrix[:3, 3] = self.center
        return mi.ScalarTransform4f(matrix)


@dataclass(frozen=True)
class Kind:
    """A kind of scene."""

    gaussians: dict[str, np.ndarray]
    views: list[Pose]
    lens: str = "pinhole"
    size: tuple[int, int] = (WIDTH, HEIGHT)
    focal: float = FOCAL
    close: Callable[[Pose], Pose] | None = None  # pose when the shutter closes
    shutter: str = "global"
    aperture: tuple[float, float] | None = None  # radius, focus distance
    wall: float | None = None  # height of a lamp below the splats, in a white environment
    settings: dict[str, Any] = field(default_factory=dict)

    def sensor(self, pose: Pose) -> dict[str, Any]:
        """Return Mitsuba's description of a view."""
        width, height = self.size
        film = {"type": "hdrfilm", "width": width, "height": height, "pixel_format": "rgb"}
        film["rfilter"] = {"type": "box"}
        sensor = {"film": film, "to_world": pose.to_world()}
        if self.aperture is not None:
            radius, distance = self.aperture
            fov = float(np.degrees(2 * np.arctan(width / 2 / self.focal)))
            lens = {"type": "thinlens", "fov": fov, "fov_axis": "x"}
            return sensor | lens | {"aperture_radius": radius, "focus_distance": distance}
        sensor |= {"type": "calibrated", "lens": self.lens}
        if self.lens != "equirectangular":
            sensor["fx"] = self.focal
        if self.close is not None:
            sensor |= {"to_world_close": self.close(pose).to_world(), "shutter": self.shutter}
            sensor |= {"shutter_samples": 8} if self.shutter == "global" else {}
        return sensor

    def scene(self, budget: float) -> mi.Scene:
        """Return the scene with all views."""
        arrays = {k: mi.TensorXf(v.astype(np.float32)) for k, v in self.gaussians.items()}
        given = {"background": list(BACKGROUND), "srgb_primitives": False}
        splats = {"type": "splats", "error": budget, "low_pass": 0.0, **given, **self.settings}
        objects: dict[str, Any] = {}
        if self.wall is not None:
            splats |= {"srgb_primitives": True}
            place = mi.ScalarTransform4f().translate([0, 0, self.wall]).scale(1.5)
            lamp = {"type": "area", "radiance": 0.6}
            objects["wall"] = {"type": "rectangle", "to_world": place, "emitter": lamp}
            objects["sky"] = {"type": "constant", "radiance": 1.0}
        views = {f"view{k:03}": self.sensor(pose) for k, pose in enumerate(self.views)}
        return mi.load_dict({"type": "scene", "integrator": splats | arrays, **views, **objects})

    def truth(self, pose: Pose) -> np.ndarray:
        """Return the image (H, W, 3), display space."""
        images = [self._of_rays(*each) for each in self._rays(pose)]
        return np.mean(images, axis=0)

    def _rays(self, pose: Pose) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield origins and directions (H, W, 3), world, of images whose mean is the view's."""
        own = self._directions()
        if self.close is None and self.aperture is None:
            yield np.broadcast_to(pose.center, own.shape), own @ pose.rotation
        elif self.aperture is not None:
            radius, distance = self.aperture
            for k in range(NUM_POINTS):  # sunflower
                r, angle = radius * np.sqrt((k + 0.5) / NUM_POINTS), k * np.pi * (3 - np.sqrt(5))
                begin = np.array([r * np.cos(angle), r * np.sin(angle), 0])
                toward = (own * distance - begin) / distance
                origin = pose.center + begin @ pose.rotation
                yield np.broadcast_to(origin, own.shape), toward @ pose.rotation
        elif self.shutter == "rolling":
            times = (np.arange(self.size[1]) + 0.5) / self.size[1]
            at = [self._pose_at(pose, time) for time in times]
            origins = np.array([np.broadcast_to(p.center, own[0].shape) for p in at])
            yield origins, np.array([row @ p.rotation for row, p in zip(own, at, strict=True)])
        else:
            for k in range(NUM_POINTS):
                at = self._pose_at(pose, (k + 0.5) / NUM_POINTS)
                yield np.broadcast_to(at.center, own.shape), own @ at.rotation

    def _pose_at(self, pose: Pose, time: float) -> Pose:
        assert self.close is not None, "it moves"
        last = self.close(pose)
        turn = Rotation.from_matrix(last.rotation @ pose.rotation.T).as_rotvec()
        rotation = Rotation.from_rotvec(time * turn).as_matrix() @ pose.rotation
        return Pose(rotation, (1 - time) * pose.center + time * last.center)

    def _directions(self) -> np.ndarray:
        """Return directions (H, W, 3) of pixels, camera axes; the depth grows by 1 along each."""
        width, height = self.size
        y, x = np.mgrid[:height, :width] + 0.5
        if self.lens == "equirectangular":
            theta, phi = (x / width - 0.5) * 2 * np.pi, (y / height - 0.5) * np.pi
            return np.stack(
                [np.sin(theta) * np.cos(phi), np.sin(phi), np.cos(theta) * np.cos(phi)], axis=-1
            )
        u, v = (x - width / 2) / self.focal, (y - height / 2) / self.focal
        if self.lens == "pinhole":
            return np.stack([u, v, np.ones_like(u)], axis=-1)
        angle = np.hypot(u, v)
        sine = np.sinc(angle / np.pi)
        return np.stack([sine * u, sine * v, np.cos(angle)], axis=-1)

    def _of_rays(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        values = {k: v.astype(np.float32).astype(np.float64) for k, v in self.gaussians.items()}
        gaussians = Gaussians(**values)
        kept = self._are_shown(gaussians, origins, directions)
        gaussians = Gaussians(*(array[kept] for array in vars(gaussians).values()))
        rows = max(1, MAX_PAIRS // (len(gaussians.means) * origins.shape[1]))
        return np.concatenate(
            [
                self._part(gaussians, origins[k : k + rows], directions[k : k + rows])
                for k in range(0, len(origins), rows)
            ]
        )

    def _part(
        self, gaussians: Gaussians, origins: np.ndarray, directions: np.ndarray
    ) -> np.ndarray:
        if self.wall is None:
            shown = rays.render_along(
                gaussians, origins, directions, background=BACKGROUND, model=NO_CUTS
            )
            return shown.image
        t = (self.wall - origins[..., 2]) / directions[..., 2]
        hit = np.abs(origins + t[..., None] * directions)[..., :2].max(axis=-1) <= 1.5
        far = np.where((t > 0) & hit, t, np.inf)
        shown = rays.render_along(gaussians, origins, directions, far=far, model=NO_CUTS)
        lamp = np.where(origins[..., 2] > self.wall, 0.6, 0.0)  # dark from below
        behind = np.where(np.isfinite(far), lamp, 1.0)[..., None]
        alpha = shown.alpha[..., None]
        linear = alpha * linear_of(shown.image / np.where(alpha > 0, alpha, 1))
        return display_of(linear + (1 - alpha) * behind)

    def counts(self, pose: Pose) -> np.ndarray:
        """Return pixels (H, W) in which the wall does not end: those are seen in random points."""
        width, height = self.size
        if self.wall is None:
            return np.ones((height, width), bool)
        y, x = np.mgrid[: 8 * height, : 8 * width] / 8 + 1 / 16
        u, v = (x - width / 2) / self.focal, (y - height / 2) / self.focal
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ pose.rotation
        t = (self.wall - pose.center[2]) / rays[..., 2]
        hit = (t > 0) & (np.abs(pose.center + t[..., None] * rays)[..., :2].max(axis=-1) <= 1.5)
        share = hit.reshape(height, 8, width, 8).mean(axis=(1, 3))
        return (share == 0) | (share == 1)

    def _are_shown(
        self, gaussians: Gaussians, origins: np.ndarray, directions: np.ndarray
    ) -> np.ndarray:
        """Return whether the lens shows the means: others are not drawn, by any approximation."""
        if self.lens == "equirectangular":
            return np.ones(len(gaussians.means), bool)
        if self.lens == "fisheye":
            axis = directions.sum(axis=(0, 1))
            offsets = gaussians.means - origins[0, 0]
            cosines = offsets @ axis / np.linalg.norm(offsets, axis=1) / np.linalg.norm(axis)
            return cosines > np.cos(FISHEYE_ANGLE)
        # Along the optical axis, which all directions advance by 1: least squares.
        flat = directions.reshape(-1, 3)
        axis = np.linalg.lstsq(flat, np.ones(len(flat)), rcond=None)[0]
        return (gaussians.means - origins[0, 0]) @ axis >= 0.01


def linear_of(display: np.ndarray) -> np.ndarray:
    """Return the linear values of sRGB's."""
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4)


def display_of(linear: np.ndarray) -> np.ndarray:
    """Return sRGB's values of linear ones."""
    linear = np.maximum(linear, 0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


# Scenes


def gaussians_of(
    seed: int,
    count: int,
    size: float,
    spread: float = 0.6,
    anisotropy: float = 0.5,
    logit: float = 0.0,
) -> dict[str, np.ndarray]:
    """Return random Gaussians around the origin."""
    rng = np.random.default_rng(seed)
    return {
        "means": rng.normal(0, spread, (count, 3)),
        "quats": rng.normal(size=(count, 4)),
        "log_scales": np.log(size) + rng.normal(0, anisotropy, (count, 3)),
        "logit_opacities": rng.normal(logit, 1.0, count),
        "sh0": rng.normal(0, 1.0, (count, 1, 3)),
        "shN": rng.normal(0, 0.2, (count, 3, 3)),
    }


def around(
    distance: float, center: np.ndarray | float = 0.0, heights: tuple[float, float] = (0.3, 0.5)
) -> list[Pose]:
    """Return views from a ring, from changing heights (mean, amplitude), towards its middle."""
    poses = []
    for k in range(NUM_VIEWS):
        angle, height = 2 * np.pi * k / NUM_VIEWS, heights[0] + heights[1] * np.sin(2.4 * k)
        place = np.array([np.cos(angle), np.sin(angle), height])
        place *= distance / np.linalg.norm(place)
        forward = -place / distance
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        rotation = np.array([right, np.cross(forward, right), forward])
        poses.append(Pose(rotation.astype(np.float32).astype(float), place + center))
    return poses


def moving(turn: float, travel: float) -> Callable[[Pose], Pose]:
    """Return the motion of a camera while its shutter is open."""
    rotation = Rotation.from_rotvec(turn * np.array([0.5, -0.6, 0.6])).as_matrix()
    way = travel * np.array([0.6, 0.5, -0.6])
    return lambda pose: Pose(rotation @ pose.rotation, pose.center + way)


def with_rows(one: dict[str, np.ndarray], other: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return the Gaussians of both."""
    return {name: np.concatenate([one[name], other[name]]) for name in one}


def kinds() -> dict[str, Kind]:
    """Return all kinds of scene by name."""
    plain = gaussians_of(0, 400, 0.12)
    needles = gaussians_of(1, 300, 0.05)
    needles["log_scales"][:, 0] += 2.5
    giants = gaussians_of(2, 120, 0.6, anisotropy=0.6, logit=-1.0)
    fog = gaussians_of(3, 2500, 0.3, logit=-4.5)
    huge = gaussians_of(4, 1, 1.0, spread=0.0, logit=-1.0)
    far_away = {**plain, "means": plain["means"] + np.array([300.0, -200.0, 100.0])}
    far_away["means"] = far_away["means"].astype(np.float32).astype(float)
    inside = [replace(pose, center=0.2 * pose.center) for pose in around(3.0)]
    wide = Kind(gaussians_of(6, 200, 0.25, spread=1.0), inside, "fisheye", focal=18.0)
    return {
        "plain": Kind(plain, around(3.0)),
        "needles": Kind(needles, around(3.0)),
        "inside giants": Kind(giants, inside),
        "fog of faint splats": Kind(fog, around(3.0)),
        "a huge splat before the camera": Kind(with_rows(plain, huge), around(1.6)),
        "far origin": Kind(far_away, around(3.0, center=np.array([300.0, -200.0, 100.0]))),
        "8 x 8 pixels": Kind(plain, around(3.0), size=(8, 8), focal=8.0),
        "wide fisheye": wide,
        "panorama": replace(wide, lens="equirectangular", size=(96, 48)),
        "open shutter": Kind(plain, around(3.0), close=moving(0.05, 0.15)),
        "rolling shutter": Kind(plain, around(3.0), close=moving(0.05, 0.15), shutter="rolling"),
        "open aperture": Kind(plain, around(3.0), aperture=(0.05, 3.0)),
        "surface and environment": Kind(plain, around(3.0, heights=(0.9, 0.3)), wall=-0.4),
    }


# Measurement


def rows_of(name: str, kind: Kind, given: tuple[float, ...]) -> Iterator[list[str]]:
    """Yield the results of a kind of scene, one for each budget."""
    width, height = kind.size
    measured = set(measured_places(len(kind.views), width * height))
    places = [k for k in range(len(kind.views)) if k not in measured]
    places = [places[int(k)] for k in np.linspace(0, len(places) - 1, NUM_JUDGED)]
    truths = {place: kind.truth(kind.views[place]) for place in places}
    for budget in given:
        scene = kind.scene(budget)
        try:
            images = {place: np.array(mi.render(scene, sensor=place, spp=1)) for place in places}
        except (UserError, RuntimeError, ValueError) as refused:
            while refused.__context__ is not None:
                refused = refused.__context__
            words = str(refused).strip().splitlines()[-1]
            yield [name, f"{budget:g}", words[words.find("cannot") :], "", "", ""]
            continue
        if kind.wall is not None:
            images = {place: display_of(image) for place, image in images.items()}
        counts = {k: kind.counts(kind.views[k]) for k in places}
        errors = [float(np.sqrt(np.mean((images[k] - truths[k])[counts[k]] ** 2))) for k in places]
        report = scene.integrator().state.budget_report
        kept = sum(error <= budget for error in errors)
        yield [
            *(name, f"{budget:g}", report.chosen.words, f"{kept} of {len(errors)}"),
            *(f"{max(errors) / budget:.2f}", f"{report.chosen.error / budget:.2f}"),
        ]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kinds", nargs="*", help="kinds of scene; default: all")
    parser.add_argument("--budgets", nargs="+", type=float, default=list(BUDGETS))
    parser.add_argument("--out", type=Path, help="Markdown file to write")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    header = ["scene", "budget", "chosen", "within", "worst error / budget", "stated / budget"]
    table = []
    for name, kind in kinds().items():
        if args.kinds and name not in args.kinds:
            continue
        for row in rows_of(name, kind, tuple(args.budgets)):
            print(" | ".join(row), flush=True)
            table.append(row)
    text = f"{machine()}\n\n{markdown_table(header, table)}\n"
    judged = [row for row in table if row[3]]
    kept = sum(int(row[3].split()[0]) for row in judged)
    worst = max((float(row[4]) for row in judged), default=0.0)
    text += f"\n{kept} of {len(judged) * NUM_JUDGED} views are within, the worst {worst:.2f}.\n"
    if args.out:
        args.out.write_text(text)
    print(text)


if __name__ == "__main__":
    main()
