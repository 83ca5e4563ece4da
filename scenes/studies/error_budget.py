"""Does an error budget keep its word, what does it save, and what would an oracle save?

For 46 views of each scene, ``drgs.accuracy.error_budget`` chooses approximations. They are judged
at the 40 views that it has not measured, against the most accurate image: a window of 64 splats,
and almost no cut-offs. The oracle has the errors of all combinations at some of these views, and
takes the cheapest one that is within the budget in 95 % of them.

Scenes: the shipped truck; fits and files that the command line names; a dense scene, needles, and a
wide lens (``accuracy.py``).
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import drgs
import drjit as dr
import mitsuba as mi
import numpy as np
from accuracy import stress_scene
from drgs.accuracy import error_budget as budgets
from drgs.bench.output import machine, markdown_table
from drgs.bench.scenes import bench_gaussians, device_camera
from drgs.cameras.camera import Camera
from drgs.cameras.orbits import orbit_of_gaussians
from drgs.cameras.viewpoints import FIELD_OF_VIEW
from drgs.config.approximations import Approximations
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.error_budget import renderer_of
from drgs.integrator.scene import make_sensors
from drgs.integrator.sensors import camera_from_sensor, read_sensor
from drgs.results.model import load_model

BUDGETS = (0.01, 0.005, 0.003, 0.002)
NUM_VIEWS = 46
ORACLE_VIEWS = 4  # of those judged, on which all combinations are rendered
TRUTH = {"order": "pixel", "order_window": 64, "sh_direction": "pixel"}
TRUTH |= {"alpha_cut": 1e-6, "transmittance_stop": 1e-8}
UP = (0.0, 0.0, 1.0)


@dataclass(frozen=True)
class Subject:
    """Gaussians, and the views for which approximations are chosen."""

    name: str
    gaussians: Gaussians  # on the device
    cameras: list[Camera]
    given: Approximations
    background: tuple[float, float, float]

    @property
    def judged_at(self) -> list[Camera]:
        """The views that are not measured."""
        camera = self.cameras[0]
        pixels = camera.width * camera.height
        measured = set(budgets.measured_places(len(self.cameras), pixels))
        return [one for k, one in enumerate(self.cameras) if k not in measured]


def of_fit(path: Path) -> Subject:
    """Return a fit, seen from its photographs' cameras."""
    model = load_model(path)
    dataset = model.dataset("error budget")
    views = [*dataset.train, *dataset.test]
    views = [views[int(k)] for k in np.linspace(0, len(views) - 1, NUM_VIEWS)]
    near = model.settings.near_plane
    cameras = [camera_from_sensor(read_sensor(one, near)) for one in make_sensors(views)]
    on_device, given = model.gaussians.to(mi.TensorXf), model.settings.approximations
    return Subject(path.name, on_device, cameras, given, model.background)


def of_gaussians(name: str, gaussians: Gaussians) -> Subject:
    """Return Gaussians seen from an orbit."""
    orbit = orbit_of_gaussians(gaussians, np.array(UP), FIELD_OF_VIEW)
    sensors = make_sensors(orbit.viewpoints(NUM_VIEWS, 400, 400, FIELD_OF_VIEW))
    cameras = [camera_from_sensor(read_sensor(one, 0.01)) for one in sensors]
    return Subject(name, gaussians.to(mi.TensorXf), cameras, Approximations(), (0, 0, 0))


def of_wide_lens() -> Subject:
    """Return the stress scene, seen from near its camera."""
    gaussians, (camera, *_) = stress_scene(400)
    rng, cameras = np.random.default_rng(0), []
    for _ in range(NUM_VIEWS):
        moved = replace(camera, center=camera.center + rng.normal(0, 0.15, 3))
        cameras.append(device_camera(moved, mi.Float))
    return Subject("wide lens", gaussians.to(mi.TensorXf), cameras, Approximations(), (0, 0, 0))


def needles() -> Gaussians:
    """Return Gaussians that are 32 times as long as they are wide."""
    gaussians = bench_gaussians(20_000)
    longer = np.log([8.0, 0.25, 0.25], dtype=np.float32)
    return replace(gaussians, log_scales=gaussians.log_scales + longer)


