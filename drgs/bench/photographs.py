"""``python -m drgs.bench photographs DIR``: fits of photographs, their cameras treated in turn.

As the folder has them, rendered through the lens that was found; as if the lens did not distort;
undistorted beforehand, as other trainers need it (a folder of COLMAP's, by pycolmap); from random
points instead of those of structure from motion; and with the cameras thrown away and found again
by ``drgs poses``. Each fit is a run of ``drgs fit`` in a process and a folder of its own. Finished
ones are not repeated.

A fit is measured on test views as it sees them: of pictures that were undistorted, and thereby
blurred, on such pictures. Where its world is that of the folder, it is measured a second time on
the photographs as they were taken, through the lens that they were taken with.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import multiprocessing
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

import mitsuba as mi

from drgs import fit
from drgs.bench.output import add_out, machine, markdown_table, write_csv
from drgs.cli.commands import CommandParser, at_least, file_or_folder
from drgs.config.schema import FitConfig
from drgs.core.environment import required
from drgs.core.files import atomic_path
from drgs.datasets import layout_name, load_dataset
from drgs.datasets.colmap import model_folder, picture_folder
from drgs.datasets.folders import config_for
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, render_views
from drgs.io.colmap import read_model
from drgs.io.pictures import image_size, read_image, write_png
from drgs.poses.structure_from_motion import Search, place
from drgs.results.files import GAUSSIANS, METRICS
from drgs.results.folder import load_run_config
from drgs.results.metrics import mean_of
from drgs.results.report import score

FOLDER = "photographs"
NAMES = ("photographs.csv",)

MEASURED = "measured.json"
"""Beside the folder of each fit that has ended."""

QUALITY = 95
"""Of the JPEGs that undistorting writes."""


@dataclass(frozen=True)
class Case:
    """What a fit sees."""

    name: str
    prepare: Callable[[FitConfig, Path], Path] = lambda config, folder: config.data.path
    overrides: tuple[str, ...] = ()
    needs_model: bool = False  # of COLMAP
    has_own_world: bool = False  # and not that of the folder


@dataclass(frozen=True)
class Measured:
    """A fit that has ended."""

    case: str
    psnr: float  # dB, test views as the fit sees them
    ssim: float
    psnr_as_taken: float | None  # dB, test views as they were taken; None: in another world
    gaussians: int
    iterations: int
    wall_s: float  # of all iterations
    peak_bytes: int  # of the process
    placed: int | None = None  # photographs whose cameras were found again; None: as the folder has


# ----------------------------------------------------------------------------------------------
# What fits see
# ----------------------------------------------------------------------------------------------


def undistorted(config: FitConfig, folder: Path) -> Path:
    """A dataset in ``folder`` of the same photographs, at their size, without distortion.

    It has no masks: COLMAP undistorts photographs alone.
    """
    pycolmap = required("pycolmap", "colmap", "undistorting")
    model = model_folder(config.data.path)
    pictures = picture_folder(config.data, read_model(model))
    found = pycolmap.Reconstruction(str(model))
    sizes = {}
    for image in found.images.values():
        sizes[image.camera_id] = size = image_size(pictures / image.name)
        scale = size[0] / found.cameras[image.camera_id].width
        for point in image.points2D:
            point.xy = point.xy * scale
    for number, size in sizes.items():
        found.cameras[number].rescale(*size)
    with tempfile.TemporaryDirectory() as scaled:
        found.write_binary(scaled)
        pycolmap.logging.minloglevel = 2
        pycolmap.undistort_images(folder, scaled, pictures, jpeg_quality=QUALITY)
    return folder


def placed_again(config: FitConfig, folder: Path) -> Path:
    """A dataset in ``folder`` of the same photographs, whose cameras are found from them alone."""
    dataset = load_dataset(config.data)
    found = [view.files for view in (*dataset.train, *dataset.test)]
    common = os.path.commonpath([files["image"].parent for files in found])
    for files in found:
        name = files["image"].relative_to(common)
        target = folder / "images" / name
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(files["image"], target)
        if "mask" in files:
            mask = folder / "masks" / f"{name}.png"
            mask.parent.mkdir(parents=True, exist_ok=True)
            write_png(mask, read_image(files["mask"])[:, :, :3])
    placed = place(folder, Search(), True, lambda *_: None)
    count = len(placed.names)
    print(f"placed {count} of {count + len(placed.missing)}, error {placed.error:.2f} px")
    return folder


CASES = (
    Case("as they are"),
    Case("distortion ignored", overrides=("data.ignore_distortion=true",)),
    Case("undistorted beforehand", undistorted, needs_model=True),
    Case("from random points", overrides=("init.start=random",)),
    Case("cameras found by drgs poses", placed_again, has_own_world=True),
)


# ----------------------------------------------------------------------------------------------
# The command
# ----------------------------------------------------------------------------------------------


def add_arguments(parser: CommandParser) -> None:
    """Add the arguments of the command."""
    parser.show_examples("%(prog)s DIR", "%(prog)s DIR --only 1 5 --set iterations=1000")
    add_out(parser, run, *(f"{FOLDER}/{name}" for name in NAMES))
    parser.add_argument("data", type=file_or_folder, metavar="DIR", help="a dataset of photographs")
    parser.add_argument(
        "--only", type=int, nargs="+", metavar="K", choices=range(1, len(CASES) + 1),
        help="; ".join(f"{k}: {case.name}" for k, case in enumerate(CASES, 1)),
    )  # fmt: skip
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE",
        help="override a value of the configurations; repeatable",
    )  # fmt: skip
    parser.add_argument("--threads", type=at_least(1), metavar="N", help="(default: one a core)")


def run(args: argparse.Namespace) -> None:
    """Fit what is asked for and not finished; a table and CSV of it."""
    out = args.out / FOLDER
    config, reasons = config_for(args.data, args.overrides)
    print(reasons)
    has_model = layout_name(config.data) == "colmap"
    cases = [CASES[k - 1] for k in args.only or range(1, len(CASES) + 1)]
    measured = []
    for case in cases:
        if case.needs_model and not has_model:
            print(f"{case.name}: left out, as {args.data} has no model of COLMAP")
            continue
        folder = folder_of_fits(out, config) / case.name.replace(" ", "_")
        measured.append(measure(case, config, folder, args))
    print(f"\n{machine()}\n\n{table(measured)}\n")
    path = out / NAMES[0]
    write_csv(path, list(Measured.__dataclass_fields__), [vars(m).values() for m in measured])
    print(f"written: {path}")


def folder_of_fits(out: Path, config: FitConfig) -> Path:
    """Another one for each dataset and each value of the configuration."""
    data = config.data.path.resolve()
    told = json.dumps([str(data), config.model_dump(mode="json")], sort_keys=True)
    return out / data.name / f"{config.iterations}-{hashlib.sha256(told.encode()).hexdigest()[:8]}"


def measure(case: Case, config: FitConfig, folder: Path, args: argparse.Namespace) -> Measured:
    """Of a fit in ``folder``, unless it is finished."""
    path = folder / MEASURED
    if path.is_file():
        return Measured(**json.loads(path.read_text()))
    print(f"\n{case.name}", flush=True)
    shutil.rmtree(folder / "data", ignore_errors=True)
    (folder / "data").mkdir(parents=True)
    data = case.prepare(config, folder / "data")
    size = f"data.image_size={config.data.image_size}"
    words = [word for each in (size, *args.overrides, *case.overrides) for word in ("--set", each)]
    words += ["--threads", str(args.threads)] if args.threads is not None else []
    peak = fit_in_own_process([str(data), "--out", str(folder / "fit"), *words])
    as_taken = None if case.has_own_world else measured_as_taken(folder / "fit", config)
    metrics = json.loads((folder / "fit" / METRICS).read_text())
    measured = Measured(
        case=case.name,
        psnr=metrics["test"]["psnr"],
        ssim=metrics["test"]["ssim"],
        psnr_as_taken=as_taken,
        gaussians=metrics["num_gaussians"],
        iterations=metrics["iterations"],
        wall_s=metrics["wall_s"],
        peak_bytes=peak,
        placed=len(read_model(model_folder(data)).images) if case.has_own_world else None,
    )
    with atomic_path(path) as temporary:
        temporary.write_text(json.dumps(asdict(measured), indent=2) + "\n")
    return measured


def fit_in_own_process(arguments: list[str]) -> int:
    """Run ``drgs fit``; see :func:`_fitted`."""
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        return pool.submit(_fitted, arguments).result()


def _fitted(arguments: list[str]) -> int:
    """Bytes that the process had, at most; not those of its parent, which ``getrusage`` counts."""
    fit.main(arguments)
    lines = Path("/proc/self/status").read_text().splitlines()
    peak = next(line for line in lines if line.startswith("VmHWM:"))
    return 1024 * int(peak.split()[1])


def measured_as_taken(fitted: Path, config: FitConfig) -> float:
    """dB of the test views of the dataset that ``config`` names, by the Gaussians of a fit."""
    run_config = load_run_config(fitted)
    gaussians = Gaussians.load(fitted / GAUSSIANS)
    dataset = load_dataset(config.data).relative_to(gaussians.origin)
    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    scene = make_scene(gaussians, run_config.model, run_config.data.background_rgb)
    pairs = zip(render_views(scene, dataset.test), dataset.test, strict=True)
    return mean_of([score(picture, view) for picture, view in pairs]).psnr


def table(measured: Sequence[Measured]) -> str:
    """A row for each fit."""
    header = ["photographs", "PSNR", "SSIM", "as taken", "Gaussians", "time", "memory"]
    rows = [
        [
            each.case + ("" if each.placed is None else f" ({each.placed} placed)"),
            f"{each.psnr:.2f} dB",
            f"{each.ssim:.4f}",
            "" if each.psnr_as_taken is None else f"{each.psnr_as_taken:.2f} dB",
            f"{each.gaussians:,}",
            f"{each.wall_s:.0f} s",
            f"{each.peak_bytes / 1e9:.2f} GB",
        ]
        for each in measured
    ]
    return markdown_table(header, rows)
