"""A wall between splats, for Mitsuba and for the float64 reference."""

from dataclasses import dataclass, replace
from functools import cache

import mitsuba as mi
import numpy as np

import drgs  # noqa: F401  (registers the plugins)
from drgs.reference import splatting as reference
from support.helpers import clear
from support.reference_effects import render_with_surfaces
from support.views import VIEWS, Scene, decode

# Tolerances of test_splats: single precision, relative to the largest value of an array.
# Conversions to display space multiply errors of dark pixels by up to 13.
IMAGE, GRADIENTS = 2e-5, 1e-4

RADIANCE = np.array([0.25, 0.5, 1.5])

SKY = np.array([0.75, 0.125, 0.5])

SCENE = Scene(VIEWS[1])


@dataclass(frozen=True)
class Wall:
    """A rectangle that shines, tilted, before a camera: what ``path`` makes of it is known."""

    z: float = 2.3  # in the middle of the film, scene units
    tilt: tuple[float, float] = (0.3, -0.2)  # slopes of z along x and y
    half: float = 20.0  # side, scene units: 20 covers the film

    def axes(self) -> np.ndarray:
        """(3, 3): right, up and the normal, towards the camera; camera axes."""
        right = np.array([1, 0, self.tilt[0]])
        normal = np.cross(right, [0, 1, self.tilt[1]])
        normal *= -np.sign(normal[2])
        right, normal = right / np.linalg.norm(right), normal / np.linalg.norm(normal)
        return np.stack([right, np.cross(normal, right), normal])

    def shape(self, camera, **others) -> dict:
        """For ``mi.load_dict``."""
        to_world = np.eye(4)
        to_world[:3, :3] = camera.rotation.T @ (self.axes().T * [self.half, self.half, 1])
        to_world[:3, 3] = camera.rotation.T @ [0, 0, self.z] + camera.center
        emitter = {"type": "area", "radiance": {"type": "rgb", "value": list(RADIANCE)}}
        to_world = mi.ScalarTransform4f(to_world)
        return {"type": "rectangle", "to_world": to_world, "emitter": emitter, **others}

    def depth(self, camera) -> np.ndarray:
        """(H, W): of the plane, at the pixels' centres."""
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        slopes = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy], axis=-1)
        normal = self.axes()[2]
        return normal[2] * self.z / (slopes @ normal[:2] + normal[2])


WALL = Wall()


def load(scene, sensor=None, wall=WALL, sky=False, shapes=None, **others):
    """A Mitsuba scene; others: settings of the integrator."""
    objects = {} if wall is None else {"wall": wall.shape(scene.view.camera)}
    if sky:
        radiance = {"type": "rgb", "value": list(SKY)}
        objects["sky"] = {"type": "constant", "radiance": radiance}
    return scene.load_with(sensor, objects | (shapes or {}), **others)


@cache
def apart(scene: Scene) -> Scene:
    """With the first seed of which no pixel is near a threshold, nor a splat near the wall."""
    for seed in range(scene.seed, scene.seed + 200):
        candidate = clear(replace(scene, seed=seed))
        depths = reference.project(candidate.gaussians, candidate.camera).depths
        gaps = np.abs(depths[:, None] - WALL.depth(candidate.camera).ravel())
        if gaps.min() > 1e-5:  # float32 places a wall at 2 to 1e-6
            return candidate
    raise AssertionError("no seed among 200")


def to_display(linear) -> np.ndarray:
    """IEC 61966-2-1."""
    linear = np.asarray(linear)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)


def expected(
    scene, gaussians=None, wall=WALL, coverage=1.0, sky=None, windows=()
) -> dict[str, np.ndarray]:
    """Planes of the window: color (RGB as the integrator has it), alpha, depth, share.

    windows: black walls in front of the first one, with the parts that they stop of what arrives.
    """
    camera = scene.camera
    walls = [*((pane, alpha, np.zeros(3)) for pane, alpha in windows), (wall, coverage, RADIANCE)]
    layers = [
        (w.depth(camera), np.broadcast_to(c, (camera.height, camera.width))) for w, c, _ in walls
    ]
    rendered = render_with_surfaces(gaussians or scene.gaussians, camera, layers)
    T = rendered.transmittance[..., None]
    if not scene.srgb_primitives:
        color = rendered.color + T * (scene.background if sky is None else to_display(sky))
    elif sky is None:
        color = decode(rendered.color + T * scene.background, rendered.coverage + T[..., 0])
    else:
        color = decode(rendered.color, rendered.coverage) + T * sky
    depth, light, shares, rest = rendered.depth, 0, 0, 1.0
    for (z, alpha), before, (_, _, radiance) in zip(layers, rendered.before, walls, strict=True):
        share, rest = rest * alpha * before, rest * (1 - alpha)
        light, shares = light + share[..., None] * radiance, shares + share
        depth = depth + share * z
    if not scene.srgb_primitives:  # the mean of what the surfaces show
        mean = light / np.where(shares > 0, shares, 1)[..., None]
        light = shares[..., None] * to_display(mean)
    color = color + light
    planes = {
        "color": color,
        "alpha": 1 - T[..., 0] if sky is None else np.ones_like(depth),
        "depth": depth,
        "share": shares,
        "transmittance": T[..., 0],
    }
    return {name: plane[scene.view.window] for name, plane in planes.items()}


def rgba(scene, **arguments) -> np.ndarray:
    planes = expected(scene, **arguments)
    return np.concatenate([planes["color"], planes["alpha"][..., None]], axis=-1)


def blob(center) -> dict:
    """One of Mitsuba's own Gaussians."""
    return {
        "type": "ellipsoids",
        "centers": mi.TensorXf(np.float32([center])),
        "scales": mi.TensorXf(np.float32([[0.3, 0.3, 0.3]])),
        "quaternions": mi.TensorXf(np.float32([[0, 0, 0, 1]])),
        "opacities": mi.TensorXf(np.float32([[0.75]])),
        "sh_coeffs": mi.TensorXf(np.float32([[1, 1, 1]])),
    }
