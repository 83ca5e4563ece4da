"""Render the shipped crane truck in the ways that the gallery shows.

    python scenes/gallery.py

Writes ``depth.jpg``, ``normals.jpg``, ``fisheye.jpg``, ``panorama.jpg``, ``defocus.jpg`` and
``popping.jpg``.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import drgs
import imageio.v3 as iio
import matplotlib as mpl
import mitsuba as mi
import numpy as np

SIZE_PX = 400
SPLATS = {
    "type": "splats",
    "filename": str(drgs.EXAMPLE),
    "srgb_primitives": False,  # display values, as trained
    "background": [1, 1, 1],
}


def main() -> None:
    """Render all images."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/gallery"),
        metavar="DIR",
        help="output folder (default: out/gallery)",
    )
    out = parser.parse_args().out
    mi.set_variant("llvm_ad_rgb")
    out.mkdir(parents=True, exist_ok=True)
    for render in (depth, normals, fisheye, panorama, defocus, popping):
        image = np.clip(render(), 0, 1)
        iio.imwrite(out / f"{render.__name__}.jpg", np.uint8(255 * image + 0.5), quality=88)


def render(sensor: dict[str, Any] | None = None, **settings: object) -> np.ndarray:
    """Return the image (H, W, channels) of a sensor, by default a pinhole camera's."""
    scene = {"type": "scene", "splats": SPLATS | settings, "camera": camera(**sensor or {})}
    return np.array(mi.render(mi.load_dict(scene)))


def camera(origin: tuple[float, float, float] = (2.6, -2.4, 1.5), **others: Any) -> dict[str, Any]:
    """Return a sensor that looks at the truck."""
    width, height = others.pop("size", (SIZE_PX, SIZE_PX))
    film = {"type": "hdrfilm", "width": width, "height": height, "rfilter": {"type": "box"}}
    samples, target = others.pop("samples", 1), others.pop("target", [0, 0, 0])
    others = others or {"type": "perspective", "fov": 38}
    return others | {
        "to_world": mi.ScalarTransform4f().look_at(origin, target, [0, 0, 1]),
        "film": film,
        "sampler": {"type": "stratified", "sample_count": samples, "jitter": samples > 1},
    }


def depth() -> np.ndarray:
    """Return the mean depth, near in light colours."""
    image = render(aovs="z:depth, a:alpha")
    total, alpha = image[..., -2], image[..., -1]
    mean = total / np.maximum(alpha, 1e-6)
    near, far = np.percentile(mean[alpha > 0.5], (1, 99))
    colors = mpl.colormaps["magma"](np.clip((far - mean) / (far - near), 0, 1))[..., :3]
    return alpha[..., None] * colors + 1 - alpha[..., None]


def normals() -> np.ndarray:
    """Return the normals' world coordinates as colours."""
    image = render(aovs="a:alpha, n:normal")
    alpha, normal = image[..., -4:-3], image[..., -3:]
    return 0.5 * (normal + alpha) + 1 - alpha


def fisheye() -> np.ndarray:
    """Return the image of a fisheye lens near the truck."""
    lens = {"type": "calibrated", "lens": "fisheye", "k1": 0.02, "fx": 190.0, "fy": 190.0}
    return render({"origin": (0.9, -1.0, 0.55), **lens}, projection="unscented")[..., :3]


def panorama() -> np.ndarray:
    """Return all that is around a point on the truck."""
    sensor = {
        "type": "calibrated",
        "lens": "equirectangular",
        "near_clip": 0.2,
        "size": (1000, 500),
    }
    return render({"origin": (0.0, -0.2, 0.2), "target": (0.0, 1.0, 0.2), **sensor})[..., :3]


def defocus() -> np.ndarray:
    """Return the image of a wide aperture that is focused on the cabin."""
    lens = {"type": "thinlens", "fov": 38, "aperture_radius": 0.09, "focus_distance": 3.2}
    return render({**lens, "samples": 16})[..., :3]


def popping() -> np.ndarray:
    """Return two sheets that cross: with one order for all pixels, and with an order per pixel."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-1, 1, (2, 400))
    sheets, colors = [], []
    for slope, color in ((0.6, (0.9, 0.35, 0.1)), (-0.6, (0.1, 0.4, 0.8))):
        sheets.append(np.stack([x, slope * x, y], axis=-1))
        colors.append(np.broadcast_to(color, (x.size, 3)))
    means, n = np.concatenate(sheets), 2 * x.size
    turn = 0.5 * np.arctan(0.6) * np.repeat([1, -1], x.size)  # about z
    zero = np.zeros(n)
    tensors = {
        "means": means,
        "quats": np.stack([np.cos(turn), zero, zero, np.sin(turn)], axis=-1),
        "log_scales": np.log(np.tile([0.13, 0.002, 0.13], (n, 1))),
        "logit_opacities": np.full(n, 3.0),
        "sh0": ((np.concatenate(colors) - 0.5) / 0.28209479)[:, None],
    }
    arrays = {name: mi.TensorXf(np.float32(value)) for name, value in tensors.items()}
    splats = {name: value for name, value in SPLATS.items() if name != "filename"} | arrays
    images = []
    for order in ("center", "pixel"):
        integrator = splats | {"order": order, "projection": "exact"}
        scene = {"type": "scene", "splats": integrator, "camera": camera((1.2, -4.2, 0.8))}
        images.append(np.array(mi.render(mi.load_dict(scene)))[..., :3])
    return np.hstack(images)


if __name__ == "__main__":
    main()
