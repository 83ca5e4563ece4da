"""A glossy trefoil knot of Gaussians, computed: ``python scenes/knot.py [--out FILE.ply]``.

A model that is small enough to be shipped and needs no photographs: coloured stripes under two
lamps, whose highlights are in the spherical harmonics. The one that is shipped is
``scenes/shapes/knot.ply``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from drgs.gaussians.parameters import Gaussians
from drgs.reference import splatting as reference
from scipy.spatial.transform import Rotation

DEGREE = 2
SIZE, TUBE = 0.36, 0.2  # scene units: of the knot's centre line, whose radius is 3; of the tube
ALONG, AROUND = 210, 10  # Gaussians
OPACITY = 0.9
THICKNESS = 0.05  # scene units: standard deviation across the surface; along it 0.03 to 0.07

COLORS = np.array([[0.94, 0.42, 0.16], [0.98, 0.86, 0.62], [0.10, 0.45, 0.53]])  # display space
LAMPS = np.array([[0.5, -0.6, 0.8], [-0.8, -0.5, 0.3]])  # directions to them
BRIGHTNESS = np.array([0.75, 0.35])
AMBIENT, GLOSS, SHARPNESS = 0.35, 0.7, 6.0


def knot() -> Gaussians:
    """The model, float32."""
    middle, frames = centre_line()
    angles = 2 * np.pi * (np.arange(AROUND) + 0.5 * (np.arange(ALONG)[:, None] % 2)) / AROUND
    outwards = np.stack([np.zeros_like(angles), np.cos(angles), np.sin(angles)], axis=-1)
    normals = np.einsum("aij,arj->ari", frames, outwards)
    means = middle[:, None] + TUBE * normals
    along = np.broadcast_to(frames[:, None, :, 0], normals.shape)
    axes = np.stack([along, np.cross(normals, along), normals], axis=-1).reshape(-1, 3, 3)

    step = np.linalg.norm(np.roll(means, -1, 0) - np.roll(means, 1, 0), axis=-1) / 2
    around = np.full_like(step, 2 * np.pi * TUBE / AROUND)
    scales = np.stack([0.8 * step, 0.55 * around, np.full_like(step, THICKNESS)], axis=-1)

    stripes = np.floor(np.arange(ALONG) * 21 / ALONG).astype(int) % len(COLORS)
    colors = np.repeat(COLORS[stripes], AROUND, axis=0)
    sh = shaded(axes[:, :, 2], colors)
    num = len(colors)
    values = {
        "means": means.reshape(-1, 3),
        "quats": np.roll(Rotation.from_matrix(axes).as_quat(), 1, axis=1),
        "log_scales": np.log(scales.reshape(-1, 3)),
        "logit_opacities": np.full(num, np.log(OPACITY / (1 - OPACITY))),
        "sh0": sh[:, :1],
        "shN": sh[:, 1:],
    }
    return Gaussians(**{name: value.astype(np.float32) for name, value in values.items()})


def centre_line() -> tuple[np.ndarray, np.ndarray]:
    """Points (ALONG, 3), and (ALONG, 3, 3) axes in columns, of which the first is the tangent."""
    t = 2 * np.pi * np.arange(ALONG) / ALONG
    radius = 2 + np.cos(3 * t)
    points = np.stack([radius * np.cos(2 * t), radius * np.sin(2 * t), np.sin(3 * t)], axis=1)
    tangents = unit(np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0))
    # Away from the torus's own circle: defined everywhere, unlike a curve's principal normal.
    circle = 2 * np.stack([np.cos(2 * t), np.sin(2 * t), 0 * t], axis=1)
    sideways = unit(np.cross(tangents, points - circle))
    return SIZE * points, np.stack([tangents, sideways, np.cross(tangents, sideways)], axis=-1)


def shaded(normals: np.ndarray, colors: np.ndarray) -> np.ndarray:
    """Coefficients (N, K, 3) of what surfels (N, 3) reflect towards each side."""
    directions = unit(np.random.default_rng(0).normal(0, 1, (400, 3)))
    seen = np.broadcast_to(AMBIENT * colors[:, None], (len(colors), 400, 3)).copy()
    for lamp, brightness in zip(unit(LAMPS), BRIGHTNESS, strict=True):
        facing = np.maximum(normals @ lamp, 0)[:, None]
        mirrored = 2 * facing * normals - lamp
        # Directions are those in which the camera looks.
        highlight = np.maximum(-(mirrored @ directions.T), 0) ** SHARPNESS * (facing > 0)
        seen += brightness * (facing[..., None] * colors[:, None] + GLOSS * highlight[..., None])
    basis = reference.sh_basis(directions, DEGREE)
    return np.einsum("kd,ndc->nkc", np.linalg.pinv(basis), seen - 0.5)


def unit(vectors: np.ndarray) -> np.ndarray:
    """Normalize vectors along the last axis."""
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def main() -> None:
    """Entry point of the command."""
    parser = argparse.ArgumentParser(description="Compute a glossy knot of Gaussians.")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/knot.ply"),
        metavar="FILE.ply",
        help="(default: %(default)s)",
    )
    args = parser.parse_args()
    args.out.parent.mkdir(parents=True, exist_ok=True)
    knot().save(args.out)
    print(f"written: {args.out}")


if __name__ == "__main__":
    main()
