"""``python -m drgs.bench hybrid``: what a path-traced object among splats costs.

Pictures of the bench scene in turns: of the splats alone, of a ball and a box under a light by the
nested integrator alone, and of both. The factor is what the splats then cost, by what they cost
alone: what is left of the last time when the second is taken off, over the first.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from drgs.bench.effects import SIZE, perspective, to_world
from drgs.bench.output import add_out, machine, markdown_table, write_csv
from drgs.bench.scenes import bench_camera, bench_gaussians
from drgs.cli.commands import CommandParser
from drgs.gaussians.parameters import PARAMETER_NAMES, Gaussians

COUNTS, QUICK_COUNTS = (10_000, 100_000), (10_000,)

SAMPLES = (1, 4)
"""Per pixel, of the nested integrator. With more, path's time varies by more than splats take."""

ROUNDS, QUICK_ROUNDS = 40, 5


@dataclass(frozen=True)
class Cost:
    """Medians, ms."""

    num_gaussians: int
    nested_spp: int
    splats_ms: float
    nested_ms: float
    hybrid_ms: float
    again_ms: float  # of a second hybrid picture from the same place
    factor: float  # what the splats cost in the hybrid picture, by what they cost alone
    again_factor: float  # the same of the second picture


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.show_examples("%(prog)s --quick")
    add_out(parser, run, "hybrid.csv")
    parser.add_argument("--quick", action="store_true", help="10,000 Gaussians, few rounds")


def run(args: argparse.Namespace) -> None:
    """Measure all counts and numbers of samples; write a table and CSV."""
    mi.set_variant("llvm_ad_rgb")
    counts, rounds = (QUICK_COUNTS, QUICK_ROUNDS) if args.quick else (COUNTS, ROUNDS)
    print(f"{machine()}\nbench scene with a ball and a box, {SIZE}x{SIZE}", flush=True)
    costs = [
        measure(gaussians, samples, rounds)
        for gaussians in map(bench_gaussians, counts)
        for samples in SAMPLES
    ]
    print(f"\n{table(costs)}")
    rows = [list(vars(cost).values()) for cost in costs]
    write_csv(args.out / "hybrid.csv", list(Cost.__dataclass_fields__), rows)
    print(f"\nwritten: {args.out / 'hybrid.csv'}")


def measure(gaussians: Gaussians, samples: int, rounds: int) -> Cost:
    """The three pictures in turns."""
    alone, hybrid = (scene(gaussians, samples, objects) for objects in ({}, _objects()))
    path = mi.load_dict({"type": "path"})
    pictures = {
        "splats": (alone, lambda: alone.integrator().render(alone, spp=1)),
        "nested": (hybrid, lambda: path.render(hybrid, spp=samples)),
        "hybrid": (hybrid, lambda: hybrid.integrator().render(hybrid, spp=1)),
        "again": (hybrid, lambda: hybrid.integrator().render(hybrid, spp=1)),
    }
    times: dict[str, list[float]] = {name: [] for name in pictures}
    for round_ in range(rounds + 2):
        for name, (loaded, picture) in pictures.items():
            # Nothing of the last picture may be used again, but for the last one: it is from the
            # same place as the one before, and only the Gaussians have changed.
            params = mi.traverse(loaded)
            params.set_dirty("integrator.means")
            if name != "again":
                params["sensor.to_world"] = mi.Transform4f(params["sensor.to_world"].matrix + 0)
            params.update()
            dr.eval(params["sensor.to_world"])
            dr.sync_thread()
            started = time.perf_counter()
            dr.eval(picture())
            dr.sync_thread()
            if round_ >= 2:  # the first compile
                times[name].append(1e3 * (time.perf_counter() - started))
    medians = {f"{name}_ms": statistics.median(values) for name, values in times.items()}
    factors = {
        "factor": _factor(times["hybrid"], times["nested"], times["splats"]),
        "again_factor": _factor(times["again"], times["nested"], times["splats"]),
    }
    return Cost(gaussians.num_gaussians, samples, **medians, **factors)


def _factor(both: list[float], nested: list[float], splats: list[float]) -> float:
    """The splats' share in the picture of both over their time alone, from times by round.

    Those of a round were taken within a second: what slows the machine down slows all.
    """
    rests = [b - n for b, n in zip(both, nested, strict=True)]
    return statistics.median(rests) / statistics.median(splats)


def scene(gaussians: Gaussians, samples: int, objects: dict[str, object]) -> mi.Scene:
    """The bench scene with more objects."""
    uploaded = gaussians.to(mi.TensorXf)
    film = {
        "type": "hdrfilm",
        "width": SIZE,
        "height": SIZE,
        "pixel_format": "rgb",
        "rfilter": {"type": "box"},
    }
    sensor = perspective() | {"to_world": to_world(0.0), "film": film}
    integrator = {
        "type": "splats",
        "nested_spp": samples,
        **{name: getattr(uploaded, name) for name in PARAMETER_NAMES},
    }
    return mi.load_dict({"type": "scene", "integrator": integrator, "sensor": sensor, **objects})


def _objects() -> dict[str, object]:
    """A ball and a box in the middle of the splats, and a light above the camera."""
    camera = bench_camera(SIZE)
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


def table(costs: list[Cost]) -> str:
    """As the page of results holds it."""
    header = ["Gaussians", "samples", "splats", "path", "both", "factor", "again", "factor"]
    rows = [
        [
            f"{c.num_gaussians:,}",
            f"{c.nested_spp}",
            *(f"{t:.1f} ms" for t in (c.splats_ms, c.nested_ms, c.hybrid_ms)),
            f"{c.factor:.2f}",
            f"{c.again_ms:.1f} ms",
            f"{c.again_factor:.2f}",
        ]
        for c in costs
    ]
    return markdown_table(header, rows)