def subjects(paths: list[Path]) -> Iterator[Subject]:
    """Yield all scenes."""
    yield of_gaussians("shipped truck", Gaussians.load(drgs.EXAMPLE))
    for path in paths:
        yield of_fit(path) if path.is_dir() else of_gaussians(path.stem, Gaussians.load(path))
    yield of_gaussians("dense", bench_gaussians(100_000))
    yield of_gaussians("needles", needles())
    yield of_wide_lens()


def study(subject: Subject) -> list[list[str]]:
    """Return a row of the table for each budget."""
    degree = subject.gaussians.sh_degree
    renderer = renderer_of(subject.gaussians, subject.given, degree, subject.background)
    judged = subject.judged_at
    projections = budgets.projections(judged)
    best = projections[-1].changes
    truths = [renderer.image(camera, best, TRUTH) for camera in judged]
    most_accurate = {**best, **budgets.WINDOWED[-1].changes, **budgets.DIRECTIONS[-1].changes}
    slow = seconds(renderer, judged[0], most_accurate | budgets.FINEST_CUT_OFFS)

    def errors(changes: budgets.Changes, count: int) -> np.ndarray:
        step = len(judged) // count
        pairs = zip(judged[::step], truths[::step], strict=True)
        found = [np.mean((renderer.image(one, changes) - truth) ** 2) for one, truth in pairs]
        return np.sqrt(found)

    oracle = _oracle(projections, lambda changes: errors(changes, ORACLE_VIEWS))
    rows = []
    for budget in BUDGETS:
        cheapest = min((cost for cost, error in oracle if error <= budget), default=math.nan)
        started = time.perf_counter()
        try:
            report = budgets.Search(renderer, subject.cameras, budget).choose(budget)
        except ValueError as refusal:
            rows.append([subject.name, f"{budget:g}", str(refusal), "", "", "", ""])
            continue
        searched = time.perf_counter() - started
        found = errors(report.chosen.changes, len(judged))
        spent = seconds(renderer, judged[0], report.chosen.changes)
        rows.append(
            [
                subject.name,
                f"{budget:g}",
                report.chosen.words,
                f"{(found <= budget).sum()} of {len(found)}",
                f"{found.max() / budget:.2f}",
                f"{slow / spent:.1f}x",
                f"{report.chosen.cost / cheapest:.2f}x",
                f"{searched:.1f} s",
            ]
        )
        print(rows[-1], flush=True)
    return rows


def seconds(renderer: budgets.Renderer, camera: Camera, changes: budgets.Changes) -> float:
    """Return the time of an image at one time of the shutter, the least of three."""
    changes, times = {k: v for k, v in changes.items() if k != budgets.SAMPLES}, []
    for _ in range(3):
        started = time.perf_counter()
        renderer.image(camera, changes)
        times.append(time.perf_counter() - started)
    return min(times)


def _oracle(
    projections: tuple[budgets.Level, ...], errors: Callable[[budgets.Changes], np.ndarray]
) -> list[tuple[float, float]]:
    """Return cost and error, which most views do not exceed, of all combinations."""
    orders, found = (budgets.CENTER, *budgets.WINDOWED), []
    for levels in product(projections, orders, budgets.DIRECTIONS, budgets.CUT_OFFS):
        changes = {k: v for level in levels for k, v in level.changes.items()}
        cost = math.prod(level.factor(changes["order"] != "center") for level in levels)
        found.append((cost, float(np.quantile(errors(changes), 0.95))))
    return found


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("paths", nargs="*", type=Path, help="folders of fits, files of Gaussians")
    args = parser.parse_args(arguments)
    mi.set_variant("llvm_ad_rgb")
    header = ["scene", "budget", "chosen", "views within", "worst error / budget"]
    header += ["faster than the most accurate", "cost / oracle's", "search"]
    with dr.suspend_grad():
        rows = [row for subject in subjects(args.paths) for row in study(subject)]
    print(f"{machine()}\n\n{markdown_table(header, rows)}")


if __name__ == "__main__":
    main()
