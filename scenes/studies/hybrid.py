"""Measure what a path-traced object among splats costs.

Images of the bench scene in turns: of the splats alone, of a ball and a box under a light by the
nested integrator alone, and of both. The factor is the splats' share in the time of both (that time
without the nested integrator's), divided by their time alone.
"""

from __future__ import annotations

import argparse
import statistics

import drgs  # noqa: F401  (registers the integrator)
import drjit as dr
import mitsuba as mi
from drgs.bench.output import machine, markdown_table, seconds
from drgs.bench.scenes import bench_camera, bench_gaussians, mitsuba_sensor
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians

IMAGE_SIZE_PX = 400

SAMPLES = (1, 4)
"""Per pixel, of the nested integrator. With more, its time varies by more than splats take."""


def measure(gaussians: Gaussians, samples: int, size: int, rounds: int) -> list[float]:
    """Return median milliseconds of the images, and the factor."""
    alone, both = (make_scene(gaussians, samples, size, o) for o in ({}, make_objects()))
    path = mi.load_dict({"type": "path"})
    images = {
        "splats": (alone, lambda: alone.integrator().render(alone, spp=1)),
        "nested": (both, lambda: path.render(both, spp=samples)),
        "both": (both, lambda: both.integrator().render(both, spp=1)),
        "again": (both, lambda: both.integrator().render(both, spp=1)),
    }
    times: dict[str, list[float]] = {name: [] for name in images}

    def render(image: object) -> None:
        dr.eval(image())
        dr.sync_thread()

    for turn in range(rounds + 2):
        for name, (scene, image) in images.items():
            # Nothing of the last image may be used again, but for the last one: it is from the
            # same place as the one before, and only the Gaussians have changed.
            params = mi.traverse(scene)
            params.set_dirty("integrator.means")
            if name != "again":
                params["sensor.to_world"] = mi.Transform4f(params["sensor.to_world"].matrix + 0)
            params.update()
            dr.eval(params["sensor.to_world"])
            dr.sync_thread()
            spent = 1e3 * seconds(lambda image=image: render(image))
            if turn >= 2:  # the first compile
                times[name].append(spent)
    medians = {name: statistics.median(values) for name, values in times.items()}
    # The images of a round were rendered within a second: other load slows all of them.
    rests = (b - n for b, n in zip(times["both"], times["nested"], strict=True))
    return [*medians.values(), statistics.median(rests) / medians["splats"]]


def make_scene(
    gaussians: Gaussians, samples: int, size: int, objects: dict[str, object]
) -> mi.Scene:
    """Load the bench scene with more objects."""
    uploaded = gaussians.to(mi.TensorXf)
    integrator = {
        "type": "splats",
        "nested_spp": samples,
        **{name: getattr(uploaded, name) for name in PARAMETER_NAMES},
    }
    sensor = mitsuba_sensor(bench_camera(size))
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **objects})


def make_objects() -> dict[str, object]:
    """Return a ball and a box amid the splats, and a light above the camera."""
    camera = bench_camera(IMAGE_SIZE_PX)
    transform = mi.ScalarTransform4f
    middle = camera.center + 4 * camera.rotation[2]
    light = list(camera.center - 3 * camera.rotation[1])
    return {
        "ball": {
            "type": "sphere",
            "to_world": transform().translate(list(middle)).scale(0.6),
            "bsdf": {"type": "roughconductor"},
        },
        "box": {
            "type": "cube",
            "to_world": transform().translate(list(middle - 0.9 * camera.rotation[0])).scale(0.3),
            "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.7, 0.2, 0.1]}},
        },
        "light": {
            "type": "sphere",
            "to_world": transform().translate(light).scale(0.5),
            "emitter": {"type": "area", "radiance": 30.0},
        },
    }


def main() -> None:
    """Measure two numbers of Gaussians."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--gaussians", type=int, nargs="+", default=[10_000, 100_000])
    parser.add_argument("--size", type=int, default=IMAGE_SIZE_PX, metavar="PX")
    parser.add_argument("--rounds", type=int, default=40, metavar="N")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    rows = []
    for count in args.gaussians:
        for samples in SAMPLES:
            found = measure(bench_gaussians(count), samples, args.size, args.rounds)
            *times, factor = found
            rows.append([f"{count:,}", samples, *(f"{t:.1f} ms" for t in times), f"{factor:.2f}"])
    header = ["Gaussians", "paths a pixel", "splats", "path", "both", "again", "factor"]
    print(f"{machine()}\n\n{markdown_table(header, rows)}")


if __name__ == "__main__":
    main()
