"""Measure the time and the error of light between splats and surfaces.

A fitted model is rendered with a mirror ball behind it, a glossy ring there, and a white plinth
under it that lies in its shadow, each alone; and in the scene of a file, ``scenes/hybrid.xml``.
Each light mode is compared with a reference of many paths by rays, over the object's pixels that no
splats cover. An error is the sum of approximation and noise; with as many paths as the reference,
it is nearly free of noise.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import drgs  # noqa: F401  (registers the integrator)
import drjit as dr
import mitsuba as mi
import numpy as np
from accuracy import add_scene
from drgs.bench.output import machine, markdown_table
from drgs.gaussians.parameters import Gaussians
from drgs.io.figures import new_figure, write_figure
from drgs.io.scenes import load_scene_file
from drgs.results import metrics
from drgs.results.folder import own_gaussians
from fits import SCENES

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PATHS, QUICK_PATHS = (1, 4, 16, 64), (1,)
"""Paths per pixel."""

REFERENCE_PATHS, QUICK_REFERENCE_PATHS = 512, 4
"""Paths per pixel of the reference images."""

MAX_PATHS = 64  # per pixel; more paths are means of several images
SIZE = (300, 200)  # px: width, height

ROUNDS, QUICK_ROUNDS = 5, 1

RING_FILE = Path("shapes/ring.ply")  # relative to the scene file
MIN_TRANSMITTANCE = 0.98  # of splats in front of an object's pixel


@dataclass(frozen=True)
class LightMode:
    """Settings of ``light``."""

    name: str
    settings: dict[str, str]


LIGHT_MODES = (
    LightMode("none", {"light": "none"}),
    LightMode("probe", {"light": "probe"}),
    LightMode("probe, unseen by rays", {"light": "probe", "probe_fallback": "rays"}),
    LightMode("rays", {"light": "rays"}),
)


@dataclass(frozen=True)
class Stage:
    """A model among objects."""

    name: str
    load: Callable[..., mi.Scene]  # by the settings of a way
    subjects: Sequence[str]  # ids of shapes


@dataclass(frozen=True)
class Measurement:
    """One way of passing light, seen on one object."""

    stage: str
    subject: str
    share: float  # of the image's pixels
    light: str
    paths: int
    seconds: float  # of the whole image; median
    factor: float  # times as long as without light
    psnr: float  # dB, against many paths of rays


# ----------------------------------------------------------------------------------------------
# Scenes
# ----------------------------------------------------------------------------------------------


def stages(ply: Path, file: Path) -> list[Stage]:
    """Return a model with one object each, and the scene of a file with its ring."""
    means = np.asarray(Gaussians.load(ply).means)
    low, high = np.quantile(means, [0.02, 0.98], axis=0)
    center, radius = ((low + high) / 2).tolist(), float((high - low).max() / 2)
    T = mi.ScalarTransform4f
    place = T().translate(center).scale(radius)
    objects = {
        "mirror ball": {
            "type": "sphere",
            "to_world": place @ T().translate([-1.15, 0.9, 0.15]).scale(0.5),
            "bsdf": {"type": "conductor", "material": "none"},
        },
        "glossy ring": {
            "type": "ply",
            "filename": str(file.parent / RING_FILE),
            "to_world": place @ T().translate([-1.15, 0.9, 0.15]).rotate([1, 1, 0], 75).scale(0.6),
            "bsdf": {"type": "roughconductor", "material": "Au", "alpha": 0.1},
        },
        "shaded plinth": {
            "type": "rectangle",
            "to_world": T().translate([*center[:2], float(low[2])]).scale(2 * radius),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.8}},
        },
    }

    def load(name: str) -> Callable[..., mi.Scene]:
        def loaded(**settings: str) -> mi.Scene:
            integrator: dict[str, object] = {"filename": str(ply), **settings}
            if settings["light"] == "probe":
                integrator["probes"] = "lamp" if name == "shaded plinth" else name
            return mi.load_dict(_stage(place, integrator) | {name: objects[name] | {"id": name}})

        return loaded

    def load_file(**settings: str) -> mi.Scene:
        size = {"width": str(SIZE[0]), "height": str(SIZE[1])}
        return load_scene_file(file, model=str(ply.resolve()), shadows="", **size, **settings)

    alone = [Stage(ply.parent.name, load(name), [name]) for name in objects]
    return [*alone, Stage(file.stem, load_file, ["ring", "ball", "globe", "plinth"])]


def _stage(place: mi.ScalarTransform4f, integrator: dict[str, object]) -> dict[str, object]:
    """Return the scene without an object: splats, camera, a lamp and the sky."""
    T = mi.ScalarTransform4f
    view = mi.ScalarPoint3f(1.7, -4, 1.7), mi.ScalarPoint3f(0, 0, -0.1)
    film = {"type": "hdrfilm", "width": SIZE[0], "height": SIZE[1], "rfilter": {"type": "box"}}
    return {
        "type": "scene",
        "integrator": {
            "type": "splats",
            "nested": {"type": "splatpath", "max_depth": 8},
            **integrator,
        },
        "sensor": {
            "type": "perspective",
            "fov": 40,
            "to_world": T().look_at(*(place @ point for point in view), [0, 0, 1]),
            "film": film | {"pixel_format": "rgb"},
            "sampler": {"type": "multijitter", "sample_count": 1},
        },
        "lamp": {
            "type": "rectangle",
            "id": "lamp",
            "to_world": place @ T().look_at([-2, -3, 5], [0, 0, 0], [0, 0, 1]).scale(0.6),
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": 40.0}},
        },
        "sky": {"type": "constant", "radiance": {"type": "rgb", "value": 0.4}},
    }


def mask_of(scene: mi.Scene, name: str) -> np.ndarray:
    """Return (H, W) bool: pixels whose centre shows a shape that no splats cover."""
    from drgs.integrator.light.rays import PathSegment
    from drgs.integrator.light.splat_transport import RayTransport

    sensor, integrator = scene.sensors()[0], scene.integrator()
    width, height = sensor.film().crop_size()
    index = dr.arange(mi.UInt32, width * height)
    x, y = index % width, index // width
    place = mi.Point2f((mi.Float(x) + 0.5) / width, (mi.Float(y) + 0.5) / height)
    ray, _ = sensor.sample_ray(0.0, 0.5, place, mi.Point2f(0.5))
    hit = scene.ray_intersect_preliminary(ray)
    shape = next(shape for shape in scene.shapes() if shape.id() == name)
    ray.maxt = dr.select(hit.is_valid(), hit.t, dr.inf)
    segment = PathSegment(
        ray, hit.shape, hit.shape.emitter(), mi.Float(dr.inf), is_open=mi.Bool(False)
    )
    T = RayTransport.from_splats(integrator.state).transmittance(
        segment, mi.Float(0), mi.Bool(True)
    )
    shows = hit.is_valid() & (hit.shape == mi.ShapePtr(shape)) & (T > MIN_TRANSMITTANCE)
    return np.array(shows).reshape(height, width)


# ----------------------------------------------------------------------------------------------
# Measuring
# ----------------------------------------------------------------------------------------------


def measure(
    stage: Stage, paths: Sequence[int], many: int, rounds: int
) -> tuple[list[Measurement], list[tuple[str, list[np.ndarray]]]]:
    """Measure all light modes and numbers of paths in turns; return also each object's images.

    The last number of paths is the reference's, with a different seed.
    """
    scenes = {way.name: stage.load(**way.settings) for way in LIGHT_MODES}
    accurate = _mean(scenes["rays"], many, first=1000)
    masks = {name: mask_of(scenes["none"], name) for name in stage.subjects}
    results, shown = [], {name: [] for name in stage.subjects}
    for n in (*paths, many):
        seconds = _times(scenes, n, rounds)
        for way, scene in scenes.items():
            image = _mean(scene, n, first=0)
            for name, mask in masks.items():
                error = metrics.psnr(image, accurate, mask.astype(np.float64))
                factor = seconds[way] / seconds["none"]
                results.append(
                    Measurement(stage.name, name, mask.mean(), way, n, seconds[way], factor, error)
                )
                if n == many:
                    shown[name].append(_crop(image, mask))
    return results, [(f"{stage.name}: {name}", images) for name, images in shown.items()]


def _image(scene: mi.Scene, paths: int, seed: int) -> mi.TensorXf:
    """Render (H, W, 3), linear."""
    scene.integrator().nested_spp = paths
    return mi.render(scene, seed=seed)


def _mean(scene: mi.Scene, paths: int, first: int) -> np.ndarray:
    """Return the mean (H, W, 3) of images with ``paths`` in total, display space."""
    seeds, each = (
        range(first, first + max(1, paths // MAX_PATHS)),
        min(paths, MAX_PATHS),
    )
    linear = np.mean([np.array(_image(scene, each, seed)) for seed in seeds], axis=0)
    return np.array(mi.math.linear_to_srgb(mi.Float(linear.ravel()))).reshape(linear.shape)


def _times(scenes: dict[str, mi.Scene], paths: int, rounds: int) -> dict[str, float]:
    """Return median seconds of an image by light mode, timed in turns."""
    each, spent = min(paths, MAX_PATHS), {name: [] for name in scenes}
    for scene in scenes.values():
        for _ in range(2):  # compiles the kernels of the first image, and of others
            _seconds(scene, each)
    for _ in range(rounds if each < MAX_PATHS else 1):
        for name, scene in scenes.items():
            spent[name].append(_seconds(scene, each))
    return {name: statistics.median(s) * max(1, paths // each) for name, s in spent.items()}


def _seconds(scene: mi.Scene, paths: int) -> float:
    """Time an image after a camera update, which clears the render cache."""
    params = mi.traverse(scene.sensors()[0])
    params["to_world"] = mi.Transform4f(params["to_world"].matrix + dr.opaque(mi.Float, 0))
    params.update()
    dr.eval(params["to_world"])
    dr.sync_thread()
    started = time.perf_counter()
    dr.eval(_image(scene, paths, 0))
    dr.sync_thread()
    return time.perf_counter() - started


def _crop(image: np.ndarray, mask: np.ndarray, border: int = 8) -> np.ndarray:
    """To what surrounds a mask."""
    rows, columns = (np.nonzero(mask.any(axis=axis))[0] for axis in (1, 0))
    return image[
        max(rows[0] - border, 0) : rows[-1] + border,
        max(columns[0] - border, 0) : columns[-1] + border,
    ]


# ----------------------------------------------------------------------------------------------
# Output
# ----------------------------------------------------------------------------------------------


def table(results: Sequence[Measurement]) -> str:
    """Format times, relative to those without light, and errors."""
    counts = sorted({m.paths for m in results})
    header = ["object, pixels", "light", *(f"{n} paths" for n in counts)]
    rows = []
    for subject in dict.fromkeys(m.subject for m in results):
        for way in LIGHT_MODES:
            found = {m.paths: m for m in results if (m.subject, m.light) == (subject, way.name)}
            cells = [
                f"{m.factor:.2f}x, {m.psnr:.1f} dB"
                for n, m in sorted(found.items())
                if n != counts[-1]
            ]
            last = found[counts[-1]]
            rows.append([f"{subject}, {last.share:.0%}", way.name, *cells, f"{last.psnr:.1f} dB"])
    return markdown_table(header, rows)


def plot(results: Sequence[Measurement]) -> Figure:
    """Error over time, one panel an object."""
    panels = list(dict.fromkeys((m.stage, m.subject) for m in results))
    figure = new_figure(11, 3.2 * -(-len(panels) // 4))
    axes = figure.subplots(-(-len(panels) // 4), 4, squeeze=False).ravel()
    for axis, panel in zip(axes, panels, strict=False):
        for way in LIGHT_MODES:
            found = [m for m in results if (m.stage, m.subject) == panel and m.light == way.name]
            axis.plot([m.seconds for m in found], [m.psnr for m in found], ".-", label=way.name)
        axis.set_xscale("log")
        axis.set_title(": ".join(panel), fontsize=9)
        axis.set_xlabel("seconds per image")
        axis.grid(alpha=0.3)
    for axis in axes[len(panels) :]:
        axis.axis("off")
    axes[0].set_ylabel("PSNR against rays [dB]")
    axes[0].legend(fontsize=7)
    return figure


def show(images: Sequence[tuple[str, list[np.ndarray]]]) -> Figure:
    """A row an object: by each way, and four times the error of all but the last."""
    names = [way.name for way in LIGHT_MODES]
    titles = [*names, *(f"error x4: {name}" for name in names[:-1])]
    figure = new_figure(2 * len(titles), 1.6 * len(images))
    axes = figure.subplots(len(images), len(titles), squeeze=False)
    for row, (name, by_way) in zip(axes, images, strict=True):
        errors = [4 * np.abs(image - by_way[-1]) for image in by_way[:-1]]
        for axis, image in zip(row, [*by_way, *errors], strict=True):
            axis.imshow(np.clip(image, 0, 1), interpolation="nearest")
            axis.set_xticks([])
            axis.set_yticks([])
        row[0].set_ylabel(name, fontsize=7)
    for axis, title in zip(axes[0], titles, strict=True):
        axis.set_title(title, fontsize=8)
    return figure


def main() -> None:
    """Measure all stages; write a plot and images."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    add_scene(parser)
    parser.add_argument("--quick", action="store_true", help="few paths and rounds")
    parser.add_argument("--out", type=Path, default=Path("out/studies/light"))
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    path = Path(args.scene)
    ply = own_gaussians(path) if path.is_dir() else path
    counts = (
        (QUICK_PATHS, QUICK_REFERENCE_PATHS, QUICK_ROUNDS)
        if args.quick
        else (PATHS, REFERENCE_PATHS, ROUNDS)
    )
    results: list[Measurement] = []
    images: list[tuple[str, list[np.ndarray]]] = []
    for stage in stages(ply, SCENES / "hybrid.xml"):
        found, shown = measure(stage, *counts)
        results += found
        images += shown
        print(f"\n{table(found)}", flush=True)
    args.out.mkdir(parents=True, exist_ok=True)
    write_figure(args.out / "light.png", plot(results))
    write_figure(args.out / "light_images.png", show(images))
    print(f"\n{machine()}; plot and images: {args.out}")


if __name__ == "__main__":
    main()
