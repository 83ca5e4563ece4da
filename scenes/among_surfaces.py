"""Splats among surfaces against what is known: ``python scenes/among_surfaces.py``.

Two tables. In a white furnace (white splats around a white object under a white sky) every pixel is
1, whichever way light takes. A black ball made of splats throws the shadow of a black sphere.
"""

from __future__ import annotations

import argparse

import drgs  # noqa: F401  (registers the plugins)
import mitsuba as mi
import numpy as np
from drgs.bench.output import markdown_table
from drgs.cli.commands import bounded_int
from drgs.reference.splatting import C_00, Gaussians

PATHS = 64
"""Paths of a pixel, in each of :data:`ROUNDS` images."""

ROUNDS = 8

LIGHTS = {
    "rays, all splats": {"light": "rays", "light_samples": 0},
    "rays, 4 splats a ray": {"light": "rays", "light_samples": 4},
    "probe": {"light": "probe", "probes": "object"},
    "probe, unseen by rays": {"light": "probe", "probes": "object", "probe_fallback": "rays"},
}

WHITE = {"type": "rgb", "value": 1.0}

MATERIALS = {
    "mirror": {"type": "conductor", "material": "none"},
    "matt": {"type": "diffuse", "reflectance": WHITE},
    "glass": {"type": "dielectric"},
    "glass of index 1": {"type": "dielectric", "int_ior": 1.0, "ext_ior": 1.0},
    "window": {"type": "thindielectric"},
    "nothing": {"type": "null"},
}

LAMPS = {
    "point": {"type": "point", "position": [0.0, 0.0, 4.0], "intensity": 16.0},
    "directional": {"type": "directional", "direction": [0.0, 0.2, -1.0], "irradiance": 1.0},
    "area": {"type": "rectangle"},  # placed by lamp()
    "sky": {"type": "constant"},
}


def main() -> None:
    """Entry point of the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--size", type=bounded_int(1), default=32, help="px (default: 32)")
    parser.add_argument("--splats", type=bounded_int(1), default=4000, help="of the ball")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    print(furnace_table(args.size))
    print(shadow_table(args.size, args.splats))


# ----------------------------------------------------------------------------------------------
# White furnace
# ----------------------------------------------------------------------------------------------


def white_cloud(count: int = 150) -> Gaussians:
    """White splats of all opacities around the origin, between 1 and 2 units from it."""
    rng = np.random.default_rng(3)
    directions = rng.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    means = directions * rng.uniform(1.0, 2.0, (count, 1))
    return balls(means, 0.25, rng.uniform(0.05, 0.99, count), color=1.0)


def balls(means: np.ndarray, scale: float, opacities: np.ndarray, color: float) -> Gaussians:
    """Round splats of one size and colour."""
    count = len(means)
    return Gaussians(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.full((count, 3), np.log(scale)),
        logit_opacities=np.log(opacities / (1 - opacities)),
        sh0=np.full((count, 1, 3), (color - 0.5) / C_00),
        shN=np.zeros((count, 0, 3)),
    )


def furnace(size: int, settings: dict, objects: dict, rounds: int = ROUNDS) -> tuple[float, float]:
    """Mean over an image of the furnace, and its standard error by images of several seeds."""
    sky = {"sky": {"type": "constant", "radiance": WHITE}} if "background" not in settings else {}
    scene = load(white_cloud(), [0, 0, 4], size, settings, objects | sky)
    means = [np.mean(mi.render(scene, seed=seed)) for seed in range(rounds)]
    return float(np.mean(means)), float(np.std(means, ddof=1) / np.sqrt(rounds))


def furnace_rows(size: int, rounds: int = ROUNDS) -> list[tuple[str, str, float, float]]:
    """Material, light, mean and standard error."""
    rows = [
        ("no object", "own background", *furnace(size, {"background": [1.0] * 3}, {}, rounds)),
        ("no object", "sky", *furnace(size, {}, {}, rounds)),
    ]
    for material, bsdf in MATERIALS.items():
        ball = {"object": {"type": "sphere", "radius": 0.7, "bsdf": bsdf}}
        rows += [(material, k, *furnace(size, v, ball, rounds)) for k, v in LIGHTS.items()]
    return rows


def furnace_table(size: int) -> str:
    """Mean and standard error of each material and each way of light."""
    cells: dict[str, dict[str, str]] = {}
    for material, light, mean, error in furnace_rows(size):
        cells.setdefault(material, {})[light] = f"{mean:.4f} ± {error:.4f}"
    lights = list(dict.fromkeys(light for found in cells.values() for light in found))
    rows = [(name, *(found.get(light, "") for light in lights)) for name, found in cells.items()]
    return markdown_table(("object", *lights), rows)


# ----------------------------------------------------------------------------------------------
# Shadows
# ----------------------------------------------------------------------------------------------


def black_ball(count: int, radius: float) -> Gaussians:
    """A ball at a height of 1.5 whose splats, on its surface, reach half their alpha there."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + np.sqrt(5)) * k
    directions = np.stack([np.sqrt(1 - z**2) * f(turn) for f in (np.cos, np.sin)] + [z], axis=1)
    scale = 2 * radius / np.sqrt(count)
    means = (radius - 1.9 * scale) * directions + [0, 0, 1.5]
    return balls(means, scale, np.full(count, 0.99), color=0.0)


