"""Measure what fewer Gaussians cost: merged and fitted, merged, or dropped by a score.

The Gaussians of each fit are reduced without its photographs. The test views are rendered as the
fit renders them, and compared with the photographs. Results: ``decimation.md``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import drgs  # noqa: F401  (registers the integrator)
import drjit as dr
import mitsuba as mi
import numpy as np
from drgs.bench.output import machine, markdown_table
from drgs.export.decimation import decimate
from drgs.export.merging import merge_down
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, make_sensors, render_views
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.io.figures import new_figure, write_figure
from drgs.results import metrics
from drgs.results.model import load_model
from drgs.splatting import rendering

SHARES = (75, 50, 35, 25, 10)  # percent


def contributions(gaussians: Gaussians, scene: mi.Scene, sensors: list[mi.Sensor]) -> np.ndarray:
    """Return the sum of each Gaussian's weights in the images of the sensors: (N,)."""
    splats, found = scene.integrator().state, np.zeros(gaussians.num_gaussians)
    for sensor in sensors:
        with dr.suspend_grad():
            camera = camera_from_sensor(read_sensor(sensor, splats.near))
            frame = rendering.render(splats.gaussians, camera, splats.pipeline)
            ones = dr.opaque(mi.Float, 1, camera.width * camera.height)
            found += np.array(rendering.weighted_sums(frame, ones)[0])
    return found


def curves(folder: Path) -> dict[str, list[float]]:
    """Return the PSNR of the test views in dB, of all Gaussians and for each of SHARES."""
    model = load_model(folder)
    whole, dataset = model.gaussians, model.dataset("FIT_DIR")
    surroundings = model.settings, dataset.background
    scores = {
        "contribution": contributions(whole, model.scene(), make_sensors(dataset.train)),
        "opacity": whole.opacities,
        "opacity times volume": whole.opacities * np.exp(whole.log_scales.sum(axis=1)),
        "random numbers": np.random.default_rng(0).random(whole.num_gaussians),
    }

    def drop(score: np.ndarray, count: int) -> Gaussians:
        return whole[np.sort(np.argsort(-score, kind="stable")[:count])]

    methods = {
        "merged and fitted": lambda n: decimate(whole, n, dataset.train, *surroundings),
        "merged": lambda n: merge_down(whole, n),
        **{f"dropped by {k}": lambda n, score=v: drop(score, n) for k, v in scores.items()},
    }

    def quality(gaussians: Gaussians) -> float:
        images = render_views(make_scene(gaussians, *surroundings), dataset.test)
        pairs = zip(images, dataset.test, strict=True)
        return float(np.mean([metrics.psnr(image, v.image, v.mask) for image, v in pairs]))

    all_of_them, num = quality(whole), whole.num_gaussians
    print(f"\n{folder.name}: {num:,} Gaussians, {all_of_them:.2f} dB\n", flush=True)
    return {
        name: [all_of_them, *(quality(reduce(num * k // 100)) for k in SHARES)]
        for name, reduce in methods.items()
    }


def main() -> None:
    """Print a table for each fit, and draw the curves."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folders", type=Path, nargs="+", metavar="FIT_DIR", help="finished fits")
    parser.add_argument("--out", type=Path, default=Path("out/decimation.png"), help="the figure")
    args = parser.parse_args()
    mi.set_variant("llvm_ad_rgb")
    print(machine())
    figure = new_figure(4.5 * len(args.folders), 3.6)
    panels = figure.subplots(1, len(args.folders), squeeze=False)[0]
    for folder, axes in zip(args.folders, panels, strict=True):
        found = curves(folder)
        rows = [[name, *(f"{v:.2f}" for v in values[1:])] for name, values in found.items()]
        print(markdown_table(["method", *(f"{k} %" for k in SHARES)], rows), flush=True)
        for name, values in found.items():
            axes.plot([100, *SHARES], values, marker=".", label=name)
        axes.set(title=folder.name, xlabel="Gaussians [%]", ylabel="PSNR of test views [dB]")
        axes.set_ylim(top=max(map(max, found.values())) + 1)
    panels[0].legend(fontsize=7)
    write_figure(args.out, figure)


if __name__ == "__main__":
    main()
