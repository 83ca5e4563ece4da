"""Light in a flat mirror against the mirrored camera: ``python scenes/flat_mirror.py``.

A cloud of splats hangs over a mirror, out of the camera's sight. What the mirror shows is what the
camera that is mirrored in its plane sees: float64 rays of that (``studies.reference_rays``) through
every pixel give the image that all are compared with. Prints a table.
"""

from __future__ import annotations

import argparse

import drgs  # noqa: F401  (registers the plugins)
import mitsuba as mi
import numpy as np
from drgs.bench.output import markdown_table
from drgs.cli.commands import bounded_int
from drgs.reference.splatting import Gaussians
from drgs.results import metrics

from studies.reference_rays import ImageModel, render_along

LIGHTS = {
    "none": {},
    "probe": {"light": "probe", "probes": "mirror"},
    "rays, 4 splats a ray": {"light": "rays", "light_samples": 4},
    "rays, all splats": {"light": "rays", "light_samples": 0},
}

SIDE = 4
"""Rays of the reference through each pixel, along either axis."""

PATHS = 64
"""Paths of a pixel."""


def main() -> None:
    """Entry point of the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--size", type=bounded_int(1), default=64, help="px (default: 64)")
    parser.add_argument("--splats", type=bounded_int(1), default=300, help="(default: 300)")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    splats = cloud(args.splats)
    images = {name: render(splats, args.size, settings) for name, settings in LIGHTS.items()}
    print(table(images, mirrored_camera(splats, args.size)))


def cloud(count: int) -> Gaussians:
    """Opaque and colourful splats over the origin, whose colours depend on the direction."""
    rng = np.random.default_rng(7)
    return Gaussians(
        means=rng.uniform(-0.4, 0.4, (count, 3)) + np.array([0, 0.9, 0]),
        quats=rng.normal(size=(count, 4)),
        log_scales=np.log(0.08) + rng.normal(0, 0.3, (count, 3)),
        logit_opacities=np.full(count, 3.0),
        sh0=rng.normal(0.3, 0.8, (count, 1, 3)),
        shN=rng.normal(0, 0.2, (count, 3, 3)),
    )


def render(splats: Gaussians, size: int, light: dict[str, object]) -> np.ndarray:
    """Linear image (H, W, 3) of the mirror."""
    T = mi.ScalarTransform4f
    tensors = {k: mi.TensorXf(np.float32(values)) for k, values in vars(splats).items()}
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    scene = mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 30,
                "to_world": T().look_at([0.3, 1.0, -2.6], [0, -0.9, 0], [0, 1, 0]),
                "film": film | {"pixel_format": "rgb"},
            },
            "mirror": {
                "type": "rectangle",
                "to_world": T().rotate([1, 0, 0], -90).scale(3),
                "bsdf": {"type": "conductor", "material": "none"},
            },
            "sky": {"type": "constant", "radiance": 0.0},
            "integrator": {
                "type": "splats",
                "nested": {"type": "splatpath", "max_depth": 3},
                "nested_spp": PATHS,
                **tensors,
                **light,
            },
        }
    )
    return np.array(mi.render(scene, spp=1), np.float64)


def mirrored_camera(splats: Gaussians, size: int) -> np.ndarray:
    """The same image as the mirrored camera sees it, in float64."""
    origin, target = np.array([0.3, -1.0, -2.6]), np.array([0, 0.9, 0])
    forward = (target - origin) / np.linalg.norm(target - origin)
    right = np.cross(forward, [0, 1, 0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)  # what is up in the mirror image is down on the film
    place = (2 * (np.arange(size * SIDE) + 0.5) / (size * SIDE) - 1) * np.tan(np.deg2rad(15))
    x, y = np.meshgrid(place, place)
    towards = forward + x[..., None] * right + y[..., None] * up
    towards /= np.linalg.norm(towards, axis=-1, keepdims=True)
    starts = origin - (origin[1] / towards[..., 1])[..., None] * towards
    model = ImageModel("exact", order="pixel", low_pass=0)
    rows = zip(starts[:, None], towards[:, None], strict=True)  # one at a time
    seen = [render_along(splats, *row, model=model) for row in rows]
    coverage = np.concatenate([row.alpha for row in seen])[..., None]
    color = np.concatenate([row.image for row in seen]) / np.where(coverage > 0, coverage, 1)
    linear = np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)
    return (coverage * linear).reshape(size, SIDE, size, SIDE, 3).mean((1, 3))


def table(images: dict[str, np.ndarray], expected: np.ndarray) -> str:
    """Errors of images, and how much of the light they have."""
    rows = [
        (name, f"{image.mean() / expected.mean():.1%}", f"{metrics.psnr(image, expected):.1f}")
        for name, image in images.items()
    ]
    return markdown_table(("`light`", "light in the mirror", "PSNR [dB]"), rows)


if __name__ == "__main__":
    main()
