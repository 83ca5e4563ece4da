"""One scene file by two integrators: ``python scenes/compare_shapes.py [MODEL.ply] [--out FILE]``.

Renders ``scenes/shapes.xml`` with Mitsuba's ``volprim_rf_basic`` and with ``splats``, and writes
the two images side by side under their times: the median of several renderings after a first one,
which compiles. Without a model, that of the scene: ``scenes/knot.py``.
"""

from __future__ import annotations

import argparse
import statistics
import time
from dataclasses import dataclass
from pathlib import Path

import drgs  # noqa: F401  (registers the plugin)
import drjit as dr
import mitsuba as mi
import numpy as np
from drgs.bench.output import machine
from drgs.cameras.orbits import orbit_of_gaussians
from drgs.cli.commands import bounded_int
from drgs.cli.ending import exit_on_user_error
from drgs.gaussians.parameters import Gaussians
from drgs.io.figures import new_figure, write_figure
from drgs.io.images import to_uint8
from drgs.results import metrics

SCENE = Path(__file__).parent / "shapes.xml"

REPEATS = {"volprim_rf_basic": 5, "splats": 25}

FIELD_OF_VIEW = 40.0
"""Degrees: the scene file's."""


@dataclass(frozen=True)
class Result:
    """The results of one integrator."""

    image: np.ndarray  # (H, W, 3) display space
    seconds: float  # the median


def main() -> None:
    """Entry point of the command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("model", type=Path, nargs="?", metavar="MODEL.ply")
    parser.add_argument("--size", type=bounded_int(1), default=400, help="px (default: 400)")
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/shapes.png"),
        metavar="FILE.png",
        help="(default: %(default)s)",
    )
    args = parser.parse_args()
    with exit_on_user_error():
        mi.set_variant("llvm_ad_rgb")
        settings = {"size": str(args.size)}
        if args.model is not None:
            settings |= view_of(args.model)
        results = {name: measure(name, settings) for name in REPEATS}
    first, second = results.values()
    print(machine())
    for name, result in results.items():
        print(f"{name}: {result.seconds * 1e3:.4g} ms")
    print(f"ratio of the times: {first.seconds / second.seconds:.3g}")
    print(f"difference of the images: {metrics.psnr(second.image, first.image):.2f} dB")
    draw(args.out, results)
    print(f"written: {args.out}")


def view_of(model: Path) -> dict[str, str]:
    """Parameters of the scene file that show all of a model from the front, z up."""
    orbit = orbit_of_gaussians(Gaussians.load(model), np.array([0.0, 0.0, 1.0]), FIELD_OF_VIEW)
    center = orbit.viewpoints(1, 1, 1, FIELD_OF_VIEW)[0].camera_to_world[:3, 3]
    points = {"origin": center, "target": orbit.focus}
    return {
        "model": str(model.resolve()),
        **{name: ", ".join(map(str, point)) for name, point in points.items()},
    }


def measure(integrator: str, settings: dict[str, str]) -> Result:
    """Load the scene with one integrator and render it several times."""
    scene = mi.load_file(str(SCENE), integrator=integrator, **settings)
    image = mi.render(scene)
    dr.eval(image)
    times = []
    for _ in range(REPEATS[integrator]):
        scene.integrator().parameters_changed([])  # no frame of an earlier call is used again
        dr.sync_thread()
        start = time.perf_counter()
        image = mi.render(scene)
        dr.eval(image)
        dr.sync_thread()
        times.append(time.perf_counter() - start)
    encoded = mi.math.linear_to_srgb(mi.Float(image.array))
    return Result(np.array(encoded, np.float64).reshape(image.shape), statistics.median(times))


def draw(path: Path, results: dict[str, Result]) -> None:
    """Write the images side by side."""
    figure = new_figure(7.6, 4.1)
    for axes, (name, result) in zip(figure.subplots(1, len(results)), results.items(), strict=True):
        axes.imshow(to_uint8(result.image), interpolation="none")
        axes.set_title(f"{name}: {words(result.seconds)}")
        axes.set_axis_off()
    write_figure(path, figure)


def words(seconds: float) -> str:
    """A time with two or three digits."""
    return f"{seconds:.2f} s" if seconds >= 1 else f"{seconds * 1e3:.0f} ms"


if __name__ == "__main__":
    main()
