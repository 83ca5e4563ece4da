"""Fit photographs, their cameras treated in turn; takes an hour.

As the folder has them, rendered through the lens that was found; as if the lens did not distort;
undistorted beforehand, as other trainers need it (a folder of COLMAP's, by pycolmap); from random
points instead of those of structure from motion; and with the cameras thrown away and found again
by ``drgs poses``.

A fit is measured on test views as it sees them: of images that were undistorted, and thereby
blurred, on such images. Where its world is that of the folder, it is measured a second time on
the photographs as they were taken, through the lens that they were taken with. Results:
``photographs.md``.
"""

from __future__ import annotations

import os
import resource
import shutil
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import drgs  # noqa: F401  (registers the integrator)
import mitsuba as mi
from drgs.bench.output import machine, markdown_table
from drgs.config.schema import FitConfig
from drgs.core.environment import require_module
from drgs.datasets import load_dataset
from drgs.datasets.colmap import image_folder, require_model
from drgs.datasets.folders import config_for, find_reader
from drgs.fit.report import score
from drgs.gaussians.parameters import Gaussians
from drgs.integrator.scene import make_scene, render_views
from drgs.io.colmap import read_model
from drgs.io.images import image_size, read_image, write_png
from drgs.poses.structure_from_motion import SfmSettings, reconstruct
from drgs.results.folder import load_run_config, own_gaussians
from drgs.results.metrics import mean_of
from fits import add_case_option, fit_words, make_parser

JPEG_QUALITY = 95
"""Quality of the images that undistorting writes."""


@dataclass(frozen=True)
class Case:
    """A treatment of a dataset's cameras."""

    name: str
    prepare: Callable[[FitConfig, Path], Path] = lambda config, folder: config.data.path
    overrides: tuple[str, ...] = ()
    needs_model: bool = False  # of COLMAP
    has_own_world: bool = False  # and not that of the folder


def undistort(config: FitConfig, folder: Path) -> Path:
    """Write the same photographs to ``folder``, at their size, without distortion.

    It has no masks: COLMAP undistorts photographs alone.
    """
    pycolmap = require_module("pycolmap", "colmap", "undistorting")
    _, model = require_model(config.data.path)
    renders = image_folder(config.data, read_model(model))
    found = pycolmap.Reconstruction(str(model))
    sizes = {}
    for image in found.images.values():
        sizes[image.camera_id] = size = image_size(renders / image.name)
        scale = size[0] / found.cameras[image.camera_id].width
        for point in image.points2D:
            point.xy = point.xy * scale
    for number, size in sizes.items():
        found.cameras[number].rescale(*size)
    with tempfile.TemporaryDirectory() as scaled:
        found.write_binary(scaled)
        pycolmap.logging.minloglevel = 2
        pycolmap.undistort_images(folder, scaled, renders, jpeg_quality=JPEG_QUALITY)
    return folder


def find_cameras(config: FitConfig, folder: Path) -> Path:
    """Copy the photographs to ``folder``, and estimate their cameras with ``drgs poses``."""
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
    found = reconstruct(folder, SfmSettings(), True, lambda *_: None)
    count = len(found.names)
    print(f"placed {count} of {count + len(found.missing)}, error {found.error:.2f} px")
    return folder


CASES = (
    Case("as they are"),
    Case("distortion ignored", overrides=("data.ignore_distortion=true",)),
    Case("undistorted beforehand", undistort, needs_model=True),
    Case("from random points", overrides=("init.start=random",)),
    Case("cameras found by drgs poses", find_cameras, has_own_world=True),
)


# ----------------------------------------------------------------------------------------------
# The command
# ----------------------------------------------------------------------------------------------


def psnr_of_test_views(fitted: Path, config: FitConfig) -> float:
    """Return the PSNR of a fit's Gaussians on the dataset's test views."""
    run_config = load_run_config(fitted)
    gaussians = Gaussians.load(own_gaussians(fitted))
    dataset = load_dataset(config.data).relative_to(gaussians.origin)
    if mi.variant() is None:
        mi.set_variant("llvm_ad_rgb")
    scene = make_scene(gaussians, run_config.model, run_config.data.background_rgb)
    pairs = zip(render_views(scene, dataset.test), dataset.test, strict=True)
    return mean_of([score(rendered, view) for rendered, view in pairs]).psnr


def main() -> None:
    """Fit each case; print a table."""
    parser = make_parser(__doc__, "photographs")
    parser.add_argument("data", type=Path, metavar="DIR", help="photographs and their cameras")
    parser.add_argument(
        "--set", dest="overrides", action="append", default=[], metavar="KEY=VALUE",
        help="override a value of the configuration; repeatable",
    )  # fmt: skip
    add_case_option(parser, [case.name for case in CASES])
    args = parser.parse_args()
    config, reasons = config_for(args.data, args.overrides)
    print(reasons)
    rows = []
    for case in (CASES[k - 1] for k in args.only):
        if case.needs_model and find_reader(config.data)[0] != "colmap":
            print(f"{case.name}: left out, as {args.data} has no model of COLMAP")
            continue
        folder = args.out / args.data.resolve().name / case.name.replace(" ", "_")
        shutil.rmtree(folder / "data", ignore_errors=True)
        (folder / "data").mkdir(parents=True)
        data = case.prepare(config, folder / "data")
        overrides = f"data.image_size={config.data.image_size}", *args.overrides, *case.overrides
        words = [str(data), *(word for each in overrides for word in ("--set", each))]
        metrics = fit_words(words, folder / "fit", args.threads)
        name, as_taken = case.name, ""
        if case.has_own_world:
            name += f" ({len(read_model(require_model(data)[1]).images)} placed)"
        else:
            as_taken = f"{psnr_of_test_views(folder / 'fit', config):.2f} dB"
        quality = f"{metrics['test']['psnr']:.2f} dB", f"{metrics['test']['ssim']:.4f}"
        peak = 1024 * resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss  # of all so far
        cost = f"{metrics['num_gaussians']:,}", f"{metrics['wall_s']:.0f} s", f"{peak / 1e9:.2f} GB"
        rows.append([name, *quality, as_taken, *cost])
    header = ["photographs", "PSNR", "SSIM", "as taken", "Gaussians", "time", "memory so far"]
    print(f"\n{machine()}\n\n{markdown_table(header, rows)}")


if __name__ == "__main__":
    main()