def lamp(name: str) -> dict:
    """One of :data:`LAMPS`, for ``mi.load_dict``."""
    if name != "area":
        return LAMPS[name]
    to_world = mi.ScalarTransform4f().look_at([1, 0, 4], [0, 0, 0], [0, 1, 0]).scale(0.5)
    return {"type": "rectangle", "to_world": to_world, "emitter": {"type": "area"}}


def floor_image(size: int, name: str, ball: dict, splats: Gaussians) -> np.ndarray:
    """Render the floor below the ball from a camera that does not see the ball."""
    floor = {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(20)}
    objects = {"floor": floor, "lamp": lamp(name)} | ball
    settings = {"light": "rays", "nested_spp": 4 * PATHS}
    scene = load(splats, [0, -3, 1.2], size, settings, objects, target=[0, 0, 0], up=[0, 0, 1])
    return np.array(mi.render(scene), np.float64)


def shadow_rows(size: int, count: int) -> list[tuple[str, float, float, float]]:
    """Lamp; what sphere and splats leave of the floor's light; mean difference by the light."""
    nothing = balls(np.array([[0, 0, -100.0]]), 0.1, np.array([0.5]), 0.0)
    sphere = {"type": "sphere", "center": [0, 0, 1.5], "radius": 0.6}
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    rows = []
    for name in LAMPS:
        lit = floor_image(size, name, {}, nothing)
        known = floor_image(size, name, {"ball": sphere | {"bsdf": black}}, nothing)
        found = floor_image(size, name, {}, black_ball(count, sphere["radius"]))
        shares = (known.sum() / lit.sum(), found.sum() / lit.sum())
        rows.append((name, *map(float, shares), float(np.abs(found - known).mean() / lit.mean())))
    return rows


def shadow_table(size: int, count: int) -> str:
    """The floor's light below a sphere and below a ball of splats, by lamp."""
    rows = [
        (name, f"{known:.1%}", f"{found:.1%}", f"{difference:.2%}")
        for name, known, found, difference in shadow_rows(size, count)
    ]
    return markdown_table(("lamp", "below a sphere", "below splats", "mean difference"), rows)


def load(
    splats: Gaussians,
    origin: list[float],
    size: int,
    settings: dict,
    objects: dict,
    target: tuple[float, ...] = (0, 0, 0),
    up: tuple[float, ...] = (0, 1, 0),
) -> mi.Scene:
    """A scene of splats and objects."""
    tensors = {k: mi.TensorXf(np.float32(values)) for k, values in vars(splats).items()}
    film = {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}}
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                "type": "perspective",
                "fov": 30,
                "to_world": mi.ScalarTransform4f().look_at(origin, list(target), list(up)),
                "film": film | {"pixel_format": "rgb"},
                "sampler": {"type": "independent", "sample_count": 1},
            },
            "integrator": {"type": "splats", "nested_spp": PATHS, **tensors, **settings},
            **objects,
        }
    )


if __name__ == "__main__":
    main()
